"""Rows of the target table: welds, figures and limits; how runs are held against them; and turns beside them."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.case import RunMetrics, WeldCase, judge, run_case, study_config
from tests.worlds.weld.plant import StudyRun, simulate
from tests.worlds.weld.seams import TrueSeam, get_seam
from weldcal.models.errors import InputError
from weldcal.tools.console import Progress
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import assess_seam, split_seam


class UnknownRow(InputError):
    """No row of the study has this name."""


class MetricTarget(NamedTuple):
    """A bound on one figure of RunMetrics: `over` the seeds ("worst" or "mean") it is to be at most `limit`."""

    figure: str
    limit: float
    over: str = "worst"


class Row(NamedTuple):
    """A line of the table: its welds and their targets; every weld has to be completed as well."""

    key: str
    label: str
    cases: tuple[WeldCase, ...]
    targets: tuple[MetricTarget, ...]


def _bounds(text: str) -> tuple[MetricTarget, ...]:
    """Read "mean_mm 0.1 mean, max_mm 0.3": figure, limit, and over what if not the worst."""
    parts = (part.split() for part in text.split(","))
    return tuple(MetricTarget(name, float(limit), *over) for name, limit, *over in parts)


CHORDS = (0.040, 0.060, 0.080)
_EASY = ("straight", "s_r60", "l_r20_convex", "l_r20_concave")
_CORNERS = tuple(f"l_{r}_{side}" for r in ("r5", "r1") for side in ("convex", "concave"))
_CURVED = tuple(f"{s}_on_{r}" for s in ("s_r60", "l_r20") for r in ("r150", "r300"))
_GAP_10, _GAP_25 = ((0.145, 0.155),), ((0.1375, 0.1625),)
_SLOW = ", omega_rad_s 0.8, tip_speed_mm_s 40"


def _of(seams: Iterable[str], budget: str = "nominal", **more: Any) -> tuple[WeldCase, ...]:
    return tuple(WeldCase(seam, budget, **more) for seam in seams)


ROWS: tuple[Row, ...] = tuple(
    Row(key, label, cases, _bounds(text))
    for key, label, cases, text in (
        (
            "imperfect",
            "imperfect world: straight, S R60, L R20",
            _of(_EASY, "imperfect"),
            f"mean_mm 0.10 mean, max_mm 0.30, height_mm 0.65, space_mean_mm 0.30 mean, space_mm 0.70{_SLOW}",
        ),
        (
            "imperfect_corners",
            "imperfect world: R5 and R1 corners",
            _of(_CORNERS, "imperfect"),
            f"mean_mm 0.12 mean, max_mm 0.50, height_mm 0.65{_SLOW}",
        ),
        (
            "nominal",
            "perfectly known world: straight, S R60, L R20; chord 40, 60, 80 mm; nominal",
            tuple(WeldCase(seam, chord_m=d) for seam in _EASY for d in CHORDS),
            f"mean_mm 0.04 mean, max_mm 0.15, cv_percent 1.0, time_ratio 1.02{_SLOW}",
        ),
        (
            "hard",
            "perfectly known world, hard budget, chord 60 mm",
            _of(_EASY, "hard"),
            f"mean_mm 0.12 mean, max_mm 0.45{_SLOW}",
        ),
        (
            "hard_corners",
            "R5 and R1 corners, hard budget: completed",
            _of(_CORNERS, "hard"),
            f"mean_mm 0.12 mean{_SLOW}",
        ),
        ("r5", "L R5, nominal", _of(_CORNERS[:2]), f"max_mm 0.35{_SLOW}"),
        ("r1_concave", "L R1 concave, nominal", _of(["l_r1_concave"]), f"max_mm 0.30{_SLOW}"),
        ("r1_convex", "L R1 convex, nominal", _of(["l_r1_convex"]), f"max_mm 0.50{_SLOW}"),
        (
            "end",
            "end of the seam: straight, on an R60 arc",
            _of(["straight", "arc_r60_end"]),
            "end_mm 0.12, end_step_mm_s 0.5",
        ),
        ("gap_10", "gap of 10 mm, straight and S", _of(_EASY[:2], gaps=_GAP_10), "gap_mm 0.12"),
        ("gap_25", "gap of 25 mm, straight and S", _of(_EASY[:2], gaps=_GAP_25), "gap_mm 0.60"),
        ("speed_16", "16 mm/s: S R60, L R20", _of(_EASY[1:], speed_m_s=0.016), f"max_mm 0.20{_SLOW}"),
        ("speed_24", "24 mm/s: S R60, L R20", _of(_EASY[1:], speed_m_s=0.024), f"max_mm 0.35{_SLOW}"),
        (
            "space",
            "on cylinders of R 150 and 300 mm, kinematic budget",
            _of(_CURVED, "kinematic"),
            "mean_mm 0.03 mean, space_mm 0.03, work_deg 3.0, travel_error_deg 0.1",
        ),
    )
)

_LAWS = ("printed", "literal", "open", "fixed", "dls", "guarded")
_SHAPES = ("straight", "s_r60", "l_r20_convex", "l_r5_convex", "l_r1_convex", "l_r1_concave")
COMPARED: tuple[WeldCase, ...] = tuple(WeldCase(seam, law=law) for seam in _SHAPES for law in _LAWS) + tuple(
    WeldCase(seam, gaps=gaps, law=law)
    for seam, gaps in (("straight", _GAP_25), ("s_r60", _GAP_10), ("arc_r60_end", ()))
    for law in ("fixed", "fixed_zeroed", "guarded")
)


def get_rows(names: tuple[str, ...]) -> tuple[Row, ...]:
    """The rows of those names, all when none is given.

    Raises:
        UnknownRow: naming the known ones.
    """
    known = {row.key: row for row in ROWS}
    for name in names:
        if name not in (*known, "turns", "laws"):
            raise UnknownRow(f"Unknown row '{name}'; use some of {', '.join((*known, 'turns', 'laws'))}.")
    return tuple(known[name] for name in names if name in known) if names else ROWS


Runs = dict[WeldCase, dict[int, RunMetrics]]
"""The figures of every case by its seeds."""


class Reached(NamedTuple):
    """One figure held against its target: the mean and the worst over all runs of the row, and which run was worst."""

    target: MetricTarget
    mean: float
    worst: float
    worst_run: str

    @property
    def met(self) -> bool:
        """Whether it is within the limit; what could not be measured is not."""
        return (self.worst if self.target.over == "worst" else self.mean) <= self.target.limit


def hold_against(target: MetricTarget, runs: Runs) -> Reached:
    """A target's figure over all runs; a run that lacks it (it broke off before) counts as infinitely bad."""
    values = {
        f"{case.name} seed {seed}": v if math.isfinite(v := float(getattr(m, target.figure))) else math.inf
        for case, of in runs.items()
        for seed, m in of.items()
    }
    worst = max(values, key=lambda name: values[name])
    return Reached(target, float(np.mean(list(values.values()))), values[worst], worst)


