"""Inverse kinematics of UR arms: all closed-form branches, refined on the robot's calibrated kinematics."""

import itertools

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

RESIDUAL = 1e-9  # m and rad: what a returned solution fulfils
_TARGET = 1e-12  # where Newton stops: three orders below, above rounding
_MAX_STEPS = 20
_BRANCHES = 8  # shoulder, elbow and wrist, two each
_MAX_STEP_RAD = 0.3
# How far outside [-1, 1] a cosine may lie and still seed Newton: a calibrated arm may reach past the nominal one.
_COSINE_SLACK = 0.02
_SAME_RAD = 1e-5
# Where two branches are about to meet, Newton also starts this far to either side: millimetres of calibration shift the
# meeting by the square root of themselves over the reach, sqrt(2 * 5 mm / 1 m) = 0.1 rad.
_BRANCH_GAP_RAD = 0.1


def inverse_kinematics(arm: ArmModel, X_BF: RigidTransform, free_wrist_3: float = 0.0) -> Array:
    """Return all joint angles (n, 6) rad that put the flange at X_BF, wrapped to (-pi, pi] and within the limits.

    Closed form on the nominal lengths: shoulder from the wrist centre, wrist 2 and wrist 3 from the orientation, elbow
    from the triangle of upper arm and forearm (after Hawkins, Analytic Inverse Kinematics for the Universal Robots,
    2013), then Newton steps on the arm's own kinematics until the residual is below 1e-9 m and rad. At most 8 solutions
    away from singularities. At the wrist singularity (wrist 2 at 0 or pi) one joint is free: wrist 3 is then put at
    `free_wrist_3`. Empty where the pose is out of reach.

    Raises:
        InputError: X_BF is not finite.
    """
    goal = X_BF.GetAsMatrix4()
    if not np.isfinite(goal).all():
        raise InputError("The flange pose must be finite to find joint angles for it.")
    R, p = goal[:3, :3], goal[:3, 3]
    found: list[Array] = []
    for seed in _branches(arm, R, p, free_wrist_3):
        q = _polish(arm, R, p, seed)
        if q is None:
            continue
        q = _wrapped(q)
        inside = np.all((q >= arm.position_lower - _SAME_RAD) & (q <= arm.position_upper + _SAME_RAD))
        if inside and all(np.abs(_wrapped(q - other)).max() > _SAME_RAD for other in found):
            found.append(np.clip(q, arm.position_lower, arm.position_upper))
    return np.array(found).reshape(-1, 6)


def nearest_solution(arm: ArmModel, X_BF: RigidTransform, q_near: ArrayLike) -> Array | None:
    """The joint angles (6,) rad for X_BF, full turns within the limits included, nearest to q_near (6,), or None.

    Nearest is in the sum of squares of each joint's travel over its speed limit: a radian of a slow joint counts more.

    Raises:
        InputError: X_BF or q_near is not finite.
    """
    near = np.asarray(q_near, dtype=np.float64)
    if near.shape != (6,) or not np.isfinite(near).all():
        raise InputError("The joint angles to stay near must be six finite numbers.")
    q = inverse_kinematics(arm, X_BF, free_wrist_3=float(_wrapped(near)[5]))
    if len(q) < _BRANCHES:
        # Beside a singularity the branch that holds q_near may have no closed-form seed of its own: q_near is one.
        goal = X_BF.GetAsMatrix4()
        here = _polish(arm, goal[:3, :3], goal[:3, 3], near)
        if here is not None and np.all((here >= arm.position_lower) & (here <= arm.position_upper)):
            q = np.vstack([q, here])
    if len(q) == 0:
        return None
    turn = 2.0 * np.pi
    lowest = np.ceil((arm.position_lower - q) / turn)
    highest = np.floor((arm.position_upper - q) / turn)
    q = q + turn * np.clip(np.round((near - q) / turn), lowest, highest)
    cost = np.sum(((q - near) / arm.velocity_limit) ** 2, axis=1)
    nearest: Array = q[int(np.argmin(cost))]
    return nearest


def continued_solution(arm: ArmModel, X_BF: RigidTransform, q_near: Array) -> Array | None:
    """The joint angles (6,) rad for X_BF that Newton's steps reach from q_near (6,), which an arm moving there ends in.

    Not wrapped, and not held within the limits. None where the steps do not get there: out of reach, or past a
    singularity.
    """
    goal = X_BF.GetAsMatrix4()
    return _polish(arm, goal[:3, :3], goal[:3, 3], np.array(q_near, dtype=np.float64))


