"""Initial estimates of the edge problem: point-to-line least squares from the 24 orientations of a cube.

The distance of a point to a line has no division by the angle between edge and scan plane, so that this converges from
any orientation, where the reprojection of edge_joint would not.
"""

import itertools

import numpy as np

from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats, times_own, turned

ITERATIONS = 60
SETTLED = 1e-6  # of the cost, in one step: the reprojection goes on from there
KEPT = 3  # different optima that are polished
SAME_RAD = 0.02  # a choice: nearer ends of descents are one optimum; half only polishes the same one twice
ROBUST = 2.5  # Cauchy scale in robust sigmas of the distances


def cube_rotations() -> Floats:
    """The 24 rotations (24, 3, 3) that bring a cube onto itself."""
    found = []
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[list(axes), range(3)] = signs
            if np.linalg.det(R) > 0.0:
                found.append(R)
    return np.array(found)


def edge_starts(poses: FlangePoses, p: Floats) -> list[EdgeState]:
    """The best different optima, best first."""
    R, t, point, e, cost = _point_to_line(poses, p)
    chosen: list[int] = []
    for k in np.argsort(cost):
        turn = [np.arccos(np.clip(0.5 * (np.trace(R[k].T @ R[j]) - 1.0), -1.0, 1.0)) for j in chosen]
        if all(angle > SAME_RAD for angle in turn):
            chosen.append(int(k))
        if len(chosen) == KEPT:
            break
    return [EdgeState(R[k], t[k], point[k], e[k]) for k in chosen]


def _line(points: Floats) -> tuple[Floats, Floats]:
    """Mean (m, 3) and main direction (m, 3) of points (m, n, 3)."""
    mean = points.mean(axis=1)
    centred = points - mean[:, None]
    _, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    return mean, vectors[:, :, 2]


def _point_to_line(poses: FlangePoses, p: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Levenberg-Marquardt on 24 problems side by side; a Cauchy loss scaled by each problem's own median distance."""
    R = cube_rotations()
    m, n = len(R), len(p)
    p_S = np.column_stack([p[:, 0], np.zeros(n), p[:, 1]])
    t, damping = np.zeros((m, 3)), np.full(m, 1e-2)
    mean, e = _line(_in_base(poses, R, t, p_S))
    scale = _scale(_distances(_in_base(poses, R, t, p_S), mean, e))
    cost = np.full(m, np.inf)
    left = np.arange(m)  # those that have not settled
    for _ in range(ITERATIONS):
        R0, e0, mean0 = R[left], e[left], mean[left]
        r, J = _linearised(poses, R0, t[left], mean0, e0, p_S)
        scale[left] = s = np.minimum(scale[left], _scale(r))
        before = _cost(r, s)
        w = 1.0 / (1.0 + np.einsum("mni,mni->mn", r, r) / s[:, None] ** 2)
        J = J.reshape(len(left), -1, 10)
        Jw = np.swapaxes(np.repeat(w, 3, axis=1)[:, :, None] * J, 1, 2)
        H, g = Jw @ J, (Jw @ r.reshape(len(left), -1, 1))[:, :, 0]
        unit = np.sqrt(np.einsum("mii->mi", H)) + 1e-12
        A = H / (unit[:, :, None] * unit[:, None, :]) + damping[left][:, None, None] * np.eye(10)
        step = -np.linalg.solve(A, (g / unit)[:, :, None])[:, :, 0] / unit
        across = _tangents(e0)
        R1, t1 = turned(R0, step[:, :3]), t[left] + step[:, 3:6]
        mean1 = mean0 + np.einsum("mij,mj->mi", across, step[:, 6:8])
        e1 = e0 + np.einsum("mij,mj->mi", across, step[:, 8:10])
        e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
        after = _cost(_distances(_in_base(poses, R1, t1, p_S), mean1, e1), s)
        better = after < before
        k = left[better]
        R[k], t[k], mean[k], e[k] = R1[better], t1[better], mean1[better], e1[better]
        cost[left] = np.where(better, after, before)
        damping[left] = np.clip(np.where(better, 0.2, 10.0) * damping[left], 1e-12, 1e9)
        left = left[~((better & (before - after < SETTLED * before)) | (damping[left] > 1e8))]
        if not left.size:
            break
    # compared at one scale: a start that explains little must not look good by its own
    common = _distances(_in_base(poses, R, t, p_S), mean, e)
    return R, t, mean, e, _cost(common, np.full(m, max(float(scale.min()), 1e-9)))


def _in_base(poses: FlangePoses, R: Floats, t: Floats, p_S: Floats) -> Floats:
    """Profile points (n, 3) in B (m, n, 3) for m candidates."""
    p_F = p_S @ np.swapaxes(R, 1, 2) + t[:, None]
    return times_own(p_F, np.swapaxes(poses.rotation, 1, 2)) + poses.translation


def _distances(points: Floats, mean: Floats, e: Floats) -> Floats:
    off = points - mean[:, None]
    return np.asarray(off - np.einsum("mni,mi->mn", off, e)[:, :, None] * e[:, None])


def _scale(r: Floats) -> Floats:
    return np.asarray(np.maximum(ROBUST * 1.4826 * np.median(np.linalg.norm(r, axis=2), axis=1), 1e-9))


def _cost(r: Floats, scale: Floats) -> Floats:
    return np.asarray(np.log1p(np.einsum("mni,mni->mn", r, r) / scale[:, None] ** 2).sum(axis=1) * scale**2)


def _tangents(e: Floats) -> Floats:
    a = np.cross(e, np.eye(3)[np.argmin(np.abs(e), axis=1)])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return np.stack([a, np.cross(e, a)], axis=2)


def _linearised(
    poses: FlangePoses, R: Floats, t: Floats, mean: Floats, e: Floats, p_S: Floats
) -> tuple[Floats, Floats]:
    """Distances (m, n, 3) and their Jacobian (m, n, 3, 10) by [turn in S; p_FS; line's point and direction across
    it]."""
    m, n = len(R), len(p_S)
    points = _in_base(poses, R, t, p_S)
    off = points - mean[:, None]
    along = np.einsum("mni,mi->mn", off, e)
    r = off - along[:, :, None] * e[:, None]
    P = np.eye(3) - e[:, :, None] * e[:, None, :]
    across = _tangents(e)
    J = np.empty((m, n, 3, 10))
    turn = -np.einsum("nij,mjk,nkl->mnil", poses.rotation, R, skew(p_S), optimize=True)
    J[..., :3] = P[:, None] @ turn
    J[..., 3:6] = P[:, None] @ poses.rotation
    J[..., 6:8] = -across[:, None]
    # e changes: the part along the old line leaves, and what lies off it leans
    J[..., 8:10] = -along[:, :, None, None] * across[:, None]
    lean = np.einsum("mni,mik->mnk", r, across)
    J[..., 8:10] -= e[:, None, :, None] * lean[:, :, None, :]
    return r, J
