"""Closed-form rigid registration of two point sets or direction sets: the paper's Eq. (10) to (12)."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arrays import Array


def fit_rigid(p_B: Array, p_C: Array, *, weights: Array | None = None) -> RigidTransform:
    """X_BC minimising the weighted sum of |p_B - X_BC p_C|^2 for points (N, 3) m, N >= 3; scale fixed to 1.

    Source: paper, Eq. (10)-(12) (Umeyama 1991 with c = 1). With Sigma = U D V^T, R = U S V^T, and S = diag(1, 1, det(U
    V^T)) keeps R a rotation, also for coplanar points, where det(Sigma) of Eq. (12) is zero. Raises ValueError for
    collinear points, which leave a rotation open.
    """
    w = np.ones(len(p_B)) if weights is None else np.asarray(weights, dtype=float)
    w = w / w.sum()
    mean_B, mean_C = w @ p_B, w @ p_C
    U, D, Vt = np.linalg.svd((p_B - mean_B).T @ (w[:, None] * (p_C - mean_C)))
    if D[1] < 1e-12 * max(float(D[0]), 1e-30) or D[0] == 0.0:
        raise ValueError("collinear points do not fix a rotation")
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return RigidTransform(RotationMatrix(R), mean_B - R @ mean_C)


def fit_rigid_sets(p_B: Array, p_C: Array) -> tuple[Array, Array]:
    """Rotations (k, 3, 3) and translations (k, 3) of k point sets (s, n, 3) at once, as fit_rigid; collinear sets are
    omitted (k <= s)."""
    R, t, good = fit_all_rigid_sets(p_B, p_C)
    return R[good], t[good]


def fit_all_rigid_sets(p_B: Array, p_C: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Rotations (s, 3, 3), translations (s, 3) and whether they are fixed (s,) of s point sets (s, n, 3), as
    fit_rigid."""
    mean_B, mean_C = p_B.mean(axis=1), p_C.mean(axis=1)
    U, D, Vt = np.linalg.svd(np.swapaxes(p_B - mean_B[:, None], 1, 2) @ (p_C - mean_C[:, None]))
    good = (D[:, 1] >= 1e-12 * np.maximum(D[:, 0], 1e-30)) & (D[:, 0] > 0.0)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    R = U @ Vt
    return R, mean_B - np.einsum("kij,kj->ki", R, mean_C), good


@lru_cache(maxsize=64)
def drawn_triples(n: int, count: int, seed: int) -> NDArray[np.int64]:
    """Minimal sets (count, 3) of n points, each of three different ones; drawn once, for folds and models ask for the
    same."""
    rng = np.random.default_rng(seed)
    sets = np.array([rng.choice(n, 3, replace=False) for _ in range(count)])
    sets.setflags(write=False)
    return sets


def fit_rotation(u_B: Array, u_C: Array) -> RotationMatrix:
    """R_BC minimising the sum of |u_B - R_BC u_C|^2 for vectors (N, 3); two that are not parallel suffice."""
    U, _, Vt = np.linalg.svd(u_B.T @ u_C)
    return RotationMatrix(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
