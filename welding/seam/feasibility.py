"""Checks whether a seam can be welded in one go, and where to split it if not."""

import itertools
import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.models.tool import WeldingTool
from weldcal.welding.seam.chord_map import ChordMap, chord_map
from weldcal.welding.seam.curve import SeamCurve

_SPACING_M = 1.0e-3  # as the chord map of the weld itself


class InfeasibleSeam(WeldcalError):
    """A trailing torch cannot weld this seam in one go: it would have to run backwards, stop, or leave its windows."""


@dataclass(frozen=True, kw_only=True)
class SeamWindows:
    """Limits on the motion that a seam may require of the tool.

    Attributes:
        back_up_m: how far the torch may have to run backwards: what the plan's noise makes of a right angle.
        conditioning: least sqrt(cos^2 th_r + cos^2 th_t).
        sharp_rad: largest turn within 4 mm: beyond it the seam reverses in a cusp.
        travel_rad: largest travel angle, unsigned; work_rad: largest lean off the wanted work angle.
        tilt_rad: how far the torch leans back from the tool's axis; it adds to the chord's pitch.
        speed_loss: largest share of torch speed that the limits may take away.
    """

    back_up_m: float = 0.5e-3
    conditioning: float = 0.4
    sharp_rad: float = math.radians(115.0)
    travel_rad: float = math.radians(20.0)
    work_rad: float = math.radians(10.0)
    speed_loss: float = 1.0
    tilt_rad: float = 0.0

    @classmethod
    def of(cls, tool: WeldingTool) -> Self:
        """The windows of a tool; a torch that leans back further than the travel window was built for that angle."""
        tilt = tool.torch_tilt_rad
        return cls(travel_rad=max(cls.travel_rad, abs(tilt)), tilt_rad=tilt)


@dataclass(frozen=True)
class SeamProblem:
    """One reason why a seam cannot be welded in one go: its kind, the torch's arc length m, and one sentence."""

    kind: str
    s: float
    sentence: str


@dataclass(frozen=True)
class SeamReport:
    """A seam's chord map, its problems, and where to split it (arc lengths m) when that helps."""

    chart: ChordMap
    problems: tuple[SeamProblem, ...]
    splits: tuple[float, ...] = ()

    @property
    def feasible(self) -> bool:
        """Whether the seam can be welded in one go."""
        return not self.problems


def assess_seam(plan: SeamCurve, d: float, weld_speed: float, windows: SeamWindows | None = None) -> SeamReport:
    """Compute the chord map of a seam and every problem of welding it in one go.

    Args:
        plan: the line that tip and torch run on; d: chord m; weld_speed: m/s.
        windows: limits; SeamWindows() when None.
    """
    limits = windows or SeamWindows()
    chart = chord_map(plan, d, weld_speed, spacing=_SPACING_M)
    problems = _problems(plan, chart, d, limits)
    splits = _splits(plan, d, weld_speed, limits) if problems else ()
    return SeamReport(chart, problems, splits)


def check_feasible(plan: SeamCurve, d: float, weld_speed: float, windows: SeamWindows | None = None) -> ChordMap:
    """The chord map of a feasible seam.

    Raises:
        InfeasibleSeam: naming its first problem, and where to split the seam if that helps.
    """
    report = assess_seam(plan, d, weld_speed, windows)
    if report.problems:
        places = " and ".join(f"{1e3 * s:.0f}" for s in report.splits)
        action = (
            f"split the weld at {places} mm or shorten the tool" if places else "shorten the tool or change the seam"
        )
        raise InfeasibleSeam(f"Plan infeasible: {report.problems[0].sentence}; {action}.")
    return report.chart


def split_seam(
    plan: SeamCurve, d: float, weld_speed: float, windows: SeamWindows | None = None
) -> tuple[SeamCurve, ...]:
    """Split the seam into pieces that each can be welded in one go, in order; a feasible seam is one piece.

    Raises:
        InfeasibleSeam: no split helps.
    """
    report = assess_seam(plan, d, weld_speed, windows)
    if report.feasible:
        return (plan,)
    if not report.splits:
        check_feasible(plan, d, weld_speed, windows)
    ends = (0.0, *report.splits, plan.length)
    return tuple(piece(plan, low, high) for low, high in itertools.pairwise(ends))


