"""Run `weldcal calibrate` on a recording in motion: X_BC, the scanner's clock, exports and a report."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.motion_dataset import load_motion_dataset
from weldcal.calibration.data.results import export_all, save_result
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.planning.observability import turn_deg
from weldcal.models.arrays import Array
from weldcal.models.robots import stated_flange
from weldcal.tools.cli.options import Call, Outcome
from weldcal.tools.console import Progress
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.motion_calibration import MotionReport, motion_report, motion_result
from weldcal.tools.report.render import check_folder, csv_text, write_atomic

_TURN_DEG = 3.0  # orientations closer than this are one orientation to a calibration
_MOST_TURNED = 50  # poses whose orientations are compared


def calibrate_recording(
    call: Call, dataset: Path, robot: str | None, flange: str | None, *, centres: bool, limit_mm: float | None
) -> Outcome:
    """Calibrate a scanner from a recording in motion, as `weldcal calibrate` does for such a folder."""
    report = calibrate_motion(
        dataset,
        call.folder("calibrate", dataset.resolve().name),
        robot=robot,
        flange=flange,
        seed=call.seed,
        progress=call.progress,
        centres=centres,
        limit_mm=limit_mm,
    )
    return Outcome(report.summary(), first=report.first)


def calibrate_motion(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    centres: bool = False,
    limit_mm: float | None = None,
) -> MotionReport:
    """Calibrate from a recording in motion and write ``calibration.yaml``, exports and ``report.html`` to ``out``.

    The scanner beside the robot sees the flange, or the one on the flange (eye_in_hand) sees a fixed target of the
    flange's shape.

    ``robot`` and ``flange`` override dataset.yaml. ``centres`` also writes centres.csv (camera frame, metres, with the
    capture time). A frame that cannot be used is refused and reported. No scanner correction is estimated: a stream
    through a few places cannot tell it from the clock. Nothing is written unless the calibration succeeded.

    Raises:
        InputError: the data cannot be used, or the motion leaves X_BC open; TooFewPoses: too few frames can be used.
    """
    started = time.monotonic()
    check_limit(limit_mm)
    tell: Progress = progress or (lambda stage, fraction: None)
    check_folder(Path(out))
    data = load_motion_dataset(Path(folder), robot=robot)
    standard = stated_flange(flange or data.header.flange, data.header.robot)
    motion = ContinuousMotion(data.stream, inverted=data.in_hand)
    seen = see_frames(data, standard, motion, seed=seed, tell=lambda fraction: tell("fitting flanges", 0.8 * fraction))
    frames = seen.observed
    tell("solving", 0.8)
    X_FR = data.X_FR
    estimate = estimate_in_motion(frames, motion, X_FR)
    outliers = tuple(
        id
        for id, keep, r in zip(frames.ids, estimate.inliers, estimate.residual_m, strict=True)
        if not keep and np.isfinite(r)
    )
    refused = [*seen.refused, *_reasons(frames, estimate)]
    warnings = [*data.warnings, *estimate.warnings]
    shown = data.stream.poses[:: max(1, len(data.stream.poses) // _MOST_TURNED)]
    if not data.in_hand and turn_deg([RigidTransform(X) for X in shown]) < _TURN_DEG:
        warnings.append(
            "The orientation hardly changes, so the motion cannot show a TCP that is set at the robot: it would shift"
            " X_BC by its own length. Check that the TCP is zero, or tilt the flange on the way."
        )
    result = motion_result(
        estimate,
        frames.ids,
        refused,
        warnings=tuple(warnings),
        robot=robot or data.header.robot,
        flange=standard.designation,
        scanner=data.header.scanner,
        seed=seed,
        data_hashes=data.hashes,
        configuration=data.header.configuration,
        target=_target(estimate) if data.in_hand else None,
    )
    report = MotionReport(
        result=result,
        estimate=estimate,
        frames=frames,
        refused=tuple(refused),
        outliers=outliers,
        seconds=time.monotonic() - started,
        out=Path(out),
        limit_mm=limit_mm,
    )
    tell("writing the report", 0.95)
    write_atomic(Path(out) / "report.html", motion_report(report, dataset=Path(folder).name))
    export_all(result, Path(out))
    if centres:
        write_atomic(Path(out) / "centres.csv", _centres_csv(frames, estimate))
    # last, so that its presence means that everything else is there
    save_result(result, Path(out))
    report = replace(report, seconds=time.monotonic() - started)
    tell("done", 1.0)
    return report


def _target(estimate: MotionEstimate) -> tuple[Array, Array]:
    """Return centre (3,) m and normal (3,) in the base of the fixed target in the scans."""
    X_BT = estimate.fit.X_FR
    assert X_BT is not None
    return np.asarray(X_BT.translation()), X_BT.rotation().matrix()[:, 2].copy()


def _reasons(frames: ObservedFrames, estimate: MotionEstimate) -> list[tuple[str, str]]:
    """Frames that show the flange and are not used, with the reason."""
    return [
        (
            id,
            (
                f"It disagrees by {1e3 * r:.1f} mm with the other frames; it is not used."
                if np.isfinite(r)
                else "The robot's stream has no data for its time; it is not used."
            ),
        )
        for id, keep, r in zip(frames.ids, estimate.inliers, estimate.residual_m, strict=True)
        if not keep
    ]


def _centres_csv(frames: ObservedFrames, estimate: MotionEstimate) -> str:
    rows = [
        [id, f"{t:.6f}", *(f"{v:.9f}" for v in (*p, *n))]
        for id, t, p, n in zip(frames.ids, estimate.capture, frames.p_C, frames.n_C, strict=True)
    ]
    return csv_text(("id", "capture", *(f"{what}_{axis}" for what in ("centre", "normal") for axis in "xyz")), rows)
