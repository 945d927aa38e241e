"""Which pose to add: the one that would shrink the uncertainty at the work point most, the target still in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.hand_eye import HandEyeResult, as_transform
from weldcal.calibration.handeye.mountings import Mounting
from weldcal.calibration.handeye.problem import Problem, State, linearise
from weldcal.calibration.handeye.scaled import Loss, Noise, Scaled, inverse_information
from weldcal.calibration.handeye.se3 import exp_rotation, inverse
from weldcal.calibration.rigid import skew
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel

Array = NDArray[np.float64]

_TURNS_RAD = (float(np.radians(20.0)), float(np.radians(40.0)))
_PRIOR_SHARE = 10.0  # what is believed of an open direction: ten radians or extents


@dataclass(frozen=True)
class NextPose:
    """A pose to add: robot pose X_BF (the first robot's, or None where the mounting leaves it open), target in the camera
    X_CM, like which taken sample and turned how, and the predicted sigma (3-D) at the work point before and after."""

    X_BF: RigidTransform | None
    X_CM: RigidTransform
    like: int
    turn_deg: float
    axis_C: Array
    sigma_before: float
    sigma_after: float

    def sentence(self) -> str:
        """What to do, for a person."""
        a = "(" + ", ".join(f"{v:+.2f}" for v in self.axis_C) + ")"
        before = "open" if not np.isfinite(self.sigma_before) else f"{1e3 * self.sigma_before:.2f} mm"
        return (
            f"Like sample {self.like}, with the target seen turned by {self.turn_deg:.0f} deg about {a} of the camera: the "
            f"uncertainty at the work point goes from {before} to {1e3 * self.sigma_after:.2f} mm."
        )


def next_pose(
    problem: Problem, result: HandEyeResult, mounting: Mounting, known: State, *, arm: ArmModel | None = None
) -> NextPose | None:
    """The most telling of poses that show the target where the camera saw it before, turned by 20 or 40 degrees.

    Visible: the same place in the picture. Reachable: by ``arm``'s inverse kinematics, where one is given. The work point
    is the mean place of the target before the camera. None where no candidate is left. For a scanner that watches a
    flange, pose_planning plans with the arm's bodies and the scanner's field of view as well.
    """
    state = _state(result, known, problem)
    used = problem.pick(result.inliers)
    noise = Noise(
        max(float(np.nan_to_num(result.sigma_rotation_rad)) ** 2, 1e-12), max(result.sigma_translation**2, 1e-14)
    )
    now = Scaled(used, linearise(used, state, np.zeros(3)), noise, Loss.SQUARES)
    length = result.extent
    scale = np.tile([1.0, 1.0, 1.0, length, length, length], problem.size // 6)
    prior = np.diag(1.0 / (_PRIOR_SHARE * scale) ** 2)
    work_C = used.G[:, :3, 3].mean(axis=0)
    best: NextPose | None = None
    before = _sigma(now.Gw + now.Gd + prior, state, work_C)
    n = len(used)
    taken = np.nonzero(result.inliers)[0]
    for i in range(0, n, max(1, n // 15)):
        for axis in np.vstack([np.eye(3), -np.eye(3)]):
            for angle in _TURNS_RAD:
                G = used.G[i].copy()
                G[:3, :3] = exp_rotation(angle * axis) @ _seen_rotation(used, state, i)
                H = used.H[i]
                F = (state[1] @ H @ state[2]) @ inverse(state[0] @ G)
                X_BF = _robot_pose(mounting, F)
                if X_BF is not None and arm is not None and not len(inverse_kinematics(arm, X_BF)):
                    continue
                one = Problem(
                    F[None], G[None], H[None], used.full[i : i + 1], used.normal[i : i + 1], None, problem.free
                )
                add = Scaled(one, linearise(one, state, np.zeros(3)), noise, Loss.SQUARES)
                after = _sigma(now.Gw + now.Gd + add.Gw + add.Gd + prior, state, work_C)
                if best is None or after < best.sigma_after:
                    best = NextPose(X_BF, as_transform(G), int(taken[i]), float(np.degrees(angle)), axis, before, after)
    return best


def _seen_rotation(problem: Problem, state: State, i: int) -> Array:
    if problem.full[i]:
        return np.asarray(problem.G[i, :3, :3])
    seen = inverse(problem.F[i] @ state[0]) @ (state[1] @ problem.H[i] @ state[2])
    return np.asarray(seen[:3, :3])


def _robot_pose(mounting: Mounting, F: Array) -> RigidTransform | None:
    if mounting.name in ("eye_in_hand", "co_manipulation"):
        return as_transform(F)
    return as_transform(inverse(F)) if mounting.name == "eye_on_base" else None


def _state(result: HandEyeResult, known: State, problem: Problem) -> State:
    out = [np.asarray(result.poses[k].GetAsMatrix4()) if k in result.poses else known[i] for i, k in enumerate("XYZ")]
    if problem.tied:
        out[1] = out[0]
    return out[0], out[1], out[2]


def _sigma(information: Array, state: State, work_C: Array) -> float:
    """Predicted standard deviation (3-D) of a point at the work point, in the parent frame of the camera."""
    C = inverse_information(information)[:6, :6]
    J = np.hstack([-skew(state[0][:3, :3] @ work_C), np.eye(3)])
    return float(np.sqrt(max(float(np.trace(J @ C @ J.T)), 0.0)))