def piece(plan: SeamCurve, low: float, high: float) -> SeamCurve:
    """The stretch of a seam between two arc lengths m as a seam of its own."""
    s = np.linspace(low, high, max(5, math.ceil((high - low) / 0.5e-3) + 1))
    return SeamCurve.from_points(plan.position(s), plan.up(s))


def _problems(plan: SeamCurve, chart: ChordMap, d: float, limits: SeamWindows) -> tuple[SeamProblem, ...]:
    found = []
    worst = int(np.argmax(np.abs(chart.turn)))
    turn, place = math.degrees(chart.max_turn), float(chart.s_torch[worst])
    within = f"the seam turns {turn:.0f} deg within the {1e3 * d:.0f} mm between torch and tip at {1e3 * place:.0f} mm"
    if chart.back_up_m > limits.back_up_m:
        text = f"{within}, and the torch would have to run {1e3 * chart.back_up_m:.1f} mm backwards"
        found.append(SeamProblem("back-up", place, text))
    elif chart.min_conditioning < limits.conditioning:
        text = f"{within}, and the tool is square to both ends of the seam"
        found.append(SeamProblem("conditioning", place, text))
    sharp, where = _sharpest(plan)
    if sharp > limits.sharp_rad:
        text = f"the seam reverses at {1e3 * where:.0f} mm: it turns {math.degrees(sharp):.0f} deg within 4 mm"
        found.append(SeamProblem("cusp", where, text))
    travel = np.abs(chart.travel + limits.tilt_rad)
    k = int(np.argmax(travel))
    if travel[k] > limits.travel_rad:
        text = (
            f"the travel angle would be {math.degrees(travel[k]):.1f} deg at {1e3 * chart.s_torch[k]:.0f} mm, "
            f"and its window is {math.degrees(limits.travel_rad):.0f} deg"
        )
        found.append(SeamProblem("travel angle", float(chart.s_torch[k]), text))
    if chart.speed_loss > limits.speed_loss:
        k = int(np.argmin(chart.torch_speed))
        text = f"the torch would lose {100.0 * chart.speed_loss:.0f} % of its speed at {1e3 * chart.s_torch[k]:.0f} mm"
        found.append(SeamProblem("speed", float(chart.s_torch[k]), text))
    return tuple(found)


def _sharpest(plan: SeamCurve) -> tuple[float, float]:
    """The largest turn (rad) of the tangent within 4 mm, and the arc length m of its middle."""
    s = np.arange(0.0, plan.length, _SPACING_M)
    if len(s) < 6:
        return 0.0, 0.0
    t = plan.tangent(s)
    cos = np.clip(np.sum(t[4:] * t[:-4], axis=1), -1.0, 1.0)
    k = int(np.argmin(cos))
    return math.acos(float(cos[k])), float(s[k] + 2.0 * _SPACING_M)


def _splits(plan: SeamCurve, d: float, weld_speed: float, limits: SeamWindows, depth: int = 4) -> tuple[float, ...]:
    """Arc lengths at which to split a seam that turns too far.

    The middle of the turn, and recursively in the pieces.
    """
    chart = chord_map(plan, d, weld_speed, spacing=_SPACING_M)
    kinds = {p.kind for p in _problems(plan, chart, d, limits)}
    if not kinds or depth == 0 or plan.length < 0.030 or not kinds <= {"back-up", "conditioning", "cusp"}:
        return ()
    sharp, where = _sharpest(plan)
    if sharp < math.radians(50.0):
        # A wide turn: its middle within the chord that turns most.
        k = int(np.argmax(np.abs(chart.turn)))
        low, high = max(0.0, float(chart.s_torch[k])), min(plan.length, float(chart.s_tip[k]))
        s = np.arange(low, high, _SPACING_M)
        swept = np.cumsum(np.abs(plan.curvature(s))) if len(s) else np.zeros(1)
        where = float(s[int(np.searchsorted(swept, 0.5 * swept[-1]))]) if len(s) else 0.5 * (low + high)
    if not 0.012 < where < plan.length - 0.012:
        return ()
    places: list[float] = []
    for low, high in ((0.0, where), (where, plan.length)):
        part = piece(plan, low, high)
        if _problems(part, chord_map(part, d, weld_speed, spacing=_SPACING_M), d, limits):
            inner = _splits(part, d, weld_speed, limits, depth - 1)
            if not inner:
                return ()
            places += [low + s for s in inner]
        if high == where:
            places.append(where)
    return tuple(places)
