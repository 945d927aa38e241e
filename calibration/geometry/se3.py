"""Rigid motions on arrays: rotations, small changes, means, and the registration of two point sets in closed form."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.models.arms.kinematics import Chain, chain_poses
from weldcal.models.arrays import Array

IDENTITY: Array = np.eye(4)
IDENTITY.setflags(write=False)


def skew(v: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def inverse(X: Array) -> Array:
    """Inverse of rigid poses (..., 4, 4)."""
    out = np.zeros_like(X)
    Rt = np.swapaxes(X[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ X[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def pose(R: Array, p: Array) -> Array:
    """Poses (..., 4, 4) from rotations (..., 3, 3) and positions (..., 3)."""
    R, p = np.asarray(R, dtype=float), np.asarray(p, dtype=float)
    out = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = R, p, 1.0
    return out


def log_rotation(R: Array) -> Array:
    """Rotation vectors (n, 3) rad of rotations (n, 3, 3)."""
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt((v * v).sum(axis=1))
    cosine = 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    w = v * np.where(sine > 1e-8, angle / np.maximum(sine, 1e-8), 1.0)[:, None]
    # near a half turn the antisymmetric part fades: go by the quaternion there
    turned = cosine < -0.9
    if turned.any():
        w[turned] = Rotation.from_matrix(R[turned]).as_rotvec()
    return np.asarray(w)


def as_transform(X: Array) -> RigidTransform:
    """Return a pose (4, 4) as RigidTransform, its rotation projected."""
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]), X[:3, 3])


def scaled(X: Array, factor: float) -> Array:
    """Return poses (n, 4, 4) with their positions multiplied by a factor."""
    out = X.copy()
    out[:, :3, 3] *= factor
    return out


def angle_of(R: Array) -> Array:
    """Angles (...) rad of rotations (..., 3, 3)."""
    return np.asarray(np.arccos(np.clip(0.5 * (np.einsum("...ii->...", R) - 1.0), -1.0, 1.0)))


def frames_along(z: Array) -> Array:
    """Rotations (..., 3, 3) whose third columns are the unit vectors z (..., 3)."""
    x = np.cross(z, np.where(np.abs(z[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def rotation_vector(R: RotationMatrix) -> Array:
    """Axis times angle (3,) rad of a rotation."""
    aa = R.ToAngleAxis()
    return np.asarray(aa.axis() * aa.angle(), dtype=float)


def exp_rotation(w: Array) -> Array:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) rad."""
    w = np.asarray(w, dtype=float)
    if w.ndim > 1 or not math.isfinite(w @ w):
        return np.asarray(Rotation.from_rotvec(w).as_matrix())
    # one at a time, as solvers ask: Rodrigues' formula on plain numbers takes a sixth of the time
    x, y, z = w.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 0.0 else 1.0
    b = 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 0.0 else 0.5
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def left_jacobian_inverse(w: Array) -> Array:
    """d log(exp(d) R) / d d at d = 0 (n, 3, 3), for w = log R (n, 3) (Chirikjian 2012, Eq. 10.86)."""
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    S = skew(w)
    a = np.clip(angle, 1e-4, np.pi - 1e-9)
    c = np.where(angle < 1e-3, 1.0 / 12.0 + angle**2 / 720.0, 1.0 / a**2 - (1.0 + np.cos(a)) / (2.0 * a * np.sin(a)))
    return np.asarray(np.eye(3) - 0.5 * S + c * (S @ S))


def nearest_rotation(M: Array) -> Array:
    """Rotation(s) (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm (Arun et al. 1987)."""
    U, _, Vt = np.linalg.svd(M)
    U = U.copy()
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


def moved(X: Array, change: Array) -> Array:
    """X after a change (6,) [rotation.

    Translation] on the parent's side about the child's origin: (exp(a) R, p + b).
    """
    out = X.copy()
    out[:3, :3] = exp_rotation(change[:3]) @ X[:3, :3]
    out[:3, 3] += change[3:]
    return out


def difference(X: Array, Y: Array) -> Array:
    """Return the change (6,) that moves X to Y in the sense of ``moved``."""
    return np.concatenate([log_rotation((Y[:3, :3] @ X[:3, :3].T)[None])[0], Y[:3, 3] - X[:3, 3]])


