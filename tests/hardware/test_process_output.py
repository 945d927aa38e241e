"""The torch at a digital output of the controller: on only while somebody asks for it, off before whatever stops the
arm."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing

import numpy as np
import pytest

from tests.hardware.emulator_process import run_client
from tests.systems.cells import EXACT_PLATE, SMALL_IDEAL_SCANNER, Drive, scenario
from tests.ur_rtde import NEEDS_UR_RTDE
from tests.worlds.robot.bench import Bench
from tests.worlds.robot.fault_run import recover
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import Fault, RobotRefused
from weldcal.systems.drivers.ur.robot import guard_script
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde
from weldcal.systems.drivers.ur.set_points import MASK, VALUE, Level
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe
from weldcal.systems.station import make_station
from weldcal.systems.wall_clock import WallClock
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import RuntimeState
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process
from weldcal.tools.emulators.ur.versions import parse_version

OUTPUT, VALVE = 3, 4
FEED, VOLTAGE = Level(0, True, 0.4), Level(1, False, 0.75)
SHOWN = [4.0, 0.016]  # V and A
ZERO = [0.0, 0.004]
ARC, ARC_FAULT = 5, 6
TURNING = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
BASE = 24
SILENT = 3
SPEED_J, SPEED_STOP, END = 9, 15, 255


class Guarded:
    """The guard in a controller, frame by frame; a negative number asks for the process."""

    def __init__(self, output: int | None = OUTPUT, gas: int | None = None, levels: Sequence[Level] = ()) -> None:
        self.controller = Controller(load_arm(), np.array(HOME), parse_version("5.21"))
        self.controller.terminals.digital_outputs = 0xFF  # somebody left them on
        self.controller.terminals.analog_outputs = [0.9, 0.9]
        self.controller.submit(guard_script(True, output, gas, levels))
        self.number = 0.0
        self.history: list[tuple[bool, float]] = []
        self.levels: list[list[float]] = []
        self.frames(5)

    def frames(self, count: int, *, fed: bool = True) -> None:
        for _ in range(count):
            if fed:
                self.controller.written((f"input_int_register_{BASE}",))
            self.controller.step()
            self.history.append((self.on, float(np.abs(self.controller.arm.qd).max())))
            self.levels.append(self.analog)

    def write(self, command: int, values: Sequence[float] = ()) -> None:
        self.controller.inputs.integers[BASE] = command
        for i, value in enumerate(values):
            self.controller.inputs.doubles[BASE + i] = value

    def speed(self, qd: Sequence[float], frames: int, process: bool, shares: Sequence[float] = ()) -> None:
        for _ in range(frames):
            self.number += 1.0
            self.write(SPEED_J, [*qd, 40.0, -self.number if process else self.number, *shares])
            self.frames(1)

    @property
    def analog(self) -> list[float]:
        """V or A at the analog outputs."""
        return [self.controller.terminals.analog_output(n) for n in range(2)]

    @property
    def on(self) -> bool:
        return bool(self.controller.terminals.digital_outputs >> OUTPUT & 1)

    def off_before_slower(self) -> bool:
        """The newest frame at full speed with the process on comes before the first slower one."""
        last_on = max(k for k, (on, _) in enumerate(self.history) if on)
        fastest = max(speed for _, speed in self.history)
        slower = [k for k, (_, speed) in enumerate(self.history) if k > last_on and speed < 0.999 * fastest]
        return bool(slower) and all(speed >= 0.999 * fastest for _, speed in self.history[last_on : last_on + 1])


def test_the_guard_begins_with_the_process_off_and_burns_while_it_is_asked_to() -> None:
    guarded = Guarded()
    assert not guarded.on
    assert guarded.controller.terminals.digital_outputs == 0xFF & ~(1 << OUTPUT)  # the others are not ours
    guarded.speed(TURNING, 20, process=False)
    assert not guarded.on
    guarded.speed(TURNING, 2, process=True)
    assert guarded.on
    guarded.speed([0.0] * 6, 40, process=True)
    assert guarded.on  # an arc may burn while the arm stands
    guarded.speed(TURNING, 2, process=False)
    assert not guarded.on


def test_the_gas_valve_closes_when_the_guard_ends_whoever_opened_it() -> None:
    guarded = Guarded(OUTPUT, gas=VALVE)
    guarded.speed(TURNING, 20, process=True)
    assert guarded.controller.terminals.digital_outputs & 1 << VALVE  # the cell's own connection opens and closes it
    guarded.frames(120, fed=False)  # nobody is there any more
    assert not guarded.controller.terminals.digital_outputs & 1 << VALVE
    assert guarded.controller.terminals.digital_outputs == 0xFF & ~(1 << VALVE) & ~(1 << OUTPUT)


def test_set_points_are_there_before_the_torch_and_the_others_outputs_are_not_touched() -> None:
    guarded = Guarded(levels=[FEED])
    assert guarded.analog == pytest.approx([0.0, 0.004 + 0.9 * 0.016])
    guarded.speed([0.0] * 6, 2, process=False, shares=[0.4, 0.0])
    assert (guarded.on, guarded.analog[0]) == (False, pytest.approx(4.0))
    guarded.speed([0.0] * 6, 2, process=True, shares=[0.4, 0.0])
    assert (guarded.on, guarded.analog[0]) == (True, pytest.approx(4.0))
    guarded.controller.terminals.analog_foreign[0] = (1.0, guarded.controller.frame + 1)
    guarded.speed([0.0] * 6, 2, process=True, shares=[0.4, 0.0])
    assert guarded.analog[0] == pytest.approx(4.0), "written in every frame"
    guarded.speed([0.0] * 6, 1, process=False, shares=[0.0, 0.0])
    assert (guarded.on, guarded.analog[0]) == (False, 0.0)
    guarded.speed([0.0] * 6, 2, process=False, shares=[0.4, 0.0])
    guarded.frames(21)
    assert guarded.analog[0] == 0.0, "numbers that stay away, before there was a torch"


def test_a_guard_without_an_output_touches_none() -> None:
    guarded = Guarded(None)
    guarded.speed(TURNING, 20, process=True)
    guarded.write(END)
    guarded.frames(60)
    assert guarded.controller.terminals.digital_outputs == 0xFF


def silence(guarded: Guarded) -> None:
    guarded.frames(60)


def stale_number(guarded: Guarded) -> None:
    for _ in range(60):
        guarded.write(SPEED_J, [*TURNING, 40.0, -guarded.number])
        guarded.frames(1)


def too_fast(guarded: Guarded) -> None:
    guarded.speed([0.0, 0.0, 0.0, 0.0, 0.0, -3.3], 60, process=True)


def told_to_stop(guarded: Guarded) -> None:
    guarded.write(SPEED_STOP, [5.0])
    guarded.frames(60)


def told_to_end(guarded: Guarded) -> None:
    guarded.write(END)
    guarded.frames(60)


def watchdog(guarded: Guarded) -> None:
    guarded.frames(120, fed=False)


def program_stopped(guarded: Guarded) -> None:
    guarded.controller.stop_program()
    guarded.frames(60)


@pytest.mark.parametrize(
    "stop", [silence, stale_number, too_fast, told_to_stop, told_to_end, watchdog, program_stopped]
)
def test_whatever_brakes_the_arm_turns_the_process_off_first(stop: Callable[[Guarded], None]) -> None:
    guarded = Guarded(levels=[FEED, VOLTAGE])
    guarded.speed(TURNING, 50, process=True, shares=[FEED.share, VOLTAGE.share])
    assert guarded.on
    assert guarded.analog == pytest.approx(SHOWN)
    stop(guarded)
    assert not guarded.on
    assert guarded.off_before_slower()
    dark = next(k for k in range(50, len(guarded.history)) if not guarded.history[k][0])
    assert guarded.levels[dark] == pytest.approx(ZERO), "in the frame in which the torch goes out"
    assert guarded.analog == pytest.approx(ZERO)


@pytest.mark.parametrize("qd", [TURNING, [0.0] * 6], ids=["moving", "at rest"])
def test_a_torch_that_silence_turned_off_stays_off_whatever_comes(qd: Sequence[float]) -> None:
    guarded = Guarded()
    guarded.speed(qd, 50, process=True)
    guarded.frames(19)
    assert guarded.on
    guarded.frames(3)  # 44 ms
    assert not guarded.on
    assert guarded.controller.runtime_state == RuntimeState.PLAYING
    assert guarded.controller.outputs.integers[BASE + 12] == SILENT
    guarded.speed(qd, 100, process=True)
    assert not any(on for on, _ in guarded.history[-100:])


def test_the_output_is_written_in_every_frame() -> None:
    guarded = Guarded()
    guarded.speed(TURNING, 20, process=False)
    guarded.controller.submit(f"sec theirs():\nset_standard_digital_out({OUTPUT}, True)\nend\n")
    guarded.speed(TURNING, 20, process=False)
    assert not any(on for on, _ in guarded.history[-20:])
    guarded.speed(TURNING, 20, process=True)
    guarded.controller.terminals.digital_outputs = 0
    guarded.speed(TURNING, 1, process=True)
    assert guarded.on


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """One controller for all that happens over the wire, and a link with a torch, its set points and the inputs of its
    arc."""
    torch = {"arc_input": ARC, "arc_fault_input": ARC_FAULT, "levels": (FEED, VOLTAGE)}
    with emulator_process(lockstep=LOCKSTEP_S) as emulator:
        yield Bench(emulator, OUTPUT, torch)


@pytest.fixture
def burning(bench: Bench) -> Iterator[Bench]:
    """The arm at full speed, the torch on, with an arc."""
    bench.start()
    assert bench.stream.state.arc == 0
    bench.stream.process = True
    bench.cruise()
    until = time.monotonic() + 2.0
    while not bench.stream.state.process_on and time.monotonic() < until:
        time.sleep(0.002)
    state = bench.emulator.state()
    assert state["digital_outputs"] >> OUTPUT & 1
    assert state["analog_outputs"] == pytest.approx(SHOWN)
    bench.emulator.do("set_digital_in", n=ARC)
    while bench.stream.state.arc != 1 and time.monotonic() < until:
        time.sleep(0.002)
    assert bench.stream.state.arc == 1
    yield bench
    bench.end(kill=True)
    recover(bench)


def answer_of(bench: Bench, at: float) -> dict[str, float | bool | None]:
    time.sleep(0.35)
    return bench.emulator.ask(check="output_after", fault_time=at, output=OUTPUT)


FAULTS: dict[str, tuple[Callable[[Bench], float], float]] = {
    # what happens, and how long after it the torch may burn: one pass of the worker after the controller's own report,
    # the deadman's 40 ms, or the 50 ms after which the worker calls a silent cell late; each with what a busy computer
    # adds
    "the cell wants it off": (lambda b: (setattr(b.stream, "process", False), time.monotonic())[1], 0.05),
    "the cell falls silent": (lambda b: b.send(lambda qd: None, 1e9), 0.12),
    "numbers 60 ms late": (lambda b: b.emulator.fault("mute_input", seconds=0.06), 0.06),
    "protective stop": (lambda b: b.emulator.fault("protective_stop"), 0.06),
    "emergency stop": (lambda b: b.emulator.fault("estop"), 0.06),
    "program stopped": (lambda b: b.emulator.fault("stop_program"), 0.06),
    "connection reset": (lambda b: b.emulator.fault("reset_tcp"), 0.10),
    "worker killed": (lambda b: b.signal_worker(signal.SIGKILL), 0.10),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_torch_goes_out_before_the_arm_stops(burning: Bench, name: str) -> None:
    happen, limit_s = FAULTS[name]
    at = happen(burning)
    answer = answer_of(burning, at)
    assert answer["ok"], answer  # off, and never on again
    off = answer["off_after_s"]
    assert isinstance(off, float)
    assert off < limit_s, answer
    assert burning.emulator.state()["analog_outputs"] == pytest.approx(ZERO)
    if name in ("numbers 60 ms late", "the cell falls silent", "connection reset", "worker killed", "program stopped"):
        frames = answer["frames_before_braking"]
        assert isinstance(frames, int)
        assert frames >= 0, answer


def test_numbers_30_ms_late_leave_the_torch_on_and_the_arm_at_its_speed(burning: Bench) -> None:
    at = burning.emulator.fault("mute_input", seconds=0.03)
    answer = answer_of(burning, at)
    assert answer["off_after_s"] is None, answer
    assert answer["slows_after_s"] is None or answer["slows_after_s"] > 0.06, answer
    assert burning.stream.state.fault is Fault.NONE


POWER_SOURCE: dict[str, tuple[Callable[[Bench], float], Fault, str]] = {
    "its fault": (lambda b: b.emulator.do("set_digital_in", n=ARC_FAULT), Fault.ARC_FAULT, "power source"),
    "its wire feed, by somebody else": (
        lambda b: b.emulator.fault("set_analog_out", n=0, share=0.6, seconds=0.2), Fault.SET_POINT, "60 % of its range"),
    "its voltage, by somebody else": (
        lambda b: b.emulator.fault("set_analog_out", n=1, share=0.0, seconds=0.2), Fault.SET_POINT, "0 % of its range"),
}  # fmt: skip


@pytest.mark.parametrize("name", POWER_SOURCE)
def test_what_the_power_source_says_or_is_told_by_others_turns_the_torch_off_by_name(burning: Bench, name: str) -> None:
    happen, fault, word = POWER_SOURCE[name]
    answer = answer_of(burning, happen(burning))
    assert answer["ok"], answer
    assert burning.stream.state.fault is fault
    assert word in str(burning.stream.state.status.fault)
    assert answer["off_after_s"] < 0.12, answer  # type: ignore[operator]
    assert answer["frames_before_braking"] >= 0, answer  # type: ignore[operator]
    until = time.monotonic() + 5.0  # zero again as soon as nobody else holds them
    while burning.emulator.state()["analog_outputs"] != pytest.approx(ZERO) and time.monotonic() < until:
        time.sleep(0.02)
    assert burning.emulator.state()["analog_outputs"] == pytest.approx(ZERO)


def test_an_arc_that_outlives_its_torch_is_named(burning: Bench) -> None:
    burning.stream.process = False  # the input stays as it is
    until = time.monotonic() + 10.0
    while burning.stream.state.fault is Fault.NONE and time.monotonic() < until:
        time.sleep(0.01)
    assert burning.stream.state.fault is Fault.ARC_INPUT
    assert "arc_input" in str(burning.stream.state.status.fault)


@NEEDS_UR_RTDE
def test_the_stock_clients_output_reaches_the_terminals_and_the_state_stream(bench: Bench) -> None:
    script = """