def _branches(arm: ArmModel, R: Array, p: Array, free_wrist_3: float) -> list[Array]:
    """Closed-form solutions (up to 8) for the nominal lengths; just out of reach, the arm stretched towards it."""
    dh = arm.dh
    wrist = p - dh.d6 * R[:, 2]
    rho = float(np.hypot(wrist[0], wrist[1]))
    lateral = _arccos(dh.d4 / rho) if rho > 0.0 else None
    if lateral is None:
        return []
    seeds: list[Array] = []
    for side, flip in itertools.product(_both_signs(lateral), (1.0, -1.0)):
        q1 = float(np.arctan2(wrist[1], wrist[0])) + side + np.pi / 2
        c1, s1 = np.cos(q1), np.sin(q1)
        z1 = np.array([s1, -c1, 0.0])  # the common axis of shoulder lift, elbow and wrist 1
        along = z1 @ R
        s5 = float(np.hypot(along[0], along[1]))
        q5 = flip * float(np.arctan2(s5, along[2]))
        singular = s5 < 1e-9
        q6 = free_wrist_3 if singular else float(np.arctan2(-flip * along[1], flip * along[0]))
        # Frame 4 from the goal: undo wrist 3 and wrist 2 (alpha_5 = -pi/2 makes z4 = -y5).
        x5 = R[:, 0] * np.cos(q6) - R[:, 1] * np.sin(q6)
        z4 = -R[:, 0] * np.sin(q6) - R[:, 1] * np.cos(q6)
        x4 = x5 * np.cos(q5) - R[:, 2] * np.sin(q5)
        center = wrist - dh.d5 * z4 - dh.d4 * z1 - np.array([0.0, 0.0, dh.d1])
        # In the plane of the two tubes: axis u = (c1, s1, 0), axis z up.
        u, w = float(c1 * center[0] + s1 * center[1]), float(center[2])
        elbow = _arccos((u * u + w * w - dh.a2**2 - dh.a3**2) / (2.0 * dh.a2 * dh.a3))
        if elbow is None:
            continue
        q234 = float(np.arctan2(x4[2], c1 * x4[0] + s1 * x4[1]))
        for q3 in _both_signs(elbow):
            q2 = float(np.arctan2(w, u) - np.arctan2(dh.a3 * np.sin(q3), dh.a2 + dh.a3 * np.cos(q3)))
            seeds.append(np.array([q1, q2, q3, q234 - q2 - q3, q5, q6]))
    return seeds


def _polish(arm: ArmModel, R: Array, p: Array, q: Array) -> Array | None:
    """Newton from q to the goal on the arm's own kinematics; None where it does not get there."""
    best, best_residual = q, np.inf
    for _ in range(_MAX_STEPS):
        R_now, p_now, J = kinematics_and_jacobian(arm, q)
        turn = R @ R_now.T
        error = np.empty(6)
        error[:3] = 0.5 * (turn[2, 1] - turn[1, 2]), 0.5 * (turn[0, 2] - turn[2, 0]), 0.5 * (turn[1, 0] - turn[0, 1])
        error[3:] = p - p_now
        # |R - R_now|_F / sqrt 2 = 2 sin(angle / 2): unlike the sine it does not vanish half a turn away.
        residual = max(float(np.linalg.norm(R - R_now)) / np.sqrt(2.0), float(np.linalg.norm(error[3:])))
        if residual < best_residual:
            best, best_residual = q, residual
        if residual < _TARGET:
            break
        step = np.linalg.lstsq(J, error, rcond=1e-12)[0]
        length = float(np.linalg.norm(step))
        q = q + step * min(1.0, _MAX_STEP_RAD / length) if length > 0.0 else q
    return best if best_residual < RESIDUAL else None


def _arccos(cosine: float) -> float | None:
    """Arc cosine, clipped just outside [-1, 1], None further out."""
    if abs(cosine) > 1.0 + _COSINE_SLACK:
        return None
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _both_signs(angle: float) -> tuple[float, ...]:
    """Return the two branches +-angle, and seeds beside them where they nearly meet."""
    return (angle, -angle) if angle > _BRANCH_GAP_RAD else (angle, -angle, _BRANCH_GAP_RAD, -_BRANCH_GAP_RAD)


def _wrapped(angle: Array) -> Array:
    """Angles wrapped to (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
