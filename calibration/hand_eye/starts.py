"""Closed-form initial estimates: quaternions, Kronecker products, dual quaternions, logarithms, a rotation grid."""

from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.se3 import inverse, log_rotation, nearest_rotation, pose
from weldcal.calibration.hand_eye.problem import Problem, State
from weldcal.models.arrays import Array

Rotations = tuple[Array, Array, Array]

_PAIRS = 600  # motions beyond these add little to a start
_CUBE: Array = np.asarray(Rotation.create_group("O").as_matrix())


def motions(problem: Problem, state: State) -> tuple[Array, Array]:
    """Relative motions P_k X = X Q_k (k, 4, 4) each, of a problem whose Z is known.

    A_i X = Y B_i gives A_i^-1 A_j X = X B_i^-1 B_j with A = F, B = H Z G^-1.
    """
    A, B = problem.F, (problem.H @ state[2]) @ inverse(problem.G)
    if problem.tied:
        return A, B
    n = len(A)
    # every so many of the pairs i < j, row by row, without a list of all of them
    total = n * (n - 1) // 2
    k = np.arange(0, total, max(1, total // _PAIRS))
    row = np.arange(n)
    begin = row * n - row * (row + 1) // 2
    i = np.searchsorted(begin, k, side="right") - 1
    i = np.minimum(i, n - 2)
    j = k - begin[i] + i + 1
    return inverse(A[i]) @ A[j], inverse(B[i]) @ B[j]


def kronecker(problem: Problem, state: State) -> Rotations:
    """R_F R_X R_G = R_Y R_P by the leading singular vectors of the sum of Kronecker products (Shah 2013)."""
    A = problem.F[:, :3, :3]
    B = (problem.H[:, :3, :3] @ state[2][:3, :3]) @ np.swapaxes(problem.G[:, :3, :3], 1, 2)
    T = np.einsum("nab,ncd->acbd", A, B).reshape(9, 9)  # row-major vec: (A (x) B) vec(R_X) = vec(A R_X B^T)
    U, _, Vt = np.linalg.svd(T)
    X, Y = Vt[0].reshape(3, 3), U[:, 0].reshape(3, 3)
    if np.linalg.det(X) < 0.0:
        X, Y = -X, -Y
    return nearest_rotation(X), nearest_rotation(Y), state[2][:3, :3]


def logarithms(problem: Problem, state: State) -> Rotations:
    """Rotation of X that lays the rotation vectors of the motions on each other (Park and Martin 1994)."""
    P, Q = motions(problem, state)
    M = log_rotation(P[:, :3, :3]).T @ log_rotation(Q[:, :3, :3])
    return _with_y(problem, nearest_rotation(M), state)


def quaternions(problem: Problem, state: State) -> Rotations:
    """Unit quaternion of X nearest to q_P x = x q_Q for all motions (Horaud and Dornaika 1995)."""
    P, Q = motions(problem, state)
    a, b = _quaternions(P), _quaternions(Q)
    D = _left(a) - _right(b)
    x = np.linalg.eigh(np.einsum("nki,nkj->ij", D, D))[1][:, 0]
    return _with_y(problem, _rotation(x), state)


def dual_quaternions(problem: Problem, state: State) -> Rotations:
    """Rotation part of the dual quaternion of X that all motions share (Daniilidis 1999, Eq. 31-33).

    Lengths are measured in units of the motions' own translations, so that the unit in which they are given does not
    matter.
    """
    P, Q = motions(problem, state)
    length = max(float(np.sqrt((P[:, :3, 3] ** 2 + Q[:, :3, 3] ** 2).sum(axis=1).mean())), 1e-30)
    a, b = _quaternions(P), _quaternions(Q)
    da = _dual(a, P[:, :3, 3] / length)
    db = _dual(b, Q[:, :3, 3] / length)
    L, M = _left(a) - _right(b), _left(da) - _right(db)
    T = np.zeros((len(a), 8, 8))
    T[:, :4, :4], T[:, 4:, :4], T[:, 4:, 4:] = L, M, L
    v = np.linalg.eigh(np.einsum("nki,nkj->ij", T, T))[1]
    u, w = v[:, 0], v[:, 1]
    # lambda u + mu w must be a unit dual quaternion: real and dual parts orthogonal
    c = np.array([u[:4] @ u[4:], u[:4] @ w[4:] + u[4:] @ w[:4], w[:4] @ w[4:]])
    best, best_norm = u[:4], -1.0
    for s in np.roots(c) if abs(c[0]) > 1e-15 else np.array([0.0]):
        q = float(np.real(s)) * u[:4] + w[:4]
        norm = float(np.linalg.norm(q)) / np.sqrt(float(np.real(s)) ** 2 + 1.0)
        if norm > best_norm:
            best, best_norm = q, norm
    if float(np.linalg.norm(best)) < 1e-9:
        best = w[:4]
    return _with_y(problem, _rotation(best), state)


def kronecker_three(problem: Problem, state: State) -> Rotations:
    """R_F R_X R_G = R_Y R_H R_Z, linear in R_X and in the product of R_Y and R_Z: 90 unknowns, one null vector.

    Here vec(R_F R_X R_G) = (R_F (x) R_G^T) vec(R_X) and vec(R_Y R_H R_Z) = (R_Y (x) R_Z^T) vec(R_H): the 81 entries of
    the latter factor are one vector, split afterwards into its nearest Kronecker product (Van Loan and Pitsianis 1993).
    """
    F, G, H = problem.F[:, :3, :3], problem.G[:, :3, :3], problem.H[:, :3, :3]
    n = len(F)
    rows = np.zeros((n, 9, 90))
    rows[:, :, :9] = np.einsum("nab,ndc->nacbd", F, G).reshape(n, 9, 9)
    h = H.reshape(n, 9)
    for k in range(9):
        rows[:, k, 9 + 9 * k : 18 + 9 * k] = -h
    flat = rows.reshape(-1, 90)
    v = np.linalg.eigh(flat.T @ flat)[1][:, 0]
    X = v[:9].reshape(3, 3)
    K = v[9:].reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    Y, Zt = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)
    X, Y, Zt = (np.asarray(M * np.sign(np.linalg.det(M)), dtype=np.float64) for M in (X, Y, Zt))
    return nearest_rotation(X), nearest_rotation(Y), nearest_rotation(Zt.T)


def relaxed_points(problem: Problem, state: State) -> Rotations:
    """Rotation of X from measured points alone, all nine entries free: R_F (R_X g + t_X) + t_F = Y (H Z origin).

    Y's position is free with it; Y's rotation counts as known where H moves the point.
    """
    F, g = problem.F, problem.G[:, :3, 3]
    n = len(F)
    rows = np.zeros((n, 3, 15))
    rows[:, :, :9] = np.einsum("nab,nd->nabd", F[:, :3, :3], g).reshape(n, 3, 9)
    rows[:, :, 9:12] = F[:, :3, :3]
    rows[:, :, 12:] = -np.eye(3)
    target = (state[1] @ problem.H @ state[2])[:, :3, 3]
    fixed = not problem.free[1]
    right = (target if fixed else target - target.mean(axis=0)) - F[:, :3, 3]
    A = rows.reshape(3 * n, 15)[:, : 12 if fixed else 15]
    scale = np.maximum(np.abs(A).max(axis=0), 1e-30)
    solution = np.linalg.lstsq(A / scale, right.reshape(-1), rcond=1e-9)[0] / scale
    return nearest_rotation(solution[:9].reshape(3, 3)), state[1][:3, :3], state[2][:3, :3]


def with_positions(problem: Problem, rotations: Rotations, state: State) -> State:
    """Positions of the free poses by linear least squares, their rotations given (equal weights)."""
    RX, RY, RZ = rotations
    n = len(problem)
    RF, tF = problem.F[:, :3, :3], problem.F[:, :3, 3]
    RYH = RY @ problem.H[:, :3, :3]
    right = -(RF @ (problem.G[:, :3, 3] @ RX.T)[:, :, None])[:, :, 0] - tF + problem.H[:, :3, 3] @ RY.T
    parts = [RF, np.broadcast_to(-np.eye(3), (n, 3, 3)), -RYH]
    columns = []
    for k in range(3):
        if k in problem.blocks:
            columns.append(parts[k] + parts[1] if problem.tied else parts[k])
        elif not (problem.tied and k == 1):
            right = right - (parts[k] @ state[k][:3, 3])
    solution = np.linalg.lstsq(np.concatenate(columns, axis=2).reshape(3 * n, -1), right.reshape(-1), rcond=1e-9)[0]
    positions: list[Array] = [np.asarray(state[k][:3, 3]) for k in range(3)]
    for row, k in enumerate(problem.blocks):
        positions[k] = np.asarray(solution[3 * row : 3 * row + 3], dtype=np.float64)
    if problem.tied:
        positions[1] = positions[0]
    return pose(RX, positions[0]), pose(RY, positions[1]), pose(RZ, positions[2])


def closed_forms(problem: Problem, state: State) -> Iterator[tuple[str, State]]:
    """The closed-form starts that fit the unknowns and the kind of observations, with their names, one after the other.

    ``state`` holds the known poses (identity where unknown).
    """
    methods: list[tuple[str, Callable[[Problem, State], Rotations]]] = []
    poses = problem.pick(problem.full) if not problem.full.all() else problem
    if len(poses) >= 3 and problem.free[0]:
        if problem.free == (True, True, False) and not problem.tied:
            methods = [("Kronecker", kronecker), ("logarithms", logarithms), ("quaternions", quaternions)]
            methods.append(("dual quaternions", dual_quaternions))
        elif problem.tied:
            methods = [("logarithms", logarithms), ("quaternions", quaternions), ("dual quaternions", dual_quaternions)]
        elif problem.free == (True, True, True) and len(poses) >= 6:
            methods = [("Kronecker of three", kronecker_three)]
        elif problem.free == (True, False, False):
            methods = [("mean", _mean_x)]
    for name, method in methods:
        yield name, with_positions(problem, method(poses, state), state)
    if len(poses) < len(problem) and problem.free[0] and not problem.free[2]:
        yield "points", with_positions(problem, relaxed_points(problem, state), state)


def grid(problem: Problem, state: State, rng: np.random.Generator, n: int = 24) -> list[tuple[str, State]]:
    """Return the rotations of the cube, about a random axis, as starts for X.

    The rotations of the other unknowns follow from the observations where these are poses, or stay as they are.
    """
    tilt = np.asarray(Rotation.random(rng=rng).as_matrix())
    out = []
    for k in range(n):
        RX = tilt @ _CUBE[k % 24]
        rotations = _others(problem, RX, state, rng)
        out.append(("grid", with_positions(problem, rotations, state)))
    return out


def _others(problem: Problem, RX: Array, state: State, rng: np.random.Generator) -> Rotations:
    RY, RZ = state[1][:3, :3], state[2][:3, :3]
    poses = problem.pick(problem.full)
    if problem.tied:
        return RX, RX, RZ
    if not len(poses):
        if problem.free[1]:
            RY = np.asarray(Rotation.random(rng=rng).as_matrix())
        return RX, RY, RZ
    M = poses.F[:, :3, :3] @ RX @ poses.G[:, :3, :3]
    if problem.free[2]:
        # alternate: each of the two rotations has a closed form while the other is held
        RZ = np.asarray(Rotation.random(rng=rng).as_matrix())
        for _ in range(6):
            RY = nearest_rotation(np.einsum("nij,nkj->ik", M, poses.H[:, :3, :3] @ RZ))
            RZ = nearest_rotation(np.einsum("nji,njk->ik", RY @ poses.H[:, :3, :3], M))
    elif problem.free[1]:
        RY = nearest_rotation(np.einsum("nij,nkj->ik", M, poses.H[:, :3, :3] @ RZ))
    return RX, RY, RZ


def _mean_x(problem: Problem, state: State) -> Rotations:
    M = np.swapaxes(problem.F[:, :3, :3], 1, 2) @ (state[1] @ problem.H @ state[2])[:, :3, :3]
    return nearest_rotation(np.einsum("nij,nkj->ik", M, problem.G[:, :3, :3])), state[1][:3, :3], state[2][:3, :3]


def _with_y(problem: Problem, RX: Array, state: State) -> Rotations:
    if problem.tied:
        return RX, RX, state[2][:3, :3]
    M = problem.F[:, :3, :3] @ RX @ problem.G[:, :3, :3]
    P = problem.H[:, :3, :3] @ state[2][:3, :3]
    return RX, nearest_rotation(np.einsum("nij,nkj->ik", M, P)), state[2][:3, :3]


def _quaternions(X: Array) -> Array:
    """Unit quaternions (n, 4) wxyz with w >= 0 of poses."""
    q = np.asarray(Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=True))
    return np.where(q[:, :1] < 0.0, -q, q)


def _left(q: Array) -> Array:
    """Matrices (n, 4, 4) of p -> q p."""
    w, x, y, z = q.T
    return np.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w], axis=1).reshape(-1, 4, 4)


def _right(q: Array) -> Array:
    """Matrices (n, 4, 4) of p -> p q."""
    w, x, y, z = q.T
    return np.stack([w, -x, -y, -z, x, w, z, -y, y, -z, w, x, z, y, -x, w], axis=1).reshape(-1, 4, 4)


def _dual(q: Array, t: Array) -> Array:
    """Dual parts (n, 4): half of (0, t) q."""
    return 0.5 * (_right(q) @ np.column_stack([np.zeros(len(t)), t])[:, :, None])[:, :, 0]


def _rotation(q: Array) -> Array:
    return np.asarray(Rotation.from_quat(q / np.linalg.norm(q), scalar_first=True).as_matrix())
