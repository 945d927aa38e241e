"""`weldcal check-robot`: every reason not to start is found and named with what to press, and nothing is touched."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

from tests.hardware.emulator_process import Emulator, emulator_process
from tests.places import ROOT
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import SENTENCES, RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.readiness import preflight as module
from weldcal.systems.drivers.ur.readiness.kinematics_info import JointLimits, KinematicsInfo, read_kinematics
from weldcal.systems.drivers.ur.readiness.load import ExpectedLoad
from weldcal.systems.drivers.ur.readiness.preflight import CHECKS, Preflight, preflight, require_ready
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.drivers.ur.wire.line import ask, stop_program
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe, Value
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.controllers import emit_table
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.process import PORTS, free_address

NOMINAL = ROOT / "models/arms/ur10e/default_kinematics.yaml"
MOVING = "def foreign():\n  movej([0.5, -1.57, 1.57, -1.57, -1.57, 0], a=1, v=0.05)\nend\n"


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    """One controller for all, with a factory calibration of its own: the forearm 0.4 mm longer and tilted."""
    text = NOMINAL.read_text()
    forearm = "x: {}\n    y: 0.0\n    z: 0.0\n    roll: {}"
    text = text.replace(forearm.format("-0.6127", "0.0"), forearm.format("-0.6131", "3e-4"))
    path = tmp_path_factory.mktemp("robot") / "calibration.yaml"
    path.write_text(text.replace("kinematics:", "kinematics:\n  hash: calib_1", 1))
    with emulator_process(kinematics=path) as made:
        yield made


@pytest.fixture
def robot(shared: Emulator) -> Iterator[Emulator]:
    """The controller, ready for the job; whatever a test does to it is put right again."""
    yield shared
    shared.fault("stop_program", latch=False)
    shared.fault("speed_scaling", value=1.0, latch=False)
    shared.fault("robot_mode", value=7, latch=False)
    for deed in ("normal", "remote", "registers_free", "clear_links"):
        shared.do(deed)
    shared.do("set_tcp", pose=[0.0] * 6)
    shared.wait("runtime_state", "STOPPED")
    shared.do("set_q", q=list(HOME))


def weldcal(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs the command as an operator does."""
    command = [sys.executable, "-P", "-m", "weldcal.tools", "check-robot", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def states(report: Preflight) -> dict[str, str]:
    return {check.name: "ok" if check.ok else "to change" if check.checked else "?" for check in report.checks}


def test_a_ready_robot_is_ready_and_its_own_kinematics_are_read(robot: Emulator) -> None:
    report = preflight(robot.host)
    assert report.ok, report.checks
    assert report.first_problem is None
    assert tuple(check.name for check in report.checks) == CHECKS
    assert report.version is not None
    assert report.version[:2] == (5, 21)
    np.testing.assert_allclose(report.arm_q, HOME)
    np.testing.assert_allclose(report.tcp_pose, robot.state()["tcp_pose"], atol=1e-12)
    assert report.kinematics is not None
    assert report.kinematics.calibrated
    assert report.arm is not None
    # the robot's forearm is 0.4 mm longer than the nominal one; its own kinematics say so to the micrometre
    away = forward_kinematics(report.arm, HOME).translation() - forward_kinematics(load_arm(), HOME).translation()
    assert np.linalg.norm(away) > 3e-4
    assert report.pose_error_m is not None
    assert report.pose_error_m < 1e-6
    require_ready(report)


def test_looking_touches_nothing(robot: Emulator) -> None:
    names = [f"input_{kind}_register_{i}" for kind in ("int", "double") for i in range(48)]

    def everything() -> dict[str, Any]:
        with RtdeProbe(robot.host) as rtde:
            registers = rtde.read(names[:48]) | rtde.read(names[48:])
        state = robot.state()
        kept = ("q", "qd", "tcp_offset", "payload_mass", "program", "programs_started", "runtime_state", "speed_slider")
        return registers | {key: state[key] for key in (*kept, "robot_mode", "safety_mode", "remote", "watchdogs")}

    before = everything()
    said = robot.log()
    assert preflight(robot.host).ok
    assert everything() == before
    assert robot.log() == said
    # what was asked for is given back: another client gets all of it, and the first asking leaves no connection behind
    assert robot.ask(ask="connections")["connections"] == []
    with RtdeProbe(robot.host) as other:
        assert set(other.claim(names).values()) == {"INT32", "DOUBLE"}


FAULTS: list[tuple[str, dict[str, Any], str, str, str]] = [
    ("protective_stop", {}, "safety", "PROTECTIVE_STOP", "Enable Robot"),
    ("estop", {}, "safety", "ROBOT_EMERGENCY_STOP", "on the pendant"),
    ("estop", {"system": True}, "safety", "SYSTEM_EMERGENCY_STOP", "in the cell"),
    ("safeguard", {}, "safety", "SAFEGUARD_STOP", "safety gate"),
    ("safety_mode", {"value": 4}, "safety", "RECOVERY", "Move tab"),
    ("safety_mode", {"value": 8}, "safety", "VIOLATION", "Restart Safety"),
    ("robot_mode", {"value": 3}, "power", "POWER_OFF", "ON, then START"),
    ("robot_mode", {"value": 5}, "power", "IDLE", "START"),
    ("foreign_program", {}, "program", "PLAYING", "press Stop"),
    ("speed_scaling", {"value": 0.35}, "speed slider", "35 %", "drag the slider"),
    ("wrong_tcp", {}, "TCP", "(0.0, 0.0, 100.0) mm", "Installation > General > TCP"),
    ("registers_in_use", {"names": ["input_double_register_30"]}, "registers", "double 30 in use", "EtherNet/IP"),
    (
        "set_q",
        {"q": [0, -1.5, 3.1, -1.5, -1.5, 0]},
        "joint limits",
        "elbow 2 deg away; the pendant's may be nearer",
        "elbow joint",
    ),
    ("local_mode", {}, "remote control", "local control", "Remote Control"),
]


@pytest.mark.parametrize(
    ("fault", "values", "check", "found", "press"), FAULTS, ids=lambda value: value if isinstance(value, str) else None
)
def test_each_fault_is_named_with_what_to_press(
    robot: Emulator, fault: str, values: dict[str, Any], check: str, found: str, press: str
) -> None:
    robot.fault(fault, **values)
    report = preflight(robot.host)
    problem = report.first_problem
    assert problem is not None
    assert problem.name == check
    assert found in problem.found
    assert press in problem.operator_action
    assert problem.operator_action.endswith((".", ")."))
    assert ". " not in problem.operator_action, "one sentence"
    with pytest.raises(RobotRefused) as refused:
        require_ready(report)
    assert str(refused.value) == problem.operator_action


TORCH = UrRtde(host="127.0.0.1").load("the welding tool")


@pytest.mark.parametrize(
    ("mass", "cog", "ok"),
    [
        (1.4, [0.03, 0.0, 0.05], True),
        (1.44, [0.033, 0.004, 0.046], True),  # as well as a tool is weighed
        (1.5, [0.03, 0.0, 0.05], False),
        (0.0, [0.0, 0.0, 0.0], False),
        (1.4, [0.03, 0.0, 0.06], False),
    ],
)
def test_the_payload_is_compared_with_the_jobs(robot: Emulator, mass: float, cog: list[float], ok: bool) -> None:
    robot.do("set_payload", mass=mass, cog=cog)
    try:
        report = preflight(robot.host, load=TORCH)
        shown = preflight(robot.host)
    finally:
        robot.do("set_payload", mass=1.4, cog=[0.03, 0.0, 0.05])
    assert report.ok == ok, report.checks
    assert shown.ok
    assert shown.checks[CHECKS.index("payload")].found.endswith("(not compared)")
    found = report.checks[CHECKS.index("payload")]
    assert f"{mass:.2f} kg" in found.found
    if not ok:
        with pytest.raises(
            RobotRefused, match=r"of the welding tool: set 1\.40 kg at \(30, 0, 50\) mm under Installation"
        ):
            require_ready(report)


def test_a_bare_flange_has_no_centre_of_gravity(robot: Emulator) -> None:
    robot.do("set_payload", mass=0.0, cog=[0.0, 0.0, 0.07])
    try:
        assert preflight(robot.host, load=ExpectedLoad(0.0, (0.0, 0.0, 0.0), "nothing")).ok
        named = weldcal(robot.host, "--json", "--scenario", "calibrate_only")
        default = weldcal(robot.host, "--json")
    finally:
        robot.do("set_payload", mass=1.4, cog=[0.03, 0.0, 0.05])
    checks = {check["name"]: check for check in json.loads(named.stdout)["checks"]}
    # the last one is this computer's timing, which depends on what else it does
    assert [name for name in CHECKS if checks[name]["state"] != "ok"] == [], named.stderr
    assert checks["payload"]["found"] == "0.00 kg at (0, 0, 70) mm (scenario calibrate_only)"
    assert default.returncode == 1
    assert "The payload is not that of the welding tool" in default.stderr


def test_a_controller_without_its_payload_is_told_in_a_sentence(
    robot: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Without(RtdeProbe):
        def read(self, names: Sequence[str]) -> dict[str, Value]:
            return super().read([name for name in names if "payload" not in name])

    monkeypatch.setattr(module, "RtdeProbe", Without)
    problem = preflight(robot.host, load=TORCH).first_problem
    assert problem is not None
    assert (problem.name, problem.found) == ("payload", "not readable")
    assert "update PolyScope" in problem.operator_action


@pytest.mark.parametrize(("mode", "ok", "found"), [("manual", False, "Manual"), ("automatic", True, "Automatic")])
def test_a_robot_in_manual_mode_is_refused(robot: Emulator, mode: str, ok: bool, found: str) -> None:
    assert preflight(robot.host).checks[CHECKS.index("operational mode")].found == "no operational mode is set up"
    assert ask(robot.host, f"set operational mode {mode}") == f"Operational mode {mode.upper()} is set"
    try:
        report = preflight(robot.host)
    finally:
        ask(robot.host, "clear operational mode")
    check = report.checks[CHECKS.index("operational mode")]
    assert (check.ok, check.found) == (ok, found)
    assert report.ok == ok
    assert ok or "three-position enabling device" in check.operator_action


def test_reduced_mode_is_a_remark(robot: Emulator) -> None:
    robot.fault("reduced")
    report = preflight(robot.host)
    assert report.ok
    assert "limits speed" in report.checks[CHECKS.index("safety")].found


def test_a_paused_program_is_a_program(robot: Emulator) -> None:
    robot.fault("foreign_program")
    robot.fault("pause_program")
    robot.wait("runtime_state", "PAUSED")
    problem = preflight(robot.host).first_problem
    assert problem is not None
    assert (problem.name, problem.found) == ("program", "PAUSED foreign")
    assert "the program foreign (PAUSED)" in problem.operator_action
    assert stop_program(robot.host) == "Stopped"
    robot.wait("runtime_state", "STOPPED")
    assert preflight(robot.host).ok


def test_an_arm_that_moves_is_seen_beside_the_program_that_moves_it(robot: Emulator) -> None:
    robot.fault("foreign_program", script=MOVING)
    time.sleep(0.2)
    found = states(preflight(robot.host))
    assert [name for name, state in found.items() if state != "ok"] == ["program", "standstill"]


def test_registers_of_the_lower_range_are_asked_for_where_the_driver_uses_them(robot: Emulator) -> None:
    robot.fault("registers_in_use", names=["input_int_register_0", "input_int_register_1", "input_double_register_3"])
    assert preflight(robot.host).ok
    problem = preflight(robot.host, upper_registers=False).first_problem
    assert problem is not None
    assert problem.found == "int 0, double 3 in use"


def test_registers_of_the_set_points_are_asked_for_where_they_are_wired(robot: Emulator) -> None:
    robot.fault("registers_in_use", names=["input_double_register_33"])
    assert preflight(robot.host).ok
    problem = preflight(robot.host, set_points=True).first_problem
    assert problem is not None
    assert problem.found == "double 33 in use"


def test_a_command_that_an_earlier_client_left_behind_is_told_and_left_alone(robot: Emulator) -> None:
    def write(value: int) -> None:
        with socket.create_connection((robot.host, 30004)) as client:
            for kind, payload in (
                (b"V", b"\0\2"),
                (b"I", b"input_int_register_24"),
                (b"U", struct.pack(">Bi", 1, value)),
            ):
                client.sendall(struct.pack(">H", len(payload) + 3) + kind + payload)
            client.shutdown(socket.SHUT_WR)
            while client.recv(1024):
                pass

    write(10)
    try:
        report = preflight(robot.host)
        assert report.ok
        assert "command 10 is left over" in report.checks[CHECKS.index("registers")].found
        with RtdeProbe(robot.host) as rtde:
            assert rtde.read(["input_int_register_24"]) == {"input_int_register_24": 10}
    finally:
        write(0)


def test_what_could_not_be_checked_is_not_called_ok(robot: Emulator) -> None:
    robot.fault("robot_mode", value=3)
    report = preflight(robot.host)
    left = [check for check in report.checks if not check.checked]
    assert [check.name for check in left] == ["standstill", "joint limits", "kinematics", "flange pose"]
    assert {check.found for check in left} == {"needs power"}
    assert not any(check.ok or check.operator_action for check in left)
    assert report.pose_error_m is None


def test_several_faults_come_in_the_order_in_which_they_are_mended(robot: Emulator) -> None:
    for fault, values in (("local_mode", {}), ("speed_scaling", {"value": 0.5}), ("estop", {}), ("wrong_tcp", {})):
        robot.fault(fault, **values)
    wrong = [name for name, state in states(preflight(robot.host)).items() if state == "to change"]
    assert wrong == ["safety", "power", "TCP", "speed slider", "remote control"]


def test_kinematics_that_are_not_the_controllers_are_refused(robot: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    def of_another_ur10e(host: str, timeout_s: float) -> tuple[KinematicsInfo, JointLimits | None]:
        info, limits = read_kinematics(host, timeout_s)
        return dataclasses.replace(info, a=info.a + np.array([0, 0, 6e-5, 0, 0, 0])), limits

    monkeypatch.setattr(module, "read_kinematics", of_another_ur10e)
    problem = preflight(robot.host).first_problem
    assert problem is not None
    assert problem.name == "flange pose"
    assert problem.found.startswith("0.060 mm")


def test_an_old_or_another_controller_is_refused(robot: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    for version in ((3, 15, 0, 0), (5, 11, 9, 0), (6, 0, 0, 0), (11, 0, 0, 0)):
        monkeypatch.setattr(module, "RtdeProbe", lambda host, timeout_s, version=version: Old(host, timeout_s, version))
        report = preflight(robot.host)
        assert report.first_problem is not None
        assert report.first_problem.name == "version"
        assert set(states(report).values()) == {"ok", "to change", "?"}
        assert "PolyScope 5.12" in report.first_problem.operator_action


def test_a_controller_of_protocol_1_is_told_to_update() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def refuse() -> None:
            visitor, _ = server.accept()
            with visitor:
                visitor.recv(16)
                visitor.sendall(bytes.fromhex("00045600"))

        thread = threading.Thread(target=refuse, daemon=True)
        thread.start()
        with pytest.raises(RobotUnreachable, match=r"version 1 of RTDE only: update PolyScope to 5\.12"):
            RtdeProbe("127.0.0.1", 2.0, server.getsockname()[1])
        thread.join(5.0)


def test_a_missing_output_of_a_new_polyscope_asks_for_no_update(
    robot: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = RtdeProbe.read

    def without(self: RtdeProbe, names: Sequence[str]) -> dict[str, Any]:
        return {name: value for name, value in whole(self, names).items() if name != "target_speed_fraction"}

    monkeypatch.setattr(RtdeProbe, "read", without)
    problem = preflight(robot.host).first_problem
    assert problem is not None
    assert problem.name == "version"
    assert "lacks target_speed_fraction" in problem.found
    assert "install" not in problem.operator_action
    assert "restart the control box" in problem.operator_action


class Old(RtdeProbe):
    """A probe that hears of another version."""

    def __init__(self, host: str, timeout_s: float, version: tuple[int, int, int, int]) -> None:
        super().__init__(host, timeout_s)
        self.version = version


def test_a_line_that_delivers_a_few_bytes_at_a_time_is_good_enough(robot: Emulator) -> None:
    with RtdeProbe(robot.host) as rtde:
        robot.fault("partial_writes", kind="rtde", bytes=5, latch=False)
        values = rtde.read(["timestamp", "no_such_output", "actual_q", "robot_mode"])
    assert list(values) == ["timestamp", "actual_q", "robot_mode"]
    assert values["actual_q"] == pytest.approx(HOME)
    assert values["robot_mode"] == 7


def test_names_that_the_controller_lacks_are_told_apart_from_those_in_use(robot: Emulator) -> None:
    robot.fault("registers_in_use", names=["input_int_register_30"])
    with RtdeProbe(robot.host) as rtde:
        assert rtde.claim(["input_int_register_30", "input_int_register_99", "input_int_register_31"]) == {
            "input_int_register_30": "IN_USE",
            "input_int_register_99": "NOT_FOUND",
            "input_int_register_31": "INT32",
        }
        assert rtde.read(["no_such_output"]) == {}


def test_a_controller_that_stands_still_is_left_in_time(robot: Emulator) -> None:
    robot.fault("freeze", seconds=4.0, latch=False)
    start = time.monotonic()
    problem = preflight(robot.host, timeout_s=0.3).first_problem
    assert time.monotonic() - start < 3.9
    assert problem is not None
    assert "sends no data" in problem.operator_action
    time.sleep(max(0.0, start + 4.05 - time.monotonic()))  # until it goes on


def test_a_dashboard_that_refuses_in_local_control_is_understood(
    robot: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the words of e-Series controllers, as users quote them
    words = "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and reconnect"
    monkeypatch.setattr(module, "asker", lambda _: lambda *_: words)
    found = preflight(robot.host)
    assert [name for name, state in states(found).items() if state != "ok"] == ["remote control"]
    assert "Local icon" in found.checks[-1].operator_action


def test_a_dashboard_that_talks_nonsense_is_quoted(robot: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "asker", lambda _: lambda *_: "could not understand: 'this'")
    found = [check for check in preflight(robot.host).checks if not check.ok]
    assert [check.name for check in found] == ["program", "remote control"]
    mode = preflight(robot.host).checks[CHECKS.index("operational mode")]
    assert (mode.ok, mode.found) == (True, "not readable; look at the pendant")
    assert all("could not understand: 'this'" in check.found for check in found)


def test_without_a_dashboard_the_service_to_enable_is_named(robot: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        module, "asker", lambda _: lambda host, command, timeout_s: ask(host, command, timeout_s, port=29998)
    )
    report = preflight(robot.host)
    assert report.first_problem is not None
    assert report.first_problem.name == "program"
    assert (
        "enable Dashboard Server on the pendant under Settings > Security > Services"
        in report.first_problem.operator_action
    )
    assert (report.checks[-1].checked, report.checks[-1].found) == (False, "needs program")


def test_the_dashboard_answers_one_question_a_connection(robot: Emulator) -> None:
    assert ask(robot.host, "robotmode") == "Robotmode: RUNNING"
    assert robot.ask(ask="connections")["connections"] == []


# hosts that are no robot


@pytest.fixture
def mute() -> Iterator[str]:
    """A host that accepts and sends no data."""
    stop = threading.Event()
    with free_address(PORTS) as host, socket.create_server((host, 30004)) as server:
        server.settimeout(0.05)
        visitors = []

        def serve() -> None:
            while not stop.is_set():
                try:
                    visitors.append(server.accept()[0])
                except TimeoutError:
                    continue

        thread = threading.Thread(target=serve)
        thread.start()
        yield host
        stop.set()
        thread.join()
        for visitor in visitors:
            visitor.close()


@pytest.fixture
def nobody() -> Iterator[str]:
    """An address of this machine at which nothing listens."""
    with free_address(PORTS) as host:
        yield host


def refused(host: str, **limits: float) -> str:
    """The sentence about a host that is no robot, which must come before long."""
    start = time.monotonic()
    report = preflight(host, **limits)
    assert time.monotonic() - start < 10.0
    assert states(report) == dict.fromkeys(CHECKS, "?") | {"answer": "to change"}
    assert report.first_problem is not None
    with pytest.raises(RobotUnreachable):
        require_ready(report)
    return report.first_problem.operator_action


def test_a_host_that_says_nothing(mute: str) -> None:
    assert "accepts a connection on its RTDE port 30004 but sends no data" in refused(mute)


def test_an_address_where_nothing_listens(nobody: str) -> None:
    assert f"{nobody} is there but its RTDE port 30004 is closed" in refused(nobody)


def test_an_address_that_leads_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    # what a network does with a packet to nowhere differs from machine to machine: here it is lost
    def lost(address: object, timeout: float) -> socket.socket:
        raise TimeoutError("timed out")

    monkeypatch.setattr(socket, "create_connection", lost)
    assert "No answer from 192.0.2.1: switch the control box on, check the network cable" in refused("192.0.2.1")


def test_a_name_that_does_not_resolve() -> None:
    assert "There is no host named 'no-such-robot.invalid'" in refused("no-such-robot.invalid")


def test_a_look_up_that_hangs_is_left_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    over = threading.Event()

    def hang(*_: object) -> list[object]:
        over.wait(30.0)
        return []

    monkeypatch.setattr(socket, "getaddrinfo", hang)
    try:
        assert "There is no host named 'robot'" in refused("robot", timeout_s=0.3)
    finally:
        over.set()


def test_an_empty_name_is_a_mistake() -> None:
    with pytest.raises(InputError, match="Give the robot's host name"):
        preflight(" ")


def test_polyscope_x_is_checked_without_a_dashboard() -> None:
    with emulator_process(polyscope="10.12") as new:
        report = preflight(new.host)
        assert report.ok, report.checks
        assert report.version is not None
        assert report.version[0] == 10
        assert report.checks[CHECKS.index("remote control")].found == "on"
        new.fault("foreign_program")
        problem = preflight(new.host).first_problem
        assert problem is not None
        assert problem.found == "PLAYING"


# the command


def test_the_command_prints_a_table_that_fits_a_terminal(robot: Emulator, capsys: pytest.CaptureFixture[str]) -> None:
    finished = weldcal(robot.host)
    assert finished.returncode == 0, finished.stderr
    lines = finished.stdout.splitlines()
    assert lines[0] == f"{robot.host}: ready"
    assert [line.split()[0] for line in lines[1:]] == ["ok"] * (len(CHECKS) + 2)
    assert finished.stderr == ""
    for fault, values in (
        ("local_mode", {}),
        ("estop", {}),
        ("registers_in_use", {"names": ["input_int_register_24"]}),
    ):
        robot.fault(fault, **values)
    emit_table(preflight(robot.host))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{robot.host}: not ready, 4 to change"
    assert max(map(len, lines)) <= 80
    assert sum(line.startswith("  to change ") for line in lines) == 4
    assert sum(line.startswith("  not checked ") for line in lines) == 4


def test_the_command_ends_with_1_and_the_first_sentence(robot: Emulator) -> None:
    robot.fault("local_mode")
    finished = weldcal(robot.host, "--json")
    assert finished.returncode == 1
    assert finished.stderr.startswith("weldcal: The robot is in local control: ")
    assert len(finished.stderr.splitlines()) == 1
    result = json.loads(finished.stdout)
    assert result["state"] == "refused"
    assert result["reason"] == finished.stderr.removeprefix("weldcal: ").strip()
    assert [check["name"] for check in result["checks"]] == [*CHECKS, "computer"]
    assert {check["state"] for check in result["checks"]} == {"ok", "to change"}
    assert result["version"] == "5.21.1.0"
    assert result["joints_deg"] == pytest.approx(np.rad2deg(HOME).tolist())
    assert result["kinematics"] == "calibrated"
    assert result["pose_error_mm"] < 1e-3
    assert result["pose_error_deg"] < 1e-4


def test_the_command_needs_no_project_and_no_robot(nobody: str) -> None:
    finished = weldcal(nobody)
    assert finished.returncode == 1
    assert "port 30004 is closed" in finished.stderr
    assert "Traceback" not in finished.stderr
    assert finished.stdout.splitlines()[-1] == f"  not checked  {len(CHECKS) - 1} more that need an answer"


def test_every_command_of_the_document_exists() -> None:
    text = (ROOT / "docs/hardware.md").read_text()
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.S) for line in block.splitlines()]
    assert len(lines) > 12
    for line in lines:
        program, *words = shlex.split(line)
        assert program == "weldcal"
        command: Any = get_command(app)
        while hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        command.make_context(line, list(words))  # unknown options and missing arguments end it
        for k, word in enumerate(words):
            if word == "--scenario":
                load_scenario(words[k + 1])


def test_the_document_names_every_check_and_every_fault() -> None:
    text = (ROOT / "docs/hardware.md").read_text()
    assert [name for name in CHECKS if f"\n| {name} |" not in text] == []
    heads = {sentence.partition(":")[0] for sentence in SENTENCES.values() if sentence.partition(":")[0].isupper()}
    assert len(heads) > 10
    assert [head for head in heads if f"\n| {head}" not in text] == []
