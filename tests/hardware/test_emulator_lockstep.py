"""Lockstep: the controller's time waits for a client that streams and is late, and for no other, and says so."""

from __future__ import annotations

import signal
import struct
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.hardware.bare_rtde import Rtde
from tests.hardware.emulator_process import LOCKSTEP_S, emulator_process
from tests.worlds.robot.bench import Bench, CommandThread
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import UrLink
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde
from weldcal.tools.emulators.ur.controller.registers import RuntimeState
from weldcal.tools.emulators.ur.lockstep import AHEAD_FRAMES, STREAM_PACKAGES, Lockstep
from weldcal.tools.emulators.ur.wire.net import LinkFaults

BOUND_S = 0.5
FRAME_S = 0.002
PROGRAM = "def idle():\n  while True:\n    sync()\n  end\nend\n"


class Client:
    """As much of a connection as lockstep looks at."""

    def __init__(self) -> None:
        self.faults = LinkFaults()
        self.open = True

    def readable(self, now: float) -> bool:
        return self.open


class Streamed:
    """A controller with a client that has streamed: the next frame would be one too far."""

    def __init__(self, bound_s: float = BOUND_S, recipe: int = 3) -> None:
        self.controller: Any = SimpleNamespace(frame=0, runtime_state=RuntimeState.PLAYING, watchdogs={})
        self.client: Any = Client()
        self.lockstep = Lockstep(self.controller, bound_s)
        self.packages(STREAM_PACKAGES, recipe)
        self.controller.frame += AHEAD_FRAMES

    def packages(self, count: int, recipe: int) -> None:
        for _ in range(count):
            self.controller.frame += AHEAD_FRAMES
            self.lockstep.heard(self.client, recipe, 0.0)

    def waits(self, now: float = 0.0) -> bool:
        return self.lockstep.waits(now)


def test_a_frame_waits_for_the_next_package_and_counts_how_long() -> None:
    streamed = Streamed()
    streamed.controller.frame -= 1
    assert not streamed.waits(), "not before it is so far ahead"
    streamed.controller.frame += 1
    assert streamed.waits(1.0)
    assert streamed.waits(1.2)
    streamed.lockstep.heard(streamed.client, 3, 1.3)
    assert not streamed.waits(1.3)
    streamed.controller.frame += AHEAD_FRAMES
    assert streamed.waits(2.0)
    streamed.lockstep.heard(streamed.client, 3, 2.1)
    found = streamed.lockstep.state()
    assert (found["waits"], found["given_up"]) == (2, 0)
    assert found["longest_s"] == pytest.approx(0.3)
    assert found["waited_s"] == pytest.approx(0.4)


def test_after_the_bound_time_goes_on_until_the_client_streams_again() -> None:
    streamed = Streamed()
    assert streamed.waits(1.0)
    assert not streamed.waits(1.0 + BOUND_S)
    assert not streamed.waits(1.1 + BOUND_S)
    assert streamed.lockstep.state()["given_up"] == 1
    streamed.lockstep.heard(streamed.client, 3, 2.0)
    streamed.controller.frame += AHEAD_FRAMES
    assert not streamed.waits(2.0), "one package is no stream"
    streamed.packages(STREAM_PACKAGES, 3)
    streamed.controller.frame += AHEAD_FRAMES
    assert streamed.waits(3.0)


def test_a_client_that_let_a_watchdog_be_set_is_waited_for_with_its_first_package() -> None:
    made = Streamed()
    made.packages(1, recipe=7)
    made.controller.frame += 12
    assert not made.waits(), "one package is no stream"
    made.controller.watchdogs["input_int_register_0"] = SimpleNamespace(
        fed_at=made.controller.frame - 12, period_s=0.05
    )
    assert not made.waits(), "24 of 50 ms"
    made.controller.frame += 1
    assert made.waits(1.0)
    assert not made.waits(1.0 + BOUND_S)
    made.controller.frame += 1
    assert not made.waits(1.0 + BOUND_S), "not again before it has been heard"


def no_stream(streamed: Streamed) -> None:
    streamed.packages(1, recipe=4)  # another command: the client waits for its end
    streamed.controller.frame += AHEAD_FRAMES


NOT_WAITED_FOR: dict[str, Callable[[Streamed], object]] = {
    "another command": no_stream,
    "connection closed": lambda s: setattr(s.client, "open", False),
    "connection deaf": lambda s: setattr(s.client.faults, "deaf_until", 1e9),
    "program stopped": lambda s: setattr(s.controller, "runtime_state", RuntimeState.STOPPED),
    "program paused": lambda s: setattr(s.controller, "runtime_state", RuntimeState.PAUSED),
    "silence on purpose": lambda s: s.lockstep.expect_silence(),
}


