"""The search for the groove: a ball that rests leaning above its plan is in the root of a guiding joint, and on a wall elsewhere."""

import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.worlds.weld import plant
from tests.worlds.weld.budgets import NOMINAL, Unknowns
from tests.worlds.weld.case import RunMetrics, judge
from tests.worlds.weld.groove import TipPlace, Wedge
from tests.worlds.weld.seams import TrueSeam, arcs
from weldcal.systems.jobs.weld.arm_way import leaning
from weldcal.welding.numerics import Array, changed
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.plan_fit import PlanFit
from weldcal.welding.servo.faults import raised
from weldcal.welding.servo.settings import DeflectionControl, ServoConfig, ToolGeometry, TouchOnConfig
from weldcal.welding.servo.state import Measurement, Phase, WeldingState
from weldcal.welding.servo.touch import _search

CONFIG = ServoConfig()
REST = WeldingState(delta_n=CONFIG.deflection.delta_d_m, delta_axial=CONFIG.deflection.axial_d_m)


def searched(offset_m: float, above_m: float, frames: int = 20) -> tuple[str | None, bool, int]:
    """The fault, whether the tip is seated, and after how many frames, of a ball that rests above its planned line."""
    config = replace(CONFIG, touch=replace(CONFIG.touch, offset_m=offset_m))
    state = replace(REST, touch=replace(REST.touch, step="search", face_height=above_m, start_left=0.0))
    for frame in range(1, frames + 1):
        state, _, _, problem, seated = _search(state, True, 0.0, above_m, 0.0, 1.0, config, 0.03 * frame)
        if problem or seated:
            return problem, seated, frame
    return None, False, frames


def test_a_ball_in_a_guiding_joint_is_seated_above_a_plan_that_is_too_deep() -> None:
    """A scanner that measures 0.2 % too far puts a fillet 1.9 mm too low: its root then lies above the plan."""
    problem, seated, frames = searched(0.0, 2.2e-3)
    assert (problem, seated) == (None, True)
    assert frames >= 10, "a ball that still slides down its wall leans too"


def test_a_ball_far_above_its_plan_or_beside_a_narrow_joint_is_at_a_wall() -> None:
    for offset_m, above_m in ((0.0, 3.5e-3), (-5e-3, 2.2e-3)):
        problem, seated, _ = searched(offset_m, above_m)
        assert not seated
        assert re.search("the tip met a wall but no groove", str(problem))


@pytest.mark.parametrize("offset_m", [0.0, -5e-3])
def test_a_ball_that_rests_where_it_is_planned_is_seated_at_once(offset_m: float) -> None:
    assert searched(offset_m, 1e-4)[1:] == (True, 3)


def seated_at(lean: float, heights_m: Array) -> bool:
    """Whether a ball of a guiding joint is seated within frames in which it leans so, over what is wanted."""
    config = replace(CONFIG, touch=replace(CONFIG.touch, offset_m=0.0))
    state = changed(REST, delta_n=lean * CONFIG.deflection.delta_d_m)
    state = replace(state, touch=replace(state.touch, step="search", face_height=2e-3, start_left=0.0))
    for frame, height in enumerate(heights_m):
        state, _, _, problem, seated = _search(state, True, 0.0, float(height), 0.0, 1.0, config, 0.03 * frame)
        if problem or seated:
            return seated
    return False


SLIDING_LEAN = 1.0 + 1.0 / 6.0  # least lean of a ball that slides: friction 0.2, up to 120 deg


@pytest.mark.parametrize(("lean", "seated"), [(1.1, True), (SLIDING_LEAN, False), (1.4, False)])
def test_a_ball_that_leans_as_one_that_slides_is_not_seated(lean: float, seated: bool) -> None:
    assert seated_at(lean, np.full(20, 2e-3)) == seated


@pytest.mark.parametrize(("step_mm", "seated"), [(0.2, True), (0.4, False)])
def test_a_ball_whose_height_changes_is_not_seated(step_mm: float, seated: bool) -> None:
    """The tag's noise of 0.05 mm makes four sigma of a change; a slide makes more."""
    assert seated_at(1.0, np.tile([2e-3, 2e-3 + 1e-3 * step_mm], 10)) == seated


def held_after(falls_m: Array) -> int | None:
    """The frame in which a ball that was seated 2 mm above its plan, and then falls so far, is held; None for none."""
    plan = SeamCurve.from_points(arcs((0.12, 0.0)), np.array([0.0, 0.0, 1.0]))
    state = changed(REST, plan_fit=PlanFit.start(plan), s_tip=0.05, phase=Phase.TRACK)
    state = changed(state, touch=replace(REST.touch, raised_m=2e-3))
    for frame, fall in enumerate(falls_m):
        point = np.array([0.05, 0.0, 2e-3 - float(fall)])
        state = raised(changed(state, measurement=Measurement(0.03 * frame, point, np.zeros(3), point)), CONFIG)
        if state.phase == Phase.FAULT:
            return frame
    return None


