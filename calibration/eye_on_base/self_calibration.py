"""Decides whether to correct the scanner, by comparing robot motion, hole circles and held-out errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.scanner_fit import (
    CIRCLE_OWN,
    CorrectionEstimate,
    from_holes,
    from_motion,
)
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import chi2_share
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

_LEAST_POSES = 8  # nine unknowns, and as many held-out errors as make a comparison
_LEAST_FOR_THIRD = 12  # sixteen unknowns
_FEWEST_PATTERNS = 3  # below eight poses, where the hole circle decides
_UNKNOWN_SCALE = 2e-3  # a scale known worse than this is as good as unknown: scanners are right to 0.2 %
_UNKNOWN_GRADIENT = 2e-2
_EVIDENT = 0.999  # probability that the correction is not zero by chance
_EVIDENT_FEW = 0.95  # the same below eight poses, where the correction is held back besides
_CHANCE_FEW = 1.6  # held-out errors of four poses differ by as much by chance: root of F (12, 12) at 5 %
_CONTRADICT = 0.99  # probability beyond which two sources that differ so much do contradict each other
_FOLDS = 20  # of a comparison, at most: up to so many poses each is held out alone
_GAIN = 0.95  # of the held-out error that must be left at most: a correction that gains less is not worth its unknowns


@dataclass(frozen=True, eq=False, kw_only=True)
class SelfCalibration:
    """Decision on the scanner correction. ``found`` is None where the scanner is taken as it is; ``sentence`` says why, or what was found;
    ``worth_saying`` where a reader of the result should know it. ``held_out_m`` and ``held_out_tilt_rad`` (n,) are errors
    of each pose under a correction and a calibration that never saw it, by which the order was chosen; NaN where they were
    not needed."""

    found: CorrectionEstimate | None
    motion: CorrectionEstimate | None
    holes: CorrectionEstimate | None
    held_out_m: Array
    held_out_tilt_rad: Array
    sentence: str
    worth_saying: bool

    @property
    def could_choose(self) -> bool:
        """Whether robot motion and hole circles were both there, so that the data made a choice."""
        return self.motion is not None and self.holes is not None

    @property
    def accepted(self) -> ScannerCorrection | None:
        """The accepted correction; None where the scanner is not corrected."""
        return None if self.found is None else self.found.correction


def self_calibrate(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    rigid_held_out_m: Array,
    *,
    seed: int = 0,
) -> SelfCalibration:
    """Decide on a scanner correction from inlier observations (n) and the hole patterns seen in them (by id).

    It is accepted only if robot motion and hole circle each determine it and do not contradict each other, if it is
    not zero by chance, and if errors on poses that neither correction nor calibration saw fall below
    ``rigid_held_out_m`` (n,), those of the calibration without it. Deterministic for ``seed``. Raises nothing for data
    that decide nothing: the sentence says what they lack.
    """
    n = len(observations)
    nothing = np.full(n, np.nan)

    def refused(why: str, said: bool = False) -> SelfCalibration:
        return SelfCalibration(
            found=None,
            motion=motion,
            holes=holes,
            held_out_m=nothing,
            held_out_tilt_rad=nothing,
            sentence=why,
            worth_saying=said,
        )

    motion: CorrectionEstimate | None = None
    holes: CorrectionEstimate | None = None
    if n < _LEAST_POSES:
        few = _from_few(observations, patterns, rigid_held_out_m, seed)
        if few is not None:
            return few
        return refused(f"No scanner correction: {n} poses do not determine one; take {_LEAST_POSES} or more.")
    motion = from_motion(observations, {}, seed=seed)
    if motion.sigma[0] > _UNKNOWN_SCALE or float(motion.sigma[1:].max()) > _UNKNOWN_GRADIENT:
        return refused(
            "No scanner correction: the positions vary too little for one (its scale would be known to "
            f"{1e2 * motion.sigma[0]:.2f} %); spread the poses over the field of view and in depth."
        )
    holes = from_holes(observations, patterns)
    asked = f"the robot's motion asks for a scale of {_percent(motion)}"
    if holes is None:
        return refused(
            f"No scanner correction: {asked}, but the flange's hole circle is not seen in enough scans to confirm it.",
            motion.certainty > _EVIDENT,
        )
    both = f"{asked}, the flange's hole circle for {_percent(holes)}"
    difference = motion.values - holes.values
    spread = motion.covariance + holes.covariance + np.diag(CIRCLE_OWN**2)
    if chi2_share(float(difference @ np.linalg.solve(spread, difference)), 3) > _CONTRADICT:
        return refused(f"No scanner correction: {both}; they contradict each other.", True)
    together = from_motion(observations, patterns, seed=seed, usual=True)
    if together.certainty < _EVIDENT:
        return refused(f"No scanner correction is needed: {both}, which may be chance.")
    held_out, tilt = held_out_errors(observations, patterns, seed, 1)
    before, after = _means(rigid_held_out_m, held_out)
    if not after < _GAIN * before:
        return refused(
            f"No scanner correction: {both}, but held-out errors do not fall with one (mean {1e3 * before:.3f} mm without,"
            f" {1e3 * after:.3f} mm with).",
            True,
        )
    said = f"The scanner is corrected: {both}; in the comparison that decided it, held-out errors fall from {1e3 * before:.3f} to {1e3 * after:.3f} mm (mean)"
    for order in (2, 3) if n >= _LEAST_FOR_THIRD else (2,):
        bent, bent_tilt = held_out_errors(observations, patterns, seed, order)
        if not _pays(held_out, tilt, bent, bent_tilt):
            break
        was, now = _means(tilt, bent_tilt)
        said += (
            f", and with bends of order {order} to {1e3 * _means(held_out, bent)[1]:.3f} mm and from {np.degrees(was):.3f} to "
            f"{np.degrees(now):.3f} degrees"
        )
        held_out, tilt = bent, bent_tilt
        together = from_motion(observations, patterns, seed=seed, order=order, usual=True)
    said += ". X_BC applies to scans with this correction."
    return SelfCalibration(
        found=together,
        motion=motion,
        holes=holes,
        held_out_m=held_out,
        held_out_tilt_rad=tilt,
        sentence=said,
        worth_saying=True,
    )


def _means(before: Array, after: Array) -> tuple[float, float]:
    """Means of both over the poses that both know."""
    known = np.isfinite(before) & np.isfinite(after)
    return (float(np.mean(before[known])), float(np.mean(after[known]))) if known.any() else (np.nan, np.nan)


def _pays(position: Array, tilt: Array, new_position: Array, new_tilt: Array) -> bool:
    """Whether held-out errors fall with more terms: neither position (three numbers a pose) nor tilt (two) rises, and both together
    fall by what is worth the unknowns."""
    (p0, p1), (t0, t1) = _means(position, new_position), _means(tilt, new_tilt)
    ratio_p = p1 / p0
    if not np.isfinite(t1) or t0 == 0.0:
        return ratio_p < _GAIN
    ratio_t = t1 / t0
    return ratio_p < 1.0 and ratio_t < 1.0 and ratio_p**0.6 * ratio_t**0.4 < _GAIN


def _from_few(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], rigid_held_out_m: Array, seed: int
) -> SelfCalibration | None:
    """The verdict below eight poses: the hole circles, and motion as far as it tells, held to what scanners usually are off;
    believed where that is not zero by chance and held-out errors do not rise beyond
    chance; None where they do. That they fall is not asked: four errors from three poses each are no measure of a gain."""
    n = len(observations)
    if n < 4 or sum(o.id in patterns for o in observations) < _FEWEST_PATTERNS:
        return None
    if from_motion(observations, patterns, seed=seed, usual=True).certainty < _EVIDENT_FEW:
        return None
    errors, tilts = held_out_errors(observations, patterns, seed, 2)
    before, after = _means(rigid_held_out_m, errors)
    if not np.isfinite(errors).all() or not after < _CHANCE_FEW * before:
        return None
    found = from_motion(observations, patterns, seed=seed, order=2, usual=True)
    return SelfCalibration(
        found=found,
        motion=None,
        holes=None,
        held_out_m=errors,
        held_out_tilt_rad=tilts,
        sentence=f"The scanner is corrected by what the flange's hole circle shows, as {n} poses are too few for the robot's motion to "
        f"confirm it: a scale of {_percent(found)}; held-out errors are {1e3 * after:.3f} mm with it and {1e3 * before:.3f} without "
        "(mean). X_BC applies to scans with this correction.",
        worth_saying=True,
    )


def held_out_errors(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], seed: int, order: int
) -> tuple[Array, Array]:
    """Errors (n,) m and tilts (n,) rad of each pose under correction and calibration of that order made without its fold.

    They compare orders; reported are those of nested.nested_errors, in which the choice is repeated, too.
    """
    errors, tilts = np.full((2, len(observations)), np.nan)
    start = from_motion(observations, patterns, seed=seed, order=order, usual=True).X_BC
    folds = min(len(observations), _FOLDS)
    for f in range(folds):
        test = [i for i in range(len(observations)) if i % folds == f]
        rest = [o for i, o in enumerate(observations) if i % folds != f]
        try:
            X, correction = calibrate_corrected(rest, patterns, seed=seed, order=order, start=start)
        except InputError:
            continue
        seen = [corrected_observation(correction, observations[i]) for i in test]
        errors[test], tilts[test] = position_errors(X, seen), tilt_errors(X, seen)
    return errors, tilts


def calibrate_corrected(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    *,
    seed: int = 0,
    order: int = 1,
    start: RigidTransform | None = None,
) -> tuple[RigidTransform, ScannerCorrection]:
    """Camera pose and correction from the same observations, without the decision: for cross-validation."""
    found = from_motion(observations, patterns, seed=seed, order=order, usual=True, start=start)
    assert found.X_BC is not None
    return found.X_BC, found.correction


def _percent(e: CorrectionEstimate) -> str:
    gx, gy = (10.0 * g for g in e.correction.gradient_per_m)  # per cent per 100 mm
    return f"{1e2 * (e.correction.scale - 1.0):+.2f} % ({gx:+.2f} and {gy:+.2f} % per 100 mm along x and y)"
