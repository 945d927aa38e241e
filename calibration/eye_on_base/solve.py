"""Solves eye-on-base calibration: robust weighted least squares on SE(3) with a covariance from the residuals."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.special import gammaincinv

from weldcal.calibration.adjustment import Kind, Observed, Spread, Unknowns, adjust, helmert, huber
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, few_residuals, point_error_covariance
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import chi2_quantile, f_quantile
from weldcal.calibration.geometry.se3 import (
    as_transform,
    drawn_triples,
    fit_all_rigid_sets,
    fit_rigid_sets,
    fit_rotation,
    skew,
)
from weldcal.calibration.planning.observability import check_diversity, unobservable_sentences
from weldcal.models.arrays import Array

__all__ = ["CalibrationEstimate", "HeldOut", "SolveConfig", "estimate_eye_on_base", "point_error_covariance"]

Flags = NDArray[np.bool_]

_GATE = 6.5  # in sigma per axis: only gross outliers go; a scanner's distortion at the rim of its field reaches five
_WIDEST_GATE = 10.0  # so many times wider at most, where three spare numbers or fewer set the scale
_START_POSES = 500  # at most: more do not make a start better
_HELD_OUT_FITS = 100  # at most, so that the time grows with the number of poses and not with its square
_WORST_SHARE = 0.1  # of the spread of the poses: residuals beyond it are no calibration
_WORST_TILT_RAD = 0.17  # of the normals' median: no arm, scanner or fit is ten degrees off
_POSITION_FLOOR_M = 1e-6  # below any scanner or arm: keeps exact synthetic data from dividing by zero
USUAL_SPREAD_M, USUAL_TILT_RAD = 1.5e-4, 1.2e-3
"""What robot and scanner together are off, an axis, where too few scans show it: as on the recorded arms."""


@dataclass(frozen=True, kw_only=True)
class SolveConfig:
    """Settings of the estimator.

    ``max_outliers`` is the share of gross outliers it must survive (and the least that agree). ``usual_weight`` is how
    many residuals the usual spread of robot and scanner (USUAL_SPREAD_M, USUAL_TILT_RAD) counts for beside the
    residuals themselves: three poses have too few of them.
    """

    seed: int = 0
    max_outliers: float = 0.40
    hypotheses: int = 600
    use_normals: bool = True
    min_poses: int = 4
    allow_coplanar: bool = False
    leave_one_out: bool = True
    usual_weight: float = 0.0


@dataclass(frozen=True, kw_only=True)
class _Data:
    """Hold observations as arrays: b, c (n, 3) m; z, m (n, 3) normals in B and C; has (n,) a normal; fit noise."""

    b: Array
    c: Array
    z: Array
    m: Array
    has: Flags
    cov: Array
    var_n: Array

    def pick(self, keep: Flags | NDArray[np.int64]) -> _Data:
        return _Data(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})


@dataclass(frozen=True, kw_only=True)
class _Solution:
    X_BC: RigidTransform
    information: Array
    var_p: float
    var_n: float
    information_p: Array  # what the positions alone bring of it
    redundancy: float = 1e6  # of the positions
    redundancy_n: float = 1e6  # of the normals


def estimate_eye_on_base(
    observations: list[Observation] | tuple[Observation, ...], config: SolveConfig | None = None
) -> CalibrationEstimate:
    """Estimate X_BC from observations of the flange at n poses, from positions and (if any) normals together.

    Start: closed form (paper, Eq. (10)-(12)) on seeded minimal sets, concentrated on the best (1 - max_outliers) share
    of the poses. Then Gauss-Newton on SE(3) with Huber weights inside a chi-square gate. The variances of positions and
    of normals are estimated from the residuals (Helmert's simplified estimator, each group divided by its own
    redundancy), never set by taste. Held-out errors repeat the weighted fit without each pose in turn (of more than 100
    poses: without each of 100 groups). Deterministic for ``config.seed``. Raises TooFewPoses, RepeatedPoses,
    CoplanarPoses (see observability.check_diversity) and InconsistentPoses when no rigid transform explains enough of
    the poses.
    """
    config = config or SolveConfig()
    observations = tuple(observations)
    data = _arrays(observations, config.use_normals)
    check_diversity(data.b, data.has, min_poses=config.min_poses, allow_coplanar=config.allow_coplanar)
    start = _robust_start(data, config)
    solution, inliers = _reweighted(data, start, config.usual_weight)
    n = len(data.b)
    need = max(3, int(np.ceil((1.0 - config.max_outliers) * n - 1e-9)))
    if int(inliers.sum()) < need and n > 4:
        raise InconsistentPoses(
            f"Only {int(inliers.sum())} of {n} poses agree on one camera position (at most"
            f" {100 * config.max_outliers:.0f} % may be outliers). Check the units and the order of the poses, and that"
            " the camera did not move."
        )
    spread = float(np.sqrt(((data.b - data.b.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if np.sqrt(solution.var_p) > _WORST_SHARE * spread:
        raise InconsistentPoses(
            f"The poses disagree by {1e3 * np.sqrt(solution.var_p):.0f} mm per axis. Check the units, the order of the"
            " poses and of the quaternion's numbers, and that the camera did not move."
        )
    if not inliers.all():
        check_diversity(
            data.b[inliers], data.has[inliers], min_poses=config.min_poses, allow_coplanar=config.allow_coplanar
        )
    residual, tilt = _residuals(data, solution.X_BC)
    used = inliers & data.has
    if used.any() and float(np.median(tilt[used])) > _WORST_TILT_RAD:
        raise InconsistentPoses(
            f"The scanned faces are turned by {np.degrees(np.median(tilt[used])):.0f} degrees from the flange's z axis"
            " in the poses. Check the quaternion order (qw, qx, qy, qz), and that the poses are those of the flange,"
            " not of a tool."
        )
    held_out = HeldOut(residual.copy(), tilt.copy())
    if config.leave_one_out:
        held_out = _leave_one_out(data, inliers, solution, held_out, config.usual_weight)
    warnings = []
    if not inliers.all():
        names = ", ".join(o.id for o, keep in zip(observations, inliers, strict=True) if not keep)
        warnings.append(f"{n - int(inliers.sum())} of {n} poses disagree with the rest and were excluded: {names}.")
    kept = [o for o, keep in zip(observations, inliers, strict=True) if keep]
    sigma_p = float(np.sqrt(solution.var_p))
    return CalibrationEstimate(
        X_BC=solution.X_BC,
        covariance=_widened(solution),
        inliers=inliers,
        position_residuals_m=residual,
        tilt_residuals_rad=tilt,
        held_out=held_out,
        sigma_position_m=sigma_p,
        sigma_normal_rad=float(np.sqrt(solution.var_n)),
        unobservable=unobservable_sentences([o.X_BR for o in kept], sigma_p, bool(data.has.any())),
        warnings=tuple(warnings),
    )


def _arrays(observations: tuple[Observation, ...], use_normals: bool) -> _Data:
    n = len(observations)
    has = np.array([use_normals and o.n_C is not None for o in observations], dtype=bool)
    m = np.array([o.n_C if o.n_C is not None else np.zeros(3) for o in observations], dtype=float).reshape(n, 3)
    cov = np.array([np.zeros((3, 3)) if o.center_covariance is None else o.center_covariance for o in observations])
    var_n = np.array([0.0 if o.normal_sigma is None else o.normal_sigma**2 for o in observations])
    b = np.array([o.p_BR for o in observations]).reshape(n, 3)
    z = np.array([o.n_B for o in observations]).reshape(n, 3)
    return _Data(
        b=b,
        c=np.array([o.p_CR for o in observations]).reshape(n, 3),
        z=z,
        m=m,
        has=has,
        cov=cov.reshape(n, 3, 3),
        var_n=var_n,
    )


def _residuals(data: _Data, X_BC: RigidTransform) -> tuple[Array, Array]:
    seen = data.m @ X_BC.rotation().matrix().T
    z = data.z
    cross = [seen[:, i] * z[:, j] - seen[:, j] * z[:, i] for i, j in ((1, 2), (2, 0), (0, 1))]
    sine = np.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)  # np.cross and norm take four times as long
    tilt = np.arctan2(sine, (seen * z).sum(axis=1))
    return _distances(data, X_BC), np.where(data.has, tilt, np.nan)


def robust_start(b: Array, c: Array, config: SolveConfig) -> RigidTransform:
    """Return the camera pose that explains most of n centres: b (n, 3) in the base, c (n, 3) in the camera, m."""
    n, none = len(b), np.zeros((len(b), 3))
    unknown = _Data(b=b, c=c, z=none, m=none, has=np.zeros(n, bool), cov=np.zeros((n, 3, 3)), var_n=np.zeros(n))
    return _robust_start(unknown, config)


def _robust_start(data: _Data, config: SolveConfig) -> RigidTransform:
    """Best of seeded minimal sets, each concentrated twice (least trimmed squares, Rousseeuw and Van Driessen 1999)."""
    if len(data.b) > _START_POSES:
        data = data.pick(np.linspace(0, len(data.b) - 1, _START_POSES).round().astype(int))
    n = len(data.b)
    if n < 3:
        return _closed_form(data)
    h = min(n, max(3, int(np.ceil((1.0 - config.max_outliers) * n))))
    sets = _minimal_sets(n, config.hypotheses, config.seed)
    R, t = fit_rigid_sets(data.b[sets], data.c[sets])
    if len(R) == 0:
        return _closed_form(data)
    costs = _trimmed(_squares(data, R, t), h)
    best = np.argsort(costs, kind="stable")[:15]
    R, t, costs = R[best], t[best], costs[best]
    going = np.arange(len(best))
    for _ in range(6):
        nearest = np.argsort(_squares(data, R[going], t[going]), axis=1, kind="stable")[:, :h]
        R_new, t_new, fixed = fit_all_rigid_sets(data.b[nearest], data.c[nearest])
        new = _trimmed(_squares(data, R_new, t_new), h)
        better = fixed & (new < costs[going] * (1.0 - 1e-9))
        going = going[better]
        if len(going) == 0:
            break
        R[going], t[going], costs[going] = R_new[better], t_new[better], new[better]
    k = int(np.argmin(costs))
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R[k]), t[k])


def _minimal_sets(n: int, hypotheses: int, seed: int) -> NDArray[np.int64]:
    """Return all triples of n poses (k, 3), or as many drawn ones as there are hypotheses."""
    if n * (n - 1) * (n - 2) // 6 <= hypotheses:
        return np.array(list(itertools.combinations(range(n), 3)))
    return drawn_triples(n, hypotheses, seed)


def _squares(data: _Data, R: Array, t: Array) -> Array:
    """Squared distances (k, n) m^2 of the flange centres for k poses R (k, 3, 3), t (k, 3)."""
    return np.asarray(((data.c @ np.swapaxes(R, 1, 2) + t[:, None] - data.b) ** 2).sum(axis=2))


def _trimmed(square: Array, h: int) -> Array:
    """Return the sum (k,) over the h smallest of each row of `square` (k, n)."""
    return np.asarray(np.partition(square, h - 1, axis=1)[:, :h].sum(axis=1))


def _distances(data: _Data, X: RigidTransform) -> Array:
    """Return the distance of each observed centre from its stated position, (n,) m."""
    return np.asarray(np.linalg.norm(data.c @ X.rotation().matrix().T + X.translation() - data.b, axis=1))


def _closed_form(data: _Data) -> RigidTransform:
    """Few or degenerate poses: normals and chords together fix the rotation."""
    mean_b, mean_c = data.b.mean(axis=0), data.c.mean(axis=0)
    scale = max(float(np.abs(data.b - mean_b).max()), 1e-9)
    u_B = np.vstack([(data.b - mean_b) / scale, data.z[data.has]])
    u_C = np.vstack([(data.c - mean_c) / scale, data.m[data.has]])
    R = fit_rotation(u_B, u_C)
    return RigidTransform(R, mean_b - R.matrix() @ mean_c)


def _scale_from_trimmed(e: Array, h: int) -> float:
    """Per-axis sigma from the h smallest of n 3-D errors, by the matching quantile of the chi distribution."""
    q = min((h - 0.5) / len(e), 0.98)
    return float(np.partition(e, h - 1)[h - 1] / np.sqrt(2.0 * gammaincinv(1.5, q)))


def _reweighted(data: _Data, start: RigidTransform, usual: float = 0.0) -> tuple[_Solution, Flags]:
    """Alternate gating and weighted fits until the set of inliers repeats."""
    n = len(data.b)
    e, _ = _residuals(data, start)
    # six parameters were fitted to few poses: the small residuals of a minimal set must not set the scale
    h = max(int(0.6 * n), min(n, 3))
    dof = max(3 * h - 6, 1) / (3 * h)
    sigma = max(_scale_from_trimmed(e, h) / np.sqrt(dof), _POSITION_FLOOR_M) * _loose(3 * h - 6)
    keep = _gate(data, start, sigma**2) if n > 4 else np.ones(n, dtype=bool)
    solution = _Solution(X_BC=start, information=np.eye(6), var_p=sigma**2, var_n=1e-3**2, information_p=np.eye(6))
    seen: set[bytes] = set()
    for _ in range(12):
        solution = _fit(data, keep, solution, usual)
        seen.add(keep.tobytes())
        if n <= 4:
            break
        new = _gate(data, solution.X_BC, solution.var_p * _loose(3 * int(keep.sum()) - 6) ** 2)
        if int(new.sum()) < 3 or new.tobytes() in seen:
            break
        keep = new
    return solution, keep


@cache
def _loose(redundancy: int) -> float:
    """How much wider a gate must be whose scale was found from few spare numbers: it may be far too small by chance.

    The ratio of the quantiles of F (3, redundancy) and chi-square (3) that one good pose in ten thousand exceeds.
    """
    wide = 3.0 * f_quantile(1.0 - 1e-4, 3, max(redundancy, 1)) / chi2_quantile(1.0 - 1e-4, 3)
    return float(min(np.sqrt(wide), _WIDEST_GATE))


def _gate(data: _Data, X: RigidTransform, var_p: float) -> Flags:
    R = X.rotation().matrix()
    e = data.c @ R.T + X.translation() - data.b
    cov = R @ data.cov @ R.T + var_p * np.eye(3)
    d2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)
    return np.asarray(d2 < _GATE**2)


def _fit(data: _Data, keep: Flags, start: _Solution, usual: float = 0.0) -> _Solution:
    """Adjust the pose to the inliers, with a spread of positions and one of normals."""
    d = data.pick(keep)
    c, b, m, z = d.c, d.b, d.m[d.has], d.z[d.has]

    def linearised(at: Unknowns) -> tuple[Observed, Observed]:
        R, p = at.poses[0][:3, :3], at.poses[0][:3, 3]
        q, seen = c @ R.T, m @ R.T
        J, tilt = np.zeros((len(c), 3, 6)), np.zeros((len(m), 3, 6))
        J[:, :, :3], J[:, :, 3:], tilt[:, :, :3] = -skew(q), np.eye(3), -skew(seen)
        e = seen - z
        e -= (e * z).sum(axis=1)[:, None] * z
        return Observed(q + p - b, J, R @ d.cov @ R.T), Observed(e, tilt, d.var_n[d.has])

    def spread(expected: float) -> Spread:
        """Helmert's, with ``usual`` residuals of the expected size."""
        return lambda left: helmert(
            replace(left, weighted=left.weighted + usual * (expected / left.sigma) ** 2, spare=left.spare + usual)
        )

    found = adjust(
        Unknowns((np.asarray(start.X_BC.GetAsMatrix4()),), np.zeros(0)),
        linearised,
        (
            Kind(rank=3, loss=huber, spread=spread(USUAL_SPREAD_M), sigma=float(np.sqrt(start.var_p))),
            Kind(rank=2, loss=huber, spread=spread(USUAL_TILT_RAD), sigma=float(np.sqrt(start.var_n))),
        ),
    )
    return _Solution(
        X_BC=as_transform(found.at.poses[0]),
        information=found.information,
        information_p=found.of[0],
        var_p=found.sigmas[0] ** 2,
        var_n=found.sigmas[1] ** 2,
        redundancy=found.spare[0] + usual,
        redundancy_n=found.spare[1] + usual,
    )


