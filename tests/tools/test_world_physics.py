"""The world's plant: it follows the controller's joints, and takes no computing time while nothing moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import nominal_arm
from weldcal.tools.emulators.cell.physics import STEP_S, STILL_FRAMES, Physics
from weldcal.tools.emulators.cell.process import WORLD
from weldcal.tools.emulators.cell.wires import Arc

TURN_RAD = 0.05


def test_a_plant_at_rest_is_left_as_it_is_until_the_arm_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "world.yaml").write_text(WORLD)
    world = load_scenario(str(tmp_path / "world.yaml"))
    physics, arc, rest = Physics(world, nominal_arm(world), 3, 0.0), Arc(), np.zeros(6)
    advanced = []
    step = physics._simulator.AdvanceTo
    monkeypatch.setattr(
        physics, "_simulator", type("Counted", (), {"AdvanceTo": lambda _, t: advanced.append(step(t))})()
    )
    q = np.array(physics.station.q_start)
    for _ in range(10 * STILL_FRAMES):
        physics.step(q, rest, arc)
    assert len(advanced) < 3 * STILL_FRAMES
    assert physics.time_s == pytest.approx(10 * STILL_FRAMES * STEP_S), "the world's time goes on"
    advanced.clear()
    speed = np.array([TURN_RAD / (100 * STEP_S), 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(100):
        q = q + speed * STEP_S
        physics.step(q, speed, arc)
    assert len(advanced) == 100
    for _ in range(10 * STILL_FRAMES):
        physics.step(q, rest, arc)
    assert physics.positions()[:6] == pytest.approx(q, abs=1e-8)
    assert len(advanced) < 100 + 9 * STILL_FRAMES
