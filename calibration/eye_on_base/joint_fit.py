"""Estimates X_BC and the scanner's own errors together, and corrects the scanner where the scans show that it errs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, corrected_observation, with_scanner
from weldcal.calibration.eye_on_base.scanner_fit import CIRCLE_OWN, CorrectionEstimate, from_holes, from_motion
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import chi2_share
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEAST = 4
"""Poses from which on the scanner's errors are estimated, too."""
_LEAST_FOR_THIRD = 12  # sixteen unknowns
_CERTAIN = 0.99  # probability that a correction is not zero by chance, from which on it is applied
_LEAST_TO_COMPARE = 8  # from which on motion alone tells a scale that the hole circles may contradict
_CONTRADICT = 0.99  # probability beyond which two sources that differ so much contradict each other
_UNKNOWN_SCALE = 2e-3  # a scale known worse than this is as good as unknown: scanners are right to 0.2 %
_FOLDS = 20  # of held-out errors, at most; up to so many poses each is held out alone
_HYPOTHESES = 60  # of an estimate from poses that are cleared of gross outliers


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannerVerdict:
    """What the scans say of the scanner.

    The correction to apply (None: none), what the robot's motion and the flange's hole circle ask for, each alone (None
    where unknown), and the sentence; ``worth_saying`` where a reader of the result should know it.
    """

    accepted: ScannerCorrection | None
    motion: CorrectionEstimate | None
    holes: CorrectionEstimate | None
    sentence: str
    worth_saying: bool


@dataclass(frozen=True, eq=False)
class _Fit:
    """Pose and correction that are used (zero where the scanner is taken as it is) and the joint estimate of both."""

    X_BC: RigidTransform
    correction: ScannerCorrection
    found: CorrectionEstimate
    motion: CorrectionEstimate | None
    holes: CorrectionEstimate | None
    contradict: bool

    @property
    def corrects(self) -> bool:
        """Whether the scanner is corrected."""
        return self.correction is self.found.correction


def estimate_jointly(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern] | None = None,
    *,
    correct_scanner: bool = True,
    config: SolveConfig | None = None,
) -> tuple[CalibrationEstimate, ScannerVerdict | None]:
    """Estimate X_BC with a scanner correction from n poses (n >= 4) and the hole circles found in them (by id).

    The correction (order 2, from twelve poses on 3) is held to its usual size: scale 0.2 %, gradient 0.15 % per 100 mm,
    bends 0.1 % at the image's edge. So few poses state what they know. It is applied where it is not zero by chance (99
    %); where it is not applied, the covariance contains what the scans leave open of it all the same. Robot motion and
    hole circles that contradict each other change nothing, and the verdict says so. Held-out errors repeat the estimate
    and the decision without the pose (20 folds at most). Outliers are those of the rigid estimate. Without
    ``correct_scanner`` and below four inliers it is the rigid estimate, with no verdict. Deterministic. Raises what
    estimate_eye_on_base raises.
    """
    observations, patterns = tuple(observations), patterns or {}
    config = config or SolveConfig()
    rigid = estimate_eye_on_base(observations, config)
    good = [o for o, keep in zip(observations, rigid.inliers, strict=True) if keep]
    if not correct_scanner or len(good) < LEAST:
        return rigid, None
    fit = _fit(good, patterns, rigid.X_BC, config.seed, whole=True)
    corrected = [corrected_observation(fit.correction, o) for o in observations]
    found, applied = fit.found, fit.corrects
    assert found.X_BC is not None
    asked = with_scanner(rigid, found.correction, found.X_BC, found.joint, found.redundancy)
    estimate = replace(
        asked if applied else left_uncorrected(rigid, asked),
        position_residuals_m=position_errors(fit.X_BC, corrected),
        tilt_residuals_rad=tilt_errors(fit.X_BC, corrected),
        held_out=_held_out(observations, patterns, rigid, fit, config.seed),
        sigma_position_m=found.sigma_position_m if applied else rigid.sigma_position_m,
        sigma_normal_rad=found.sigma_normal_rad if applied else rigid.sigma_normal_rad,
    )
    return estimate, _verdict(fit, len(good), rigid, estimate)


def left_uncorrected(rigid: CalibrationEstimate, asked: CalibrationEstimate) -> CalibrationEstimate:
    """Return the rigid estimate with the covariance of a scanner that stays uncorrected.

    ``asked`` is the joint estimate from the same poses (``estimate_jointly``). To its covariance comes the square of
    what its correction would change: as far as that is right, the rigid estimate errs by it.
    """
    if asked.scanner is None or asked.joint is None:
        return rigid
    none = replace(ScannerCorrection.unchanged(len(asked.scanner.values)), field_m=asked.scanner.field_m)
    change = np.concatenate(
        [
            rotation_vector(asked.X_BC.rotation() @ rigid.X_BC.rotation().inverse()),
            asked.X_BC.translation() - rigid.X_BC.translation(),
            asked.scanner.values - none.values,
        ]
    )
    joint = asked.joint + np.outer(change, change)
    return replace(rigid, scanner=none, joint=joint, covariance=joint[:6, :6])


