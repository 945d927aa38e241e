"""Watch a link of the arm instead of its flange: by its description's mesh, or by a model fused from the scans."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.motion_dataset import MotionDataset
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ARRIVAL
from weldcal.calibration.motion.body import BodyModel, fused_model, link_motion, model_from_solids, see_body
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.motion.synchronise import synchronise
from weldcal.models.arms.kinematics import ArmModel, known_arms, load_arm
from weldcal.models.arms.urdf import link_capsules, link_index, link_solids
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard

_USUAL_DELAY_S = 0.1
_FUSED = 60  # frames of which a model is made
_MARGIN_M = 0.005


def track_link(
    data: MotionDataset,
    result: CalibrationResult,
    standard: FlangeStandard,
    link: str,
    *,
    fused: bool,
    seed: int,
    tell: Callable[[float], None],
) -> tuple[ObservedFrames, ContinuousMotion, RigidTransform, list[tuple[str, str]]]:
    """Observations of a link, its motion by the robot, the place of the observed point on it, and frames without it.

    With ``fused`` the surface is made from the first frames with the robot's own poses, at the times that the flange
    tells. Raises InputError: the arm or its link is not known, its stream does not say where the link is, or the link
    does not show.
    """
    robot = data.header.robot or result.robot
    if robot not in known_arms():
        raise InputError(f"The links of the robot '{robot}' are not known: use one of {', '.join(known_arms())}.")
    arm = load_arm(robot)
    index = link_index(arm, link)
    motion = link_motion(data.stream, arm, index)
    delay = _USUAL_DELAY_S
    if result.clock is not None and result.clock.kind == ARRIVAL and result.clock.offset_s is not None:
        delay = result.clock.offset_s
    if fused:
        model, delay = _fused(data, result, standard, arm, index, motion, seed)
    else:
        model = model_from_solids(link_solids(arm, index), seed=seed)
    frames, X_LR, refused = see_body(data, model, motion, result.X_BC, delay, tell=tell)
    return frames, motion, X_LR, refused


def _fused(
    data: MotionDataset,
    result: CalibrationResult,
    standard: FlangeStandard,
    arm: ArmModel,
    index: int,
    motion: ContinuousMotion,
    seed: int,
) -> tuple[BodyModel, float]:
    """Return the link's model from the first frames, and the delay of those."""
    first = replace(data, frames=data.frames[:_FUSED])
    flange = ContinuousMotion(data.stream)
    seen = see_frames(first, standard, flange, X_BC=result.X_BC, seed=seed).observed
    clock = synchronise(seen, flange, result.X_BC, X_FR=data.X_FR, known=result.clock)
    poses = motion.poses(clock.times)
    scans = []
    for id, X_BL in zip(seen.ids, poses, strict=True):
        try:
            cloud = data.cloud(id)
        except CloudError:
            continue
        if np.isfinite(X_BL).all():
            X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_BL[:3, :3]), X_BL[:3, 3])
            scans.append((cloud, X.inverse() @ result.X_BC))
    middle, radius = _extent(arm, index)
    return fused_model(scans, middle, radius + _MARGIN_M), clock.delay_s or _USUAL_DELAY_S


def _extent(arm: ArmModel, index: int) -> tuple[Array, float]:
    """Return a sphere about a link's drawn body: middle (3,) m in its frame, radius m."""
    capsules = [c for c in link_capsules(arm) if c.link_index == index]
    ends = np.array([p for c in capsules for p in (c.p_start, c.p_end)])
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    return middle, max(float(np.linalg.norm(p - middle)) + c.radius for c in capsules for p in (c.p_start, c.p_end))