def _leave_one_out(data: _Data, inliers: Flags, solution: _Solution, full: HeldOut, usual: float) -> HeldOut:
    position, tilt = full.position_m.copy(), full.tilt_rad.copy()
    if int(inliers.sum()) < (3 if data.has.all() else 4):
        return HeldOut(np.full_like(position, np.nan), np.full_like(tilt, np.nan))
    used = np.flatnonzero(inliers)
    for k in range(min(len(used), _HELD_OUT_FITS)):
        out = used[k::_HELD_OUT_FITS]
        keep = inliers.copy()
        keep[out] = False
        position[out], tilt[out] = _residuals(data.pick(out), _fit(data, keep, solution, usual).X_BC)
    return HeldOut(position, tilt)


def _widened(solution: _Solution) -> Array:
    """Widen the covariance for few poses and for spreads that were themselves estimated.

    Its Gaussian 95 % region then holds the truth in 95 of 100 calibrations.

    A plain inverse leaves out two things. The weights between positions and normals are estimates too (Kenward and
    Roger 1997, their adjusted covariance, each variance known to 2 / redundancy of itself). So is the scale (the ratio
    of the 95 % quantiles of F (6, redundancy) and chi-square (6)).
    """
    inverse = np.linalg.pinv(solution.information)
    N_p = solution.information_p
    N_n = solution.information - N_p
    excess = np.zeros((6, 6))
    for part, redundancy in ((N_p, solution.redundancy), (N_n, solution.redundancy_n)):
        excess += 2.0 / redundancy * (inverse @ (part - part @ inverse @ part) @ inverse)
    return np.asarray(few_residuals(solution.redundancy) * (inverse + 2.0 * excess))
