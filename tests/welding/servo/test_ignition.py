"""The weld moves while the arc is established, stands pressed on while it is not, and ends by name where it does not
come."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.plant import simulate
from tests.worlds.weld.seams import TrueSeam
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import DeflectionSample, Phase, ServoSample, WeldingCommand, WeldingState
from weldcal.welding.servo.step import welding_step

CONFIG = ServoConfig()
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def lit() -> tuple[WeldingState, RigidTransform, SeamCurve]:
    """A straight weld that has just asked for the torch."""
    points = np.column_stack([np.linspace(0.0, 0.12, 60), np.zeros(60), np.zeros(60)])
    run = simulate(TrueSeam("straight", points, UP), NOMINAL, CONFIG, 1, time_limit_s=16.0)
    assert run.state.torch_on
    assert run.phase == Phase.TRACK
    u, _, vt = np.linalg.svd(np.column_stack([run.points("ahead")[-1], run.points("left")[-1], UP]))
    state = replace(run.state, arc_seen=False, arc_waited_s=0.0)
    return state, RigidTransform(RotationMatrix(u @ vt), run.points("robot")[-1]), SeamCurve.from_points(points)


def ticks(
    start: tuple[WeldingState, RigidTransform, SeamCurve], arcs: list[bool]
) -> tuple[WeldingState, list[WeldingCommand]]:
    """The servo's answers while the arm stands where it is, one tick for each flag of the arc."""
    state, X, plan = start
    time, commands = float(state.time or 0.0), []
    for k, arc in enumerate(arcs):
        now = time + CONFIG.period_s * (k + 1)
        frame = DeflectionSample(now - 0.04, X, np.array([0.0, -2e-3, 3e-3 + 1e-9 * k]), True)
        state, command = welding_step(state, ServoSample(now, X, frame, arc), plan, CONFIG)
        commands.append(command)
    return state, commands


def n(seconds: float) -> int:
    return round(seconds / CONFIG.period_s)


def speed(command: WeldingCommand) -> float:
    return float(np.linalg.norm(command.V_BT[3:]))


def test_without_an_arc_the_tool_comes_to_rest_and_the_torch_stays_asked_for(
    lit: tuple[WeldingState, RigidTransform, SeamCurve],
) -> None:
    _, commands = ticks(lit, [False] * n(1.5))
    speeds = [speed(c) for c in commands]
    assert speeds[0] > 0.002, "it comes out of its motion"
    assert all(b <= a + 1e-12 for a, b in pairwise(speeds)), "and only slows"
    assert speeds[n(CONFIG.limits.ramp_s) + 1] == 0.0
    assert all(c.torch_on and c.phase == Phase.TRACK for c in commands)


def test_the_weld_moves_once_the_arc_is_there(lit: tuple[WeldingState, RigidTransform, SeamCurve]) -> None:
    _, commands = ticks(lit, [False] * n(1.5) + [True] * n(0.6))
    assert commands[-1].phase == Phase.TRACK
    assert speed(commands[n(1.5) - 1]) == 0.0
    assert speed(commands[-1]) > 0.5 * CONFIG.weld_speed_m_s
    assert max(speed(c) for c in commands[n(1.5) :]) < 3.0 * CONFIG.weld_speed_m_s, "without a jump"


def test_an_arc_that_does_not_come_ends_the_weld(lit: tuple[WeldingState, RigidTransform, SeamCurve]) -> None:
    limit = CONFIG.torch.ignition_limit_s
    state, commands = ticks(lit, [False] * n(limit + 0.1))
    assert state.phase == Phase.FAULT
    assert "not established within 2 s" in (state.reason or "")
    assert not commands[-1].torch_on
    assert all(c.torch_on for c in commands[: n(limit) - 1]), "not before its time"


def test_an_arc_that_goes_out_ends_the_weld_sooner(lit: tuple[WeldingState, RigidTransform, SeamCurve]) -> None:
    state, commands = ticks(lit, [True] * 5 + [False] * n(0.2) + [True] * 5)
    assert state.phase == Phase.TRACK, "a flicker does not"
    state, commands = ticks(lit, [True] * 5 + [False] * n(0.4))
    assert state.phase == Phase.FAULT
    assert "went out" in (state.reason or "")
    assert not commands[-1].torch_on
    assert speed(commands[-1]) == 0.0
