"""The report page of `weldcal verify --touch`: every touch against its stated limit."""

import numpy as np

from weldcal.tools.outcomes.touch import TouchReport
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed, render


def touch_page(report: TouchReport, source: str) -> str:
    """The whole report as one self-contained HTML text."""
    f = report.found
    errors = 1e3 * np.abs(f.error_m)
    rows = [
        (id, feature, "inside" if inside else "outside", fixed(float(e), 3), fixed(float(limit), 3))
        for id, feature, inside, e, limit in zip(f.ids, f.features, f.inside, errors, 1e3 * f.limit_m, strict=True)
    ]
    return render(
        "touch.html.j2",
        first=report.first,
        source=source,
        bars=error_bars(list(f.ids), errors, np.ones(len(errors), bool), "touched less scanned, mm"),
        rows=rows,
    )
