"""A weld that an operator holds: the arc is off at once, the tool rests, goes back over its own path and welds the rest as
well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.welding.weld_kinematics import Run, l_curve, straight, weld
from tests.worlds.weld import plant
from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.groove import SEAT_M
from weldcal.welding.record.process import path_error
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.interruption import RAMP_S, Interruption, interruptible_step
from weldcal.welding.servo.settings import ServoConfig, TouchOnConfig
from weldcal.welding.servo.state import Phase, ServoSample, WeldingCommand, WeldingState

CONFIG = ServoConfig(touch=TouchOnConfig(calibrate_gain=True))
SEAMS = {"straight": straight(0.1), "l": l_curve()}
MM = 1e-3


class Held:
    """The servo with an operator beside it, who holds it for a second once the torch has come to each of these places
    (m)."""

    def __init__(self, *places: float, held_s: float = 1.0, moved: float = 0.0, phase: Phase | None = None) -> None:
        self.places, self.held_s, self.moved, self.phase = list(places), held_s, moved, phase
        self.held, self.since = Interruption(), -np.inf
        self.begun: list[int] = []
        self.tick = 0

    def __call__(
        self, state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig
    ) -> tuple[WeldingState, WeldingCommand]:
        due = state.phase == self.phase if self.phase else state.torch_on
        if self.places and due and state.s_torch >= self.places[0]:
            self.places.pop(0)
            self.since = sample.time
            self.begun.append(self.tick)
        holds = sample.time - self.since < self.held_s
        if self.moved and self.held.p_stop is not None:
            sample = replace(sample, X_BT=RigidTransform(np.array([self.moved, 0.0, 0.0])) @ sample.X_BT)
        state, self.held, command = interruptible_step(state, self.held, sample, plan, config, holds)
        self.tick += 1
        return state, command


def welded(monkeypatch: pytest.MonkeyPatch, name: str, held: Held, time_limit: float = 90.0) -> Run:
    monkeypatch.setattr(plant, "welding_step", held)
    return weld(SEAMS[name], NOMINAL, CONFIG, seed=1, time_limit=time_limit)


def off_seam(run: Run, name: str) -> np.ndarray:
    """Distance (N,) m of the torch from the true seam while the arc burned, and where on the seam."""
    line = SeamCurve.from_points(SEAMS[name]).raised(SEAT_M + CONFIG.clearance_m)
    error = path_error(run.torch[run.torch_on], line)
    return np.column_stack([error.s, np.hypot(error.lateral, error.height)])


def test_without_a_hold_every_number_is_that_of_the_servo_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = weld(SEAMS["straight"], NOMINAL, CONFIG, seed=1, time_limit=20.0)
    beside = welded(monkeypatch, "straight", Held(), time_limit=20.0)
    assert beside.torch_on.any()
    assert alone.phases() == beside.phases()
    assert np.array_equal(alone.torch, beside.torch)
    assert all(np.array_equal(a.V_BT, b.V_BT) for a, b in zip(alone.commands, beside.commands, strict=True))


@pytest.mark.parametrize(("name", "places"), [("straight", (0.002, 0.05)), ("l", (0.155,))])
def test_a_held_weld_goes_on_over_its_crater_and_the_join_is_as_good_as_the_rest(
    monkeypatch: pytest.MonkeyPatch, name: str, places: tuple[float, ...]
) -> None:
    held = Held(*places)
    run = welded(monkeypatch, name, held)
    assert run.last.phase == Phase.DONE
    assert len(held.begun) == len(places)
    for tick in held.begun:
        assert run.torch_on[tick - 1]
        assert not run.torch_on[tick], "off in the tick of the hold"
        assert run.phase[tick] == Phase.HELD
        still = tick + int((RAMP_S + 0.05) / CONFIG.period_s)
        end = next(k for k in range(tick, len(run.phase)) if run.phase[k] != Phase.HELD)
        assert np.abs([c.V_BT for c in run.commands[still:end]]).max() == 0.0, "at rest while it is held"
        assert run.phase[end] == Phase.BACK
        on = next(k for k in range(end, len(run.phase)) if run.torch_on[k])
        assert not run.torch_on[tick:on].any(), "off on the way back"
    found = off_seam(run, name)
    for place in places:
        join = found[np.abs(found[:, 0] - place) < 10 * MM]
        assert join[:, 1].mean() <= 0.15 * MM
        assert join[:, 1].max() <= 0.4 * MM
    gaps = np.diff(np.sort(found[:, 0]))
    assert gaps.max() < 0.5 * MM, "no stretch is left out"
    assert found[:, 1].mean() <= 0.1 * MM


def test_the_way_back_is_the_overlap_and_never_before_the_seams_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    for place, least, most in ((0.015, 5.0 * MM, 5.2 * MM), (0.002, 1.0 * MM, 2.5 * MM)):
        held = Held(place, held_s=1e9)
        ways = []

        def watched(*given: object, held: Held = held, ways: list[float] = ways) -> object:
            answer = held(*given)  # type: ignore[arg-type]
            ways.append(held.held.way_back_m)
            return answer

        monkeypatch.setattr(plant, "welding_step", watched)
        weld(SEAMS["straight"], NOMINAL, CONFIG, seed=1, time_limit=20.0)
        assert least <= ways[-1] <= most


def test_a_person_may_hold_before_the_arc_and_beyond_the_plate(monkeypatch: pytest.MonkeyPatch) -> None:
    for phase in (Phase.TOUCH, Phase.FINISH):
        run = welded(monkeypatch, "straight", Held(-1.0, phase=phase))
        assert run.last.phase == Phase.DONE, run.last.reason
        assert Phase.HELD in run.phase
        assert (Phase.BACK in run.phase) == (phase == Phase.FINISH), "without an arc there is no way back"


def test_a_tool_that_was_moved_while_it_was_held_is_not_moved_back(monkeypatch: pytest.MonkeyPatch) -> None:
    held = Held(0.02, moved=2.0 * MM)
    run = welded(monkeypatch, "straight", held)
    assert run.last.phase == Phase.FAULT
    assert "was moved while the weld was held" in str(run.last.reason)
    assert not run.torch_on[held.begun[0] :].any()


def test_holding_again_on_the_way_back_stops_there_and_goes_on_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    held, again = Held(0.02), []

    def twice(state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig) -> object:
        if held.held.step == "back" and held.held.ticks == 40 and not again:
            again.append(sample.time)
            held.since = sample.time
        return held(state, sample, plan, config)

    monkeypatch.setattr(plant, "welding_step", twice)
    run = weld(SEAMS["straight"], NOMINAL, CONFIG, seed=1)
    assert again
    order = [p for p in run.phases() if p in (Phase.HELD, Phase.BACK)]
    assert order == [Phase.HELD, Phase.BACK, Phase.HELD, Phase.BACK]
    assert run.last.phase == Phase.DONE
    assert np.diff(np.sort(off_seam(run, "straight")[:, 0])).max() < 0.5 * MM
