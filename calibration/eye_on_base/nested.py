"""Held-out errors for which every choice, that of the scanner's correction included, is repeated without the held-out poses."""

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.self_calibration import self_calibrate
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import t_quantile
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

_FOLDS = 20  # at most; up to so many poses each is held out alone
_HYPOTHESES = 150  # of an estimate from poses that are cleared of gross outliers


def calibrate_by_choice(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], *, seed: int = 0
) -> tuple[RigidTransform, ScannerCorrection]:
    """X_BC and scanner correction, with the decision whether to correct, and to which order, made on these observations alone.

    Raises what estimate_eye_on_base raises.
    """
    config = SolveConfig(seed=seed, allow_coplanar=True, hypotheses=_HYPOTHESES)
    rigid = estimate_eye_on_base(tuple(observations), config)
    good = [o for o, keep in zip(observations, rigid.inliers, strict=True) if keep]
    scanner = self_calibrate(good, patterns, rigid.held_out.position_m[rigid.inliers], seed=seed)
    if scanner.found is None or scanner.found.X_BC is None:
        return rigid.X_BC, ScannerCorrection()
    return scanner.found.X_BC, scanner.found.correction


def nested_errors(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], *, seed: int = 0
) -> tuple[Array, Array]:
    """Errors (n,) m and tilts (n,) rad of each pose under a calibration, choices included, from the other folds; NaN where the
    others do not fix one. Source: Varma and Simon 2006 (a choice made on the errors that are reported biases them)."""
    n = len(observations)
    errors, tilts = np.full((2, n), np.nan)
    folds = min(n, _FOLDS)
    place = np.random.default_rng(seed).permutation(n)
    for f in range(folds):
        test = place[f::folds]
        held = set(test.tolist())
        try:
            X, correction = calibrate_by_choice(
                [o for i, o in enumerate(observations) if i not in held], patterns, seed=seed
            )
        except InputError:
            continue
        seen = [corrected_observation(correction, observations[i]) for i in test]
        errors[test], tilts[test] = position_errors(X, seen), tilt_errors(X, seen)
    return errors, tilts


def mean_interval(errors: Array, level: float = 0.95) -> tuple[float, float] | None:
    """Interval in which the mean error of as many new poses lies with that probability; None for fewer than four errors.

    From the scatter of the held-out ``errors`` (n,) themselves: both means know theirs to c / sqrt(n), c the coefficient
    of variation, so the logarithm of their ratio has the variance 2 c^2 / n (Student's t with n - 1 degrees of freedom).
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
    """Interval in which the quantile ``share`` of as many new errors lies with that probability; None for fewer than four errors.

    From 4 000 pairs of resamples of the held-out ``errors`` (n,): one stands for what was seen, the other for what comes, and the
    ratio of their quantiles is that of the new one to the reported one (bootstrap, Efron and Tibshirani 1993, 13.3).
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
