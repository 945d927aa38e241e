"""The result of `weldcal verify --touch` and its page: every touch against its stated limit, and the verdict."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.touch.judge import LEVEL, TouchErrors
from weldcal.tools.report.calibration import error_summary, scanner_pose
from weldcal.tools.report.first_screen import CARE, DO_NOT, USE, ExpectedError, Findings, FirstScreen, Next, Tolerance
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed, render
from weldcal.tools.report.verify import Verdict

ENOUGH = 4
"""Touches from which on the verdict may be "use"."""


@dataclass(frozen=True, eq=False)
class TouchReport:
    """Touches judged, and the folder that holds touch.json and touches.csv."""

    found: TouchErrors
    folder: Path
    result: CalibrationResult | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen; its verdict is this command's own, by the touches outside their stated regions."""
        v, f = self.verdict, self.found
        errors = 1e3 * np.abs(f.error_m)
        tolerance = Tolerance(
            "touches outside their region", float(f.outside), float(f.most_outside), "99 % of good cells", ""
        )
        found = Findings(tolerance=tolerance, unseen=len(f.ids), settled=(v.verdict, v.reason))
        expected = ExpectedError(
            "touched less scanned, 95 %",
            f"{np.percentile(errors, 95):.3f} mm",
            f"of {len(errors)} touches, which the calibration did not use; median {np.median(errors):.3f} mm",
        )
        if v.verdict == USE:
            after = Next("Use X_BC. Touch again after any knock, and after work at the robot or the scanner.")
        elif v.verdict == DO_NOT:
            after = Next("Check the tip's place on the flange, then calibrate again.")
        else:
            after = Next("Touch more points across the work space, with joint angles.")
        return FirstScreen(found, expected, after, () if self.result is None else (scanner_pose(self.result),))

    @property
    def verdict(self) -> Verdict:
        """Use, use with care or do not use; the limit is the median of the touches' 95 % limits."""
        f, n = self.found, len(self.found.ids)
        limit = 1e3 * float(np.median(f.limit_m))
        count = f"{n - f.outside} of {n} touches lie inside their stated {100 * LEVEL:.0f} % region"
        if f.outside > f.most_outside:
            return Verdict(
                DO_NOT,
                limit,
                f"{count}; by chance at most {f.most_outside} of {n} lie outside in 99 % of good cells. Calibrate"
                " again, or check the tip's place on the flange.",
            )
        if n < ENOUGH:
            return Verdict(CARE, limit, f"{count}; fewer than {ENOUGH} touches say little.")
        if f.stated_poses:
            return Verdict(
                CARE,
                limit,
                f"{count}. The result has refined kinematics, and the touches no joint angles: add q1 to q6.",
            )
        return Verdict(USE, limit, f"{count}; at most {f.most_outside} may lie outside by chance.")

    @property
    def rows(self) -> dict[str, str]:
        """Rows for the terminal."""
        f, e = self.found, error_summary(1e3 * np.abs(self.found.error_m))
        left = error_summary(1e3 * np.abs(f.relative_m))
        rows = {
            "verdict": f"{self.verdict.verdict}: {self.verdict.reason}",
            "touched - scanned": (
                f"median {e['median']:.3f} mm, largest {e['max']:.3f} mm; stated 95 % limit {self.verdict.limit_mm:.3f}"
                " mm (median)"
            ),
        }
        if np.isfinite(left["median"]):
            rows["from point to point"] = (
                f"median {left['median']:.3f} mm, largest {left['max']:.3f} mm, once the tool has touched the other"
                " points"
            )
        return rows

    def summary(self) -> dict[str, object]:
        """The JSON object of `verify --touch`."""
        f, v = self.found, self.verdict
        rows = zip(
            f.ids,
            f.features,
            1e3 * f.error_m,
            1e3 * f.limit_m,
            f.inside.tolist(),
            1e3 * f.relative_m,
            1e3 * f.relative_limit_m,
            strict=True,
        )
        return {
            "state": "done",
            "verdict": v.verdict,
            "reason": v.reason,
            "n_touches": len(f.ids),
            "inside": int(f.inside.sum()),
            "most_outside": f.most_outside,
            "error_mm": error_summary(1e3 * np.abs(f.error_m)),
            "relative_mm": {
                k: v if np.isfinite(v) else None for k, v in error_summary(1e3 * np.abs(f.relative_m)).items()
            },
            "touches": [
                {
                    "id": id,
                    "feature": feature,
                    "error_mm": float(e),
                    "limit_mm": float(limit),
                    "inside": inside,
                    "relative_mm": float(r) if np.isfinite(r) else None,
                    "relative_limit_mm": float(rl) if np.isfinite(rl) else None,
                }
                for id, feature, e, limit, inside, r, rl in rows
            ],
            "written_to": str(self.folder),
        }


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
