"""A seam cut short of its groove: it ends where it was said to, and the tip stays in the bend before the torch."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.welding.weld_kinematics import Run, weld
from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.groove import SEAT_M as SEAT
from tests.worlds.weld.seams import s_curve
from weldcal.welding.numerics import changed
from weldcal.welding.record.process import path_error
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.faults import watch
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase, ServoSample

CUT_M = 0.085  # just before the S bends: the torch is on the straight while the tip goes round
PLAN_OFF_M = np.array([0.6e-3, 0.8e-3, 0.0])  # the first is along the seam, which no wall tells before the bend
ALONG_MM = 1.0  # that, and what the torch makes until it is lit
CONFIG = ServoConfig()
LIMIT_M = CONFIG.faults.lateral_m
POINTS = s_curve()


@cache
def cut(gap: tuple[float, float] | None = None, hidden_s: float | None = None) -> Run:
    """A weld of the first part of the S, planned 1 mm off."""
    plan = SeamCurve.from_points(POINTS + PLAN_OFF_M, length=CUT_M)
    gaps = () if gap is None else (gap,)
    hidden = (np.inf, np.inf) if hidden_s is None else (hidden_s, np.inf)
    return weld(POINTS, NOMINAL, CONFIG, seed=2, plan=plan, gaps=gaps, hidden=hidden)


def welded(run: Run) -> tuple[float, float, float]:
    """Where the arc went on and off along the true seam, and the torch's largest error, mm."""
    error = path_error(run.torch[run.torch_on], SeamCurve.from_points(POINTS).raised(SEAT + CONFIG.clearance_m))
    return 1e3 * float(error.s[0]), 1e3 * float(error.s[-1]), 1e3 * error.max_m


def largest_bend(run: Run) -> float:
    """The tip's largest deflection across the seam, m."""
    return max(abs(c.diagnostics.delta_n) for c in run.commands)


def test_it_is_felt_on_until_the_torch_is_at_its_end() -> None:
    run = cut()
    assert run.phases() == (Phase.TOUCH, Phase.TRACK, Phase.DONE), run.last.reason
    start, end, most = welded(run)
    assert start == pytest.approx(0.0, abs=ALONG_MM)
    assert end == pytest.approx(1e3 * CUT_M, abs=ALONG_MM), "no further than it was said, though the groove goes on"
    assert most <= 0.2
    assert largest_bend(run) < 0.5 * LIMIT_M


def test_a_tip_that_went_straight_on_would_be_bent_too_far_by_the_wall() -> None:
    whole = SeamCurve.from_points(POINTS)
    only = SeamCurve.from_points(whole.position(np.linspace(0.0, CUT_M, 60)))
    assert largest_bend(weld(POINTS, NOMINAL, CONFIG, seed=2, plan=only)) > LIMIT_M


def test_a_gap_past_its_end_does_not_stop_the_torch() -> None:
    run = cut(gap=(CUT_M + 0.015, CUT_M + 0.045))
    assert run.phases() == (Phase.TOUCH, Phase.TRACK, Phase.FINISH, Phase.DONE), run.last.reason
    _, end, most = welded(run)
    assert end == pytest.approx(1e3 * CUT_M, abs=ALONG_MM)
    assert most <= 0.2


def test_a_tag_hidden_past_its_end_does_not_stop_the_torch() -> None:
    run = cut()
    past = next(t for t, c in zip(run.time, run.commands, strict=True) if c.diagnostics.s_tip > CUT_M + 0.005)
    hidden = cut(hidden_s=float(past))
    assert hidden.phases() == (Phase.TOUCH, Phase.TRACK, Phase.FINISH, Phase.DONE), hidden.last.reason
    assert welded(hidden)[1] == pytest.approx(1e3 * CUT_M, abs=ALONG_MM)
    assert welded(hidden)[2] <= 0.2


@pytest.mark.parametrize(("past_mm", "phase"), [(-1.0, Phase.FAULT), (1.0, Phase.FINISH)])
def test_a_tip_pushed_too_far_is_a_fault_only_where_it_is_needed(past_mm: float, phase: Phase) -> None:
    run = cut()
    state, sideways = run.state, np.array([0.0, 1.2 * LIMIT_M, 0.0])
    assert state.measurement is not None
    pushed = changed(
        state,
        phase=Phase.TRACK,
        s_tip=CUT_M + 1e-3 * past_mm,
        s_end=CUT_M,
        measurement=state.measurement._replace(delta=sideways),
        frame_time=float(run.time[-1]),
    )
    assert watch(pushed, ServoSample(float(run.time[-1]), RigidTransform()), CONFIG).phase == phase
