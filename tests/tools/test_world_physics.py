"""The world's plant: it follows the controller's joints, and takes no computing time while nothing moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.worlds.robot.played import WORLD
from weldcal.calibration.planning.clearance import TOOL, LinkCapsule, lowest_point
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import nominal_arm
from weldcal.tools.emulators.cell.physics import STEP_S, STILL_FRAMES, Physics, to_the_wire
from weldcal.tools.emulators.cell.wires import Arc

TURN_RAD = 0.05


def test_the_torch_is_no_longer_than_its_wire() -> None:
    """The clearance checks keep 12 mm about the torch; the world does not count a table 1 mm below the wire's end."""
    tool = load_tool(WELDING).tool
    torch = [to_the_wire(LinkCapsule(TOOL, 6, c.p_start, c.p_end, c.radius), tool) for c in tool.capsules()]
    down = [RigidTransform()] * 6 + [RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 1.0])]
    heights = [lowest_point([body], down) for body in torch]
    assert heights[-1] == pytest.approx(1.0 - 0.1715, abs=1e-9)
    assert heights[:-1] == [
        lowest_point([LinkCapsule(TOOL, 6, c.p_start, c.p_end, c.radius)], down) for c in tool.capsules()[:-1]
    ]


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
