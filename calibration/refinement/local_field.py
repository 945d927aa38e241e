"""A field of what a calibration leaves at the flange.

Gaussian process over the place and orientation of the robot's poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, corrected_observation
from weldcal.calibration.eye_on_base.joint_fit import solve_jointly
from weldcal.calibration.eye_on_base.scanner_fit import from_motion
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.stated_error import USUAL_FIELD_M, USUAL_TURN_RAD
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEAST = 10
"""Poses from which on a field is estimated."""
_USUAL = np.array(
    [0.2, USUAL_TURN_RAD, USUAL_FIELD_M, 1e-4]
)  # length m, turn rad, spread of the field m, of single scans m
_USUAL_FACTOR = np.array(
    [2.0, 1.5, 2.7, 2.7]
)  # by which these differ from cell to cell (one standard deviation of the logarithm)
_STARTS_M = (0.08, 0.2, 0.5)
_COST, _SLOPE = 1e-14, 1e-8  # where the search ends, of a cost of order 100: near what rounding allows


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalField:
    """A field of residuals at poses of the flange, and what lies between.

    Residuals (n, 3) m are in the base, at ``places`` (n, 3) m and ``turns`` (n, 3, 3).

    The covariance of the field at two poses is ``sigma_field_m``^2 exp(-d^2 / 2 ``length_m``^2 - a^2 / 2
    ``turn_rad``^2) for each axis, d their distance and a the angle between them. Every scan has ``sigma_scan_m`` (per
    axis) of its own. Far from all poses, or at another orientation, the field is zero and its spread is
    ``sigma_field_m``. Source: Rasmussen and Williams 2006, 2.2 and 5.4.1.
    """

    places: Array
    turns: Array
    residuals: Array
    length_m: float
    turn_rad: float
    sigma_field_m: float
    sigma_scan_m: float

    def at(self, X_BR: Sequence[RigidTransform]) -> tuple[Array, Array]:
        """Return the field (m, 3) m at poses, and the standard deviation (m,) m per axis of what is left.

        It and the scan itself leave that.
        """
        places, turns = _poses(X_BR)
        k = _kernel(places, turns, self.places, self.turns, self._values)
        known = np.einsum("ij,jk,ik->i", k, self._inverse, k)
        left = np.maximum(self.sigma_field_m**2 - known, 0.0) + self.sigma_scan_m**2
        return k @ (self._inverse @ self.residuals), np.asarray(np.sqrt(left))

    def at_places(self, p_B: Array, R_BF: Array) -> Array:
        """Return the field (m, 3) m at places (m, 3) m of a feature on a flange of one orientation (3, 3)."""
        k = _kernel(p_B, R_BF[None], self.places, self.turns, self._values)
        return np.asarray(k @ (self._inverse @ self.residuals))

    def applied(self, X_BC: RigidTransform, observations: Sequence[Observation]) -> list[Observation]:
        """Move the centres of observations by the field, so that X_BC maps them to where it expects them.

        They are in the camera frame.
        """
        if not observations:
            return []
        shift, _ = self.at([o.X_BR for o in observations])
        moved = shift @ X_BC.rotation().matrix()
        return [replace(o, p_CR=o.p_CR - d) for o, d in zip(observations, moved, strict=True)]

    @property
    def _values(self) -> Array:
        return np.array([self.length_m, self.turn_rad, self.sigma_field_m, self.sigma_scan_m])

    @cached_property
    def _inverse(self) -> Array:
        K = _kernel(self.places, self.turns, self.places, self.turns, self._values)
        return np.asarray(np.linalg.inv(K + self.sigma_scan_m**2 * np.eye(len(K))))

    def document(self) -> dict[str, Any]:
        """Return the field as plain types for calibration.yaml: lengths in m, orientations as quaternions wxyz."""
        return {
            "length_m": self.length_m,
            "turn_rad": self.turn_rad,
            "sigma_field_m": self.sigma_field_m,
            "sigma_scan_m": self.sigma_scan_m,
            "places": [[float(v) for v in p] for p in self.places],
            "wxyz": [[float(v) for v in RotationMatrix(R).ToQuaternion().wxyz()] for R in self.turns],
            "residuals_m": [[float(v) for v in r] for r in self.residuals],
        }


def field_from_document(document: dict[str, Any] | None, file: str = "") -> LocalField | None:
    """Read a field from its document, of the file of that name; None for None.

    Raises InputError where it is malformed.
    """
    if document is None:
        return None
    try:
        places, residuals = (np.array(document[key], dtype=float).reshape(-1, 3) for key in ("places", "residuals_m"))
        turns = np.array([RotationMatrix(Quaternion(np.array(q, dtype=float))).matrix() for q in document["wxyz"]])
        values = {key: float(document[key]) for key in ("length_m", "turn_rad", "sigma_field_m", "sigma_scan_m")}
        if (
            not len(places) == len(residuals) == len(turns) > 0
            or not np.isfinite([*places.ravel(), *residuals.ravel()]).all()
        ):
            raise ValueError("lengths differ")
        if not (np.isfinite([*values.values()]).all() and min(values.values()) > 0.0):
            raise ValueError("not positive")
        return LocalField(places=places, turns=turns, residuals=residuals, **values)
    except (KeyError, TypeError, ValueError, RuntimeError) as e:
        where = f"'{file}': " if file else ""
        raise InputError(
            f"{where}The local field in the result cannot be read; run 'weldcal calibrate --refine local' again."
        ) from e


def fit_field(X_BR: Sequence[RigidTransform], residuals: Array) -> LocalField:
    """Return the field through residuals (n, 3) m at n poses.

    Lengths and spreads maximise the marginal likelihood times a prior.

    The prior is wide (a factor of 2 to 3) about what cells show: 0.2 m, 10 degrees, 0.15 mm of field and 0.1 mm of
    single scans. Where the orientation does not vary, the 10 degrees are the prior's.
    """
    places, turns = _poses(X_BR)
    d, a = _distances(places, turns, places, turns)
    n = len(places)

    def cost(logarithms: Array) -> float:
        length, turn, field, scan = np.exp(logarithms)
        K = field**2 * np.exp(-0.5 * (d / length) ** 2 - 0.5 * (a / turn) ** 2) + scan**2 * np.eye(n)
        try:
            L = np.linalg.cholesky(K)
        except np.linalg.LinAlgError:
            return 1e12
        half = np.linalg.solve(L, residuals)
        prior = (logarithms - np.log(_USUAL)) / np.log(_USUAL_FACTOR)
        return float(0.5 * (half**2).sum() + 3.0 * np.log(np.diag(L)).sum() + 0.5 * (prior**2).sum())

    starts = [np.log([length, *_USUAL[1:]]) for length in _STARTS_M]
    wide = [
        (float(m - 4.0 * w), float(m + 4.0 * w)) for m, w in zip(np.log(_USUAL), np.log(_USUAL_FACTOR), strict=True)
    ]
    # the optimum is flat: with one-sided differences it depends on the processor's rounding
    fits = (
        minimize(cost, s, method="L-BFGS-B", jac="3-point", bounds=wide, options={"ftol": _COST, "gtol": _SLOPE})
        for s in starts
    )
    found = min(fits, key=lambda f: float(f.fun))
    length, turn, field, scan = (float(v) for v in np.exp(found.x))
    return LocalField(
        places=places,
        turns=turns,
        residuals=np.array(residuals, dtype=float),
        length_m=length,
        turn_rad=turn,
        sigma_field_m=field,
        sigma_scan_m=scan,
    )


def _poses(X_BR: Sequence[RigidTransform]) -> tuple[Array, Array]:
    return np.array([X.translation() for X in X_BR]), np.array([X.rotation().matrix() for X in X_BR])


def _distances(p: Array, R: Array, q: Array, S: Array) -> tuple[Array, Array]:
    """Distances (m, n) m and angles (m, n) rad between two lists of poses."""
    d = np.linalg.norm(p[:, None] - q[None], axis=2)
    trace = np.einsum("mij,nij->mn", R, S)  # (1, n) where all have one orientation
    return d, np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def _kernel(p: Array, R: Array, q: Array, S: Array, values: Array) -> Array:
    d, a = _distances(p, R, q, S)
    return np.asarray(values[2] ** 2 * np.exp(-0.5 * (d / values[0]) ** 2 - 0.5 * (a / values[1]) ** 2))


GAIN = 0.95  # a choice: less than 5 % is not worth a second model beside X_BC
"""Share of the nested held-out mean error that a refinement must leave at most."""
_FOLDS = 20  # at most; up to so many poses each is held out alone
_STARTS = 60


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalChoice:
    """A field and the errors of poses (n,) that neither it nor the calibration saw.

    ``plain_m``, ``tilt_rad`` and ``local_m`` with it, NaN where the others fix none; ``squares`` (n,): the squared
    error with the field in units of its stated variance (3 on average). ``accepted``: the field is applied;
    ``sentence``: why.
    """

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
) -> LocalChoice:
    """Fit a field to the held-out residuals of a calibration of n inlier observations, and decide on it.

    The calibration is ``X_BC`` with ``correction``.

    For every held-out pose (20 folds at most) the whole is repeated without it: the choice of the scanner's correction,
    the held-out residuals of the others, the field and its lengths. The field is accepted if the mean of these errors
    falls by 5 %. Raises TooFewPoses below ten.
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
            X, c = solve_jointly(rest, patterns, correct_scanner=correct_scanner, seed=seed)
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
            f"A local field is applied ({lengths}): {said}. It holds near the poses that were taken and at their"
            " orientation; elsewhere it falls to zero and the stated region grows. X_BC and its exports are those of"
            " the plain calibration."
        )
    return LocalChoice(
        field=field, plain_m=plain, tilt_rad=tilt, local_m=local, squares=squares, accepted=accepted, sentence=said
    )


def held_out_residuals(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    X_BC: RigidTransform,
    correction: ScannerCorrection,
    seed: int = 0,
) -> Array:
    """Residuals (n, 3) m, in the base, of each pose under the same kind of calibration without it."""
    out = np.empty((len(observations), 3))
    for i, o in enumerate(observations):
        rest = [other for k, other in enumerate(observations) if k != i]
        try:
            if not correction.changes:
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
    """Apply the choice to the estimate's held-out errors and, where it was accepted, to the observations.

    The held-out errors are nested.
    """
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
