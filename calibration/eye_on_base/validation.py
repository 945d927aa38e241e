"""Judge a calibration for its report: held-out errors, their intervals, and advice which poses to add."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import (
    CalibrationEstimate,
    corrected_observation,
    point_error_covariance,
    sigma_at,
)
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import t_quantile
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.calibration.planning.observability import has_orientations, turn_deg
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError

Solve = Callable[[list[Observation]], tuple[RigidTransform, ScannerCorrection]]
"""Camera pose and scanner correction from observations."""


@dataclass(frozen=True)
class VerificationResult:
    """Errors of a calibration at one held-out pose."""

    label: str
    error_m: float
    tilt_rad: float


def position_errors(X_BC: RigidTransform, observations: Sequence[Observation]) -> Array:
    """Distances (n,) m between the flange centres by the calibration and by the robot."""
    p_C, p_B = (np.array([getattr(o, name) for o in observations]).reshape(-1, 3) for name in ("p_CR", "p_BR"))
    return np.asarray(np.linalg.norm(X_BC.multiply(p_C.T).T - p_B, axis=1))


@dataclass(frozen=True, eq=False)
class Offset:
    """A stated X_BC beside the one of new scans, compared at the middle ``p_BQ`` (3,) m of their flange centres.

    ``new``: the estimate from these scans alone. ``shift_m`` (3,): the place of that point by the stated pose, less its
    place by the new one, in B, with its ``covariance`` (3, 3) m^2. ``turn_rad``: the angle between both.
    """

    new: CalibrationEstimate
    p_BQ: Array
    shift_m: Array
    covariance: Array
    turn_rad: float

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of ``shift_m``, in any direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def offset_from(X_BC: RigidTransform, observations: Sequence[Observation], seed: int = 0) -> Offset | None:
    """Return how far a stated X_BC is off by new observations; None where they do not determine a pose.

    In the middle of the centres an error of the scanner's scale does not count: both poses move the same points.
    """
    try:
        new = estimate_eye_on_base(tuple(observations), SolveConfig(seed=seed))
    except WeldcalError:
        return None
    p_CQ = np.mean([o.p_CR for o, keep in zip(observations, new.inliers, strict=True) if keep], axis=0)
    p_BQ = new.X_BC @ p_CQ
    turn = float(np.linalg.norm(rotation_vector(X_BC.rotation() @ new.X_BC.rotation().inverse())))
    return Offset(new, p_BQ, X_BC @ p_CQ - p_BQ, point_error_covariance(new, p_BQ), turn)


def scale_error(X_BC: RigidTransform, observations: Sequence[Observation]) -> tuple[float, float]:
    """Estimate the scale that, with a shift, best explains the errors, and its standard error; NaN for few scans."""
    n = len(observations)
    if n < 6:
        return float("nan"), float("nan")
    c = np.array([X_BC.rotation() @ o.p_CR for o in observations])
    e = np.array([o.p_BR - X_BC @ o.p_CR for o in observations])
    c, e = c - c.mean(axis=0), e - e.mean(axis=0)
    spread = float((c**2).sum())
    if spread < 1e-6:
        return float("nan"), float("nan")
    scale = float((c * e).sum()) / spread
    left = float(((e - scale * c) ** 2).sum()) / (3 * n - 4)
    return scale, float(np.sqrt(left / spread))


def tilt_errors(X_BC: RigidTransform, observations: Sequence[Observation]) -> Array:
    """Return the angle (n,) rad between observed and stated face normals; NaN where none was observed."""
    out = []
    for o in observations:
        if o.n_C is None:
            out.append(np.nan)
            continue
        seen = X_BC.rotation() @ o.n_C
        out.append(float(np.arctan2(np.linalg.norm(np.cross(seen, o.n_B)), seen @ o.n_B)))
    return np.array(out)


def _plain(config: SolveConfig) -> Solve:
    """Return the plain estimate, without a correction of the scanner, as a Solve."""
    config = replace(config, leave_one_out=False, hypotheses=150)
    return lambda observations: (estimate_eye_on_base(observations, config).X_BC, ScannerCorrection())


def k_fold(
    observations: Sequence[Observation],
    *,
    folds: int = 5,
    repeats: int = 10,
    seed: int = 0,
    config: SolveConfig | None = None,
    solve: Solve | None = None,
) -> Array:
    """Held-out position errors (repeats, n) m, NaN where a fold could not be solved (too few or coplanar poses left).

    ``solve`` replaces the plain estimate and may correct the scanner as well; it sees the poses of its fold only.
    Deterministic for ``seed``. Raises InputError when there are fewer poses than folds.
    """
    n = len(observations)
    if not 2 <= folds <= n:
        raise InputError(f"{n} poses cannot be divided into {folds} folds; ask for 2 to {n}.")
    solve = solve or _plain(config or SolveConfig())
    rng = np.random.default_rng(seed)
    errors = np.full((repeats, n), np.nan)
    for r in range(repeats):
        order = rng.permutation(n)
        for f in range(folds):
            test = order[f::folds]
            held = set(test.tolist())
            train = [o for i, o in enumerate(observations) if i not in held]
            try:
                X, correction = solve(train)
            except InputError:
                continue
            errors[r, test] = position_errors(X, [corrected_observation(correction, observations[i]) for i in test])
    return errors


@dataclass(frozen=True)
class Convergence:
    """Errors against the number of scans.

    Attributes:
        counts: (k,) numbers of scans.
        held_out: (rows, k) m, errors on the scans that were not used yet, over seeded orders; NaN where open.
    """

    counts: Array
    held_out: Array


def shuffled_orders(observations: Sequence[Observation], orders: int, seed: int) -> Iterator[list[Observation]]:
    """Yield the observations in as many seeded orders."""
    rng = np.random.default_rng(seed)
    for _ in range(orders):
        yield [observations[i] for i in rng.permutation(len(observations))]


def convergence(
    observations: Sequence[Observation], *, orders: int = 8, seed: int = 0, solve: Solve | None = None
) -> Convergence:
    """Calibrate from the first scans of seeded orders, in the manner of the paper's Fig. 11; at least two scans judge.

    ``solve`` replaces the plain estimate, as in k_fold.
    """
    n = len(observations)
    counts = np.unique(np.concatenate([np.arange(4, 10), np.round(np.geomspace(9, max(n, 10), 8)).astype(int)]))
    counts = counts[counts <= n - 2]
    solve = solve or _plain(SolveConfig())
    held_out = np.full((orders * n, len(counts)), np.nan)
    for r, shuffled in enumerate(shuffled_orders(observations, orders, seed)):
        for k, m in enumerate(counts):
            try:
                X, correction = solve(shuffled[:m])
            except InputError:
                continue  # the first m scans of this order lie in one plane
            seen = correction.points(np.array([o.p_CR for o in shuffled[m:]]))
            p_B = np.array([o.p_BR for o in shuffled[m:]])
            held_out[r * n : r * n + n - int(m), k] = np.linalg.norm(X.multiply(seen.T).T - p_B, axis=1)
    return Convergence(counts.astype(float), held_out)


def mean_interval(errors: Array, level: float = 0.95) -> tuple[float, float] | None:
    """Interval in which the mean error of as many new poses lies with that probability.

    None for fewer than four errors.

    It follows from the scatter of the held-out ``errors`` (n,) themselves. Both means have the relative error
    c / sqrt(n), c the coefficient of variation. The logarithm of their ratio therefore has the variance 2 c^2 / n
    (Student's t with n - 1 degrees of freedom).
    """
    e = np.asarray(errors, dtype=float)
    e = e[np.isfinite(e)]
    n = len(e)
    if n < 4 or not e.mean() > 0.0:
        return None
    spread = float(np.std(e, ddof=1) / e.mean() * np.sqrt(2.0 / n) * t_quantile(0.5 + 0.5 * level, n - 1))
    return float(e.mean() * np.exp(-spread)), float(e.mean() * np.exp(spread))


def bootstrap_interval(
    errors: Array, share: float = 0.5, level: float = 0.95, seed: int = 0
) -> tuple[float, float] | None:
    """Interval in which the quantile ``share`` of as many new errors lies with that probability.

    None for fewer than four errors.

    It follows from 4 000 pairs of resamples of the held-out ``errors`` (n,). One of a pair takes the place of the
    reported errors, the other that of the new ones. The ratio of their quantiles is that of the new to the reported
    quantile (bootstrap, Efron and Tibshirani 1993, 13.3).
    """
    e = np.asarray(errors, dtype=float)
    e = e[np.isfinite(e)]
    if len(e) < 4 or not e.min() > 0.0:
        return None
    rng = np.random.default_rng(seed)
    # few resamples at a time: all of them would take memory for 8 000 times n numbers
    drawn = np.concatenate([np.quantile(e[rng.integers(len(e), size=(80, len(e)))], share, axis=1) for _ in range(100)])
    low, high = np.quantile(drawn[4000:] / drawn[:4000], [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    reported = float(np.quantile(e, share))
    return reported * float(low), reported * float(high)


_TURN_DEG = 15.0  # orientations that differ by less hardly tell a bias of the centre from a shift of the camera
_FLAT = 0.25  # of the widest spread of positions: less in a direction leaves the rotation about the others weak
_WEAK_FACTOR = 1.5  # of the error in the middle: a corner that is worse is worth a pose
_FEW = 4
_LITTLE = 0.1  # gain by one more pose, as a share of the error, that is not worth a scan


def sampling_advice(
    estimate: CalibrationEstimate, observations: Sequence[Observation], *, required_m: float | None = None
) -> tuple[str, ...]:
    """Advice from an estimate and the observations that made it (outliers are ignored).

    It names the directions in which positions vary too little, and whether orientations vary. It also names where in
    the poses' own field a scanned point is worst known, and the gain of one more pose like these. With ``required_m``
    (standard deviation of a scanned point, 3-D) it says when that is reached. Distances in B.
    """
    used = [o for o, keep in zip(observations, estimate.inliers, strict=True) if keep]
    if len(used) < 2:
        return ("Add poses: fewer than two can be used.",)
    p = np.array([o.p_BR for o in used])
    middle = p.mean(axis=0)
    spread = np.linalg.svd(p - middle, full_matrices=False)
    width = spread[1] / np.sqrt(len(used))
    out = []
    if len(used) < _FEW:
        out.append(f"Add poses, to {_FEW} at least, whose flange centres do not lie in one plane.")
    for k in (1, 2) if len(used) >= _FEW else ():
        if width[k] < _FLAT * width[0]:
            out.append(
                f"Spread the poses along {_direction(spread[2][k])} of the robot's base: they vary by only "
                f"{1e3 * width[k]:.0f} mm there (rms), by {1e3 * width[0]:.0f} mm along {_direction(spread[2][0])}."
            )
    turned = turn_deg([o.X_BR for o in used])
    if not has_orientations([o.X_BR for o in used]):
        out.append(
            "Give the orientations of the poses (base_qw ... base_qz in pairs.csv): without them a constant error of"
            " the flange centre or of the tool's offset cannot be seen."
        )
    elif turned < _TURN_DEG:
        out.append(
            f"Turn and tilt the flange between poses by 20 degrees or more: these poses differ by {turned:.1f} degrees,"
            " so a constant error of the flange centre or of the tool's offset cannot be seen."
        )
    sigma = sigma_at(estimate, middle)
    weak = weakest_place(estimate, p)
    if sigma_at(estimate, weak) > _WEAK_FACTOR * sigma:
        x, y, z = 1e3 * weak
        out.append(
            f"The most informative next pose is near ({x:.0f}, {y:.0f}, {z:.0f}) mm in the base: the uncertainty of a"
            f" scanned point is {1e3 * sigma_at(estimate, weak):.2f} mm there and {1e3 * sigma:.2f} mm in the middle."
        )
    n = len(used)
    gain = 1.0 - np.sqrt(n / (n + 1.0))
    if required_m is not None and sigma <= required_m and not out:
        out.append(
            f"Stop: the uncertainty of a scanned point is {1e3 * sigma:.2f} mm, {1e3 * required_m:.2f} mm is required."
        )
    elif gain < _LITTLE and not out:
        out.append(
            f"Stop if {1e3 * sigma:.2f} mm is enough: one more pose would reduce it by {100 * gain:.0f} %, and would "
            f"not reduce the scatter of a single scan, {1e3 * estimate.sigma_position_m:.2f} mm per axis."
        )
    elif gain >= _LITTLE:
        want = int(np.ceil(1.0 / (1.0 - (1.0 - _LITTLE) ** 2)))
        out.append(
            f"Add poses, up to {want} or more: each reduces the uncertainty of {1e3 * sigma:.2f} mm by {100 * gain:.0f}"
            " % or more."
        )
    return tuple(out)


def weakest_place(estimate: CalibrationEstimate, p_B: Array) -> Array:
    """Find the place (3,) m with the largest uncertainty of a scanned point.

    It is one of the ends of the principal axes of poses (n, 3) m, half as far again.
    """
    middle = p_B.mean(axis=0)
    spread = np.linalg.svd(p_B - middle, full_matrices=False)
    reach = spread[2] * (spread[1] / np.sqrt(len(p_B)))[:, None]
    corners = middle + 1.5 * np.vstack([reach, -reach])
    errors = [sigma_at(estimate, c) for c in corners]
    return np.asarray(corners[int(np.argmax(errors))])


def _direction(axis: Array) -> str:
    """Return the base axis that a direction follows most, or the two that share it."""
    order = np.argsort(-np.abs(axis))
    names = "xyz"
    if abs(axis[order[0]]) > 0.9:
        return names[int(order[0])]
    first, second = sorted((int(order[0]), int(order[1])))
    return f"{names[first]} and {names[second]}"