def solve_jointly(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern] | None = None,
    *,
    correct_scanner: bool = True,
    seed: int = 0,
) -> tuple[RigidTransform, ScannerCorrection]:
    """X_BC and correction of estimate_jointly, without its held-out errors: for cross-validation.

    Raises InputError where the poses do not fix it.
    """
    config = SolveConfig(seed=seed, leave_one_out=False, hypotheses=_HYPOTHESES, allow_coplanar=True)
    rigid = estimate_eye_on_base(tuple(observations), config)
    good = [o for o, keep in zip(observations, rigid.inliers, strict=True) if keep]
    if not correct_scanner or len(good) < LEAST:
        return rigid.X_BC, ScannerCorrection()
    fit = _fit(good, patterns or {}, rigid.X_BC, seed)
    return fit.X_BC, fit.correction if fit.corrects else ScannerCorrection()


def _fit(
    good: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    X_rigid: RigidTransform,
    seed: int,
    *,
    whole: bool = False,
) -> _Fit:
    """Estimate pose and correction from poses without outliers (n >= 4), and decide on the correction.

    ``whole``: say what the motion alone asks for, even where there is nothing to compare it with.
    """
    motion, holes, contradict = None, None, False  # each alone, only to see whether the two sources contradict
    if len(good) >= _LEAST_TO_COMPARE:
        holes = from_holes(good, patterns)
        if holes is not None or whole:
            motion = from_motion(good, {}, seed=seed, start=X_rigid)
        contradict = holes is not None and motion is not None and _differ(motion, holes)
    order = 3 if len(good) >= _LEAST_FOR_THIRD else 2
    confirmed = {} if contradict else patterns
    found = from_motion(good, confirmed, seed=seed, order=order, usual=True, start=X_rigid)
    assert found.X_BC is not None
    if found.certainty > _CERTAIN and not contradict:
        return _Fit(found.X_BC, found.correction, found, motion, holes, contradict)
    none = replace(ScannerCorrection.unchanged(len(found.values)), field_m=found.correction.field_m)
    return _Fit(X_rigid, none, found, motion, holes, contradict)


def _differ(motion: CorrectionEstimate, holes: CorrectionEstimate) -> bool:
    difference = motion.values - holes.values
    spread = motion.covariance + holes.covariance + np.diag(CIRCLE_OWN**2)
    return chi2_share(float(difference @ np.linalg.solve(spread, difference)), 3) > _CONTRADICT


def _held_out(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    rigid: CalibrationEstimate,
    fit: _Fit,
    seed: int,
) -> HeldOut:
    """Errors of each pose under estimates that did not see it.

    Outliers are measured against the estimate from the others.
    """
    n = len(observations)
    position, tilt = np.full((2, n), np.nan)
    folds = min(n, _FOLDS)
    place = np.random.default_rng(seed).permutation(n)
    for f in range(folds):
        test = place[f::folds]
        held = set(test.tolist())
        rest = [o for i, o in enumerate(observations) if i not in held and rigid.inliers[i]]
        if len(rest) == int(rigid.inliers.sum()):
            X, correction = fit.X_BC, fit.correction
        else:
            try:
                X, correction = solve_jointly(rest, patterns, seed=seed)
            except InputError:
                continue
        seen = [corrected_observation(correction, observations[i]) for i in test]
        position[test], tilt[test] = position_errors(X, seen), tilt_errors(X, seen)
    return HeldOut(position, tilt)


def _verdict(fit: _Fit, n: int, rigid: CalibrationEstimate, estimate: CalibrationEstimate) -> ScannerVerdict:
    asked = f"the robot's motion asks for a scale of {_percent(fit.motion or fit.found)}"
    confirmed = "the flange's hole circle is not seen in enough scans to confirm it"
    both = (
        f"{asked}; {confirmed}" if fit.holes is None else f"{asked}, the flange's hole circle for {_percent(fit.holes)}"
    )
    scale_sigma = (fit.motion or fit.found).sigma[0]
    known = fit.contradict
    if fit.corrects:
        before, after = _means(rigid.held_out.position_m[rigid.inliers], estimate.held_out.position_m[rigid.inliers])
        text = f"The scanner is corrected: {both}. "
        if np.isfinite([before, after]).all():
            text += (
                f"Held-out errors are {1e3 * after:.3f} mm with the correction and {1e3 * before:.3f} mm without"
                " (mean). "
            )
        text += "X_BC applies to scans with this correction."
        known = True
    elif fit.contradict:
        text = f"No scanner correction: {both}; they contradict each other."
    elif fit.motion is None:
        text = f"No scanner correction: {n} poses show none; take {_LEAST_TO_COMPARE} or more to determine one."
    elif scale_sigma > _UNKNOWN_SCALE:
        text = (
            "No scanner correction: the positions vary too little for one (its scale would be known to "
            f"{1e2 * scale_sigma:.2f} %); spread the poses over the field of view and in depth."
        )
    else:
        text = f"No scanner correction is needed: {both}. This may be chance."
    accepted = fit.correction if fit.corrects else None
    return ScannerVerdict(accepted=accepted, motion=fit.motion, holes=fit.holes, sentence=text, worth_saying=known)


def _means(before: Array, after: Array) -> tuple[float, float]:
    """Means of both over the poses that both know."""
    known = np.isfinite(before) & np.isfinite(after)
    return (float(np.mean(before[known])), float(np.mean(after[known]))) if known.any() else (np.nan, np.nan)


def _percent(e: CorrectionEstimate) -> str:
    gx, gy = (10.0 * g for g in e.correction.gradient_per_m)  # per cent per 100 mm
    return f"{1e2 * (e.correction.scale - 1.0):+.2f} % ({gx:+.2f} and {gy:+.2f} % per 100 mm along x and y)"
