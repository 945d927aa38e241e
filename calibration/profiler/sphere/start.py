"""Initial estimates of the sphere problem: radial least squares from the 24 orientations of a cube."""

from collections.abc import Sequence

import numpy as np

from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.profiler.edge.start import cube_rotations
from weldcal.calibration.profiler.motion import FlangePoses, Floats, times_own, turned
from weldcal.calibration.profiler.sphere.arc import fit_circle

POINTS = 7  # of each profile
ITERATIONS = 80
KEPT = 3
SAME_RAD = 0.02  # as in edge/start.py
WORSE = 3.0  # times the best one's mean distance: what explains the sphere so badly is not polished


def sphere_starts(
    poses: FlangePoses, profiles: Sequence[Floats], radius_m: float
) -> list[tuple[Floats, Floats, Floats]]:
    """The best different optima (R_FS, p_FS, centre in B), best first."""
    some = [p[np.linspace(0, len(p) - 1, POINTS).astype(int)] for p in profiles]
    p = np.vstack(some)
    of = np.repeat(np.arange(len(some)), POINTS)
    p_S = np.column_stack([p[:, 0], np.zeros(len(p)), p[:, 1]])
    R_BF, p_BF = poses.rotation[of], poses.translation[of]
    R = cube_rotations()
    m = len(R)
    t, c = _translations(poses, profiles, R, radius_m)
    damping = np.full(m, 1e-2)
    r, J = _linearised(R_BF, p_BF, R, t, c, p_S, radius_m)
    cost = _cost(r)
    for _ in range(ITERATIONS):
        w = 1.0 / np.sqrt(1.0 + (r / _scale(r)[:, None]) ** 2)
        Jw = np.swapaxes(w[:, :, None] * J, 1, 2)
        H, g = Jw @ J, (Jw @ r[:, :, None])[:, :, 0]
        unit = np.sqrt(np.einsum("mii->mi", H)) + 1e-12
        A = H / (unit[:, :, None] * unit[:, None, :]) + damping[:, None, None] * np.eye(9)
        step = -np.linalg.solve(A, (g / unit)[:, :, None])[:, :, 0] / unit
        R_new, t_new, c_new = turned(R, step[:, :3]), t + step[:, 3:6], c + step[:, 6:]
        r_new, J_new = _linearised(R_BF, p_BF, R_new, t_new, c_new, p_S, radius_m)
        cost_new = _cost(r_new)
        better = cost_new < cost
        settled = np.abs(cost - cost_new) < 1e-10 * cost
        R, t = np.where(better[:, None, None], R_new, R), np.where(better[:, None], t_new, t)
        c, cost = np.where(better[:, None], c_new, c), np.where(better, cost_new, cost)
        r, J = np.where(better[:, None], r_new, r), np.where(better[:, None, None], J_new, J)
        damping = np.clip(np.where(better, 0.2 * damping, 10.0 * damping), 1e-12, 1e9)
        if (settled | (damping > 1e8)).all():
            break
    chosen: list[int] = []
    for k in np.argsort(cost):
        if cost[k] > WORSE * cost.min() + 1e-9:
            break
        angles = [np.arccos(np.clip(0.5 * (np.trace(R[k].T @ R[j]) - 1.0), -1.0, 1.0)) for j in chosen]
        if all(angle > SAME_RAD for angle in angles):
            chosen.append(int(k))
        if len(chosen) == KEPT:
            break
    return [(R[k], t[k], c[k]) for k in chosen]


def _translations(poses: FlangePoses, profiles: Sequence[Floats], R: Floats, radius_m: float) -> tuple[Floats, Floats]:
    """p_FS (m, 3) and the sphere's centre in B (m, 3) for rotations R_FS (m, 3, 3), by linear least squares.

    The sphere's centre in S is taken as that of the profile's circle: its distance from the scan plane, unknown in
    sign, is left out. From p_FS = 0 the search ended in another optimum in up to half of the sets of six scans.
    """
    circles = np.array([fit_circle(p)[0] for p in profiles])
    means = np.array([p.mean(axis=0) for p in profiles])
    x, z = np.where(circles[:, 2:] < 1.05 * radius_m, circles[:, :2], means).T
    c_F = np.column_stack([x, np.zeros(len(x)), z]) @ np.swapaxes(R, 1, 2)
    moved = times_own(c_F, np.swapaxes(poses.rotation, 1, 2)) + poses.translation
    A = np.concatenate([poses.rotation, np.tile(-np.eye(3), (len(poses), 1, 1))], axis=2).reshape(-1, 6)
    found = -moved.reshape(len(R), -1) @ np.linalg.pinv(A).T
    return np.asarray(found[:, :3]), np.asarray(found[:, 3:])


def _scale(r: Floats) -> Floats:
    return np.asarray(np.maximum(3.0 * np.median(np.abs(r), axis=1), 1e-9))


def _cost(r: Floats) -> Floats:
    return np.asarray(np.abs(r).mean(axis=1))


def _linearised(
    R_BF: Floats, p_BF: Floats, R: Floats, t: Floats, c: Floats, p_S: Floats, radius_m: float
) -> tuple[Floats, Floats]:
    """Distances (m, n) to the sphere and their Jacobian (m, n, 9) by [turn in S; p_FS; centre]."""
    p_F = p_S @ np.swapaxes(R, 1, 2) + t[:, None]
    at = times_own(p_F, np.swapaxes(R_BF, 1, 2)) + p_BF - c[:, None]
    length = np.maximum(np.linalg.norm(at, axis=2), 1e-9)
    n_B = at / length[:, :, None]
    n_F = times_own(n_B, R_BF)
    turn = -times_own(n_F @ R, skew(p_S))
    return np.asarray(length - radius_m), np.concatenate([turn, n_F, -n_B], axis=2)
