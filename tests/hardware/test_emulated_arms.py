"""The emulated controller of every arm says which arm it is, and the pre-flight refuses another arm than the
scenario's."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from tests.hardware.emulator_process import emulator_process
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.robots import CONTROLLER_MODELS, get_robot
from weldcal.systems.drivers.ur.readiness.kinematics_info import model_finding, read_kinematics
from weldcal.systems.drivers.ur.readiness.load import mounting_finding
from weldcal.systems.drivers.ur.readiness.preflight import CHECKS, preflight
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.versions import parse_version
from weldcal.tools.emulators.ur.wire.dashboard import DashboardServer
from weldcal.tools.emulators.ur.wire.script_ports import PrimaryServer

# RobotType of Universal Robots' client library
TYPES = {"ur3e": 3, "ur5e": 1, "ur10e": 2, "ur16e": 4, "ur20": 7, "ur30": 8}


def controller(arm: str) -> Controller:
    return Controller(load_arm(arm), np.array(HOME), parse_version("5.21"))


@pytest.mark.parametrize("arm", known_arms())
def test_each_controller_knows_its_arm(arm: str) -> None:
    made = controller(arm)
    told = DashboardServer(made).answer("get robot model")
    assert told == arm.upper().rstrip("E").replace("UR7", "UR5").replace("UR12", "UR10")
    assert model_finding(told, arm)[0]
    others = {name for name in CONTROLLER_MODELS if model_finding(told, name)[0]}
    assert {CONTROLLER_MODELS[name] for name in others} == {CONTROLLER_MODELS[arm]}
    server = PrimaryServer(made, lambda now: None, primary=True)
    assert struct.unpack(">4i", server._configuration[-16:])[2] == TYPES.get(arm, CONTROLLER_MODELS[arm][1])


def test_each_emulated_arm_has_its_serial_number() -> None:
    told = [DashboardServer(controller(arm)).answer("get serial number") for arm in known_arms()]
    assert len(set(told)) == len(known_arms())
    assert all(len(number) == 11 and number.startswith("2023") for number in told)


def test_a_payload_beyond_the_arm_ends_the_program() -> None:
    made = controller("ur3e")
    for mass, left in ((2.5, 2.5), (3.5, 2.5)):
        made.start(f"def load():\n  set_payload({mass})\nend\n")
        for _ in range(3):
            made.step()
        assert made.payload.mass == left
    assert any("payload of a ur3e is 0 to 3 kg" in line for line in made.log)


def test_the_preflight_wants_the_scenarios_arm() -> None:
    with emulator_process(robot="ur20") as robot:
        report = preflight(robot.host, nominal=load_arm("ur20"))
        assert report.ok, report.checks
        assert report.checks[CHECKS.index("model")].found == "UR20"
        refused = preflight(robot.host, nominal=load_arm("ur10e"))
        assert refused.first_problem is not None
        assert refused.first_problem.name == "model"
        assert "connect a ur10e, or write this robot's arm in the scenario" in refused.first_problem.operator_action
        assert "not a ur10e" in refused.checks[CHECKS.index("kinematics")].found
        assert read_kinematics(robot.host)[0].a[1] == pytest.approx(load_arm("ur20").dh.a2)
    assert get_robot("ur20").flange == "iso9409-1-80-6-m8"


def test_the_mounting_is_compared_with_the_scenarios() -> None:
    ceiling = np.array([0.0, 0.0, -1.0])
    hangs = mounting_finding({"target_gravity": (0.0, 0.1, -9.8)}, ceiling)
    assert hangs[0]
    stands = mounting_finding({"target_gravity": (0.0, 0.0, 9.82)}, ceiling)
    assert not stands[0]
    assert "up is (0.00, 0.00, 1.00) in the base, not (0.00, 0.00, -1.00)" in stands[1]
    assert "Installation > General > Mounting" in stands[2]
    unknown = mounting_finding({}, ceiling)
    assert unknown[0]
    assert "not readable" in unknown[1]
