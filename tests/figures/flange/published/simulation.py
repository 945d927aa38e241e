"""Simulates section 3.1 of the paper: the effect of Algorithm 1's cost on the errors that it is judged by."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import fit_all_rigid_sets
from weldcal.models.arrays import Array
from weldcal.tools.console import Progress

Ints = NDArray[np.int64]

X_BC_TRUE = RigidTransform(RotationMatrix([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]), [0.6, -0.0125, 1.0])
"""Eq. (19)."""
WORKSPACE_M = (0.3, 0.3, 0.2)
GRID = (5, 5, 3)
WORKSPACE_CENTRE_M = (0.6, -0.0125, 0.1)
"""The paper gives the workspace's size, not its place: here it lies under the camera and stands on the table."""
TILT_PER_MM = np.radians(0.05)
"""Noise of the verification pose's rotation per millimetre of noise of its position: 1 mm at the edge of a flange is
more."""
ROBUST_RUNS = 40
ORDERS = 3
"""Of the scans, for Fig. 9 as printed: of the calibrations of three orders that nearest to the truth."""

COSTS = {
    "truth": "Alg. 1, the true error",
    "verification": "Alg. 1, a measured pose",
    "median": "Alg. 1, median residual",
    "all": "all pairs, SVD",
    "ours": "all pairs, weldcal",
}
"""What chooses the calibration: the measured pose has the noise of the others, the median is over all pairs."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of K calibrations.

    ``e`` (K, 6) roll, pitch, yaw (rad) and x, y, z (m) of X_est^-1 X_true, as the paper takes them. ``at_tcp`` (K,
    75) m, how far each flange centre is put from where it is.
    """

    e: Array
    at_tcp: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Simulation:
    """Standard deviations and means (L, 6) at ``levels_m`` (L,) noise.

    Of all pairs and of Algorithm 1 judged by the truth (Fig. 9); ``history`` (75 - 3, K, 6) of it at 1 mm (Fig. 10)
    with ``history_tcp`` (75 - 3, K) m, the mean true error; ``costs`` at 1 mm, by name of COSTS. ``chosen_std`` (L, 6)
    is of the best of ORDERS orders by the truth; ``scaled`` at 1 mm, Eq. (10) with its c.
    """

    levels_m: Array
    all_mean: Array
    all_std: Array
    truth_mean: Array
    truth_std: Array
    history: Array
    history_tcp: Array
    costs: dict[str, Errors]
    chosen_std: Array
    scaled: dict[str, Errors]

    @property
    def ratio(self) -> Array:
        """Standard deviations of all pairs over Algorithm 1 (6,), mean over the levels: 7 for x and y in the paper."""
        return np.asarray((self.all_std / self.truth_std).mean(axis=0))

    @property
    def chosen_ratio(self) -> Array:
        """Return the same (6,) of the best of ORDERS orders."""
        return np.asarray((self.all_std / self.chosen_std).mean(axis=0))


