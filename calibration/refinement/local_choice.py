"""Decides on a local field by nested held-out errors, and applies it to an estimate."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut
from weldcal.calibration.eye_on_base.nested import calibrate_by_choice
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.scanner_fit import from_motion
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.local_field import LEAST, LocalField, fit_field
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

GAIN = 0.95
"""Share of the nested held-out mean error that a refinement must leave at most."""
PlainSolve = Callable[[Sequence[Observation]], tuple[RigidTransform, ScannerCorrection]]
"""Makes the plain calibration from some of the poses; raises InputError where they are too few."""
_FOLDS = 20  # at most; up to so many poses each is held out alone
_STARTS = 60


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalChoice:
    """A field and the errors of poses (n,) that neither it nor the calibration saw: ``plain_m``, ``tilt_rad`` and ``local_m`` with it, NaN
    where the others fix none; ``squares`` (n,): the squared error with the field in units of its stated variance (3 on average).
    ``accepted``: the field is applied; ``sentence``: why."""

    field: LocalField
    plain_m: Array
    tilt_rad: Array
    local_m: Array
    squares: Array
    accepted: bool
    sentence: str


def choose_local(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    X_BC: RigidTransform,
    correction: ScannerCorrection,
    *,
    correct_scanner: bool = True,
    seed: int = 0,
    plain_solve: PlainSolve | None = None,
) -> LocalChoice:
    """Fit a field to the held-out residuals of a calibration (``X_BC`` with ``correction``) of n inlier observations, and decide on it.

    For every held-out pose (20 folds at most) the whole is repeated without it: the choice of the scanner's correction, the held-out
    residuals of the others, the field and its lengths. The field is accepted if the mean of these errors falls by 5 %.
    ``plain_solve``: how the plain calibration was made, where it is not that of `calibrate`. Raises TooFewPoses below ten.
    """
    n = len(observations)
    if n < LEAST:
        raise TooFewPoses(f"A local field (--refine local) needs {LEAST} usable poses, and there are {n}; add poses.")
    field = fit_field(
        [o.X_BR for o in observations], held_out_residuals(observations, patterns, X_BC, correction, seed)
    )
    plain, tilt, local, squares = np.full((4, n), np.nan)
    folds = min(n, _FOLDS)
    place = np.random.default_rng(seed).permutation(n)
    for f in range(folds):
        test = place[f::folds]
        held = set(test.tolist())
        rest = [o for i, o in enumerate(observations) if i not in held]
        try:
            X, c = plain_solve(rest) if plain_solve else calibrate_plain(rest, patterns, correct_scanner, seed)
            without = fit_field([o.X_BR for o in rest], held_out_residuals(rest, patterns, X, c, seed))
        except InputError:
            continue
        seen = [corrected_observation(c, observations[i]) for i in test]
        plain[test], tilt[test] = position_errors(X, seen), tilt_errors(X, seen)
        local[test] = position_errors(X, without.applied(X, seen))
        squares[test] = (local[test] / without.at([o.X_BR for o in seen])[1]) ** 2
    known = np.isfinite(plain)
    before, after = (1e3 * float(np.mean(e[known])) if known.any() else float("nan") for e in (plain, local))
    accepted = bool(after < GAIN * before)
    lengths = f"length {1e3 * field.length_m:.0f} mm, {1e3 * field.sigma_field_m:.3f} mm per axis"
    said = f"mean held-out error {before:.3f} mm without, {after:.3f} mm with it"
    if not accepted:
        said = f"A local field ({lengths}) does not help: {said}. The plain calibration is used."
    else:
        said = (
            f"A local field is applied ({lengths}): {said}. It holds near the poses that were taken and at their orientation; elsewhere it "
            "falls to zero and the stated region grows. X_BC and its exports are those of the plain calibration."
        )
    return LocalChoice(
        field=field, plain_m=plain, tilt_rad=tilt, local_m=local, squares=squares, accepted=accepted, sentence=said
    )


def calibrate_plain(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], correct_scanner: bool, seed: int
) -> tuple[RigidTransform, ScannerCorrection]:
    """X_BC and correction that `calibrate` finds without a refinement, choices included."""
    if correct_scanner:
        return calibrate_by_choice(observations, patterns, seed=seed)
    return _rigid(observations, seed), ScannerCorrection()


def held_out_residuals(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    X_BC: RigidTransform,
    correction: ScannerCorrection,
    seed: int = 0,
) -> Array:
    """Residuals (n, 3) m, in the base, of each pose under the same kind of calibration without it."""
    out = np.empty((len(observations), 3))
    plain = np.array_equal(correction.values, ScannerCorrection().values)
    for i, o in enumerate(observations):
        rest = [other for k, other in enumerate(observations) if k != i]
        try:
            if plain:
                X, c = _rigid(rest, seed), correction
            else:
                found = from_motion(rest, patterns, seed=seed, order=correction.order, usual=True, start=X_BC)
                assert found.X_BC is not None
                X, c = found.X_BC, found.correction
        except InputError:
            X, c = X_BC, correction  # the others alone are in one plane
        out[i] = X @ corrected_observation(c, o).p_CR - o.p_BR
    return out


def with_field(
    estimate: CalibrationEstimate, choice: LocalChoice, corrected: Sequence[Observation]
) -> tuple[CalibrationEstimate, list[Observation]]:
    """The estimate with the nested held-out errors of the choice, and the observations with the field where it was accepted."""
    position, tilt = estimate.held_out.position_m.copy(), estimate.held_out.tilt_rad.copy()
    position[estimate.inliers] = choice.local_m if choice.accepted else choice.plain_m
    tilt[estimate.inliers] = choice.tilt_rad
    estimate = replace(estimate, held_out=HeldOut(position, tilt))
    if not choice.accepted:
        return estimate, list(corrected)
    moved = choice.field.applied(estimate.X_BC, corrected)
    return replace(estimate, position_residuals_m=position_errors(estimate.X_BC, moved)), moved


def _rigid(observations: Sequence[Observation], seed: int) -> RigidTransform:
    config = SolveConfig(seed=seed, leave_one_out=False, hypotheses=_STARTS, allow_coplanar=True)
    return estimate_eye_on_base(tuple(observations), config).X_BC
