"""PolyScope X from 10.12 on is read by its Robot API; older controllers are read, word for word, as before it."""

from __future__ import annotations

import http.client
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.hardware.emulator_process import Emulator, emulator_process
from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur import link as link_module
from weldcal.systems.drivers.ur.faults import SENTENCES, Fault, RobotUnreachable
from weldcal.systems.drivers.ur.link import LinkState, UrLink
from weldcal.systems.drivers.ur.readiness import operator_actions
from weldcal.systems.drivers.ur.readiness.preflight import CHECKS, Preflight, preflight
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.drivers.ur.wire import robot_api
from weldcal.systems.drivers.ur.wire.line import ask, stop_program
from weldcal.systems.drivers.ur.wire.robot_api import RobotApiFailed, ask_robot_api, asker
from weldcal.tools.emulators.ur.main import HOME

# what the code before the Robot API printed, with the states in which the emulator was
BEFORE = json.loads((Path(__file__).parent / "preflight_before_robot_api.json").read_text())
MENUS_OF_5 = ("Installation >", "Initialize", "Local icon", "Fieldbus", "Move tab", "Log tab", "Enable Robot", "slider")
X = (10, 12, 0, 0)


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulator]:
    with emulator_process(polyscope="10.12") as made:
        yield made


@pytest.fixture
def robot(shared: Emulator) -> Iterator[Emulator]:
    """A PolyScope X 10.12 that is ready; whatever a test does to it is put right again."""
    yield shared
    shared.do("recover")
    shared.do("registers_free")
    shared.wait("runtime_state", "STOPPED")
    shared.do("set_q", q=list(HOME))


def rows(report: Preflight) -> list[list[Any]]:
    return [[c.name, c.ok, c.found, c.operator_action, c.checked] for c in report.checks]


def test_a_ready_polyscope_x_is_read_whole(robot: Emulator) -> None:
    report = preflight(robot.host)
    assert report.ok, report.checks
    found = {check.name: check.found for check in report.checks}
    assert tuple(found) == CHECKS
    assert not [text for text in found.values() if "not readable" in text]
    assert (found["operational mode"], found["remote control"]) == ("Automatic", "on")


CONDITIONS: list[tuple[str, dict[str, Any], str, str, str]] = [
    ("protective_stop", {}, "safety", "PROTECTIVE_STOP", "unlock it in the message on the pendant"),
    ("estop", {}, "safety", "ROBOT_EMERGENCY_STOP", "tap Robot State at the lower left"),
    ("estop", {"system": True}, "safety", "SYSTEM_EMERGENCY_STOP", "tap Robot State at the lower left"),
    ("safeguard", {}, "safety", "SAFEGUARD_STOP", "safety gate"),
    ("safety_mode", {"value": 4}, "safety", "RECOVERY", "the Move panel"),
    ("safety_mode", {"value": 8}, "safety", "VIOLATION", "restart the safety system there"),
    ("robot_mode", {"value": 1}, "power", "CONFIRM_SAFETY", "pop-up on the pendant"),
    ("robot_mode", {"value": 2}, "power", "BOOTING", "tap Robot State at the lower left"),
    ("robot_mode", {"value": 3}, "power", "POWER_OFF", "tap Robot State at the lower left"),
    ("robot_mode", {"value": 5}, "power", "IDLE", "tap Robot State at the lower left of the pendant and release them"),
    ("robot_mode", {"value": 6}, "power", "BACKDRIVE", "the Robot State panel"),
    ("foreign_program", {}, "program", "PLAYING", "press Stop at the bottom"),
    ("speed_scaling", {"value": 0.35}, "speed slider", "35 %", "press + beside Speed at the lower right"),
    ("wrong_tcp", {}, "TCP", "(0.0, 0.0, 100.0) mm", "Application > End Effector"),
    ("registers_in_use", {"names": ["input_double_register_30"]}, "registers", "in use", "Security > Services"),
    ("set_q", {"q": [0, -1.5, 3.1, -1.5, -1.5, 0]}, "joint limits", "elbow 2 deg", "the Move panel"),
    ("local_mode", {}, "remote control", "local control", "Mode Selection > Automatic > Remote"),
]


@pytest.mark.parametrize(
    ("fault", "values", "check", "found", "press"), CONDITIONS, ids=lambda v: v if isinstance(v, str) else None
)
def test_each_condition_is_named_with_the_menu_of_polyscope_x(
    robot: Emulator, fault: str, values: dict[str, Any], check: str, found: str, press: str
) -> None:
    robot.fault(fault, **values)
    report = preflight(robot.host)
    problem = report.first_problem
    assert problem is not None
    assert (problem.name, found in problem.found) == (check, True), problem
    assert press in problem.operator_action
    assert ". " not in problem.operator_action, "one sentence"
    for row in report.checks:
        assert "not readable" not in row.found
        assert not [menu for menu in MENUS_OF_5 if menu in row.operator_action], row


