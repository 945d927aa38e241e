"""The results of weldcal verify on scans and on touches, and their pages: every error beside the stated ones."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import RESULT_FILE, CalibrationResult, correction_note, known, statistics
from weldcal.calibration.touch.judge import LEVEL, TouchErrors
from weldcal.calibration.verified_scans import FEW, WORST_TILT_DEG, VerifiedScans
from weldcal.tools.report.calibration import fit_cells, interval_rows, scanner_pose
from weldcal.tools.report.first_screen import (
    CARE,
    DO_NOT,
    ENOUGH_UNSEEN,
    USE,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    typed,
)
from weldcal.tools.report.page import Bullets, Quantity, Shot, TableRows, page_html
from weldcal.tools.report.pictures import error_bars, error_field
from weldcal.tools.report.render import fixed

NONE = "not a verification"
CORRECTED = "corrected"
"""The folder of the shifted calibration in that of a verification."""
ANY_LIMIT_MM = 0.5  # a choice: that of docs/first_hour/your_scans.md


@dataclass(frozen=True)
class Verdict:
    """The verdict (one of the four above), its limit for the median in mm and the reason, a sentence.

    The limit is None where the calibration states none.
    """

    verdict: str
    limit_mm: float | None
    reason: str

    @property
    def tone(self) -> str:
        """The report's colour."""
        return {USE: "good", DO_NOT: "bad"}.get(self.verdict, "warn")


