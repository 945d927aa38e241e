"""Calibrate a scanner and its clock from frames in motion: one function for recorded and live frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.motion_dataset import load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, pose_records, software_version, statistics, tilt_summary
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.planning.observability import turn_deg
from weldcal.models.robots import stated_flange

_TURN_DEG = 3.0  # orientations closer than this are one orientation to a calibration
_MOST_TURNED = 50  # poses whose orientations are compared


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedMotion:
    """The contents of calibration.yaml and what led to them.

    ``refused``: id and reason of each frame that is not used; ``outliers`` are those whose centre disagrees.
    """

    result: CalibrationResult
    estimate: MotionEstimate
    frames: ObservedFrames
    refused: tuple[tuple[str, str], ...]
    outliers: tuple[str, ...]


def calibrate_frames(
    frames: ObservedFrames,
    motion: ContinuousMotion,
    refused: Sequence[tuple[str, str]] = (),
    X_FR: RigidTransform | None = None,
    warnings: Sequence[str] = (),
    **more: Any,
) -> RecordedMotion:
    """Calibrate from frames with the flange; ``more``: robot, flange, scanner and other fields of the result.

    Raises:
        InputError: the motion leaves X_BC open; TooFewPoses: too few frames can be used.
    """
    e = estimate_in_motion(frames, motion, X_FR)
    left = {id: r for id, keep, r in zip(frames.ids, e.inliers, e.residual_m, strict=True) if not keep}
    outliers = tuple(id for id, r in left.items() if np.isfinite(r))
    refused = [*refused]
    for id, r in left.items():
        far = f"It disagrees by {1e3 * r:.1f} mm with the other frames; it is not used."
        refused.append((id, far if id in outliers else "The robot's stream has no data for its time; it is not used."))
    values = {
        "residual_mm": 1e3 * e.residual_m,
        "held_out_mm": 1e3 * e.held_out_m,
        "tilt_deg": np.degrees(e.tilt_rad),
        "held_out_tilt_deg": np.degrees(e.held_out_tilt_rad),
    }
    target = None
    if motion.inverted and (X_BT := e.fit.X_FR) is not None:
        target = X_BT.translation().copy(), X_BT.rotation().matrix()[:, 2].copy()
    result = CalibrationResult(
        X_BC=e.X_BC,
        covariance=e.covariance,
        held_out_mm=statistics(1e3 * e.held_out_m[e.inliers]),
        tilt_deg=tilt_summary(e.held_out_tilt_rad[e.inliers]),
        poses=pose_records(frames.ids, e.inliers, values, refused),
        unobservable=e.unobservable,
        warnings=(*warnings, *e.warnings),
        sigma_position_mm=1e3 * e.sigma_position_m,
        sigma_normal_deg=float(np.degrees(e.sigma_normal_rad)),
        software=software_version(),
        clock=e.clock,
        clock_covariance=e.joint,
        target=target,
        **more,
    )
    return RecordedMotion(result=result, estimate=e, frames=frames, refused=tuple(refused), outliers=outliers)


def calibrate_motion(
    folder: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    seed: int = 0,
    tell: Callable[[str, float], None] = lambda step, fraction: None,
) -> RecordedMotion:
    """Calibrate from a recording in motion; ``robot`` and ``flange`` override dataset.yaml.

    The scanner beside the robot sees the flange, or the one on the flange (eye_in_hand) sees a fixed target of the
    flange's shape. A frame that cannot be used is refused and reported. No scanner correction is estimated: a stream
    through a few places cannot tell it from the clock.

    Raises:
        InputError: the data cannot be used, or the motion leaves X_BC open; TooFewPoses: too few frames can be used.
    """
    data = load_motion_dataset(folder, robot=robot)
    standard = stated_flange(flange or data.header.flange, data.header.robot)
    motion = ContinuousMotion(data.stream, inverted=data.in_hand)
    seen = see_frames(data, standard, motion, seed=seed, tell=lambda fraction: tell("fitting flanges", 0.8 * fraction))
    tell("solving", 0.8)
    shown = data.stream.poses[:: max(1, len(data.stream.poses) // _MOST_TURNED)]
    still = not data.in_hand and turn_deg([RigidTransform(X) for X in shown]) < _TURN_DEG
    tcp = (
        "The orientation hardly changes, so the motion cannot show a TCP that is set at the robot: it would shift X_BC"
        " by its own length. Check that the TCP is zero, or tilt the flange on the way."
    )
    return calibrate_frames(
        seen.observed,
        motion,
        seen.refused,
        data.X_FR,
        (*data.warnings, *([tcp] if still else [])),
        robot=robot or data.header.robot,
        flange=standard.designation,
        scanner=data.header.scanner,
        seed=seed,
        data_hashes=data.hashes,
        configuration=data.header.configuration,
    )
