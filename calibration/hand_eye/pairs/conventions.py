"""Decide how two lists of poses are to be read, by relative motions: they must agree for one X, whatever X is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.readings import CHANGES, PoseReading, pick
from weldcal.calibration.geometry.robust import FoundOrder, OrderFit, Rows, f_quantile, find_order
from weldcal.calibration.geometry.se3 import angle_of, exp_rotation, inverse, log_rotation, nearest_rotation
from weldcal.models.arrays import Array

CHANCE = 1e-6  # as for readings of a dataset (eye_on_base/observations.py)
"""Chance that the right reading is rejected in favour of a wrong one."""
UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254}
_PAIRS = 400  # relative motions that are compared
_KEPT = 0.7  # share of the poses that must agree: the others may be outliers
_ROTATION_FLOOR = 2e-6  # rad: six printed digits
_POSITION_FLOOR = 1e-6  # share of the positions: six printed digits
_AGREE = 0.1  # of the motion: beyond it there is no agreement that deserves the name
_SAME_SCALE = 0.02  # of the logarithm, a choice: readings with scales farther apart are two answers
_NEAR_UNIT = 0.08  # of the logarithm of a factor: attenuation by noise of short motions
# Pairs of notations that are solved: proper Euler angles of six orders each have relative rotations of the same size
_MOST = 160
_SURE_TURN = 2.8  # rad
_ONE_AXIS = 0.1  # share of the turns off the main axis below which rotations do not determine X about it
_STEPS = 6
_CHANGED = 3  # more than two lists in doubted readings
_TRIAL_STEPS = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class ReadingAgreement:
    """How well two lists agree under one reading of each.

    Attributes:
        robot, camera: the readings.
        scale: robot units per camera unit that fits best.
        scale_sigma: its standard deviation as a share of itself.
        unit_scale: the nearest ratio of two units, or None where none is near.
        rotation: rms residual of the rotations, rad, of the poses that agree best.
        turn: rms angle of the relative motions under these readings, rad.
        position: rms residual of the positions, in the robot's unit.
        extent: rms distance of the robot's positions from their mean, in its unit.
        X, Y: the solution of F X G = Y, positions in the robot's unit.
        changes: 3 where a list is changed beyond what is stated, and 1 for each list in a doubted reading.
        dof: degrees of freedom of each residual.
    """

    robot: PoseReading
    camera: PoseReading
    scale: float
    scale_sigma: float
    unit_scale: float | None
    rotation: float
    turn: float
    position: float
    extent: float
    X: Array
    Y: Array
    dof: int
    changes: int = 0

    @property
    def changed(self) -> bool:
        """Whether a list is transposed, left-handed or inverted beyond what is stated."""
        return self.changes >= _CHANGED

    @property
    def agrees(self) -> bool:
        """Whether the residuals are small against the motion."""
        return self.rotation < _AGREE * self.turn and self.position < _AGREE * self.extent

    @property
    def cost(self) -> float:
        """Negative log-likelihood with unknown noise, per pose; a constant left out."""
        return float(np.log(self.rotation / self.turn) + np.log(self.position))


@dataclass(frozen=True, eq=False)
class ReadingDecision:
    """The readings of two lists that the data select.

    Attributes:
        best: the reading of least residuals.
        rivals: other readings that the data do not reject and that lead to another result, best first.
        same: readings that the data do not reject and that lead to the same result.
        next: the best of the rejected readings; None where there is no other.
    """

    best: ReadingAgreement
    rivals: tuple[ReadingAgreement, ...]
    same: tuple[ReadingAgreement, ...]
    next: ReadingAgreement | None

    @property
    def determined(self) -> bool:
        """Whether one result is left."""
        return not self.rivals


def decide(
    robot: Sequence[PoseReading], camera: Sequence[PoseReading], *, eye_in_hand: bool, changes: bool = True
) -> ReadingDecision:
    """Compare all readings of two lists of n poses and keep those that the data do not reject.

    With F = X_BF (eye in hand) or its inverse (eye on base) and G = X_CM, F X G = Y for one X and one Y. Pairs of poses
    give the angle of each relative rotation, which is equal on both sides whatever X is: it selects the notations. A
    least-squares solution of those that remain gives rotation and position residuals with 3 n - 6 degrees of freedom
    each. If reading r were right, its squared residuals would exceed those of any other by more than the quantile of
    F(dof, dof) with probability CHANCE at most: readings beyond it are rejected.

    Args:
        robot, camera: the candidates, usual ones first.
        eye_in_hand: the mounting, as stated.
        changes: whether transposed, left-handed and inverted lists are candidates, too.
    """
    notations = _notations(robot, camera)
    tried = [pair for a, b in notations for pair in _variants(robot[a], camera[b], changes)]
    return _judge(agreements(tried, eye_in_hand=eye_in_hand, all_of_them=False), len(tried))


def _judge(tried: list[ReadingAgreement], count: int) -> ReadingDecision:
    best = min(tried, key=lambda t: t.cost)
    for least in sorted({t.changes for t in tried if t.changes < best.changes}):
        # a list that need not be changed, or read in a doubted way, is not
        plain = [t for t in tried if t.changes <= least]
        first = min(plain, key=lambda t: t.cost)
        if not _rejected(first, best, _limit(best.dof, count)):
            best, tried = first, plain
            break
    limit = _limit(best.dof, count)
    alive: list[ReadingAgreement] = []
    dead: list[ReadingAgreement] = []
    for one in tried:
        if one is not best and (best.changed or not one.changed or one.cost < best.cost):
            (dead if _rejected(one, best, limit) else alive).append(one)
    alive.sort(key=lambda t: t.cost)
    dead.sort(key=lambda t: t.cost)
    same = [one for one in alive if _same(one, best)]
    rivals = [one for one in alive if not _same(one, best)]
    return ReadingDecision(best, tuple(rivals), tuple(same), dead[0] if dead else None)


def _limit(dof: int, tried: int) -> float:
    """Ratio of residuals beyond which a reading is rejected."""
    return float(np.sqrt(f_quantile(1.0 - CHANCE / (2.0 * max(tried - 1, 1)), dof, dof)))


def _rejected(one: ReadingAgreement, best: ReadingAgreement, limit: float) -> bool:
    return one.rotation / one.turn * best.turn > limit * best.rotation or one.position > limit * best.position


def _same(one: ReadingAgreement, other: ReadingAgreement) -> bool:
    """Test whether two readings agree, within the residuals of the better one.

    They have the same rotations, or lead to the same X and Y.
    """
    if abs(np.log(one.scale / other.scale)) > _SAME_SCALE:
        return False
    gaps = [
        float(
            np.sqrt((Rotation.from_matrix(np.swapaxes(U.X[:, :3, :3], 1, 2) @ V.X[:, :3, :3]).magnitude() ** 2).mean())
        )
        for U, V in ((one.robot, other.robot), (one.camera, other.camera))
    ]
    if max(gaps) <= other.rotation:
        return True
    for U, V in ((one.X, other.X), (one.Y, other.Y)):
        turn = Rotation.from_matrix(U[:3, :3].T @ V[:3, :3]).magnitude()
        if turn > 2.0 * other.rotation or np.linalg.norm(U[:3, 3] - V[:3, 3]) > 3.0 * other.position:
            return False
    return True


def _variants(robot: PoseReading, camera: PoseReading, changes: bool) -> list[tuple[PoseReading, PoseReading, int]]:
    """Return the two readings as they are and with one change of one list ."""
    doubted = int(robot.doubted) + int(camera.doubted)
    found = [(robot, camera, doubted)]
    if changes:
        found += [(robot.changed(c), camera, doubted + _CHANGED) for c in CHANGES]
        found += [(robot, camera.changed(c), doubted + _CHANGED) for c in CHANGES]
    return found


def _notations(robot: Sequence[PoseReading], camera: Sequence[PoseReading]) -> list[tuple[int, int]]:
    """Return index pairs of readings whose relative rotations have equal angles within the noise."""
    n = len(robot[0].X)
    i, j = _pairs(n, _PAIRS)
    angles = [np.stack([_relative_angles(one.X[:, :3, :3], i, j) for one in listed]) for listed in (robot, camera)]
    gap = np.sort(np.abs(angles[0][:, None, :] - angles[1][None, :, :]), axis=2)
    kept = gap[:, :, : max(int(_KEPT**2 * len(i)), 3)]
    sizes = [np.sqrt((one**2).mean(axis=1)) + _ROTATION_FLOOR for one in angles]
    # relative to the motion: degrees that are radians would make all angles, and their differences, small
    spread = np.sqrt((kept**2).mean(axis=2)) / np.sqrt(sizes[0][:, None] * sizes[1][None, :]) + _ROTATION_FLOOR
    dof = max(n - 2, 1)
    least = spread.min()
    # angles of n poses share their errors: no more than n - 2 are independent
    limit = least * float(np.sqrt(f_quantile(1.0 - CHANCE / spread.size, dof, dof)))
    order = np.argsort(spread, axis=None, kind="stable")
    found = [(int(k // spread.shape[1]), int(k % spread.shape[1])) for k in order if spread.flat[k] <= limit]
    return (
        found[:_MOST] if len(found) > 1 else [(int(k // spread.shape[1]), int(k % spread.shape[1])) for k in order[:2]]
    )


def _relative_angles(R: Array, i: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
    chord = np.linalg.norm(R[i] - R[j], axis=(1, 2)) / (2.0 * np.sqrt(2.0))
    return np.asarray(2.0 * np.arcsin(np.clip(chord, 0.0, 1.0)))


def agreements(
    variants: list[tuple[PoseReading, PoseReading, int]], *, eye_in_hand: bool, all_of_them: bool = True
) -> list[ReadingAgreement]:
    """Solve F X G = Y for each pair of readings, all at once.

    Without ``all_of_them``, readings that their rotations reject are left out, but the best of them and the best
    without a change.
    """
    tried, changes = [(a, b) for a, b, _ in variants], [c for _, _, c in variants]
    F = np.stack([one.X if eye_in_hand else inverse(one.X) for one, _ in tried])
    G = np.stack([other.X for _, other in tried])
    n = F.shape[1]
    kept = max(int(np.ceil(_KEPT * n)), min(n, 5))
    dof = max(3 * kept - 6, 3)
    RX, RY, angle = _rotation(F[..., :3, :3], G[..., :3, :3], kept)
    turn = np.sqrt(_motion(F[..., :3, :3]) * _motion(G[..., :3, :3])) + _ROTATION_FLOOR
    rotation = np.sqrt(_trimmed(angle, kept)) + _ROTATION_FLOOR
    if not all_of_them:
        some = _worth_solving(rotation / turn, np.array(changes), _limit(dof, len(tried)))
        tried, changes = [tried[k] for k in some], [changes[k] for k in some]
        F, G, RX, RY, turn, rotation = (one[some] for one in (F, G, RX, RY, turn, rotation))
    RX, RY = _about_one_axis(F, G, RX, RY, kept)
    turned = (F[..., :3, :3] @ (G[..., :3, 3] @ np.swapaxes(RX, 1, 2))[..., None])[..., 0]
    tX, tY, scale, d, sigma = _translation(F, turned, kept, None)
    # a negative scale is no solution: without its sign the positions do not fit
    scale = np.maximum(np.abs(scale), 1e-12)
    units = [_nearest_unit(float(s)) for s in scale]
    fixed = np.array([s if u is None else u for s, u in zip(scale, units, strict=True)])
    tX, tY, _, d, _ = _translation(F, turned, kept, fixed)
    position = np.sqrt(_trimmed(np.linalg.norm(d, axis=2), kept))
    extent = np.sqrt(F[..., :3, 3].var(axis=1).sum(axis=1)) + 1e-12
    digits = _POSITION_FLOOR * np.sqrt((F[..., :3, 3] ** 2).sum(axis=2).mean(axis=1)) + 1e-18
    found = []
    for k, (one, other) in enumerate(tried):
        X, Y = np.eye(4), np.eye(4)
        X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3] = RX[k], tX[k], RY[k], tY[k]
        agreement = ReadingAgreement(
            robot=one,
            camera=other,
            scale=float(scale[k]),
            scale_sigma=float(sigma[k] / scale[k]),
            unit_scale=units[k],
            rotation=float(rotation[k]),
            turn=float(turn[k]),
            position=float(position[k] + digits[k]),
            extent=float(extent[k]),
            X=X,
            Y=Y,
            changes=changes[k],
            dof=dof,
        )
        found.append(agreement)
    return found


def order_of(robot: Sequence[PoseReading], camera: Sequence[PoseReading], *, eye_in_hand: bool) -> FoundOrder | None:
    """Return the order in which two lists of poses (n) and (m) agree, by the angles of their motions; None without one.

    Args:
        robot, camera: the readings of all rows of each list.
        eye_in_hand: the mounting, as stated.
    """
    F = [one.X if eye_in_hand else inverse(one.X) for one in robot]

    def solve(a: int, b: int, pairs: tuple[Rows, Rows]) -> OrderFit:
        some = [(pick([robot[a]], pairs[0])[0], pick([camera[b]], pairs[1])[0], 0)]
        (one,) = agreements(some, eye_in_hand=eye_in_hand)
        X, Y, scale, G = one.X, one.Y, one.scale if one.unit_scale is None else one.unit_scale, camera[b].X
        moved = np.einsum("ca,ncd,de->nae", Y[:3, :3], F[a][:, :3, :3], X[:3, :3])
        trace = np.einsum("nab,mba->nm", moved, G[:, :3, :3])
        at = np.einsum("nab,mb->nma", F[a][:, :3, :3], scale * G[:, :3, 3] @ X[:3, :3].T + X[:3, 3])
        off = at + (F[a][:, :3, 3] - Y[:3, 3])[:, None]
        return OrderFit(
            turn2=np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)) ** 2,
            off2=(off**2).sum(axis=2),
            turn=one.turn,
            extent=one.extent,
            agrees=one.agrees,
        )

    ours, theirs = ([_all_angles(one.X) for one in listed] for listed in (robot, camera))
    return find_order(ours, theirs, solve, robot[0].X)


def _all_angles(X: Array) -> Array:
    """Angles (n, n) rad of the motions between poses: the same from either side."""
    R = X[:, :3, :3]
    return angle_of(np.einsum("aji,bjk->abik", R, R, optimize=True))


def _worth_solving(spread: Array, changes: Array, limit: float) -> Array:
    """Indices of the readings whose rotations agree, of the best of the others, and of the best without a change."""
    alive = spread <= limit * spread.min()
    dead = np.flatnonzero(~alive)
    plain = np.flatnonzero(changes == 0)
    best = [one[np.argmin(spread[one])] for one in (dead, plain) if len(one)]
    return np.union1d(np.flatnonzero(alive), np.array(best, dtype=int))


def _motion(R: Array) -> Array:
    """Rms angle (m,) of rotations (m, n, 3, 3) relative to their mean, rad."""
    off = np.swapaxes(nearest_rotation(R.sum(axis=1)), 1, 2)[:, None] @ R
    chord = np.linalg.norm(off - np.eye(3), axis=(2, 3)) / (2.0 * np.sqrt(2.0))
    return np.asarray(np.sqrt(((2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))) ** 2).mean(axis=1)))


def _weights(size: Array, kept: int) -> Array:
    """Weights (m, n) that fall where a residual is far beyond those of the poses that agree."""
    cut = np.sort(size, axis=1)[:, kept - 1 : kept] + 1e-12
    return np.asarray(np.minimum(1.0, (1.5 * cut / np.maximum(size, 1e-12)) ** 2))


def _rotation(F: Array, G: Array, kept: int) -> tuple[Array, Array, Array]:
    """R_X and R_Y of F R_X G = R_Y and the residual angles (m, n) rad, for (m, n, 3, 3).

    The better of two linear starts, then alternating robust means.
    """
    back = np.ascontiguousarray(np.swapaxes(F, 2, 3)), np.ascontiguousarray(np.swapaxes(G, 2, 3))
    one, other = (_alternate(R, F, G, back, kept, _TRIAL_STEPS) for R in _starts(F, G))
    better = _trimmed(other[2], kept) < _trimmed(one[2], kept)
    return _alternate(np.where(better[:, None, None], other[0], one[0]), F, G, back, kept, _STEPS)


def _alternate(
    R: Array, F: Array, G: Array, back: tuple[Array, Array], kept: int, steps: int
) -> tuple[Array, Array, Array]:
    """R_X, R_Y and the residual angles (m, n) after some steps from a start; ``back``: the transposed F and G."""
    weight = np.ones(F.shape[:2])
    moved = F @ R[:, None] @ G
    for _ in range(steps):
        RY = nearest_rotation((weight[..., None, None] * moved).sum(axis=1))
        R = nearest_rotation((weight[..., None, None] * (back[0] @ RY[:, None] @ back[1])).sum(axis=1))
        moved = F @ R[:, None] @ G
        chord = np.sqrt(((moved - RY[:, None]) ** 2).sum(axis=(2, 3))) / (2.0 * np.sqrt(2.0))
        angle = 2.0 * np.arcsin(np.minimum(chord, 1.0))
        weight = _weights(angle, kept)
    return R, RY, angle


def _trimmed(angle: Array, kept: int) -> Array:
    """Mean square of the least residuals."""
    return np.asarray(np.sort(angle**2, axis=1)[:, :kept].mean(axis=1))


def _starts(F: Array, G: Array) -> list[Array]:
    """Rotations R_X (m, 3, 3) that fit relative rotations best: of the Kronecker form, and of the rotation vectors."""
    m, n = F.shape[:2]
    i, j = _pairs(n, 3 * n)
    P, Q = np.swapaxes(F[:, i], 2, 3) @ F[:, j], G[:, i] @ np.swapaxes(G[:, j], 2, 3)
    M = np.einsum("mnik,mnjl->mijkl", P, Q, optimize=True).reshape(m, 9, 9)
    _, vectors = np.linalg.eigh(M + np.swapaxes(M, 1, 2))
    linear = vectors[:, :, -1].reshape(m, 3, 3)
    linear = linear * np.sign(np.linalg.det(linear) + 1e-300)[:, None, None]
    p, q = (Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(m, -1, 3) for R in (P, Q))
    # near half a turn the sign of the vector is not sure
    usable = (np.linalg.norm(p, axis=2) < _SURE_TURN) & (np.linalg.norm(q, axis=2) < _SURE_TURN)
    vectors_ = np.swapaxes(p * usable[..., None], 1, 2) @ q
    return [nearest_rotation(linear), nearest_rotation(vectors_ + 1e-9 * np.eye(3))]


def _about_one_axis(F: Array, G: Array, RX: Array, RY: Array, kept: int) -> tuple[Array, Array]:
    """R_X and R_Y turned about the robot's axis where it turns about one only.

    Rotations leave that angle open, and positions fix it.

    F X G = Y is linear in t_X, t_Y and, with v = R_X t_G and the axis a, in the factors of v along a, of v across a,
    and of a x v.
    """
    mean = nearest_rotation(F[..., :3, :3].sum(axis=1))
    turns = log_rotation((np.swapaxes(mean, 1, 2)[:, None] @ F[..., :3, :3]).reshape(-1, 3, 3)).reshape(*F.shape[:2], 3)
    spread, axes = np.linalg.svd(turns, full_matrices=False)[1:]
    RX, RY = RX.copy(), RY.copy()
    for k in np.flatnonzero(spread[:, 1] < _ONE_AXIS * spread[:, 0]):
        R, a, v = F[k, :, :3, :3], axes[k, 0], G[k, :, :3, 3] @ RX[k].T
        along = (v @ a)[:, None] * a
        parts = [(R @ u[..., None]) for u in (along, v - along, np.cross(a, v))]
        A = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape), *parts], axis=2)
        size = np.maximum(np.abs(A).max(axis=(0, 1)), 1e-30)
        weight = np.ones(len(R))
        for _ in range(_STEPS):
            some = np.sqrt(weight)[:, None]
            x = (
                np.linalg.lstsq(
                    (A / size * some[..., None]).reshape(-1, 9), -(F[k, :, :3, 3] * some).reshape(-1), 1e-9
                )[0]
                / size
            )
            weight = _weights(np.linalg.norm(A @ x + F[k, :, :3, 3], axis=1)[None], kept)[0]
        RX[k] = exp_rotation(a * np.arctan2(x[8], x[7])) @ RX[k]
        RY[k] = nearest_rotation((weight[:, None, None] * (R @ RX[k] @ G[k, :, :3, :3])).sum(axis=0))
    return RX, RY


def _pairs(n: int, most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices i < j of pairs of n poses, evenly chosen where there are more than ``most``."""
    i, j = np.triu_indices(n, 1)
    if len(i) > most:
        chosen = np.linspace(0, len(i) - 1, most).round().astype(int)
        i, j = i[chosen], j[chosen]
    return i, j