@dataclass(frozen=True, kw_only=True)
class VerifyReport(VerifiedScans):
    """The result of a verification, its folder and its sources; ``pose`` is what the option of this name must state."""

    out: Path
    dataset: str = "NEW_SCANS"
    calibration: str = RESULT_FILE
    pose: str = ""

    @property
    def verdict(self) -> Verdict:
        """The verdict on the new scans alone; a calibration of another arm is named first."""
        found = self._verdict()
        named = not self.other_arm or self.other_arm in found.reason
        return found if named else replace(found, reason=f"{self.other_arm} {found.reason}")

    def _verdict(self) -> Verdict:
        new, limit_mm, source = [p for p in self.poses if not p.used_before], self.limit_mm, self.source
        if not new:
            return Verdict(NONE, None, "The calibration used all of these scans. Take new scans to verify it.")
        median = float(np.median([p.error_mm for p in new]))
        scans = f"{len(new)} new scan{'' if len(new) == 1 else 's'}"
        said = f"The median error on {scans} is {median:.3f} mm"
        tilts = [p.tilt_deg for p in new if p.tilt_deg is not None]
        if tilts and float(np.median(tilts)) > WORST_TILT_DEG:
            return Verdict(
                DO_NOT, limit_mm, f"The scanned faces are turned by {np.median(tilts):.0f} degrees from the poses."
            )
        if limit_mm is None:
            return Verdict(
                CARE, None, f"{said}, and the calibration states no error of its own. Give a limit: --limit-mm."
            )
        if median > limit_mm:
            return Verdict(
                DO_NOT, limit_mm, f"{said}, above the limit of {limit_mm:.3f} mm, {source}. Calibrate again."
            )
        said += f", within the limit of {limit_mm:.3f} mm, {source}"
        if len(new) < FEW:
            return Verdict(CARE, limit_mm, f"{said}; fewer than {FEW} new scans say little.")
        if self.concerns:
            return Verdict(CARE, limit_mm, f"{said}. But: {self.concerns[0]}")
        return Verdict(USE, limit_mm, f"{said}.")

    @property
    def first(self) -> FirstScreen:
        """The first screen; its verdict is this command's own, on the new scans. What is no verification says so."""
        v, r = self.verdict, self.result
        new = np.array([p.error_mm for p in self.poses if not p.used_before])
        reason = f"This is no verification. {v.reason}" if v.verdict == NONE else v.reason
        settled = (CARE if v.verdict == NONE else v.verdict, reason)
        tolerance = None
        if v.limit_mm is not None and len(new):
            tolerance = Tolerance("the median error of the new scans", float(np.median(new)), v.limit_mm, self.source)
        found = Findings(
            tolerance=tolerance,
            unseen=len(new),
            concerns=self.warnings,
            notes=tuple(filter(None, (*self.notes, correction_note(r, self.calibration)))),
            settled=settled,
        )
        if len(new):
            what = f"{len(new)} new scan{'' if len(new) == 1 else 's'}, which the calibration did not use"
            expected = ExpectedError(
                "error at the flange, 95 %",
                f"{np.percentile(new, 95):.3f} mm",
                f"of {what}; median {np.median(new):.3f} mm",
            )
        else:
            expected = ExpectedError(
                "error at the flange, 95 %", "not known", "every scan here was used in the calibration"
            )
        judged = scanner_pose(r)
        poses = [replace(judged, symbol=f"{judged.symbol}, judged")]
        more = {"corrected": self.shift} if self.shift else {}
        if (o := self.offset) is not None:
            words = f"{judged.words}, from these scans alone"
            name = f"{judged.symbol}, new solution"
            poses.append(ShownPose(name, words, o.new.X_BC, aside=v.verdict != DO_NOT))
            x, y, z = (f"{1e3 * v:+.3f}" for v in o.shift_m)
            more["off by"] = (
                f"({x}, {y}, {z}) mm +- {1e3 * o.sigma_m:.3f} mm (one sigma) and {np.degrees(o.turn_rad):.3f} degrees"
                " from the new solution. The vector is in the base, at the middle of these scans."
            )
        return FirstScreen(found, expected, self._next(), tuple(poses), more)

    def _next(self) -> Next:
        v, flange = self.verdict, ("--flange", self.flange) if self.flange else ()
        if self.corrected is not None:
            return Next(f"Verify the pose in {self.out / CORRECTED} on other scans before you use it.")
        held = None if self.offset is None else 1e3 * float(np.nanmedian(self.offset.new.held_out.position_m))
        if v.verdict == USE:
            return Next("Use X_BC. Verify again after any knock, and after work at the robot or the scanner.")
        if v.verdict == DO_NOT and held is not None and v.limit_mm is not None and held <= v.limit_mm:
            text = "These scans agree with each other: calibrate from them, and verify that result on other scans."
            return Next(text, typed("calibrate", self.dataset, *flange))
        if v.verdict == DO_NOT:
            return Next("See what has changed, then calibrate again.", typed("doctor", self.dataset, *flange))
        if v.verdict == NONE or sum(not p.used_before for p in self.poses) < ENOUGH_UNSEEN:
            return Next("Take four or more new scans across the work space, and verify with them.")
        if v.limit_mm is None:
            pose = ("--pose", shlex.quote(self.pose)) if self.pose else ()
            given = (shlex.quote(self.dataset), *flange, *pose, "--limit-mm", f"{ANY_LIMIT_MM:g}")
            text = f"State the error that your job allows, such as {ANY_LIMIT_MM:g} mm."
            return Next(text, typed("verify", self.calibration, *given))
        return Next("Remove what could be wrong, then verify again.", typed("doctor", self.dataset, *flange))

    @property
    def position_error_mm(self) -> dict[str, float]:
        """Median, mean, 95th percentile and largest position error, mm."""
        return statistics(np.array([p.error_mm for p in self.poses]))

    @property
    def interval_rows(self) -> dict[str, str]:
        """Rows for the terminal: median and 95 % of the errors, each with its bootstrap interval."""
        return interval_rows("error", np.array([p.error_mm for p in self.poses]))

    @property
    def tilt_deg(self) -> dict[str, float | None]:
        """Return median and 95th percentile of the tilt, deg; None without a normal."""
        found = statistics(np.array([p.tilt_deg for p in self.poses], dtype=float))
        return {key: known(found[key]) for key in ("median", "p95")}

    def summary(self) -> dict[str, Any]:
        """The JSON object of `verify`. A refused scan is named in the warnings."""
        return {
            "state": "done",
            "verdict": self.verdict.verdict,
            "limit_mm": self.verdict.limit_mm,
            "reason": self.verdict.reason,
            "position_error_mm": self.position_error_mm,
            "tilt_deg": self.tilt_deg,
            "per_pose": [{"id": p.id, "error_mm": p.error_mm, "tilt_deg": p.tilt_deg} for p in self.poses],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "X": self.result.X_BC.GetAsMatrix4().tolist(),
            "X_corrected": None if self.corrected is None else self.corrected.X_BC.GetAsMatrix4().tolist(),
            **self._off(),
        }

    def _off(self) -> dict[str, Any]:
        """The JSON keys of the offset, null where it is not known."""
        o = self.offset
        if o is None:
            return dict.fromkeys(("off_mm", "off_xyz_mm", "off_sigma_mm", "off_deg", "new"))
        return {
            "off_mm": 1e3 * float(np.linalg.norm(o.shift_m)),
            "off_xyz_mm": (1e3 * o.shift_m).tolist(),
            "off_sigma_mm": (1e3 * np.sqrt(np.diag(o.covariance))).tolist(),
            "off_deg": float(np.degrees(o.turn_rad)),
            "new": {"X": o.new.X_BC.GetAsMatrix4().tolist(), "at_mm": (1e3 * o.p_BQ).tolist()},
        }


