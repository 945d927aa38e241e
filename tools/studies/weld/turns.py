"""Turns, U-turns and cusps: the prediction of the chord map, and the result of the weld."""

from dataclasses import dataclass, replace

import numpy as np

from weldcal.tools.studies.weld.budgets import NOMINAL
from weldcal.tools.studies.weld.metrics import judge
from weldcal.tools.studies.weld.plant import simulate
from weldcal.tools.studies.weld.rows import Case
from weldcal.tools.studies.weld.seams import TrueSeam, get_seam
from weldcal.tools.studies.weld.study import study_config
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import assess_seam, split_seam

TURNS = ("turn_120_r20", "turn_120_r5", "turn_150_r10", "u_r20", "u_r30", "u_r100", "cusp_r20")
CHORDS = (0.040, 0.060, 0.080)


@dataclass(frozen=True, kw_only=True)
class TurnResult:
    """One seam and chord: the true seam's chord map, and how the weld of its nominal plan ended.

    Attributes:
        turn_deg, back_up_mm: by the true seam's chord map; possible: nothing stands against it there.
        refused: before anything moved; phase, reason: how it ended; max_mm: error of what was welded in one go.
        splits_mm: where the seam was split instead; pieces_done: how many of its pieces were welded; pieces_max_mm: their
            largest error.
    """

    seam: str
    chord_mm: float
    turn_deg: float
    back_up_mm: float
    possible: bool
    refused: bool
    phase: str
    reason: str
    max_mm: float
    splits_mm: tuple[float, ...] = ()
    pieces_done: int = 0
    pieces_max_mm: float = float("nan")

    @property
    def named(self) -> bool:
        """Whether what is impossible was named before arc-on; of what is possible nothing is asked here."""
        return self.possible or self.refused

    @property
    def stalled(self) -> bool:
        """Whether the weld neither finished nor said why not, or had to be stopped with the arc on."""
        return not self.refused and self.phase != "DONE"

    @property
    def outcome(self) -> str:
        """In words."""
        if self.refused:
            places = " and ".join(f"{s:.0f}" for s in self.splits_mm)
            pieces = len(self.splits_mm) + 1
            welded = f"{self.pieces_done} of {pieces} pieces welded, largest error {self.pieces_max_mm:.2f} mm"
            return f"refused before arc-on; split at {places} mm: {welded}" if places else "refused before arc-on"
        return f"welded, largest error {self.max_mm:.2f} mm" if self.phase == "DONE" else f"{self.phase}: {self.reason}"


def run_turn(seam: str, chord_m: float, seed: int) -> TurnResult:
    """Predict and then weld one seam with one chord, with the nominal budget's plan; what is refused is welded in pieces."""
    case = Case(seam, chord_m=chord_m)
    config = study_config(case)
    true = get_seam(seam)
    line = SeamCurve.from_points(true.points, true.up)
    report = assess_seam(line, chord_m, case.speed_m_s)
    run = simulate(true, NOMINAL, config, seed)
    figures = judge(run, case.speed_m_s, chord_m)
    refused = figures.phase == "FAULT" and not run.column("torch_on").any() and "infeasible" in figures.reason
    result = TurnResult(
        seam=seam,
        chord_mm=1e3 * chord_m,
        turn_deg=float(np.degrees(report.chart.max_turn)),
        back_up_mm=1e3 * report.chart.back_up_m,
        possible=report.feasible,
        refused=refused,
        phase=figures.phase,
        reason=figures.reason,
        max_mm=figures.max_mm,
    )
    if not refused or not report.splits:
        return result
    done, worst = 0, 0.0
    for k, part in enumerate(split_seam(line, chord_m, case.speed_m_s)):
        s = np.linspace(0.0, part.length, max(8, round(part.length / 0.5e-3)))
        welded = simulate(TrueSeam(f"{seam}-{k}", part.position(s), part.up(s)), NOMINAL, config, seed)
        found = judge(welded, case.speed_m_s, chord_m)
        done += found.completed
        worst = max(worst, found.max_mm)
    return replace(result, splits_mm=tuple(1e3 * s for s in report.splits), pieces_done=done, pieces_max_mm=worst)
