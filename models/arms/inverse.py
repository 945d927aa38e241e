"""Inverse kinematics of any arm of revolute joints: all branches, refined on the arm's own kinematics."""

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arms.kinematics import ArmModel, Chain, joint_frames, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

RESIDUAL = 1e-9  # m and rad: what a returned solution fulfils
_TARGET = 1e-12  # where Newton stops: three orders below, above rounding
_MAX_STEPS = 20
_MAX_STEP_RAD = 0.3
_DAMPING = 1e-3  # far from the goal; it vanishes with the square of the error, so that the last steps are Newton's
_NO_DAMPING = 1e-15  # keeps a singular arm's equations solvable; of the order of rounding
# How far outside [-1, 1] a cosine may lie and still seed Newton: a calibrated arm may reach past the nominal one.
_COSINE_SLACK = 0.02
_SAME_RAD = 1e-5
# Where two branches are about to meet, Newton also starts this far to either side: millimetres of calibration shift the
# meeting by the square root of themselves over the reach, sqrt(2 * 5 mm / 1 m) = 0.1 rad.
_BRANCH_GAP_RAD = 0.1
# Parallel and meeting axes make the elimination singular: its links are bent by this share of the arm's size, and rad.
# Tried on eight arms, 300 poses each: with 1e-4 it loses one branch in fifty, with 3e-3 one in a thousand.
_BEND = 1e-3
_BENT = 5  # times that an arm is bent at most
_HALF_REAL = 0.5  # rad: the imaginary part up to which a complex angle seeds Newton; a bend makes some of a pair of two
_SHIFT_RAD = 0.3  # of the eliminated joint: its half turn, which tan cannot say, lies at no angle that people choose
_DRAWN, _DRAWN_STEPS = 40, 60  # starts of more than six joints, and their steps within the limits: a choice


def inverse_kinematics(arm: Chain, X_BF: RigidTransform, near: ArrayLike | None = None) -> Array:
    """Return all joint angles (k, n) rad within the limits that put the flange at X_BF, in (-pi, pi] where possible.

    Starts are the closed form of a UR on its nominal lengths, and the eigenvalues of `_loop_angles` of another arm.
    Newton steps on the arm's own kinematics then lower the residual below 1e-9 m and rad. ``near`` (n,) rad is one more
    start. At a UR's wrist singularity (wrist 2 at 0 or pi) wrist 3 is put where it is in ``near``, else at zero. More
    than six joints start from drawn angles and have whole families of solutions, of which some are returned. Empty
    where the pose is out of reach.

    Raises:
        InputError: X_BF is not finite.
    """
    goal = X_BF.GetAsMatrix4()
    if not np.isfinite(goal).all():
        raise InputError("The flange pose must be finite to find joint angles for it.")
    if _beyond_m(arm, goal) > 0.0:
        return np.empty((0, arm.n))
    stay = np.zeros(arm.n) if near is None else np.asarray(near, dtype=np.float64)
    R, p = goal[:3, :3], goal[:3, 3]
    starts = np.empty((0, arm.n)) if near is None else stay[None]
    found: list[Array] = []
    for bends in _BENDS:
        own = _branches(arm, R, p, _wrapped(stay)[5]) if isinstance(arm, ArmModel) else _starts(arm, goal, bends)
        left = np.vstack([np.reshape(found, (-1, arm.n)), _wrapped(_polish(arm, R, p, np.vstack([own, starts])))])
        found = []
        while len(left):
            found.append(left[0])
            left = left[np.abs(_wrapped(left - left[0])).max(axis=1) > _SAME_RAD]
        if isinstance(arm, ArmModel) or arm.n != 6 or len(found) % 2 == 0:
            break  # the real solutions of six joints come in pairs: an odd one says that a singularity hides another
    q = np.reshape(found, (-1, arm.n))
    q = q + 2.0 * np.pi * (1.0 * (q < arm.position_lower - _SAME_RAD) - (q > arm.position_upper + _SAME_RAD))
    q = q[np.all((q >= arm.position_lower - _SAME_RAD) & (q <= arm.position_upper + _SAME_RAD), axis=1)]
    return np.clip(q, arm.position_lower, arm.position_upper)


