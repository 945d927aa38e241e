"""Table cells of the flange fits: residuals of face plane, outer edge, bore and holes, centre sigma and coverage."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.holes import HolePattern
from weldcal.tools.report.render import fixed

HEADER = ("pose", "plane, mm", "outer edge, mm", "bore, mm", "holes", "holes, mm", "rotation about the axis, ± deg")


def feature_residuals(
    fits: Mapping[str, FlangeFit], patterns: Mapping[str, HolePattern]
) -> list[dict[str, float | int | str | None]]:
    """One row per scan: rms residual (mm) of plane, outer edge, bore (None where not seen) and of the hole centres from
    their pattern (None where fewer than four show), and one sigma (deg) of the rotation about the flange's axis."""
    rows: list[dict[str, float | int | str | None]] = []
    for id, fit in fits.items():
        holes = patterns.get(id)
        rows.append(
            {
                "id": id,
                "plane_mm": 1e3 * fit.plane_rms_m,
                "outer_mm": 1e3 * fit.outer_rms_m,
                "bore_mm": None if fit.bore_rms_m is None else 1e3 * fit.bore_rms_m,
                "holes": 0 if holes is None else len(holes.holes_C),
                "holes_mm": None if holes is None else 1e3 * holes.rms_m,
                "turn_sigma_deg": None if holes is None else float(np.degrees(holes.turn_sigma)),
            }
        )
    return rows


def feature_table(fits: Mapping[str, FlangeFit], patterns: Mapping[str, HolePattern]) -> list[tuple[str, ...]]:
    """The rows of ``feature_residuals`` as a report shows them, under ``HEADER``."""
    places = {"plane_mm": 3, "outer_mm": 3, "bore_mm": 3, "holes_mm": 3, "turn_sigma_deg": 2}
    return [
        tuple(str(v) if k not in places else fixed(None if v is None else float(v), places[k]) for k, v in row.items())
        for row in feature_residuals(fits, patterns)
    ]


def fit_cells(fit: FlangeFit | None) -> tuple[str, str]:
    """One sigma of the centre (3-D, mm) and the share of the edge seen (%); dashes without a fit."""
    if fit is None:
        return "–", "–"
    return fixed(1e3 * float(np.sqrt(np.trace(fit.center_covariance))), 3), fixed(100 * fit.coverage, 0)
