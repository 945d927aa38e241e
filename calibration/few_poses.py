"""The scanner's pose from one, two or three scans: whole flange poses, where the flange's rotation about its axis is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.holes import HolePattern
from weldcal.calibration.observation import Observation

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FewPosesEstimate:
    """X_BC from ``ids``, and how far (m) each flange centre is from where it puts it; zero where there is only one."""

    X_BC: RigidTransform
    ids: tuple[str, ...]
    residuals_m: Array


def estimate_from_whole_poses(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], turn_rad: float = 0.0
) -> FewPosesEstimate:
    """X_BC from the sightings whose hole pattern was seen (n >= 1): each gives all six degrees of freedom.

    ``turn_rad`` is how far the drilled pattern is turned about the face normal from where the robot's flange frame says it is;
    ``axis_turn`` finds it once from a calibration by many poses, and a flange keeps it. Rotations are averaged (chordal
    mean), then centres. Raises TooFewPoses where no pattern was seen.
    """
    seen = [o for o in observations if o.id in patterns]
    if not seen:
        raise TooFewPoses("No scan shows the flange's holes well enough; scan from nearer or take four poses and more.")
    turn = RotationMatrix.MakeZRotation(turn_rad).matrix()
    total = np.zeros((3, 3))
    for o in seen:
        R_BR = o.X_BR.rotation().matrix() @ turn
        total += R_BR @ patterns[o.id].X_CR.rotation().matrix().T
    u, _, vt = np.linalg.svd(total)
    R = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    c, b = np.array([o.p_CR for o in seen]), np.array([o.p_BR for o in seen])
    p = (b - c @ R.T).mean(axis=0)
    X_BC = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
    return FewPosesEstimate(X_BC, tuple(o.id for o in seen), np.linalg.norm(c @ R.T + p - b, axis=1))


def axis_turn(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], X_BC: RigidTransform
) -> tuple[float, float]:
    """How far (rad) the drilled pattern is turned about the face normal from the robot's flange frame, and its spread over
    the scans (standard deviation, rad; NaN for one scan). Median over the scans that show the pattern; raises TooFewPoses
    where none does."""
    turns = []
    for o in observations:
        if o.id in patterns:
            R = (o.X_BR.rotation().inverse() @ X_BC.rotation() @ patterns[o.id].X_CR.rotation()).matrix()
            turns.append(float(np.arctan2(R[1, 0], R[0, 0])))
    if not turns:
        raise TooFewPoses("No scan shows the flange's holes well enough to tell its rotation about the axis.")
    middle = float(np.median(turns))
    return middle, float(np.std(turns, ddof=1)) if len(turns) > 1 else float("nan")
