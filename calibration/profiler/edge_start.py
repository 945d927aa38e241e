"""Where the edge problem may start: point-to-line least squares from the 24 orientations of a cube, all at once.

The distance of a point to a line has no division by the angle between edge and scan plane, so that this converges from any
orientation, where the reprojection of edge_joint would not.
"""

from __future__ import annotations

import itertools

import numpy as np

from weldcal.calibration.profiler.edge_model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats, skew, turned

ITERATIONS = 60
KEPT = 3  # different optima that are polished
SAME_RAD = 0.02
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
    r = np.empty((m, n, 3))
    J = np.empty((m, n, 3, 10))
    fresh = np.ones(m, bool)
    for _ in range(ITERATIONS):
        if fresh.any():
            r, J = _linearised(poses, R, t, mean, e, p_S)
            scale = np.minimum(scale, _scale(r))
            cost = _cost(r, scale)
        w = 1.0 / (1.0 + np.einsum("mni,mni->mn", r, r) / scale[:, None] ** 2)
        Jw = np.swapaxes((w[:, :, None, None] * J).reshape(m, -1, 10), 1, 2)
        H, g = Jw @ J.reshape(m, -1, 10), (Jw @ r.reshape(m, -1, 1))[:, :, 0]
        unit = np.sqrt(np.einsum("mii->mi", H)) + 1e-12
        A = H / (unit[:, :, None] * unit[:, None, :]) + damping[:, None, None] * np.eye(10)
        step = -np.linalg.solve(A, (g / unit)[:, :, None])[:, :, 0] / unit
        across = _tangents(e)
        R_new, t_new = turned(R, step[:, :3]), t + step[:, 3:6]
        mean_new = mean + np.einsum("mij,mj->mi", across, step[:, 6:8])
        e_new = e + np.einsum("mij,mj->mi", across, step[:, 8:10])
        e_new /= np.linalg.norm(e_new, axis=1, keepdims=True)
        cost_new = _cost(_distances(_in_base(poses, R_new, t_new, p_S), mean_new, e_new), scale)
        fresh = cost_new < cost
        settled = np.abs(cost - cost_new) < 1e-9 * cost
        R, t = np.where(fresh[:, None, None], R_new, R), np.where(fresh[:, None], t_new, t)
        mean, e = np.where(fresh[:, None], mean_new, mean), np.where(fresh[:, None], e_new, e)
        damping = np.clip(np.where(fresh, 0.2 * damping, 10.0 * damping), 1e-12, 1e9)
        if (settled | (damping > 1e8)).all():
            break
    # compared at one scale: a start that explains little must not look good by its own
    common = _distances(_in_base(poses, R, t, p_S), mean, e)
    return R, t, mean, e, _cost(common, np.full(m, max(float(scale.min()), 1e-9)))


def _in_base(poses: FlangePoses, R: Floats, t: Floats, p_S: Floats) -> Floats:
    """Profile points (n, 3) in B (m, n, 3) for m candidates."""
    p_F = np.einsum("mij,nj->mni", R, p_S) + t[:, None]
    return np.asarray(np.einsum("nij,mnj->mni", poses.rotation, p_F) + poses.translation)


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
    """Distances (m, n, 3) and their Jacobian (m, n, 3, 10) by [turn in S; p_FS; line's point and direction across it]."""
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
    J[..., 3:6] = np.einsum("mij,njk->mnik", P, poses.rotation)
    J[..., 6:8] = -across[:, None]
    # e changes: the part along the old line leaves, and what lies off it leans
    J[..., 8:10] = -along[:, :, None, None] * across[:, None]
    lean = np.einsum("mni,mik->mnk", r, across)
    J[..., 8:10] -= e[:, None, :, None] * lean[:, :, None, :]
    return r, J