def test_manual_mode_and_another_payload_are_named_with_their_menus() -> None:
    with emulator_process(polyscope="10.12", operational_mode="manual") as manual:
        problem = preflight(manual.host).first_problem
    assert problem is not None
    assert (problem.name, problem.found) == ("operational mode", "Manual")
    assert (
        "safety overview at the upper right of the pendant, then Mode Selection > Automatic" in problem.operator_action
    )
    for text in (operator_actions.payload("x", "1 kg"), operator_actions.mounting("up"), operator_actions.POSE):
        assert "Application > " in operator_actions.as_on_x(text)


def test_no_action_and_no_fault_keeps_a_menu_of_polyscope_5() -> None:
    texts = [v for k, v in vars(operator_actions).items() if k.isupper() and isinstance(v, str) and k[0] != "_"]
    texts += [operator_actions.power(mode) for mode in operator_actions.ROBOT_MODES]
    texts += [operator_actions.safety(mode) for mode in operator_actions.SAFETY_MODES]
    texts += [operator_actions.program("PAUSED", "x"), operator_actions.limits("elbow")]
    for text in [*texts, *SENTENCES.values()]:
        assert not [menu for menu in MENUS_OF_5 if menu in operator_actions.as_on_x(text)], text
    # each entry is in use: none is left over from a sentence that has changed
    everything = "".join(
        [*texts, *SENTENCES.values(), operator_actions.payload("x", ""), operator_actions.mounting("")]
    )
    for five, _ in operator_actions.X_MENUS:
        assert five in everything, five


def test_the_link_to_polyscope_x_names_its_menus_and_stops_by_its_robot_api(
    robot: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped: list[Any] = []
    monkeypatch.setattr(link_module, "stop_program", lambda host, asks: stopped.append(asks))
    arm = load_arm()
    link = UrLink.start(robot.host, arm, UrRtde(host=robot.host).limits(arm), version=X)
    try:
        robot.fault("protective_stop")
        until = time.monotonic() + 10.0
        while link.state().fault is Fault.NONE and time.monotonic() < until:
            link.rest()
            time.sleep(0.01)
        fault = link.state().status.fault
    finally:
        link.close()
    assert fault is not None
    assert fault.startswith("PROTECTIVE STOP: ")
    assert "unlock it on the pendant after 5 s" in fault
    assert stopped
    assert set(stopped) == {ask_robot_api}


def test_a_fault_of_the_link_names_the_menus_of_polyscope_x() -> None:
    state = {"robot_mode": 7, "safety_mode": 3, "runtime_state": 4, "speed_scaling": 1.0, "arc": -1}
    five, ten = (
        LinkState(fault=Fault.POSE_MISMATCH, on_x=on_x, q=None, qd=None, **state).status.fault for on_x in (False, True)
    )  # type: ignore[arg-type]
    assert five is not None
    assert ten is not None
    assert "Installation > General > TCP" in five
    assert "Application > End Effector" in ten


@pytest.mark.parametrize("version", sorted({entry["version"] for entry in BEFORE}))
def test_older_controllers_are_read_as_before_to_the_word(version: str) -> None:
    with emulator_process(polyscope=version) as old:
        for entry in (entry for entry in BEFORE if entry["version"] == version):
            if entry["fault"]:
                old.fault(entry["fault"], latch=False, **entry["values"])
            assert rows(preflight(old.host)) == entry["rows"], entry["fault"]
            old.do("recover")
            old.wait("runtime_state", "STOPPED")


def test_polyscope_x_before_10_12_says_which_version_brings_the_modes() -> None:
    with emulator_process(polyscope="10.11") as older:
        report = preflight(older.host)
    assert report.ok, report.checks
    for name in ("operational mode", "remote control"):
        assert report.checks[CHECKS.index(name)].found.startswith("not readable before PolyScope X 10.12; ")


FAULTS = {
    "refused": "is closed: wait until PolyScope X has started",
    "slow": "does not answer in time",
    "cut": "hangs up or answers no HTTP",
    "no_json": "answers no JSON",
    "wrong_type": "names '7' as state",
    "missing": "(404): install PolyScope X 10.12 or newer",
    "error": "answers with the error 500",
    "old": "states version 3.0.0, older than the 3.1.4 of PolyScope X 10.12 that RTDE states",
    "redirect": "sends from one path to another without an end",
    "elsewhere": "sends to another address, 'http://192.0.2.1/",
    "empty": "answers nothing",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_of_the_robot_api_is_one_sentence_at_once_and_moves_nothing(robot: Emulator, fault: str) -> None:
    before, said = robot.state(), robot.log()
    robot.fault("robot_api", what=fault, latch=False)
    begun = time.monotonic()
    problem = preflight(robot.host).first_problem
    assert time.monotonic() - begun < 2.0
    assert problem is not None
    assert problem.found == "STOPPED; the Robot API does not answer"
    assert FAULTS[fault] in problem.operator_action
    assert ". " not in problem.operator_action
    assert problem.operator_action.endswith(".")
    after = robot.state()
    assert {key: after[key] for key in ("q", "program", "programs_started")} == {
        key: before[key] for key in ("q", "program", "programs_started")
    }
    assert robot.log() == said
    robot.do("clear_links")
    assert preflight(robot.host).ok


def test_the_port_of_the_robot_api_is_80_but_for_an_emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int]] = []

    def refuse(host: str, port: int, _: float) -> tuple[str, int]:
        asked.append((host, port))
        raise RobotUnreachable("nobody")

    monkeypatch.setattr(robot_api, "resolve", refuse)
    for host in ("192.0.2.7", "127.0.0.9"):
        with pytest.raises(RobotUnreachable, match="nobody"):
            ask_robot_api(host, "robotmode")
    assert asked == [("192.0.2.7", 80), ("127.0.0.9", 30080)]


