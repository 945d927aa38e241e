"""What the emulator tells clients of the primary port, the dashboard and RTDE, byte for byte and in process."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import SafetyMode
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.versions import parse_version
from weldcal.tools.emulators.ur.wire.dashboard import DashboardServer
from weldcal.tools.emulators.ur.wire.rtde_fields import outputs
from weldcal.tools.emulators.ur.wire.rtde_server import RtdeServer
from weldcal.tools.emulators.ur.wire.script_ports import PrimaryServer

TEXT, POPUP, SAFETY_MODE, ERROR_CODE, KEY, RUNTIME_EXCEPTION = 0, 2, 5, 6, 7, 10
HEADER = 5 + 10  # size and type of the package; time stamp, source and type of the message


class Wire:
    """A connection that keeps what is sent on it."""

    def __init__(self) -> None:
        self.packages: list[bytes] = []
        self.inbox = bytearray()

    def send(self, package: bytes, now: float, *, droppable: bool = False) -> None:
        self.packages.append(package)


def controller() -> Controller:
    return Controller(load_arm(), np.array(HOME), parse_version("5.21"))


def told(made: Controller, script: str, frames: int = 5) -> list[tuple[int, bytes]]:
    """Type and body of every message on the primary port while a script runs."""
    wire = Wire()
    server = PrimaryServer(made, lambda _: None, primary=True)
    server.opened(wire, 0.0)  # type: ignore[arg-type]
    wire.packages.clear()
    made.events.clear()
    made.submit(script)
    for _ in range(frames):
        made.step()
    while made.events:
        server.announce(made.events.popleft(), 0.0)
    stream = b"".join(wire.packages)
    found = []
    while stream:
        (size,) = struct.unpack_from(">i", stream)
        if stream[4] == 20:
            found.append((stream[14], stream[HEADER:size]))
        stream = stream[size:]
    return found


def key(title: bytes, text: bytes) -> tuple[int, bytes]:
    return KEY, struct.pack(">iiB", 0, 0, len(title)) + title + text


def test_a_program_is_announced_and_what_it_says_comes_between() -> None:
    assert told(controller(), 'def talk():\n  textmsg("at ", 0.5)\nend\n') == [
        key(b"PROGRAM_XXX_STARTED", b"talk"),
        (TEXT, b"at 0.5"),
        key(b"PROGRAM_XXX_STOPPED", b"talk"),
    ]


def test_an_unknown_name_is_refused_with_its_line_and_column() -> None:
    assert told(controller(), "def bad():\n  x = 1\n  if x == 1:\n    y = nothing_like_it(1)\n  end\nend\n") == [
        (RUNTIME_EXCEPTION, struct.pack(">ii", 4, 9) + b"compile_error_name_not_found:nothing_like_it:")
    ]


def test_a_protective_stop_is_report_209_and_a_safety_mode_before_the_program_ends() -> None:
    assert told(controller(), "def stop():\n  protective_stop()\nend\n")[1:] == [
        (ERROR_CODE, struct.pack(">3i2I", 209, 0, 2, 0, 0) + b"a protective stop was triggered"),
        (SAFETY_MODE, struct.pack(">2iB2I", 0, 0, SafetyMode.PROTECTIVE_STOP, 0, 0)),
        key(b"PROGRAM_XXX_STOPPED", b"stop"),
    ]


def test_a_popup_carries_its_flags_and_its_title() -> None:
    found = told(controller(), 'def show():\n  popup("text", title="Title", error=True)\nend\n')
    assert (POPUP, struct.pack(">IB3?B", 0, 0, False, True, False, 5) + b"Titletext") in found


def test_a_script_in_local_mode_is_answered_with_report_210() -> None:
    made = controller()
    made.remote = False
    ((kind, body),) = told(made, "def go():\n  sync()\nend\n")
    assert (kind, struct.unpack_from(">3i", body)) == (ERROR_CODE, (210, 0, 3))


def test_the_state_says_safety_mode_outputs_and_robot_type() -> None:
    made = controller()
    made.set_safety_mode(SafetyMode.REDUCED)
    made.terminals.set_digital(0, 0b10, 0b10)
    made.operational_mode = "MANUAL"
    wire = Wire()
    PrimaryServer(made, lambda _: None, primary=False).opened(wire, 0.0)  # type: ignore[arg-type]
    parts, rest = {}, wire.packages[1][5:]
    while rest:
        size, kind = struct.unpack_from(">IB", rest)
        parts[kind], rest = rest[5:size], rest[size:]
    board = parts[3]
    assert struct.unpack_from(">2I", board) == (0, 2)
    # four bytes of ranges and domains, four analog values and four floats come before the safety mode
    assert board[8 + 4 + 32 + 16 :] == bytes([SafetyMode.REDUCED, True, 0, 0, 0, 0, 0, 1, 0, 0])
    assert struct.unpack(">4i", parts[6][-16:])[2] == 2


def test_the_word_on_the_primary_port_unlocks_a_stop_that_is_young() -> None:
    made = controller()
    made.protective_stop("a test")
    dashboard = DashboardServer(made)
    assert dashboard.answer("unlock protective stop").startswith("Cannot unlock")
    made.submit("set unlock protective stop\n")
    assert made.safety_mode == SafetyMode.NORMAL


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("load installation default.installation", "Loading installation: default.installation"),
        ("load installation missing.installation", "File not found: missing.installation"),
        ("generate flight report system", "Flight Report generated with id: 1"),
        ("generate support file .", "Completed successfully: ursupport_20235500001_1.zip"),
        ("generate anything", "could not understand: 'generate anything'"),
        ("set operational mode automatic", "Operational mode AUTOMATIC is set"),
        ("set operational mode sideways", "Failed setting operational mode: sideways"),
        ("set anything", "could not understand: 'set anything'"),
        ("load /other/a.urp", "Loading program: /other/a.urp, default.installation"),
    ],
)
def test_the_dashboard_answers(command: str, reply: str) -> None:
    assert DashboardServer(controller()).answer(command) == reply


def test_the_operational_mode_is_kept_until_it_is_cleared() -> None:
    dashboard = DashboardServer(controller())
    dashboard.answer("set operational mode manual")
    assert dashboard.answer("get operational mode") == "MANUAL"
    dashboard.answer("clear operational mode")
    assert dashboard.answer("get operational mode") == "NONE"


def test_a_recipe_may_be_as_long_as_a_package() -> None:
    made, wire = controller(), Wire()
    server = RtdeServer(made, lambda names, now: None)
    server.opened(wire, 0.0)  # type: ignore[arg-type]
    names = [name for name, field in outputs().items() if made.version.at_least(*field.since)]
    listed = ",".join(names).encode()
    assert len(listed) > 9000
    server.arrived(wire, struct.pack(">HBH", 5, ord("V"), 2), 0.0)  # type: ignore[arg-type]
    server.arrived(wire, struct.pack(">HBd", 11 + len(listed), ord("O"), 500.0) + listed, 0.0)  # type: ignore[arg-type]
    answer = wire.packages[-1]
    assert answer[3] == 1
    assert "NOT_FOUND" not in answer[4:].decode()
    server.arrived(wire, struct.pack(">HB", 3, ord("S")), 0.0)  # type: ignore[arg-type]
    server.frame(0.0)
    assert struct.unpack_from(">H", wire.packages[-1])[0] == len(wire.packages[-1]) > 2000


@pytest.mark.parametrize("action", ["PAUSE", "pause", "Stop"])
def test_a_watchdogs_action_is_read_in_capitals_too(action: str) -> None:
    made = controller()
    made.start(f'def dog():\nrtde_set_watchdog("input_int_register_0", 10, "{action}")\nsleep(1.0)\nend\n')
    made.step()
    assert made.watchdogs["input_int_register_0"].action == action.lower()
