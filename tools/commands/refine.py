"""The refinements of `weldcal calibrate --refine`: takes from the dataset what they need."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.refinement.refined import Plain, Refined, refine_arm, refine_locally
from weldcal.calibration.refinement.stated_arm import require_joint_angles
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import known_arms
from weldcal.models.errors import InputError


@dataclass(frozen=True, eq=False)
class Refinable:
    """A plain calibration with its data and the name of the robot, with the file of its kinematics where it has one."""

    data: Dataset
    plain: Plain
    robot: str
    kinematics: Path | None = None


def refine_calibration(kind: str, given: Refinable, *, seed: int) -> Refined:
    """Refine a calibration by ``kind`` of REFINEMENTS; it stays as it is, but for nested held-out errors, where that does not help.

    Raises TooFewPoses and other InputErrors where the data cannot be refined in this way.
    """
    if kind == "local":
        return refine_locally(given.plain, seed=seed)
    if given.robot not in known_arms():
        raise InputError(
            f"Errors of the arm (--refine {kind}) are written as Universal Robots' kinematics: name one of {', '.join(known_arms())} with "
            "--robot, or use --refine local."
        )
    arm = load_chain(given.robot, given.kinematics)
    ids = [o.id for o in given.plain.observations]
    poses = {p.id: p.X_BR for p in given.data.pairs} or given.data.poses
    q = require_joint_angles(given.data, ids, arm, np.array([poses[id].GetAsMatrix4() for id in ids]))
    note = f"{given.robot}, refined by weldcal calibrate --refine {kind}"
    return refine_arm(kind, given.plain, q, arm, note=note, seed=seed)