def why_unreached(arm: Chain, X_BF: RigidTransform) -> str:
    """Return why `inverse_kinematics` finds nothing for X_BF: out of reach, or the limits of which joint."""
    if (beyond := _beyond_m(arm, X_BF.GetAsMatrix4())) > 0.0:
        return f"the flange is {1e3 * beyond:.0f} mm farther away than all links in a row reach"
    whole = np.full(arm.n, np.pi)
    found = inverse_kinematics(replace(arm, position_lower=-whole, position_upper=whole), X_BF)
    if not len(found):
        return "no joint angles lead to the pose of the flange"
    turned = found - 2.0 * np.pi * np.sign(found)
    found = np.where((turned >= arm.position_lower) & (turned <= arm.position_upper), turned, found)
    outside = np.maximum(arm.position_lower - found, found - arm.position_upper)
    least = int(np.argmin(outside.max(axis=1)))
    joint = int(np.argmax(outside[least]))
    low, high, angle = np.degrees([arm.position_lower[joint], arm.position_upper[joint], found[least, joint]])
    return f"joint {joint + 1} would be at {angle:.1f} deg, and its limits are {low:.1f} to {high:.1f} deg"


def nearest_solution(arm: Chain, X_BF: RigidTransform, q_near: ArrayLike) -> Array | None:
    """The joint angles (n,) rad for X_BF, full turns within the limits included, nearest to q_near (n,), or None.

    Nearest is in the sum of squares of each joint's travel over its speed limit: a radian of a slow joint counts more.

    Raises:
        InputError: X_BF or q_near is not finite.
    """
    near = np.asarray(q_near, dtype=np.float64)
    if near.shape != (arm.n,) or not np.isfinite(near).all():
        raise InputError(f"The joint angles to stay near must be {arm.n} finite numbers.")
    q = inverse_kinematics(arm, X_BF, near)
    if len(q) == 0:
        return None
    turn = 2.0 * np.pi
    lowest = np.ceil((arm.position_lower - q) / turn)
    highest = np.floor((arm.position_upper - q) / turn)
    q = q + turn * np.clip(np.round((near - q) / turn), lowest, highest)
    cost = np.sum(((q - near) / arm.velocity_limit) ** 2, axis=1)
    nearest: Array = q[int(np.argmin(cost))]
    return nearest


def continued_solution(arm: Chain, X_BF: RigidTransform, q_near: Array) -> Array | None:
    """The joint angles (n,) rad for X_BF that Newton's steps reach from q_near (n,), which an arm moving there ends in.

    Not wrapped, and not held within the limits. None where the steps do not get there: out of reach, or past a
    singularity.
    """
    goal = X_BF.GetAsMatrix4()
    found = _polish(arm, goal[:3, :3], goal[:3, 3], np.array([q_near], dtype=np.float64))
    return found[0] if len(found) else None


def _beyond_m(arm: Chain, goal: Array) -> float:
    """How much farther from the first joint a flange pose (4, 4) is than all links laid end to end, m."""
    size = np.linalg.norm(arm.stack[1:, :3, 3], axis=1).sum() + np.linalg.norm(arm.X_LF[:3, 3])
    return float(np.linalg.norm(goal[:3, 3] - arm.stack[0, :3, 3]) - size)


def _starts(arm: Chain, goal: Array, bends: Array) -> Array:
    """Joint angles (m, n) rad near all solutions of up to six joints, those missing put at its end; else drawn."""
    if arm.n > 6:
        low, high = np.maximum(arm.position_lower, -np.pi), np.minimum(arm.position_upper, np.pi)
        return np.random.default_rng(0).uniform(low, high, (_DRAWN, arm.n))
    pads, X_LF = _PADS[: 6 - arm.n], arm.X_LF
    for pad in pads[::-1]:
        X_LF = _inverse(pad) @ X_LF
    return _six_joint_starts(np.vstack([arm.stack, pads]), X_LF, goal, bends)[:, : arm.n]