def grid_points() -> Array:
    """Return the 75 flange centres (75, 3) m in the base."""
    axes = [c + np.linspace(-0.5, 0.5, n) * w for c, n, w in zip(WORKSPACE_CENTRE_M, GRID, WORKSPACE_M, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def noisy_points(p_B: Array, sigma: Array, rng: np.random.Generator) -> Array:
    """Eq. (20): (K, n, 3) m in the camera, one noise level of ``sigma`` (K,) m for each realisation."""
    exact = (X_BC_TRUE.inverse() @ p_B.T).T
    return np.asarray(exact + sigma[:, None, None] * rng.standard_normal((len(sigma), *p_B.shape)))


def algorithm1_batch(
    p_B: Array, p_C: Array, orders: Ints, cost: Callable[[Array, Array], Array], *, keep_history: bool = False
) -> tuple[Array, Array, list[tuple[Array, Array]]]:
    """Algorithm 1 on K realisations at once: p_B (n, 3), p_C (K, n, 3) m, ``orders`` (K, n) the order of the scans.

    ``cost`` takes R (K, m, 3, 3) and t (K, m, 3) and gives (K, m). The new pair enters at most once, as in
    iterative.algorithm1_step (a test holds the two against each other). Returns R (K, 3, 3), t (K, 3) and their
    history.
    """
    K = len(orders)
    rows = np.arange(K)
    pool = orders[:, :4].copy()
    R, t, value = (a[:, 0] for a in _fit(p_B, p_C, pool[:, None], cost))
    history = [(R.copy(), t.copy())] if keep_history else []
    for new in orders[:, 4:].T:
        tried = np.repeat(pool[:, None], 4, axis=1)
        tried[:, np.arange(4), np.arange(4)] = new[:, None]
        R_new, t_new, values = _fit(p_B, p_C, tried, cost)
        best = np.argmin(values, axis=1)
        better = values[rows, best] < value
        pool[better] = tried[rows, best][better]
        R[better], t[better] = R_new[rows, best][better], t_new[rows, best][better]
        value = np.where(better, values[rows, best], value)
        if keep_history:
            history.append((R.copy(), t.copy()))
    return R, t, history


def _fit(p_B: Array, p_C: Array, pools: Ints, cost: Callable[[Array, Array], Array]) -> tuple[Array, Array, Array]:
    """R (K, m, 3, 3), t (K, m, 3) and cost (K, m), infinite where collinear, of pools (K, m, 4)."""
    K, m, _ = pools.shape
    b = p_B[pools.reshape(-1, 4)]
    c = p_C[np.repeat(np.arange(K), m)[:, None], pools.reshape(-1, 4)]
    R, t, good = fit_all_rigid_sets(b, c)
    R, t = R.reshape(K, m, 3, 3), t.reshape(K, m, 3)
    return R, t, np.where(good.reshape(K, m), cost(R, t), np.inf)


def camera_error(R: Array, t: Array, R_true: Array, t_true: Array) -> tuple[Array, Array]:
    """Rotation (..., 3, 3) and translation (..., 3) of X_est^-1 X_true."""
    Rt = np.swapaxes(R, -1, -2)
    return Rt @ R_true, np.einsum("...ij,...j->...i", Rt, t_true - t)


def errors_of(R: Array, t: Array, p_B: Array, scale: Array | None = None) -> Errors:
    """Errors of K estimates (K, 3, 3), (K, 3), where they scale the points by ``scale`` (K,)."""
    dR, dt = camera_error(R, t, X_BC_TRUE.rotation().matrix(), X_BC_TRUE.translation())
    rpy = Rotation.from_matrix(dR).as_euler("xyz")
    exact = (X_BC_TRUE.inverse() @ p_B.T).T
    turned = np.einsum("kij,nj->kni", R, exact) * (1.0 if scale is None else scale[:, None, None])
    at_tcp = np.linalg.norm(turned + t[:, None] - p_B, axis=2)
    return Errors(np.hstack([rpy, dt]), at_tcp)


def simulate(*, levels: int = 50, realisations: int = 100, seed: int = 0, progress: Progress) -> Simulation:
    """Fig. 9 (noise to 10 mm in ``levels`` steps), Fig. 10 and the comparison of costs at 1 mm.

    Deterministic for ``seed``.
    """
    p_B = grid_points()
    rng = np.random.default_rng(seed)
    R_true, t_true = X_BC_TRUE.rotation().matrix(), X_BC_TRUE.translation()

    def by_truth(R: Array, t: Array) -> Array:
        return np.asarray(np.linalg.norm(camera_error(R, t, R_true, t_true)[1], axis=-1))

    sigmas = 0.010 * np.arange(1, levels + 1) / levels
    spread: dict[str, list[Errors]] = {"all": [], "truth": [], "chosen": []}
    more = np.random.default_rng([seed, ORDERS])
    for k, sigma in enumerate(sigmas):
        progress("simulated noise levels", k / levels)
        p_C = noisy_points(p_B, np.full(realisations, sigma), rng)
        spread["all"].append(errors_of(*_all_pairs(p_B, p_C), p_B))
        R, t, _ = algorithm1_batch(p_B, p_C, _orders(realisations, len(p_B), rng), by_truth)
        spread["truth"].append(errors_of(R, t, p_B))
        for _ in range(ORDERS - 1):
            R_k, t_k, _ = algorithm1_batch(p_B, p_C, _orders(realisations, len(p_B), more), by_truth)
            nearer = by_truth(R_k, t_k) < by_truth(R, t)
            R[nearer], t[nearer] = R_k[nearer], t_k[nearer]
        spread["chosen"].append(errors_of(R, t, p_B))
    p_C = noisy_points(p_B, np.full(realisations, 1e-3), rng)
    orders = _orders(realisations, len(p_B), rng)
    R, t, steps = algorithm1_batch(p_B, p_C, orders, by_truth, keep_history=True)
    path = [errors_of(Rk, tk, p_B) for Rk, tk in steps]
    costs = {"truth": errors_of(R, t, p_B), "all": errors_of(*_all_pairs(p_B, p_C), p_B)}
    R_v, t_v = _measured_camera(realisations, 1e-3, rng)

    def by_verification(R: Array, t: Array) -> Array:
        shift = camera_error(R, t, R_v[:, None], t_v[:, None])[1]
        return np.asarray(np.linalg.norm(shift, axis=-1))

    def by_median(R: Array, t: Array) -> Array:
        off = np.einsum("kmij,knj->kmni", R, p_C) + t[:, :, None] - p_B
        return np.asarray(np.median(np.linalg.norm(off, axis=-1), axis=-1))

    for name, cost in (("verification", by_verification), ("median", by_median)):
        progress(f"Algorithm 1 by its {name}", 1.0)
        R, t, _ = algorithm1_batch(p_B, p_C, orders, cost)
        costs[name] = errors_of(R, t, p_B)
    costs["ours"] = errors_of(*_robust(p_B, p_C[:ROBUST_RUNS]), p_B)
    mean = {k: np.array([x.e.mean(axis=0) for x in v]) for k, v in spread.items()}
    std = {k: np.array([x.e.std(axis=0, ddof=1) for x in v]) for k, v in spread.items()}
    return Simulation(
        levels_m=sigmas,
        all_mean=mean["all"],
        all_std=std["all"],
        truth_mean=mean["truth"],
        truth_std=std["truth"],
        history=np.array([x.e for x in path]),
        history_tcp=np.array([x.at_tcp.mean(axis=1) for x in path]),
        costs={name: costs[name] for name in COSTS},
        chosen_std=std["chosen"],
        scaled=with_scale(p_B, p_C),
    )


def with_scale(p_B: Array, p_C: Array) -> dict[str, Errors]:
    """Errors of Eq. (10) with its c for p_B (n, 3) and p_C (K, n, 3) m.

    c = tr(DS) / sigma^2 is Umeyama's scale, applied to points and translation. The last line of Eq. (11) as printed is
    sigma^2 itself, in square metres; it is taken as c of Eq. (10b), and the result as a rigid pose.
    """
    R, t, _ = fit_all_rigid_sets(np.broadcast_to(p_B, p_C.shape), p_C)
    mean_B, mean_C = p_B.mean(axis=0), p_C.mean(axis=1)
    off = p_C - mean_C[:, None]
    variance = (off**2).sum(axis=2).mean(axis=1)
    trace = np.einsum("kij,knj,ni->k", R, off, p_B - mean_B) / p_B.shape[0]  # tr(D S) = tr(R^T Sigma)
    turned = np.einsum("kij,kj->ki", R, mean_C)
    c = trace / variance
    umeyama = errors_of(R, mean_B - c[:, None] * turned, p_B, c)
    return {
        "c = tr(DS) / sigma²": umeyama,
        "c = 1 (Eq. 9)": errors_of(R, t, p_B),
        "c as printed, sigma²": errors_of(R, mean_B - variance[:, None] * turned, p_B),
    }


def _orders(K: int, n: int, rng: np.random.Generator) -> Ints:
    return np.asarray(np.argsort(rng.random((K, n)), axis=1), dtype=np.int64)


def _all_pairs(p_B: Array, p_C: Array) -> tuple[Array, Array]:
    R, t, _ = fit_all_rigid_sets(np.broadcast_to(p_B, p_C.shape), p_C)
    return R, t


def _measured_camera(K: int, sigma: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Measure the camera's pose R (K, 3, 3), t (K, 3) by one verification flange under the grid's middle."""
    p_B = np.array(WORKSPACE_CENTRE_M)
    p_C = X_BC_TRUE.inverse() @ p_B + sigma * rng.standard_normal((K, 3))
    turn = Rotation.from_rotvec(1e3 * sigma * TILT_PER_MM * rng.standard_normal((K, 3))).as_matrix()
    R = X_BC_TRUE.rotation().matrix() @ turn
    return R, p_B - np.einsum("kij,kj->ki", R, p_C)


def _robust(p_B: Array, p_C: Array) -> tuple[Array, Array]:
    config = SolveConfig(leave_one_out=False, hypotheses=60)
    poses = [RigidTransform(p) for p in p_B]
    found = [
        estimate_eye_on_base(
            [Observation(str(i), X, c) for i, (X, c) in enumerate(zip(poses, points, strict=True))], config
        )
        for points in p_C
    ]
    return np.array([f.X_BC.rotation().matrix() for f in found]), np.array([f.X_BC.translation() for f in found])