def _translation(F: Array, turned: Array, kept: int, scale: Array | None) -> tuple[Array, Array, Array, Array, Array]:
    """Solve F X G = Y for t_X, t_Y (m, 3) and the scale (m,) of the camera's positions.

    Also returns the residuals (m, n, 3), in F's unit, and the scale's sigma.

    ``turned``: R_F R_X t_G (m, n, 3). ``scale``: fixed, or None to estimate it.
    """
    m, n = F.shape[:2]
    columns = [F[..., :3, :3], np.broadcast_to(-np.eye(3), (m, n, 3, 3))]
    right = -F[..., :3, 3]
    if scale is None:
        columns.append(turned[..., None])
    else:
        right = right - scale[:, None, None] * turned
    A = np.concatenate(columns, axis=3)
    size = np.maximum(np.abs(A).max(axis=(1, 2)), 1e-30)
    A = A / size[:, None, None, :]
    weight = np.ones((m, n))
    for _ in range(_STEPS):
        AW = A * weight[..., None, None]
        H = np.einsum("mnik,mnil->mkl", AW, A)
        g = np.einsum("mnik,mni->mk", AW, right)
        inverted = np.linalg.pinv(H, rcond=1e-12, hermitian=True)
        x = (inverted @ g[..., None])[..., 0]
        d = np.einsum("mnik,mk->mni", A, x) - right
        weight = _weights(np.linalg.norm(d, axis=2), kept)
    x = x / size
    if scale is not None:
        return x[:, :3], x[:, 3:6], scale, d, np.zeros(m)
    variance = np.sort((d**2).sum(axis=2), axis=1)[:, :kept].sum(axis=1) / max(3 * kept - 7, 1)
    return x[:, :3], x[:, 3:6], x[:, 6], d, np.sqrt(np.maximum(variance * inverted[:, 6, 6], 0.0)) / size[:, 6]


def _nearest_unit(scale: float) -> float | None:
    """Return the ratio of two units of length that is nearest to a scale; None where none is near."""
    ratios = {a / b for a in UNITS.values() for b in UNITS.values()}
    near = min(ratios, key=lambda r: abs(np.log(scale / r)))
    return near if abs(np.log(scale / near)) < _NEAR_UNIT else None