import sys, time, rtde_io, rtde_receive
io = rtde_io.RTDEIOInterface(sys.argv[1])
receive = rtde_receive.RTDEReceiveInterface(sys.argv[1])
seen = []
for on in (True, False):
    assert io.setStandardDigitalOut(5, on)
    until = time.monotonic() + 5.0
    while receive.getActualDigitalOutputBits() >> 5 & 1 != on and time.monotonic() < until:
        time.sleep(0.01)
    seen.append(receive.getActualDigitalOutputBits() >> 5 & 1)
print(seen)
"""
    done = run_client(bench.host, script)
    assert done.stdout.strip() == "[1, 0]", done.stderr


def test_outputs_that_somebody_else_writes_are_a_refusal(bench: Bench) -> None:
    with RtdeProbe(bench.host) as other:
        assert other.grant((MASK, VALUE)) is not None
        with pytest.raises(RobotRefused, match="process_output"):
            bench.start()
    bench.end(kill=True)


@pytest.mark.parametrize("output", [OUTPUT, None])
def test_the_cells_process_output_reaches_the_terminal_where_one_is_wired(bench: Bench, output: int | None) -> None:
    bench.emulator.do("set_q", q=np.deg2rad(scenario().home_deg).tolist())
    described = scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE)
    described.robot = UrRtde(host=bench.host, process_output=output)
    station = make_station(described, 0)
    with closing(station):
        wired = station.diagram.HasInputPort("arm.process_on")
        assert wired == (output is not None)
        if not wired:
            return
        drive = Drive(station)
        clock = WallClock(1.0)
        drive.set("arm.process_on", [1.0])
        for _ in range(1000):  # it comes on within 0.02 s, on a busy computer later
            drive.run(0.004)
            clock.wait_for(drive.time, moving=True)
            if on := bench.emulator.state()["digital_outputs"] >> OUTPUT & 1:
                break
        assert on
    assert not bench.emulator.state()["digital_outputs"] >> OUTPUT & 1


def test_an_output_that_does_not_exist_is_told_before_anything_is_asked_of_the_robot() -> None:
    with pytest.raises(InputError, match="from 0 to 7, not 8"):
        PrepareRobot(UrRtde(host="127.0.0.1", process_output=8), load_arm())