@pytest.mark.parametrize(("fall_mm", "held"), [(0.4, None), (0.7, 0)])
def test_a_ball_that_falls_by_half_of_a_low_tack_is_held(fall_mm: float, held: int | None) -> None:
    assert held_after(np.array([1e-3 * fall_mm])) == held


@pytest.mark.parametrize(("fall_mm", "held"), [(0.018, False), (0.03, True)])
def test_a_ball_follows_the_slope_of_a_plan_and_no_steeper_one(fall_mm: float, held: bool) -> None:
    """By frame: at 8 mm/s and 30 frames a second 0.018 mm are a slope of 7 %, and 0.03 mm one of 11 %."""
    assert (held_after(1e-3 * fall_mm * np.arange(1.0, 101.0)) is not None) == held


R, SEAT, D = 2.5e-3, 2.5e-3 * math.sqrt(2.0), math.sqrt(0.5)
GRID = np.arange(-30e-3, 30e-3, 5e-5)
Line = tuple[float, float, float, float]


class Section(Wedge):
    """Height of the ball's centre over its seat in a joint of 90 deg with anything in it: material as lines, m.

    A line is (x, z, x, z), x to the left of the root and z along the bisector.
    """

    def __init__(self, *lines: Line) -> None:
        super().__init__(R, math.radians(45.0), 1.0)
        height = np.full(len(GRID), -30e-3)
        for x0, z0, x1, z1 in lines:
            share = np.linspace(0.0, 1.0, max(2, int(math.hypot(x1 - x0, z1 - z0) / 5e-5)))
            d = GRID[:, None] - (x0 + share * (x1 - x0))
            top = z0 + share * (z1 - z0) + np.sqrt(np.maximum(R * R - d * d, 0.0))
            height = np.maximum(height, np.where(np.abs(d) < R, top, -1.0).max(axis=1))
        object.__setattr__(self, "_height", (height - SEAT).tolist())
        object.__setattr__(self, "_slope", np.clip(np.gradient(height, GRID), -20.0, 20.0).tolist())

    def floor(self, y: float) -> tuple[float, float]:
        at = min(max((y - GRID[0]) / 5e-5, 0.0), len(GRID) - 2.0)
        i, share = int(at), at % 1.0
        rows = (self._height, self._slope)  # type: ignore[attr-defined]
        low, slope = ((1.0 - share) * row[i] + share * row[i + 1] for row in rows)
        return low, slope


def wall(side: float, to: float = 40e-3) -> Line:
    """From the root outwards: the web at the left (1), the plate at the right (-1)."""
    return (0.0, 0.0, side * to * D, to * D)


def tack(h: float, cap: float = 0.0) -> list[Line]:
    """Weld metal in the root, h mm high at its edges, with a cap."""
    x = np.linspace(-1.0, 1.0, 13)
    x, z = 1e-3 * h * x, 1e-3 * (h + cap * (1.0 - x * x))
    return list(zip(x[:-1], z[:-1], x[1:], z[1:], strict=True))


def bar(side: float, thick: float, start: float, end: float) -> list[Line]:
    """A clamp's bar or a strip on a wall, from so far to so far of the root, mm."""
    around = [(start, 0.0), (start, thick), (end, thick), (end, 0.0)]
    p = [(1e-3 * side * D * (d - up), 1e-3 * D * (d + up)) for d, up in around]
    return [(*a, *b) for a, b in pairwise(p)]


CLEAN = (wall(1.0), wall(-1.0))
END = 6e-3 * D  # of a wall of 6 mm, whose end is square to it
SHORT = {
    "web": ((wall(1.0, 6e-3), wall(-1.0), (END, END, 2.0 * END, 0.0))),
    "plate": ((wall(1.0), wall(-1.0, 6e-3), (-END, END, -2.0 * END, 0.0))),
}
BESIDE = [(f"flat tack of {h}, {a} beside", (*CLEAN, *tack(h)), a) for h in (2, 3, 4, 5) for a in (0, -2)]
BESIDE += [(f"round tack of {h}", (*CLEAN, *tack(1.2 * h, 0.4 * h)), 0) for h in (2, 3, 4, 5)]
BESIDE += [(f"clamp of {t} on {w}", (*CLEAN, *bar(w, t, 0.5, 14)), 0) for t in (2, 3, 4, 5) for w in (-1, 1)]
BESIDE += [(f"edge of a strip {d} beside", (*CLEAN, *bar(-1, 3, 1, d)), -(d + 2) * D) for d in (3, 5)]
SHIFTS = [(f"{name}, {a} beside", walls, a) for a in (4, 5, 6, -4, -5, -6) for name, walls in SHORT.items()]
SHIFTS += [(f"plan {a} beside", CLEAN, a) for a in (4, 5, 6, -4, -5, -6)]


