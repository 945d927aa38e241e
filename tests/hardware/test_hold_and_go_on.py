"""An operator holds a move of the emulated arm: it comes to rest on its path, stays, and goes on along it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from tests.held_weld import held_weld, short_weld
from weldcal.systems.cell import build_cell
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.operator import Operator
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, Emulator, emulator_process

AWAY_RAD = 0.8
MOVING_S, HELD_S = 0.6, 2.0
AT_REST_RAD_S = 1e-3


def scenario() -> Scenario:
    found = load_scenario(
        "straight_groove",
        "scanner: !RenderedScanner {mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}\n"
        "job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}",
    )
    found.job.weld = False
    return found


Q_HOME = np.deg2rad(scenario().home_deg)
TURN = np.array([1.0, 0.0, 0.0, 0.0, 0.0, -0.5])  # of base and last wrist only: the way home is free


@pytest.fixture
def controller() -> Iterator[Emulator]:
    with emulator_process(q=(Q_HOME + AWAY_RAD * TURN).tolist(), lockstep=LOCKSTEP_S) as made:
        yield made


def test_the_arm_rests_on_its_path_while_it_is_held_and_then_ends_its_way(controller: Emulator) -> None:
    described, operator, seen = scenario(), Operator(), {}
    described.robot = UrRtde(host=controller.host, lockstep=True)

    def hold_for_a_while() -> None:
        time.sleep(MOVING_S)
        operator.hold()
        time.sleep(0.5 * HELD_S)
        seen["first"] = controller.state()
        time.sleep(0.5 * HELD_S)
        seen["last"] = controller.state()
        operator.go_on()

    def watch(stage: str, _: float) -> None:
        if stage == phase_words("move_home") and not seen:
            seen["begun"] = {}
            threading.Thread(target=hold_for_a_while, daemon=True).start()

    run = run_cell(build_cell(described, operator=operator), watch)
    assert run.reason is None
    assert run.held_by_person == 1
    assert [name for name, _, _ in run.phases] == ["start", "move_home", "park", "done"]
    q_first, q_last = (np.array(seen[name]["q"]) for name in ("first", "last"))
    assert np.abs(seen["first"]["qd"]).max() < AT_REST_RAD_S
    assert np.abs(q_last - q_first).max() < 1e-4
    # on the straight line in joint space, neither at its begin nor at its end
    way = (q_last - Q_HOME) / (AWAY_RAD * TURN + (TURN == 0.0))
    assert way[0] == pytest.approx(way[5], abs=0.01)
    assert 0.02 < way[0] < 0.98
    assert np.abs(np.array(controller.state()["q"]) - Q_HOME).max() < 1e-3
    assert run.clock is not None
    assert run.clock.lost_s < 0.5 * HELD_S, "the time that it stood is none that was lost"  # a busy computer loses some


def test_a_held_weld_is_finished_over_the_join() -> None:
    described = short_weld()
    with emulator_process(q=np.deg2rad(described.home_deg).tolist(), lockstep=LOCKSTEP_S) as controller:
        described.robot = UrRtde(host=controller.host, lockstep=True, process_output=3)
        found = held_weld(described)
    assert found.run.reason is None
    assert found.run.held_by_person == 1
    assert found.still_ms < 100.0
    assert found.mean_m <= 0.15e-3
    assert found.welded_twice_m > 4e-3, "the join lies in what is welded twice"