@pytest.mark.parametrize("case", NOT_WAITED_FOR)
def test_nobody_waits_where_the_silence_is_meant(case: str) -> None:
    streamed = Streamed()
    assert streamed.waits()
    NOT_WAITED_FOR[case](streamed)
    assert not streamed.waits()
    assert not Streamed(bound_s=0.0).waits(), "nor where lockstep is off"


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with emulator_process(lockstep=LOCKSTEP_S) as emulator:
        yield Bench(emulator)


def test_a_worker_that_does_not_run_costs_the_controller_no_time(bench: Bench) -> None:
    bench.start()
    bench.cruise()
    assert bench.link is not None
    worker, before = bench.link._process, bench.emulator.state()
    worker.send_signal(signal.SIGSTOP)
    time.sleep(0.1)
    during = bench.emulator.state()
    worker.send_signal(signal.SIGCONT)
    assert during["timestamp"] - before["timestamp"] < 0.03, "a tenth of a second of the host's time"
    until = time.monotonic() + 5.0
    while (after := bench.emulator.state())["timestamp"] < during["timestamp"] + 0.2:
        assert time.monotonic() < until, "time does not go on"
    assert bench.stream.state.fault is Fault.NONE, bench.stream.state.status.fault
    assert bench.tool_speed() > 0.01
    assert after["lockstep"]["longest_s"] > 0.05
    assert after["lockstep"]["given_up"] == 0
    bench.end()


def test_a_cell_that_is_late_finds_the_arm_where_it_left_it(bench: Bench) -> None:
    config = UrRtde(host=bench.host, lockstep=True)
    bench.emulator.do("reset_checker")
    link = UrLink.start(bench.host, bench.arm, config.limits(bench.arm), payload_kg=config.payload_kg)
    stream = CommandThread(link, bench.arm, bench.home)
    stream.start()
    until = time.monotonic() + 8.0
    while not stream.cruising:
        assert time.monotonic() < until, stream.state.status.fault
        time.sleep(0.002)
    stream.twist = lambda qd: None
    time.sleep(0.1)
    begin = bench.emulator.state()
    time.sleep(0.3)
    end = bench.emulator.state()
    assert end["timestamp"] == begin["timestamp"]
    assert end["q"] == begin["q"]
    assert np.abs(begin["qd"]).max() > 0.05, "in the middle of its motion"
    stream.twist = lambda qd: qd
    while bench.emulator.state()["timestamp"] < end["timestamp"] + 0.3:
        assert time.monotonic() < until + 5.0, "time does not go on"
    assert stream.state.fault is Fault.NONE, stream.state.status.fault
    assert bench.tool_speed() > 0.01
    stream.stop()
    link.close()


def test_a_real_robot_does_not_wait_for_this_computer() -> None:
    with pytest.raises(InputError, match="leave lockstep at false"):
        PrepareRobot(UrRtde(host="192.0.2.1", lockstep=True), load_arm())


def test_a_worker_that_is_silenced_on_purpose_is_not_waited_for(bench: Bench) -> None:
    bench.start()
    bench.cruise()
    at = bench.signal_worker(signal.SIGSTOP)
    before = bench.emulator.state()
    while bench.emulator.state()["timestamp"] < before["timestamp"] + 0.03:
        assert time.monotonic() < at + 0.9 * LOCKSTEP_S, "it is waited for"
    bench.emulator.wait("runtime_state", "STOPPED")
    assert bench.at_rest_after(at, 0.3)["ok"]
    bench.end(kill=True)


def test_a_client_that_only_falls_silent_is_waited_for_as_long_as_it_says() -> None:
    with emulator_process(lockstep=BOUND_S) as robot, Rtde(robot.host).watch("timestamp", "runtime_state") as client:
        client.send(b"I", b"input_int_register_25")
        robot.fault("foreign_program", script=PROGRAM, latch=False)
        client.until("runtime_state", 2)
        for k in range(50):
            newest = client.next()["timestamp"]
            client.put(b"U", struct.pack(">Bi", 1, k))
        begin = time.monotonic()
        ahead = client.until("timestamp", pytest.approx(newest + 20 * FRAME_S, abs=0.5 * FRAME_S), limit_s=5.0)
        assert time.monotonic() - begin > 0.9 * BOUND_S
        assert ahead["runtime_state"] == 2
        found = robot.state()["lockstep"]
        assert found["given_up"] == 1
        assert found["longest_s"] >= BOUND_S


def test_a_bound_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="Give a lockstep bound"), emulator_process(lockstep=-1.0):
        pass