def verify_report(report: VerifyReport, *, dataset: str) -> str:
    """Return the whole report as one self-contained HTML text."""
    r, v, error, tilt, poses = report.result, report.verdict, report.position_error_mm, report.tilt_deg, report.poses
    fresh = np.array([not p.used_before for p in poses])
    n, stated, mixed = int(fresh.sum()), r.held_out_mm.get("median"), fresh.any() and not fresh.all()

    def bars(values: list[float | None], quantity: str, told: float | None) -> bytes | None:
        shown = np.array([np.nan if value is None else value for value in values])
        seen = np.isfinite(shown)
        ids = [p.id for p, s in zip(poses, seen, strict=True) if s]
        line = None if told is None else (told, "stated by the calibration")
        of = "of the new scans " if mixed else ""
        return error_bars(ids, shown[seen], fresh[seen], quantity, stated=line, median_of=of) if seen.any() else None

    used_as = ["in the calibration" if p.used_before else "new" for p in poses]
    rows = [
        (p.id, used, fixed(p.error_mm, 3), fixed(p.tilt_deg, 3), *fit_cells(report.fits.get(p.id)))
        for p, used in zip(poses, used_as, strict=True)
    ]
    spread = "centres only, no normals" if tilt["median"] is None else f"95 % under {fixed(tilt['p95'], 3)}"
    n_used, of_mean = f"{len(poses)} of {len(poses) + len(report.refused)}", f"mean {fixed(error['mean'], 3)}"
    limit = Quantity("Limit of the median", v.limit_mm, "mm", f"for {n} new scan{'s' * (n != 1)}", v.tone)
    cell = ", ".join(filter(None, (r.robot, r.scanner, r.flange and f"flange {r.flange}")))
    return page_html(
        f"Verification on {dataset}",
        "; ".join(filter(None, (cell, "errors at the flange centre, in the robot's base"))),
        (
            ("Warnings", [Bullets(report.warnings)]),
            (
                "All scans",
                [
                    Shot(
                        bars([p.error_mm for p in poses], "position error, mm", stated),
                        ERRORS,
                        "Bar chart of position errors",
                    ),
                    Shot(
                        bars([p.tilt_deg for p in poses], "tilt, deg", r.tilt_deg.get("median")),
                        TILTS,
                        "Bar chart of tilts",
                    ),
                    Shot(error_field(r.X_BC, report.observations), FIELD, "Arrow plot of errors"),
                    TableRows(
                        rows,
                        ("pose", "", "error, mm", "tilt, deg", "fit sigma, mm", "edge seen, %"),
                        (0, 1),
                        "All scans as a table",
                    ),
                ],
            ),
            ("Scans not used", [TableRows(report.refused, ("pose", "reason"), (0, 1))]),
        ),
        first=report.first,
        cards=(
            Quantity(
                "Position error, median", error["median"], "mm", f"{of_mean}, 95 % under {fixed(error['p95'], 3)}"
            ),
            None if v.limit_mm is None else limit,
            Quantity("Stated by the calibration", stated, "mm", "held-out median of its own scans"),
            Quantity("Tilt, median", tilt["median"], "deg", spread),
            Quantity("Scans used", n_used, tone="warn" if report.refused else "plain"),
        ),
        facts=(
            ("calibration made by", r.software),
            ("scanner correction", "none" if report.correction is None else f"factor {report.correction.formula}"),
            *report.hashes.items(),
        ),
    )


ERRORS = (
    "Distance between the flange centre by the calibration and by the robot. Grey: the scan was used in the"
    " calibration."
)
TILTS = "Angle between the scanned face normal and the one stated by the robot."
FIELD = (
    "Error of each scan in the camera frame, across the field of view and along the line of sight. Parallel arrows"
    " indicate that scanner or base has moved, a pattern indicates an error of the scanner, random arrows indicate"
    " noise."
)
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
        f, e = self.found, statistics(1e3 * np.abs(self.found.error_m))
        left = statistics(1e3 * np.abs(f.relative_m))
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
        """Return the JSON object of `verify --touch`."""
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
            "error_mm": statistics(1e3 * np.abs(f.error_m)),
            "relative_mm": {k: known(v) for k, v in statistics(1e3 * np.abs(f.relative_m)).items()},
            "touches": [
                {
                    "id": id,
                    "feature": feature,
                    "error_mm": float(e),
                    "limit_mm": float(limit),
                    "inside": inside,
                    "relative_mm": known(r),
                    "relative_limit_mm": known(rl),
                }
                for id, feature, e, limit, inside, r, rl in rows
            ],
            "written_to": str(self.folder),
        }


def touch_page(report: TouchReport, source: str) -> str:
    """Return the whole report as one self-contained HTML text."""
    f = report.found
    errors = 1e3 * np.abs(f.error_m)
    rows = [
        (id, feature, "inside" if inside else "outside", fixed(float(e), 3), fixed(float(limit), 3))
        for id, feature, inside, e, limit in zip(f.ids, f.features, f.inside, errors, 1e3 * f.limit_m, strict=True)
    ]
    bars = error_bars(list(f.ids), errors, np.ones(len(errors), bool), "touched less scanned, mm")
    header = ("touch", "feature", "95 % region", "error, mm", "limit, mm")
    caption = "Distance between the touched point and the scanned one."
    return page_html(
        f"Verification by touches: {source}",
        "Points that the robot's tip touched and the scanner measured",
        [("All touches", [Shot(bars, caption, "Bar chart of touches"), TableRows(rows, header, (0, 1, 2))])],
        first=report.first,
    )
