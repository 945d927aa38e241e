"""The simulated tip creeps and loses work as its material says, by the closed forms of a held and of a free tip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.models.tools.test_tool_file import changed
from tests.systems.cells import EXACT_PLATE, Q_HOME, SMALL_IDEAL_SCANNER, TOOL, Drive, scenario
from tests.systems.drivers.test_soft_tip import Groove
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import kinematics_and_jacobian
from weldcal.systems.station import make_station

PRESS_M, TIME_S, CREEP, LOSS = 0.003, 0.4, 0.3, 0.3


def pressed(folder: Path, **material: float) -> tuple[Drive, Groove]:
    """A tip with this material, let go just above the groove's bottom while the tool presses it by PRESS_M."""
    file = changed(folder, *((f"tip.{key}", value) for key, value in material.items()))
    station = make_station(scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE, f"tool: {{file: {file}}}"), 0)
    drive, groove = Drive(station), Groove()
    lift(drive, groove, PRESS_M + 0.0004, PRESS_M + 0.0004)
    return drive, groove


def lift(drive: Drive, groove: Groove, depth_m: float, deflection_m: float) -> None:
    """Put the tool's rest point that far below the seat, and the tip that far above it."""
    X_BF = RigidTransform(groove.X_BT_axes, groove.p_BSeat - depth_m * groove.up) @ TOOL.X_FT.inverse()
    q = nearest_solution(drive.station.arm, X_BF, Q_HOME)
    assert q is not None
    drive.place_arm(q, np.array([0.0, 0.0, deflection_m]))


def height(drive: Drive) -> float:
    """Deflection of the tip along the finger, m."""
    return float(drive.get("cheat.contact")[5])


def force(drive: Drive) -> float:
    """Force of the axial spring, N, upwards positive on the finger; the ball's weight is held too."""
    world = drive.station.world
    return 9.81 * TOOL.tip_mass_kg / 3.0 - float(
        world.plant.get_net_actuation_output_port(world.tool).Eval(drive.plant)[2]
    )


def test_a_held_tip_relaxes_and_a_freed_one_recovers(tmp_path: Path) -> None:
    drive, groove = pressed(tmp_path, relaxation_s=TIME_S, creep_share=CREEP, loss_share=0.0)
    k, r = TOOL.axial_stiffness_N_per_m, CREEP / (1.0 - CREEP)
    seen = []
    for _ in range(20):
        drive.run(0.1)
        seen.append(force(drive) / (k * height(drive)))
    assert seen[0] == pytest.approx(1.0 + r * np.exp(-0.1 / TIME_S), abs=0.03)  # it settles within 0.03 s
    assert seen[4] == pytest.approx(1.0 + r * np.exp(-0.5 / TIME_S), abs=0.02)
    assert seen[-1] == pytest.approx(1.0, abs=0.01)
    held = height(drive)
    lift(drive, groove, -0.02, held)
    found = []
    for _ in range(3):
        drive.run(0.3)
        found.append(height(drive))
    # free: x = r v / (1 + r), so that v' = (x - v) / time = -v / (time (1 + r))
    expected = [held * CREEP * np.exp(-t * (1.0 - CREEP) / TIME_S) for t in (0.3, 0.6, 0.9)]
    assert found == pytest.approx(expected, abs=0.03e-3)
    assert found[0] > 0.4e-3


def test_friction_holds_back_on_both_ways(tmp_path: Path) -> None:
    drive, groove = pressed(tmp_path, relaxation_s=TIME_S, creep_share=0.0, loss_share=LOSS)
    drive.run(0.2)
    p_FT, found = np.array(TOOL.X_FT.translation()), []
    for speed in (-0.004, 0.004):  # m/s, deeper, and back
        for _ in range(7):
            _, _, J = kinematics_and_jacobian(drive.station.arm, drive.get("arm.position_measured"), p_FT)
            drive.set("arm.velocity_command", np.linalg.solve(J, [0.0, 0.0, 0.0, *(speed * groove.up)]))
            drive.run(0.05)
        found.append(force(drive) / (TOOL.axial_stiffness_N_per_m * height(drive)))
    b = LOSS / (2.0 - LOSS)
    assert found == pytest.approx([1.0 + b, 1.0 - b], abs=0.025)  # damping is 0.012 N of 1.3 N