def welded(
    monkeypatch: pytest.MonkeyPatch,
    section: Section,
    ends: float,
    across: float,
    up: float = 0.0,
    above_m: float = 3e-3,
) -> RunMetrics:
    """A weld of a fillet of 120 mm, whose section is another up to `ends` mm; the plan lies so far beside it, mm."""

    class Place(TipPlace):
        def step(self, rest: Array, dt: float) -> Array:
            self._wedge = section if self.s < 1e-3 * ends else clean
            return super().step(rest, dt)

        @property
        def y(self) -> float:
            return self._y

        @y.setter
        def y(self, value: float) -> None:
            """The plant takes zero for its own root, and stops there."""
            if value == 0.0 and self._wedge.floor(0.0)[0] > 1e-4:
                value = -math.copysign(1e-6, self._y)
            self._y = value

    clean = Section(*CLEAN)
    monkeypatch.setattr(plant, "TipPlace", Place)
    monkeypatch.setattr(plant, "SEAT_M", SEAT)
    monkeypatch.setattr(plant, "groove_config", lambda config: config)
    config = ServoConfig(
        tool=ToolGeometry(tip_seat_height_m=SEAT, tip_drop_m=2e-3),
        touch=TouchOnConfig(zero_frames=10, offset_m=0.0, above_m=above_m),
        deflection=DeflectionControl(delta_d_m=1e-3, axial_d_m=4e-3),
        weld_speed_m_s=16e-3,
    )
    opened = (math.radians(22.5), math.radians(22.5))
    budget = replace(NOMINAL, unknown=Unknowns(left_wall_rad=opened, right_wall_rad=opened))
    seam = TrueSeam("fillet", arcs((0.12, 0.0), spacing=5e-3), np.array([0.0, 0.0, 1.0]))
    plan = SeamCurve.from_points(seam.points, seam.up).raised(1e-3 * up, 1e-3 * across)
    return judge(plant.simulate(seam, budget, config, 0, plan=plan), 16e-3, 0.06, (), 1e-3)


@pytest.mark.parametrize(("lines", "across"), [row[1:] for row in BESIDE], ids=[row[0] for row in BESIDE])
def test_a_ball_on_what_is_no_root_is_held_before_the_arc(
    lines: tuple[Line, ...], across: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What lies in the joint ends 16 mm behind its start, where the tip falls off it."""
    run = welded(monkeypatch, Section(*lines), 16.0, across)
    assert run.phase == "FAULT"
    assert math.isnan(run.max_mm), "the arc was lit"


@pytest.mark.parametrize(("lines", "across"), [row[1:] for row in SHIFTS], ids=[row[0] for row in SHIFTS])
def test_a_plan_far_beside_its_joint_is_held_or_welded_in_the_root(
    lines: tuple[Line, ...], across: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = welded(monkeypatch, Section(*lines), 1e9, across)
    assert run.phase == "FAULT" or run.max_mm < 0.5


@pytest.mark.parametrize("up", [-0.8, -2.2, -2.8])
def test_a_root_above_its_plan_is_welded(up: float, monkeypatch: pytest.MonkeyPatch) -> None:
    run = welded(monkeypatch, Section(*CLEAN), 1e9, 1.5, up)
    assert (run.phase, run.max_mm < 0.3) == ("DONE", True)


def test_a_strip_along_the_joint_is_held_where_the_plan_is_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    """By touch the edge of a strip is a joint of its own; only the plan says that the root is not there."""
    sure = leaning(ServoConfig(tool=ToolGeometry(tip_drop_m=2e-3)), 0.0, sigma_m=0.2e-3).touch.above_m
    run = welded(monkeypatch, Section(*CLEAN, *bar(-1, 3, 1, 3)), 1e9, -5 * D, above_m=sure)
    assert run.phase == "FAULT"
    assert math.isnan(run.max_mm)
    for sigma, above in ((0.2e-3, 1e-3), (1.0e-3, 2e-3), (5e-3, 3e-3), (math.nan, 3e-3)):
        config = leaning(ServoConfig(tool=ToolGeometry(tip_drop_m=2e-3)), 0.0, sigma_m=sigma)
        assert config.touch.above_m == pytest.approx(above)
