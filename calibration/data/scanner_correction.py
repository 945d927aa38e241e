"""What a calibration found of the scanner: the factor over the image that corrects its points, and its clock."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.documents import read_part
from weldcal.models.errors import InputError

EXPONENTS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of x and y of each term of the factor, in order."""
TERMS = {1: 3, 2: 6, 3: 10}
"""How many terms a correction of that order has."""

LARGEST = 0.05  # a choice: 25 times the usual scale error; at half of it a poor scanner would be refused
"""A factor farther from 1 is no property of a scanner that measures."""
LOOSE = np.array([0.03, 0.3, 0.3])
"""Standard deviations of scale and gradient that keep poses on one spot solvable, and a gradient that no circle
shows."""
_USUAL = np.array([2e-3, 1.5e-2, 1.5e-2])  # what scanners are off in scale and gradient (1/m)
_USUAL_BEND, _EDGE = 1e-3, 0.35  # and by a bend, at the edge of the image: so many depths from its middle


@dataclass(frozen=True)
class ScannerCorrection:
    """Correct a point by p_C (scale + gx x + gy y + bends).

    ``x`` and y (m) are those of the point as it was measured, in the camera frame.

    ``gradient_per_m`` is (gx, gy) in 1/m. ``bend`` is empty, or the factors of x^2, x y, y^2 (1/m^2), or those and of
    x^3, x^2 y, x y^2, y^3 (1/m^3): what a lens that is not quite known does. Bends hold within ``field_m`` (smallest
    and largest x, then y, m), where they were seen; beyond, they stay as at its edge, because a polynomial is no
    forecast. Raises InputError for numbers that are not finite or a scale that is off by more than 5 %.
    """

    scale: float = 1.0
    gradient_per_m: tuple[float, float] = (0.0, 0.0)
    bend: tuple[float, ...] = ()
    field_m: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        values = np.array([self.scale, *self.gradient_per_m, *self.bend, *(self.field_m or ())])
        if not np.isfinite(values).all() or abs(self.scale - 1.0) > LARGEST or len(self.values) not in TERMS.values():
            raise InputError("The scanner correction is invalid: its scale must lie within 5 % of 1.")

    @classmethod
    def unchanged(cls, terms: int) -> "ScannerCorrection":
        """Return the correction with that many terms (3, 6 or 10) that changes nothing: for its derivatives."""
        return cls(bend=(0.0,) * (terms - 3))

    @property
    def changes(self) -> bool:
        """Whether it moves any point."""
        return bool(self.scale != 1.0 or np.any(self.values[1:]))

    @property
    def values(self) -> Array:
        """Factors (K,) of the terms, K = 3, 6 or 10."""
        return np.array([self.scale, *self.gradient_per_m, *self.bend])

    @property
    def order(self) -> int:
        """1, 2 or 3: the highest power of its terms."""
        return next(order for order, size in TERMS.items() if size == len(self.values))

    def factor(self, p_C: Array) -> Array:
        """Return the factor (...) of points (..., 3): the sum of the terms, weighted by ``values``."""
        out = np.zeros(np.shape(p_C)[:-1])
        for term, value in zip(self._each(np.asarray(p_C, dtype=float)), self.values, strict=True):
            out += value * term
        return out

    def terms(self, p_C: Array) -> Array:
        """Return the terms (..., K) at points (..., 3)."""
        return np.stack(list(self._each(np.asarray(p_C, dtype=float))), axis=-1)

    def _each(self, p: Array) -> Iterator[Array]:
        near = self._within(p) if self.bend else p
        for i, j in EXPONENTS[: len(self.values)]:
            at = p if i + j < 2 else near
            yield at[..., 0] ** i * at[..., 1] ** j + 0.0 * p[..., 2]

    def slopes(self, p_C: Array) -> Array:
        """Derivatives (..., K, 2) of the terms by x and y."""
        p = np.asarray(p_C, dtype=float)
        near = self._within(p)
        inside = (near == p[..., :2]).astype(float)
        out = np.zeros((*p.shape[:-1], len(self.values), 2))
        for k, (i, j) in enumerate(EXPONENTS[: len(self.values)]):
            x, y = (p if i + j < 2 else near)[..., 0], (p if i + j < 2 else near)[..., 1]
            moves = inside if i + j > 1 else np.ones_like(inside)
            if i:
                out[..., k, 0] = i * x ** (i - 1) * y**j * moves[..., 0]
            if j:
                out[..., k, 1] = j * x**i * y ** (j - 1) * moves[..., 1]
        return out

    def _within(self, p: Array) -> Array:
        """x and y (..., 2), brought back to the edge of the field where they lie beyond it."""
        if self.field_m is None:
            return np.asarray(p[..., :2])
        x0, x1, y0, y1 = self.field_m
        return np.stack([np.clip(p[..., 0], x0, x1), np.clip(p[..., 1], y0, y1)], axis=-1)

    def points(self, p_C: Array) -> Array:
        """Corrected points (..., 3) m; NaN stays NaN."""
        p = np.asarray(p_C, dtype=float)
        return np.asarray(p * self.factor(p)[..., None])

    def jacobian(self, p_C: Array) -> Array:
        """Derivative (..., 3, 3) of the corrected by the measured point."""
        p = np.asarray(p_C, dtype=float)
        factor = self.factor(p)
        slope = np.zeros(p.shape)
        slope[..., :2] = np.einsum("...ki,k->...i", self.slopes(p), self.values)
        return np.asarray(factor[..., None, None] * np.eye(3) + p[..., :, None] * slope[..., None, :])

    def normals(self, p_C: Array, n_C: Array) -> Array:
        """Unit normals (..., 3) of the corrected surface at measured points (..., 3) with measured normals (..., 3)."""
        moved = np.linalg.solve(np.swapaxes(self.jacobian(p_C), -1, -2), np.asarray(n_C, dtype=float)[..., None])[
            ..., 0
        ]
        return np.asarray(moved / np.linalg.norm(moved, axis=-1, keepdims=True))

    def document(self) -> dict[str, Any]:
        """Return the correction as plain types for calibration.yaml and JSON; bends only where there are any."""
        out: dict[str, Any] = {"scale": float(self.scale), "gradient_per_m": [float(v) for v in self.gradient_per_m]}
        if self.bend:
            out["bend_per_m2"] = [float(v) for v in self.bend[:3]]
            out["bend_per_m3"] = [float(v) for v in self.bend[3:]]
            out["field_m"] = None if self.field_m is None else [float(v) for v in self.field_m]
        return out

    @property
    def formula(self) -> str:
        """The factor as a formula in x and y (m)."""
        names = ("", "x", "y", "x^2", "x y", "y^2", "x^3", "x^2 y", "x y^2", "y^3")
        text = " ".join(f"{v:+.7f} {n}".strip() for v, n in zip(self.values, names, strict=False)).lstrip("+")
        if self.field_m is None or not self.bend:
            return text
        x0, x1, y0, y1 = self.field_m
        return (
            f"{text} (in all terms but the first three, x between {x0:.3f} and {x1:.3f}, y between {y0:.3f} and"
            f" {y1:.3f}: beyond, the value at the edge)"
        )