def mean_pose(X: Array) -> Array:
    """Chordal mean of rotations and component-wise median of positions of poses (n, 4, 4)."""
    return pose(nearest_rotation(X[:, :3, :3].sum(axis=0)), np.median(X[:, :3, 3], axis=0))


def mean_of(poses: list[Array]) -> Array:
    """Return the pose M with sum log(M^-1 X_k) = 0 on SE(3).

    It moves with the poses under any change of frames on either side (Pennec and Arsigny 2013, bi-invariant mean).
    """
    M = poses[0]
    stack = np.array(poses)
    before = np.inf
    for _ in range(50):
        D = inverse(M) @ stack
        w = log_rotation(D[:, :3, :3])
        rho = (left_jacobian_inverse(w) @ D[:, :3, 3:])[:, :, 0].mean(axis=0)
        omega = w.mean(axis=0)
        step = pose(exp_rotation(omega), np.linalg.solve(left_jacobian_inverse(omega[None])[0], rho))
        M = M @ step
        M = pose(nearest_rotation(M[:3, :3]), M[:3, 3])
        size = float(np.linalg.norm(omega))
        if size < 1e-15 or (size < 1e-12 and size >= 0.5 * before):  # rounding: nothing left to gain
            break
        before = size
    return M


def flange_poses(arm: Chain, q: Array, errors: Array) -> Array:
    """Flange poses (m, 4, 4) at joint angles q (m, n) rad; ``errors`` (n, 6) [rotation.

    Translation] of each joint in its own frame before it turns: the third is the joint's offset.
    """
    return chain_poses(replace(arm, stack=arm.stack @ pose(exp_rotation(errors[:, :3]), errors[:, 3:])), q)


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
    """Rotations (k, 3, 3) and translations (k, 3) of k point sets (s, n, 3) at once, as fit_rigid.

    Collinear sets are omitted (k <= s).
    """
    R, t, good = fit_all_rigid_sets(p_B, p_C)
    return R[good], t[good]


def fit_all_rigid_sets(p_B: Array, p_C: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Fit rotations (s, 3, 3) and translations (s, 3) of s point sets (s, n, 3), as fit_rigid.

    The third result (s,) is whether a set fixes them.
    """
    mean_B, mean_C = p_B.mean(axis=1), p_C.mean(axis=1)
    U, D, Vt = np.linalg.svd(np.swapaxes(p_B - mean_B[:, None], 1, 2) @ (p_C - mean_C[:, None]))
    good = (D[:, 1] >= 1e-12 * np.maximum(D[:, 0], 1e-30)) & (D[:, 0] > 0.0)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    R = U @ Vt
    return R, mean_B - np.einsum("kij,kj->ki", R, mean_C), good


@lru_cache(maxsize=64)
def drawn_triples(n: int, count: int, seed: int) -> NDArray[np.int64]:
    """Minimal sets (count, 3) of n points, each of three different ones.

    Drawn once, for folds and models ask for the same.
    """
    rng = np.random.default_rng(seed)
    sets = np.array([rng.choice(n, 3, replace=False) for _ in range(count)])
    sets.setflags(write=False)
    return sets


def fit_with_offset(p_B: Array, p_C: Array, R_B: Array) -> tuple[Array, Array, Array]:
    """R_BC (3, 3), p_BC (3,) and b (3,) of R_BC p_C + p_BC = p_B + R_B b, the rotation's nine numbers free.

    So an offset b of any size in the frames R_B (n, 3, 3) is linear; points (n, 3) m, n >= 6.
    """
    n = len(p_C)
    A = np.zeros((n, 3, 15))
    for k in range(3):
        A[:, k, 3 * k : 3 * k + 3] = p_C
    A[:, :, 9:12], A[:, :, 12:] = np.eye(3), -R_B
    x = np.asarray(np.linalg.lstsq(A.reshape(-1, 15), p_B.ravel(), rcond=1e-9)[0], dtype=float)
    return nearest_rotation(x[:9].reshape(3, 3)), x[9:12], x[12:]


def fit_rotation(u_B: Array, u_C: Array) -> RotationMatrix:
    """R_BC minimising the sum of |u_B - R_BC u_C|^2 for vectors (N, 3); two that are not parallel suffice."""
    return RotationMatrix(nearest_rotation(u_B.T @ u_C))
