"""Which transport reaches the controller, and that ur_rtde runs the guard and nothing else."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from tests.ur_rtde import NEEDS_UR_RTDE
from tests.worlds.robot.bench import OUTPUT, Bench
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur import rtde
from weldcal.systems.drivers.ur.link import StartFailed
from weldcal.systems.drivers.ur.robot import guard_script
from weldcal.systems.drivers.ur.rtde import UrRtde, chosen_transport
from weldcal.systems.drivers.ur.set_points import AnalogSetPoint
from weldcal.systems.drivers.ur.wire.transport import AUTO, NATIVE, UR_RTDE, Situation, choose
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

POLYSCOPE = (5, 21, 1, 0)
WIRE = AnalogSetPoint(at_full=10.0, value=5.0)


@pytest.mark.parametrize(
    ("found", "why"),
    [
        ({"installed": False}, "not installed"),
        ({"own_time": True}, "time of its own"),
        ({"version": (10, 10, 0, 0)}, "PolyScope X"),
        ({"set_points": True}, "set points"),
        ({"taken": ("speed_slider_mask",)}, "not free"),
        ({"cores": 2}, "fewer than 4 cores"),
    ],
)
def test_auto_is_native_where_ur_rtde_would_lose_something(found: dict[str, object], why: str) -> None:
    name, sentence = choose(AUTO, Situation(**{"version": POLYSCOPE, **found}))  # type: ignore[arg-type]
    assert name == NATIVE
    assert why in sentence


def test_auto_is_ur_rtde_where_nothing_is_lost() -> None:
    assert choose(AUTO, Situation(version=POLYSCOPE))[0] == UR_RTDE
    assert choose(NATIVE, Situation(version=POLYSCOPE))[0] == NATIVE
    assert choose(UR_RTDE, Situation(version=POLYSCOPE, cores=2))[0] == UR_RTDE


@pytest.mark.parametrize(
    "changed", [{"lockstep": True}, {"pace": 0.5}, {"lockstep": True, "follow": True}, {"wire_feed": WIRE}]
)
def test_ur_rtde_is_refused_where_it_cannot_be_used(changed: dict[str, object]) -> None:
    asked = {"host": "127.0.0.1", "process_output": 0, "arc_input": 0, **changed}
    assert chosen_transport(UrRtde(**asked), POLYSCOPE, True)[0] == NATIVE  # type: ignore[arg-type]
    with pytest.raises(InputError, match="cannot be ur_rtde here"):
        chosen_transport(UrRtde(**asked, transport=UR_RTDE), POLYSCOPE, True)  # type: ignore[arg-type]


def test_an_unknown_transport_is_refused() -> None:
    with pytest.raises(InputError, match="auto, native or ur_rtde, not 'serial'"):
        chosen_transport(UrRtde(host="127.0.0.1", transport="serial"), POLYSCOPE, True)


def test_the_cell_never_imports_ur_rtde() -> None:
    code = "import sys, weldcal.systems.drivers.ur.rtde; print(sorted(n for n in sys.modules if n.startswith('rtde')))"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


@NEEDS_UR_RTDE
def test_each_state_that_is_read_is_in_the_type_table_of_ur_rtde() -> None:
    # a name that is not in its table shifts all that follow; the names of its own default list are
    from weldcal.systems.drivers.ur.robot import ALWAYS, INPUTS, OUTPUTS
    from weldcal.systems.drivers.ur.wire.ur_rtde_client import GETTERS

    assert set(GETTERS) == {*ALWAYS, "actual_TCP_pose", OUTPUTS, INPUTS}


@NEEDS_UR_RTDE
def test_the_guard_gets_no_command_before_the_control_connection_has_seen_it_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # ur_rtde reads states and gives commands on two connections: here the second one hears of the program later
    from weldcal.systems.drivers.ur.wire.ur_rtde_client import UrRtdeTransport

    heard = iter((False, False, True))
    asked: list[bool] = []

    class Control:
        def setCustomScriptFile(self, name: str) -> None: ...

        def isProgramRunning(self) -> bool:
            asked.append(next(heard))
            return asked[-1]

    made = object.__new__(UrRtdeTransport)
    monkeypatch.setattr(made, "_control", Control(), raising=False)
    monkeypatch.setattr(made, "wait", lambda seconds: None)
    assert made.upload("def guard():\nend\n", lambda: True, time.monotonic() + 5.0)
    assert asked == [False, False, True]


@NEEDS_UR_RTDE
def test_ur_rtde_runs_the_guard_on_the_controller(monkeypatch: pytest.MonkeyPatch) -> None:
    with emulator_process(lockstep=LOCKSTEP_S) as emulator:
        config = UrRtde(host=emulator.host)
        monkeypatch.setattr("os.sched_getaffinity", lambda pid: range(4))
        assert chosen_transport(config, POLYSCOPE, True)[0] == UR_RTDE
        bench = Bench(emulator, torch={"gas_output": 2, "gas_before_s": 0.1, "gas_after_s": 0.2}, transport=UR_RTDE)
        bench.start(process=True)
        bench.cruise()
        assert emulator.state()["digital_outputs"] == 1 << OUTPUT | 1 << 2
        assert emulator.ask(ask="program")["source"].strip() == guard_script(True, OUTPUT, 2).strip()
        assert "rtde" in emulator.ask(ask="connections")["connections"]
        state = bench.stream.state
        assert state.process_on
        bench.end()
        assert emulator.wait("runtime_state", "STOPPED")["program"] is None
        assert emulator.state()["digital_outputs"] == 0
        assert emulator.ask(check="summary")["moves_without_a_command"] == 0


@NEEDS_UR_RTDE
def test_a_register_that_only_ur_rtde_claims_makes_auto_native(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: range(4))
    with emulator_process() as emulator:
        emulator.fault("registers_in_use", names=["input_double_register_40"])
        name, sentence = chosen_transport(UrRtde(host=emulator.host), POLYSCOPE, True)
        assert (name, "not free" in sentence) == (NATIVE, True)
        emulator.do("registers_free")
        emulator.fault("registers_in_use", names=["configurable_digital_output_mask"])
        assert chosen_transport(UrRtde(host=emulator.host), POLYSCOPE, True)[0] == UR_RTDE
        wired = UrRtde(host=emulator.host, process_output=3)
        assert chosen_transport(wired, POLYSCOPE, True)[0] == NATIVE


@NEEDS_UR_RTDE
def test_no_command_of_ur_rtde_waits_for_a_package() -> None:
    # in a process of its own, as the worker's: its constructors hold the interpreter's lock
    code = (
        "import os, sys, weldcal.systems.drivers.ur.wire.ur_rtde_client as client; "
        "held = client.UrRtdeTransport(sys.argv[1], ['timestamp'], True); "
        "sys.stdout.write(str(client.send_at_once(30004))); sys.stdout.flush(); os._exit(0)"
    )
    with emulator_process() as emulator:
        done = subprocess.run([sys.executable, "-c", code, emulator.host], capture_output=True, text=True, timeout=60)
    assert done.stdout == "0", "connections with Nagle's algorithm"


@pytest.mark.parametrize("wanted", ["auto", "ur_rtde"])
def test_auto_starts_natively_where_ur_rtde_does_not_start(wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    def start(transport: str) -> str:
        tried.append(transport)
        if transport == "ur_rtde":
            raise StartFailed("the worker ended")
        return "a link"

    stopped: list[str] = []
    monkeypatch.setattr(rtde, "stop_program", stopped.append)
    config = UrRtde(host="127.0.0.1", transport=wanted)
    if wanted == "ur_rtde":
        with pytest.raises(StartFailed):
            rtde.start_link(start, config, "ur_rtde", "")
        assert (tried, stopped) == (["ur_rtde"], [])
        return
    link, why = rtde.start_link(start, config, "ur_rtde", "")
    assert (link, why) == ("a link", "Transport native: ur_rtde did not start.")
    assert (tried, stopped) == (["ur_rtde", "native"], ["127.0.0.1"])
