"""What the 3D view's colours mean and how it is scaled: one place for the scene itself and for the legends beside
it."""

from typing import NamedTuple

import numpy as np
from pydrake.geometry import Rgba

from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.models.arrays import Array

CONE, CLOUD = Rgba(0.05, 0.45, 0.50, 1.0), Rgba(0.12, 0.25, 0.40, 1.0)
CIRCLE, UNCERTAINTY = Rgba(0.85, 0.10, 0.35, 1.0), Rgba(0.10, 0.60, 0.45, 0.45)
PLANNED, FELT, WELDED = Rgba(0.30, 0.32, 0.35, 1.0), Rgba(0.10, 0.40, 0.90, 1.0), Rgba(0.95, 0.45, 0.10, 1.0)
DEFLECTION, CAD, WAY_BACK = Rgba(0.80, 0.10, 0.45, 1.0), Rgba(0.05, 0.50, 0.42, 1.0), Rgba(0.48, 0.20, 0.80, 1.0)
RESIDUAL_MM = 0.3
"""At the ends of the residuals' scale of colours."""
DEFLECTION_SCALE = 10.0
_SIGMAS, _LARGEST_M = 3.0, 0.10
_MAGNIFICATIONS = (200, 100, 50, 20, 10, 5, 2, 1)
WELDING_PHASES = ("approach_above", "approach", "weld", "retract")


class Uncertainty(NamedTuple):
    """The 3-sigma ellipsoid of a scanned point: half axes (3,) m, their directions (3, 3) in B as columns, and the
    magnification at which it is drawn."""

    half_axes: Array
    R_BE: Array
    magnification: int


def uncertainty_at(estimate: CalibrationEstimate, p_BQ: Array) -> Uncertainty:
    """The uncertainty of a scanned point at p_BQ (3,) m, drawn with half axes of 0.1 m at most."""
    values, vectors = np.linalg.eigh(point_error_covariance(estimate, p_BQ))
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1.0
    half = _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    times = next((m for m in _MAGNIFICATIONS if m * half.max() <= _LARGEST_M), 1)
    return Uncertainty(half, vectors, times)


class LegendKey(NamedTuple):
    """One entry of the legend: CSS colour, how it is drawn (solid, dashed, area), and its meaning."""

    colour: str
    style: str
    text: str


def legend(phase: str, magnification: int | None = None) -> list[LegendKey]:
    """The legend of a phase of the weld job; `magnification` of the drawn uncertainty, 0 where it is written beside it,
    None where there is none yet."""
    if phase in WELDING_PHASES:
        return [
            LegendKey(_css(PLANNED), "dashed", "planned seam"),
            LegendKey(_css(FELT), "solid", "felt by the tip"),
            LegendKey(_css(WELDED), "solid", "welded"),
            LegendKey(_css(DEFLECTION), "solid", f"deflection of the tip, x {DEFLECTION_SCALE:g}"),
        ]
    if phase in ("start", "park", "home", "done", "held"):
        return []
    found = [
        LegendKey(_css(CONE), "area", "what the scanner sees"),
        LegendKey(_css(CIRCLE), "solid", "flange found; the number of its scan"),
        LegendKey(_css(CIRCLE), "dashed", "refused"),
    ]
    if magnification is not None:
        times = f", x {magnification}" if magnification > 1 else "" if magnification else ", magnified as written"
        found.append(LegendKey(_css(UNCERTAINTY), "area", f"error at the work point, 3 sigma{times}"))
    return found


def _css(rgba: Rgba) -> str:
    return f"rgb({round(255 * rgba.r())} {round(255 * rgba.g())} {round(255 * rgba.b())})"