def run_cases(
    cases: Iterable[WeldCase],
    seeds: Iterable[int],
    keep: Callable[[WeldCase, int, StudyRun], None],
    progress: Progress,
    runs: Runs,
) -> Runs:
    """Return every case over every seed; what ``runs`` has is not run again. `keep` sees each run as it ends."""
    wanted = list(dict.fromkeys(cases))
    for k, case in enumerate(wanted):
        for seed in seeds:
            progress(case.name, k / len(wanted))
            if seed not in runs.setdefault(case, {}):
                run, runs[case][seed] = run_case(case, seed)
                keep(case, seed, run)
    return {case: {seed: runs[case][seed] for seed in seeds} for case in wanted}


TURNS = ("turn_120_r20", "turn_120_r5", "turn_150_r10", "u_r20", "u_r30", "u_r100", "cusp_r20")


@dataclass(frozen=True, kw_only=True)
class TurnResult:
    """One seam and chord: the true seam's chord map, and how the weld of its nominal plan ended.

    Attributes:
        turn_deg, back_up_mm: by the true seam's chord map; possible: the map has no obstacle there.
        refused: before anything moved; phase, reason: how it ended; max_mm: error of what was welded in one go.
        splits_mm: where the seam was split instead; pieces_done: how many of its pieces were welded; pieces_max_mm:
            their largest error.
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
        """Whether the weld neither finished nor gave a reason, or had to be stopped with the arc on."""
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
    """Predict and weld one seam with one chord by the nominal budget's plan; what is refused is done in pieces."""
    case = WeldCase(seam, chord_m=chord_m)
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
