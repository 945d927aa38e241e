"""A field of what a calibration leaves at the flange: Gaussian process over the place and orientation of the robot's poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from weldcal.calibration.eye_on_base.stated_error import USUAL_FIELD_M, USUAL_TURN_RAD
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


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalField:
    """Residuals (n, 3) m, in the base, at poses of the flange (``places`` (n, 3) m and ``turns`` (n, 3, 3)), and what lies between.

    The covariance of the field at two poses is ``sigma_field_m``^2 exp(-d^2 / 2 ``length_m``^2 - a^2 / 2 ``turn_rad``^2) for each axis, d
    their distance and a the angle between them; every scan has ``sigma_scan_m`` (per axis) of its own. Far from all poses, or at another
    orientation, the field is zero and its spread is ``sigma_field_m``. Source: Rasmussen and Williams 2006, 2.2 and 5.4.1.
    """

    places: Array
    turns: Array
    residuals: Array
    length_m: float
    turn_rad: float
    sigma_field_m: float
    sigma_scan_m: float

    def at(self, X_BR: Sequence[RigidTransform]) -> tuple[Array, Array]:
        """The field (m, 3) m at poses, and the standard deviation (m,) m per axis of what it and the scan itself leave."""
        places, turns = _poses(X_BR)
        k = _kernel(places, turns, self.places, self.turns, self._values)
        known = np.einsum("ij,jk,ik->i", k, self._inverse, k)
        left = np.maximum(self.sigma_field_m**2 - known, 0.0) + self.sigma_scan_m**2
        return k @ (self._inverse @ self.residuals), np.asarray(np.sqrt(left))

    def at_places(self, p_B: Array, R_BF: Array) -> Array:
        """The field (m, 3) m at places (m, 3) m of a feature on a flange of one orientation (3, 3)."""
        k = _kernel(p_B, R_BF[None], self.places, self.turns, self._values)
        return np.asarray(k @ (self._inverse @ self.residuals))

    def applied(self, X_BC: RigidTransform, observations: Sequence[Observation]) -> list[Observation]:
        """Observations whose centres (camera frame) are moved by the field, so that X_BC maps them to where it expects them."""
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
        """The field as plain types for calibration.yaml: lengths in m, orientations as quaternions wxyz."""
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
    """Read a field from its document, of the file of that name; None for None. Raises InputError where it is malformed."""
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
    """The field through residuals (n, 3) m at n poses; lengths and spreads maximise the marginal likelihood times a prior.

    The prior is wide (a factor of 2 to 3) about what cells show: 0.2 m, 10 degrees, 0.15 mm of field and 0.1 mm of single scans. Where
    the orientation does not vary, the 10 degrees are the prior's.
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
    found = min((minimize(cost, s, method="L-BFGS-B", bounds=wide) for s in starts), key=lambda f: float(f.fun))
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
