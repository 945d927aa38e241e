"""Write the page of `verify` on pairs: the rule of the verdict, residuals and held-out errors of every pair."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.data.results import known
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.calibration.hand_eye.pairs.judging import FALSE_ALARM, POWER, SHOWN_MM, SMALL
from weldcal.calibration.verified_pairs import VerifiedPairs
from weldcal.tools.report.first_screen import (
    CARE,
    DO_NOT,
    USE,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    typed,
    upper,
)
from weldcal.tools.report.page import Bullets, Quantity, Shot, TableRows, page_html
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed
from weldcal.tools.report.verify import NONE, Verdict

CANNOT_TELL = "cannot tell"


@dataclass(frozen=True, kw_only=True)
class PairsReport(VerifiedPairs):
    """A stated pose judged on pairs, for a page.

    Attributes:
        pairs: name of their file or folder.
        limit_mm: the error that the job allows, or None.
        board: the board, where the pairs are pictures of it.
        options: further words of a command that reads the pairs.
    """

    pairs: str
    limit_mm: float | None = None
    board: str = ""
    options: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The verdict on the result.

        1. The result was computed from these pairs: no verification.
        2. It names another mounting: do not use.
        3. The pairs have no solution of their own: cannot tell; do not use where the residuals alone are above a stated
          limit.
        4. The new solution is better than chance: do not use where the error is above the limit. Without a limit: above
           its own uncertainty and above SMALL of the held-out error of one pose. Else use with care.
        5. It is not: use, if the pairs show an error of the limit (SHOWN_MM without one) with the probability POWER;
          else cannot tell.
        """
        j, limit = self.judgement, self.limit_mm
        held = (
            f"The held-out error of {int(j.used.sum())} pairs with it is {j.held_out_mm:.3f} mm and"
            f" {j.held_out_deg:.3f} degrees (rms)"
        )
        if self.same_data:
            return Verdict(NONE, limit, f"RESULT was computed from these pairs. {held}. Record new pairs to verify it.")
        if self.mounting_stated not in (None, self.mounting.name):
            text = (
                f"RESULT is for the mounting {self.mounting_stated}, and the pairs are {self.mounting.name}. {held}. "
            )
            return Verdict(DO_NOT, limit, text + "Give the result of this camera, or correct --mounting.")
        if j.new is None:
            if limit is not None and j.held_out_mm > limit:
                return Verdict(DO_NOT, limit, f"The pairs contradict RESULT. {held}, above the limit of {limit:g} mm.")
            return Verdict(
                CANNOT_TELL, limit, f"The pairs have no solution of their own to compare with: {j.missing} {held}."
            )
        off = f"RESULT is off by {j.off_mm:.3f} mm at the target (+- {j.uncertain_mm:.3f}) and {j.off_deg:.3f} degrees"
        if np.isfinite(j.new_held_out_mm):
            held += f"; with a new solution it is {j.new_held_out_mm:.3f} mm"
        if j.rejected:
            chance = f"By chance alone a right pose differs as much with a probability of {_small(j.chance)}."
            if j.other is not None:
                return Verdict(
                    DO_NOT, limit, f"{upper(j.other[0])} fits: {j.other[1]:.1f} mm. As it is, {off}. {held}."
                )
            if limit is not None:
                small, why = j.off_mm <= limit, f"The error is within the limit of {limit:g} mm."
            else:
                small = j.off_mm <= max(SMALL * j.new_held_out_mm, j.uncertain_mm)
                why = "The error is small beside that of one pair, or beside the uncertainty of the new solution."
            if small:
                return Verdict(CARE, limit, f"{off}. {held}. {chance} {why}")
            return Verdict(DO_NOT, limit, f"{off}. {held}. {chance} Use the new solution, or calibrate again.")
        need, source = (SHOWN_MM, "which is needed without --limit-mm") if limit is None else (limit, "the limit")
        text = (
            f"{off}, no more than chance explains. {held}. The pairs show errors from {j.shown_mm:.3g} mm on with"
            f" {100 * POWER:.0f} %"
        )
        if j.shown_mm > need:
            return Verdict(CANNOT_TELL, limit, f"{text}, and not of {need:g} mm, {source}. Add pairs.")
        return Verdict(USE, limit, f"{text}.")

    @property
    def first(self) -> FirstScreen:
        """The first screen; its verdict is this command's own."""
        v, j = self.verdict, self.judgement
        lead = {NONE: "This is no verification. ", CANNOT_TELL: "These pairs cannot tell. "}.get(v.verdict, "")
        settled = (v.verdict if v.verdict in (USE, CARE, DO_NOT) else CARE, lead + v.reason)
        expected = ExpectedError(
            "held-out error at the target, 95 %",
            f"{1e3 * np.percentile(j.held_translation_m[j.used], 95):.3f} mm",
            f"of {int(j.used.sum())} pairs, with RESULT's pose and the target's pose from the other pairs",
        )
        unknown = self.mounting.unknowns["X"]
        words = f"pose of the {unknown.child_words} in the {unknown.parent_words} frame"
        poses = [ShownPose(f"{unknown.symbol}, judged", f"{words}, as RESULT states it", as_transform(j.X))]
        if j.new is not None:
            name = f"{unknown.symbol}, new solution"
            aside = self.verdict.verdict != DO_NOT
            poses.append(ShownPose(name, f"{words}, from these pairs alone", j.new.X, aside=aside))
        return FirstScreen(
            Findings(settled=settled, notes=self.notes, concerns=self.warnings), expected, self._next(), tuple(poses)
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the new solution warns of, and directions that these pairs do not show."""
        new = self.judgement.new
        return () if new is None else (*(f"Not observable: {text}" for text in new.unobservable), *new.warnings)

    def _next(self) -> Next:
        v = self.verdict.verdict
        board = ("--board", self.board) if self.board else ()
        solve = typed("hand-eye ax-yb", self.pairs, "--mounting", self.mounting.name, *board, *self.options)
        if v == USE:
            return Next("Use RESULT. Verify again after work at the robot or the camera.")
        if v == DO_NOT and self.judgement.other is not None:
            return Next("Correct RESULT as the verdict says, and verify it again.")
        if v in (DO_NOT, CARE):
            return Next("Solve from these pairs, and verify the new result on pairs that it did not use.", solve)
        if v == NONE:
            return Next("Record new pairs, and verify with them.")
        return Next("Record pairs with larger and more varied turns of the robot, and verify with them.")

    def summary(self) -> dict[str, object]:
        """Return the JSON object of the command."""
        j = self.judgement
        return {
            "state": "done",
            "verdict": self.verdict.verdict,
            "limit_mm": self.limit_mm,
            "reason": self.verdict.reason,
            "configuration": self.mounting.name,
            "X": as_transform(j.X),
            "read_as": self.read_as,
            "held_out_mm": j.held_out_mm,
            "held_out_deg": j.held_out_deg,
            "off_mm": known(j.off_mm),
            "off_deg": known(j.off_deg),
            "off_uncertainty_mm": known(j.uncertain_mm),
            "shown_mm": known(j.shown_mm),
            "chance": known(j.chance),
            "false_alarm": FALSE_ALARM,
            "fits": None if j.other is None else {"form": j.other[0], "off_mm": j.other[1]},
            "new": (
                None
                if j.new is None
                else {
                    "X": j.new.X,
                    "held_out_mm": known(j.new_held_out_mm),
                    "held_out_deg": known(j.new.held_out.rms_deg),
                }
            ),
            "per_pose": [
                {"id": i, "used": bool(u), "residual_deg": a, "residual_mm": b, "held_out_deg": c, "held_out_mm": d}
                for i, u, a, b, c, d in self._columns()
            ],
            "reading": {who: dict(found) for who, found in self.reading.items()},
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    def _columns(self) -> list[tuple[str, bool, float, float, float, float]]:
        j = self.judgement
        columns = (
            np.degrees(j.rotation_rad),
            1e3 * j.translation_m,
            np.degrees(j.held_rotation_rad),
            1e3 * j.held_translation_m,
        )
        return [(i, bool(u), *map(float, row)) for i, u, *row in zip(self.ids, j.used, *columns, strict=True)]

    def rows(self) -> dict[str, str]:
        """Rows for the terminal: the residuals of every pair, the largest first where there are many."""
        worst = sorted(self._columns(), key=lambda row: -row[5])
        some = self._columns() if len(worst) <= 12 else worst[:8]
        title = "held out" if len(worst) <= 12 else "held out, worst"
        text = "\n".join(f"{i}  {d:.3f} mm  {c:.3f} deg{'' if u else '  (outlier)'}" for i, u, _, _, c, d in some)
        return {"result": f"{self.result}, {self.read_as}", "mounting": self.mounting.name, title: text}


def verify_pairs_report(report: PairsReport) -> str:
    """Return the whole report as one self-contained HTML text."""
    j = report.judgement
    rows = [(i, "used" if u else "outlier", *(fixed(v, 4) for v in row)) for i, u, *row in report._columns()]
    tone, new = report.verdict.tone, j.new is not None
    bars = error_bars(list(report.ids), 1e3 * j.held_translation_m, j.used, "held-out error, mm")
    tilts = error_bars(list(report.ids), np.degrees(j.held_rotation_rad), j.used, "held-out rotation, deg")
    header = ("pair", "", "residual, deg", "residual, mm", "held-out, deg", "held-out, mm")
    with_it = f"with the pose of the result; {fixed(j.held_out_deg, 3)} degrees"
    parts: list[str | Shot | TableRows] = [
        f"{report.result}, {report.read_as}. The pose of the target is computed from the other pairs.",
        Shot(bars, FAR, "Bar chart of held-out errors"),
        Shot(tilts, TURNED, "Bar chart of held-out rotations"),
        TableRows(rows, header, (0, 1), f"All {len(rows)} pairs as a table"),
    ]
    cards = [
        Quantity("Held-out error, rms", j.held_out_mm, "mm", with_it, tone),
        Quantity("New solution, rms", j.new_held_out_mm, "mm", "held out, from these pairs alone"),
        Quantity("Off at the target", j.off_mm, "mm", f"+- {fixed(j.uncertain_mm, 3)} mm, 95 %", tone),
        Quantity("These pairs show", j.shown_mm, "mm", "and larger errors, with 95 %"),
    ]
    return page_html(
        f"Verification of {report.result} on {report.pairs.rstrip('/').rpartition('/')[2]}",
        f"{report.mounting.name}: {report.mounting.words}; {report.mounting.equation}",
        [("Warnings", [Bullets(report.warnings)]), ("All pairs", parts)],
        first=report.first,
        cards=cards if new else cards[:2],
        facts=[("result", report.result), ("read as", report.read_as), ("pairs", report.pairs)],
    )


FAR = "Distance at the target between each pair and the one that the result predicts. Grey: an outlier."
TURNED = "Angle between each pair and the one that the result predicts."


def _small(chance: float) -> str:
    return f"{chance:.2g}" if chance >= 1e-6 else "less than 1e-6"