def test_the_version_chooses_whom_to_ask() -> None:
    assert [asker(v) for v in ((5, 9), (5, 25), (10, 7), (10, 11, 9), (10, 12), (10, 13, 1), (11, 0))] == (
        [ask, ask, None, None, ask_robot_api, ask_robot_api, ask_robot_api]
    )


def test_the_robot_api_answers_in_the_words_of_the_dashboard(robot: Emulator) -> None:
    with emulator_process(polyscope="5.21", operational_mode="automatic") as five:
        for fault, values in ((None, {}), ("local_mode", {}), ("robot_mode", {"value": 3}), ("protective_stop", {})):
            for one in (five, robot):
                if fault is not None:
                    one.fault(fault, **values)
            for command in robot_api.READS:
                told = ask(five.host, command)
                told = told.partition(" ")[0] if command == "programState" else told  # X names no program
                assert ask_robot_api(robot.host, command) == told, (fault, command)


def test_the_arm_is_powered_and_a_program_ends_only_in_remote_control(robot: Emulator) -> None:
    robot.fault("robot_mode", value=3)
    robot.fault("local_mode")
    for command in robot_api.ACTIONS:
        assert "remote control mode" in ask_robot_api(robot.host, command)
    assert robot.state()["robot_mode"] == "POWER_OFF"
    robot.do("remote")
    assert ask_robot_api(robot.host, "power on") == "Powering on"
    assert robot.state()["robot_mode"] == "IDLE"
    assert ask_robot_api(robot.host, "brake release") == "Brake releasing"
    assert robot.state()["robot_mode"] == "RUNNING"


@pytest.mark.parametrize("fault", ["", "error"])
def test_a_paused_program_is_stopped_through_the_robot_api_or_beside_it(robot: Emulator, fault: str) -> None:
    robot.fault("foreign_program", latch=False)
    robot.fault("pause_program", latch=False)
    robot.wait("runtime_state", "PAUSED")
    robot.fault("robot_api", what=fault, latch=False)
    asks = asker(X)
    assert asks is not None
    assert stop_program(robot.host, asks=asks) == ("" if fault else "Stopped")
    robot.wait("runtime_state", "STOPPED")


def test_a_path_that_has_moved_is_followed_on_the_same_controller(
    robot: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, key, answers = robot_api.READS["robotmode"]
    monkeypatch.setitem(robot_api.READS, "robotmode", (f"{path}/", key, answers))
    assert ask_robot_api(robot.host, "robotmode") == "Robotmode: RUNNING"


def test_an_unknown_mode_is_never_taken_for_remote_control(robot: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    path, key, _ = robot_api.READS["is in remote control"]
    monkeypatch.setitem(robot_api.READS, "is in remote control", (path, key, {"LOCAL": "false"}))
    with pytest.raises(RobotApiFailed, match="names 'REMOTE' as mode"):
        ask_robot_api(robot.host, "is in remote control")


def test_the_emulator_answers_a_wrong_request_and_goes_on(robot: Emulator) -> None:
    for method, path, body in (("DELETE", "/x", b""), ("PUT", "/program/v1/state", b"[1"), ("BREW", "/x", b"")):
        line = http.client.HTTPConnection(robot.host, robot_api.LOOPBACK_PORT, timeout=5.0)
        line.request(method, robot_api.BASE + path, body)
        assert 400 <= line.getresponse().status < 600
        line.close()
    assert ask_robot_api(robot.host, "robotmode") == "Robotmode: RUNNING"
