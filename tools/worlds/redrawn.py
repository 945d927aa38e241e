"""Calibrations from known poses with noise drawn anew, and the least that these poses, arm and scanner allow."""

from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, jacobian
from weldcal.models.arrays import Array
from weldcal.tools.report.weld import calibration_error


@dataclass(frozen=True, eq=False)
class RedrawnStation:
    """What made the observations: arm (its joints (n, 6) rad at each of them), how well the flange repeats (m, rms),
    the true X_BC, and the work point (3,) m in B."""

    arm: ArmModel
    joints: Array
    repeatability_m: float
    X_BC: RigidTransform
    p_BWork: Array


@dataclass(frozen=True, eq=False)
class Redrawn:
    """Errors (k,) of a point at the work point (m) and of the rotation (rad): of calibrations whose noise was drawn
    anew, and of as many draws from the Gaussian that the Cramer-Rao bound allows."""

    at_work_m: Array
    rotation_rad: Array
    bound_at_work_m: Array
    bound_rotation_rad: Array

    def within(self, at_work_m: float, rotation_rad: float) -> tuple[float, float]:
        """Share of the calibrations, and of those at the bound, within both."""
        ours = (self.at_work_m <= at_work_m) & (self.rotation_rad <= rotation_rad)
        least = (self.bound_at_work_m <= at_work_m) & (self.bound_rotation_rad <= rotation_rad)
        return float(np.mean(ours)), float(np.mean(least))


def joints_of(observations: tuple[Observation, ...], arm: ArmModel, q_home: Array) -> Array:
    """Joints (n, 6) rad in which a bare flange stands where each observation says: the solution nearest to
    ``q_home``."""
    out = []
    for o in observations:
        solutions = inverse_kinematics(arm, o.X_BR)
        out.append(min(solutions, key=lambda s: float(np.abs((s - q_home + np.pi) % (2.0 * np.pi) - np.pi).sum())))
    return np.array(out)


def redraw(observations: tuple[Observation, ...], station: RedrawnStation, count: int, seed: int = 0) -> Redrawn:
    """``count`` calibrations from the poses of these observations, each with noise of its own: joint offsets that
    displace the flange by the repeatability, and fits that err as they state. Deterministic for ``seed``."""
    rng = np.random.default_rng(seed)
    errors = np.empty((2, count))
    for k in range(count):
        drawn = [_redrawn(o, q, station, rng) for o, q in zip(observations, station.joints, strict=True)]
        estimate = estimate_eye_on_base(drawn, SolveConfig(leave_one_out=False))
        e = calibration_error(estimate.X_BC, station.X_BC, station.p_BWork)
        errors[:, k] = e.at_work_m, e.rotation_rad
    drawn_least = rng.multivariate_normal(np.zeros(6), bound_covariance(observations, station), size=count)
    turn, shift = np.linalg.norm(drawn_least[:, :3], axis=1), np.linalg.norm(drawn_least[:, 3:], axis=1)
    return Redrawn(errors[0], errors[1], shift, turn)


def joined(parts: list[Redrawn]) -> Redrawn:
    """All of them together."""
    names = ("at_work_m", "rotation_rad", "bound_at_work_m", "bound_rotation_rad")
    return Redrawn(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def bound_covariance(observations: tuple[Observation, ...], station: RedrawnStation) -> Array:
    """Cramer-Rao: the least covariance (6, 6) [rotation rad; displacement of the work point m] that an unbiased
    calibration from these observations of a bare flange can have.

    The arm's error is six independent joint offsets that displace the flange by the repeatability (rms); the scanner's
    is what each fit states of itself. Centre and normal of a pose err together, as one offset of the joints moves both.
    """
    information = np.zeros((6, 6))
    for o, q in zip(observations, station.joints, strict=True):
        J = jacobian(station.arm, q)
        R, z = o.X_BR.rotation().matrix(), o.n_B
        across = R[:, :2].T  # the two directions in which a normal can lean
        H = np.zeros((5, 6))
        H[:3, 3:], H[3:, :3] = np.eye(3), -across @ skew(z)
        noise = _joint_sigma(station, J) ** 2 * H @ J @ J.T @ H.T
        noise[:3, :3] += np.zeros((3, 3)) if o.center_covariance is None else _in_base(o)
        noise[3:, 3:] += (o.normal_sigma or 0.0) ** 2 * np.eye(2)
        A = np.zeros((5, 6))
        A[:3, :3], A[:3, 3:], A[3:, :3] = -skew(o.p_BR - station.p_BWork), np.eye(3), -across @ skew(z)
        information += A.T @ np.linalg.solve(noise, A)
    return np.asarray(np.linalg.inv(information))


def _joint_sigma(station: RedrawnStation, J: Array) -> float:
    """Standard deviation (rad) of each joint's offset, as the simulated arm draws it."""
    return station.repeatability_m / float(np.linalg.norm(J[3:]))


def _redrawn(o: Observation, q: Array, station: RedrawnStation, rng: np.random.Generator) -> Observation:
    """The observation with noise of its own; the robot's reported pose stays."""
    offset = _joint_sigma(station, jacobian(station.arm, q)) * rng.standard_normal(6)
    X_CR = station.X_BC.inverse() @ forward_kinematics(station.arm, q + offset)
    z = X_CR.rotation().matrix()[:, 2]
    p, n = np.asarray(X_CR.translation()), z
    if o.center_covariance is not None:
        p = p + rng.multivariate_normal(np.zeros(3), o.center_covariance)
    if o.normal_sigma is not None:
        lean = o.normal_sigma * rng.standard_normal(3)
        n = exp_rotation(lean - z * float(z @ lean)) @ z
    return replace(o, p_CR=p, n_C=None if o.n_C is None else n)


def _in_base(o: Observation) -> Array:
    """The fit's covariance (3, 3) m^2: along the face's normal and across, whatever way the camera is turned."""
    assert o.center_covariance is not None
    n = np.asarray(o.n_C) if o.n_C is not None else np.array([0.0, 0.0, -1.0])
    along = float(n @ o.center_covariance @ n)
    across = 0.5 * (float(np.trace(o.center_covariance)) - along)
    return np.asarray(across * np.eye(3) + (along - across) * np.outer(o.n_B, o.n_B))