def _six_joint_starts(stack: Array, X_LF: Array, goal: Array, bends: Array) -> Array:
    """Joint angles (m, 6) rad near all solutions of six joints, by each of several bends."""
    loop = np.array([*stack[1:], X_LF @ _inverse(goal) @ stack[0]])
    loop[:, :3, 3] /= np.linalg.norm(loop[:, :3, 3], axis=1).sum()
    return np.vstack([_loop_angles(np.array([*(loop[:5] @ bend), loop[5]])) for bend in bends])


def _loop_angles(L: Array) -> Array:
    """Angles (m, 6) rad near all real ones with RotZ(q1) L1 RotZ(q2) L2 ... RotZ(q6) L6 = 1, of no special geometry.

    Raghavan and Roth 1993, Inverse Kinematics of the General 6R Manipulator: joint 6 leaves its own axis, and so
    fourteen functions of it, which are of first order in each of q3, q4, q5 on one side, and of q1, q2 on the other.
    Six combinations hold no q1 and q2. They and their multiples by e^(i q4) are a matrix that is singular where q3
    solves; its vector holds q4 and q5. Written in e^(i q) instead of tan (q / 2), with coefficients by Fourier sums.
    A pair of real solutions that the bend made complex is sought on both sides of the real part.
    """
    far = _invariants(_THIRDS[:, None, None] @ L[2] @ _THIRDS[:, None] @ L[3] @ _THIRDS @ L[4])
    near = _invariants(_inverse(L[5] @ _THIRDS[:, None] @ L[0] @ _THIRDS @ L[1]))
    P = np.einsum("ai,bj,ck,ijkm->ambc", _FOURIER, _FOURIER, _FOURIER, far).reshape(3, 14, 9)
    Q = np.einsum("ai,bj,ijm->mab", _FOURIER, _FOURIER, near).reshape(14, 9)
    P[1, :, 4] -= Q[:, 4]
    U, s, Vh = np.linalg.svd(np.delete(Q, 4, axis=1))
    M = np.zeros((3, 12, 12), dtype=complex)
    M[:, :6, :9] = M[:, 6:, 3:] = U[:, 8:].conj().T @ P
    low, middle, high = M * np.exp(1j * _SHIFT_RAD * np.array([-1.0, 0.0, 1.0]))[:, None, None]
    # e^(i q3) = e^(i shift) (1 + i x) / (1 - i x) makes it quadratic in x, with a regular leading matrix
    companion = np.eye(24, k=12, dtype=complex)
    companion[12:] = -np.linalg.solve(middle - high - low, np.hstack([high + middle + low, 2j * (high - low)]))
    x, vectors = np.linalg.eig(companion)
    real = np.abs(np.log(np.abs(1.0 + 1j * x) / np.maximum(np.abs(1.0 - 1j * x), 1e-300))) < _HALF_REAL
    z3 = np.exp(1j * _SHIFT_RAD) * (1.0 + 1j * x[real]) / (1.0 - 1j * x[real])
    v = vectors[:12, real].T.reshape(-1, 4, 3)
    z4, z5 = (
        np.sum(one.conj() * other, axis=(1, 2)) / np.sum(np.abs(one) ** 2, axis=(1, 2))
        for one, other in ((v[:, :-1], v[:, 1:]), (v[:, :, :-1], v[:, :, 1:]))
    )
    powers = [np.stack([1.0 / z, np.ones_like(z), z], axis=1) for z in (z3, z4, z5)]
    right = np.einsum("na,nb,nc,ambc->nm", *powers, P.reshape(3, 14, 3, 3))
    products = (right @ U[:, :8].conj() / s) @ Vh.conj()
    angles = -1j * np.log(np.stack([products[:, 6], products[:, 4], z3, z4, z5], axis=1))
    q = np.vstack([angles.real, angles.real + np.clip(angles.imag, -_HALF_REAL, _HALF_REAL)])
    q = q[np.isfinite(q).all(axis=1)]
    last = joint_frames(np.array([np.eye(4), *L[:4]]), q)[:, -1] @ L[4]
    turn = _inverse(L[5] @ last)
    return np.column_stack([q, np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])])


