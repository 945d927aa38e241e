"""Table cells of the flange fits: residuals of face plane, outer edge, bore and holes, centre sigma and coverage."""

from collections.abc import Mapping

import numpy as np

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.holes import HolePattern
from weldcal.tools.outcomes.calibration import feature_residuals
from weldcal.tools.report.render import fixed

HEADER = ("pose", "plane, mm", "outer edge, mm", "bore, mm", "holes", "holes, mm", "rotation about the axis, ± deg")


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