def correction_from_document(document: dict[str, Any] | None, file: str = "") -> ScannerCorrection | None:
    """Read a correction from its document, of the file of that name; None for None.

    Raises InputError where it is malformed.
    """
    if document is None:
        return None
    where = f"'{file}': " if file else ""
    try:
        gx, gy = (float(v) for v in document["gradient_per_m"])
        bend = tuple(float(v) for key in ("bend_per_m2", "bend_per_m3") for v in document.get(key) or ())
        field = document.get("field_m")
        x0, x1, y0, y1 = (0.0,) * 4 if field is None else (float(v) for v in field)
        return ScannerCorrection(float(document["scale"]), (gx, gy), bend, None if field is None else (x0, x1, y0, y1))
    except InputError as e:
        raise InputError(f"{where}{e}") from e
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as e:
        raise InputError(
            f"{where}The scanner correction in the result cannot be read; it holds scale and gradient_per_m [gx, gy]."
        ) from e


def correction_of(change: Array, field: tuple[float, float, float, float] | None = None) -> ScannerCorrection:
    """Return the correction whose factors (K,) differ by ``change`` from those of a perfect scanner."""
    limited = np.clip(change[0], -LARGEST, LARGEST)
    bend = tuple(float(v) for v in change[3:])
    return ScannerCorrection(1.0 + float(limited), (float(change[1]), float(change[2])), bend, field if bend else None)


def expected_factors(terms: int, depth: float, usual: bool = True) -> Array:
    """Standard deviations (K,) of the factors of a scanner before its first scan.

    Bends by their size at the edge of the image.
    """
    edge = _EDGE * depth
    bends = np.concatenate([np.full(3, _USUAL_BEND / edge**2), np.full(4, _USUAL_BEND / edge**3)])
    return np.concatenate([_USUAL if usual else LOOSE, bends])[:terms]


ARRIVAL, DEVICE = "arrival", "device"


@dataclass(frozen=True, kw_only=True)
class ScannerClock:
    """When a frame was taken, on the robot's clock, s.

    ``kind`` arrival: capture = arrival - offset. ``kind`` device: capture = device + offset + drift (device -
    reference). ``offset_s`` is the mean over frames, ``sigma_s`` its standard deviation, both None where the motion
    does not show them. ``jitter_s`` the standard deviation of single frames about it. ``reference_s`` the clock's time
    that the offset holds for. ``drift`` and ``drift_sigma`` s/s (None for arrivals). ``rolling_s``: an image row y/z is
    exposed so much later per unit (None where the data do not show it). ``late``: ids of frames left out of the offset
    as grossly late or early; ``reason``: why this clock.
    """

    kind: str
    offset_s: float | None
    sigma_s: float | None
    jitter_s: float | None
    reference_s: float
    drift: float | None = None
    drift_sigma: float | None = None
    rolling_s: float | None = None
    rolling_sigma_s: float | None = None
    late: tuple[str, ...] = ()
    reason: str = ""

    def capture(self, arrival: float, device: float | None = None, row: float = 0.0) -> float | None:
        """Capture time (s) of a frame on the robot's clock, expected from its times.

        ``row`` is y/z of what is looked at. None where the offset is not known, or the frame lacks the clock's time.
        """
        if self.offset_s is None or (self.kind == DEVICE and device is None):
            return None
        rolled = (self.rolling_s or 0.0) * row
        if self.kind == DEVICE:
            assert device is not None
            return device + self.offset_s + (self.drift or 0.0) * (device - self.reference_s) + rolled
        return arrival - self.offset_s + rolled

    def document(self) -> dict[str, Any]:
        """Plain values for a file."""
        return {**asdict(self), "late": list(self.late)}


def clock_from_document(value: Any, file: str) -> ScannerClock | None:
    """Return the clock of a calibration.yaml; None without one. Raises InputError naming the key."""
    if value is None:
        return None
    found = read_part(ScannerClock, value, file, "clock")
    if found.kind not in (ARRIVAL, DEVICE):
        raise InputError(f"'{file}': clock.kind must be {ARRIVAL} or {DEVICE}; the file was changed by hand.")
    return found