def _invariants(X: Array) -> Array:
    """Raghavan and Roth's functions (..., 14) of the z axis and origin of poses (..., 4, 4)."""
    z, p = X[..., :3, 2], X[..., :3, 3]
    pp, pz = (p * p).sum(axis=-1, keepdims=True), (p * z).sum(axis=-1, keepdims=True)
    return np.concatenate([z, p, pp, pz, np.cross(p, z), pp * z - 2.0 * pz * p], axis=-1)


def _inverse(X: Array) -> Array:
    """Inverse of rigid poses (..., 4, 4)."""
    return np.asarray(np.linalg.inv(X))


def _small_motions(count: int, size: float) -> Array:
    """Motions (count, 4, 4) without any symmetry, up to ``size`` in rad and m."""
    drawn = size * np.random.default_rng(0).uniform(-1.0, 1.0, (count, 6))
    return np.array([RigidTransform(RollPitchYaw(v[:3]), v[3:]).GetAsMatrix4() for v in drawn])


_BENDS = _small_motions(10 * _BENT, _BEND).reshape(_BENT, 2, 5, 4, 4)
_PADS = _small_motions(3, 1.0)  # joints that an arm of fewer than six has not: of no special geometry
_THIRDS = joint_frames(np.eye(4)[None], 2.0 * np.pi / 3.0 * np.arange(3.0)[:, None])[:, 0]
_FOURIER = np.exp(-2j * np.pi / 3.0 * np.outer([-1.0, 0.0, 1.0], np.arange(3.0))) / 3.0


def _polish(arm: Chain, R: Array, p: Array, starts: Array) -> Array:
    """Newton from joint angles (m, n) to the goal on the arm's own kinematics; those (k, n) that get there."""
    q, best, least = starts.copy(), starts.copy(), np.full(len(starts), np.inf)
    left = np.arange(len(q))
    for _ in range(_MAX_STEPS if arm.n <= 6 else _DRAWN_STEPS):
        R_now, p_now, J = kinematics_and_jacobian(arm, q[left])
        turn = R @ np.swapaxes(R_now, 1, 2)
        error = np.empty((len(left), 6, 1))
        error[:, :3, 0] = 0.5 * (turn[:, [2, 0, 1], [1, 2, 0]] - turn[:, [1, 2, 0], [2, 0, 1]])
        error[:, 3:, 0] = p - p_now
        # |R - R_now|_F / sqrt 2 = 2 sin(angle / 2): unlike the sine it does not vanish half a turn away.
        far = np.linalg.norm(R - R_now, axis=(1, 2)) / np.sqrt(2.0)
        residual = np.maximum(far, np.linalg.norm(error[:, 3:, 0], axis=1))
        better = left[residual < least[left]]
        best[better], least[left] = q[better], np.minimum(least[left], residual)
        go_on = residual >= _TARGET
        left, J = left[go_on], J[go_on]
        if not len(left):
            break
        damping = np.clip(residual[go_on] ** 2, _NO_DAMPING, _DAMPING)[:, None, None] * np.eye(6)
        J_T = np.swapaxes(J, 1, 2)
        step = (J_T @ np.linalg.solve(J @ J_T + damping, error[go_on]))[:, :, 0]
        step *= np.minimum(1.0, _MAX_STEP_RAD / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        q[left] += step
        if arm.n > 6:  # the others close the loop at any turn
            q[left] = np.clip(q[left], arm.position_lower, arm.position_upper)
    return best[least < RESIDUAL]


def _branches(arm: ArmModel, R: Array, p: Array, free_wrist_3: float) -> Array:
    """Closed-form solutions (up to 8) of a UR for the nominal lengths; just out of reach, the arm stretched towards it.

    Shoulder from the wrist centre, wrist 2 and wrist 3 from the orientation, elbow from the triangle of upper arm and
    forearm (after Hawkins, Analytic Inverse Kinematics for the Universal Robots, 2013).
    """
    dh = arm.dh
    wrist = p - dh.d6 * R[:, 2]
    rho = float(np.hypot(wrist[0], wrist[1]))
    lateral = _arccos(dh.d4 / rho) if rho > 0.0 else None
    if lateral is None:
        return np.empty((0, 6))
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
    return np.reshape(seeds, (-1, 6))


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
