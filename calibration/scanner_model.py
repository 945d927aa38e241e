"""A scanner's own error of scale, and how it changes across the image: one factor for every point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.observation import Observation
from weldcal.models.errors import InputError

Array = NDArray[np.float64]

_LARGEST = 0.05  # a factor farther from 1 is no property of a scanner that measures


@dataclass(frozen=True)
class ScannerCorrection:
    """p_C corrected = p_C (scale + gx x + gy y), with x and y (m) of the point as it was measured, camera frame.

    ``gradient_per_m`` is (gx, gy) in 1/m. Raises InputError for numbers that are not finite or a scale that is off by
    more than 5 %.
    """

    scale: float = 1.0
    gradient_per_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        values = np.array([self.scale, *self.gradient_per_m])
        if not np.isfinite(values).all() or abs(self.scale - 1.0) > _LARGEST:
            raise InputError("The scanner correction is not usable: its scale must lie within 5 % of 1.")

    def points(self, p_C: Array) -> Array:
        """Corrected points (..., 3) m; NaN stays NaN."""
        p = np.asarray(p_C, dtype=float)
        gx, gy = self.gradient_per_m
        return np.asarray(p * (self.scale + gx * p[..., :1] + gy * p[..., 1:2]))

    def jacobian(self, p_C: Array) -> Array:
        """Derivative (..., 3, 3) of the corrected by the measured point."""
        p = np.asarray(p_C, dtype=float)
        gx, gy = self.gradient_per_m
        factor = self.scale + gx * p[..., 0] + gy * p[..., 1]
        slope = np.array([gx, gy, 0.0])
        return np.asarray(factor[..., None, None] * np.eye(3) + p[..., :, None] * slope)

    def normals(self, p_C: Array, n_C: Array) -> Array:
        """Unit normals (..., 3) of the corrected surface at measured points (..., 3) with measured normals (..., 3)."""
        moved = np.linalg.solve(np.swapaxes(self.jacobian(p_C), -1, -2), np.asarray(n_C, dtype=float)[..., None])[
            ..., 0
        ]
        return np.asarray(moved / np.linalg.norm(moved, axis=-1, keepdims=True))

    def observation(self, o: Observation) -> Observation:
        """The sighting as a scanner without this error would have made it."""
        return replace(
            o, p_CR=self.points(o.p_CR), n_C=None if o.n_C is None else self.normals(np.asarray(o.p_CR), o.n_C)
        )

    def document(self) -> dict[str, Any]:
        """As calibration.yaml and the JSON object hold it."""
        return {"scale": float(self.scale), "gradient_per_m": [float(v) for v in self.gradient_per_m]}


def correction_from_document(document: dict[str, Any] | None) -> ScannerCorrection | None:
    """Read it back; None where a result has none. Raises InputError where it is not one."""
    if document is None:
        return None
    try:
        gx, gy = (float(v) for v in document["gradient_per_m"])
        return ScannerCorrection(float(document["scale"]), (gx, gy))
    except (KeyError, TypeError, ValueError) as e:
        raise InputError(
            "The scanner correction in the result cannot be read; it holds scale and gradient_per_m [gx, gy]."
        ) from e
