"""The report page of `weldcal verify`: errors per scan against the stated ones, and over the field of view."""

import numpy as np

from weldcal.tools.outcomes.calibration import VerifyReport
from weldcal.tools.report.flange_features import fit_cells
from weldcal.tools.report.pictures import error_bars, error_field
from weldcal.tools.report.render import fixed, render


def verify_report(report: VerifyReport, *, dataset: str) -> str:
    """The whole report as one self-contained HTML text."""
    ids = [p.id for p in report.poses]
    fresh = np.array([not p.used_before for p in report.poses])
    median_of = "of the new scans " if fresh.any() and not fresh.all() else ""
    tilts = np.array([np.nan if p.tilt_deg is None else p.tilt_deg for p in report.poses])
    seen = np.isfinite(tilts)
    stated = report.result.held_out_mm.get("median")
    stated_tilt = report.result.tilt_deg.get("median")
    rows = []
    for p in report.poses:
        rows.append(
            (
                p.id,
                "in the calibration" if p.used_before else "new",
                fixed(p.error_mm, 3),
                fixed(p.tilt_deg, 3),
                *fit_cells(report.fits.get(p.id)),
            )
        )
    return render(
        "verify.html.j2",
        dataset=dataset,
        r=report.result,
        v=report.verdict,
        first=report.first,
        n_new=int(fresh.sum()),
        error=report.position_error_mm,
        tilt=report.tilt_deg,
        stated=stated,
        stated_tilt=stated_tilt,
        n=len(report.poses),
        refused=report.refused,
        warnings=report.warnings,
        correction=report.correction,
        pose_rows=rows,
        bars=error_bars(
            ids,
            np.array([p.error_mm for p in report.poses]),
            fresh,
            "position error, mm",
            stated=None if stated is None else (stated, "stated by the calibration"),
            median_of=median_of,
        ),
        tilt_bars=error_bars(
            [i for i, s in zip(ids, seen, strict=True) if s],
            tilts[seen],
            fresh[seen],
            "tilt, deg",
            stated=None if stated_tilt is None else (stated_tilt, "stated by the calibration"),
            median_of=median_of,
        )
        if seen.any()
        else None,
        field=error_field(report.result.X_BC, report.observations),
        hashes=list(report.hashes.items()),
    )
