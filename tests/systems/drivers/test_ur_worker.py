"""The worker of the robot link, with a robot that only records: what a late command does to torch and set points."""

from __future__ import annotations

import math
import os
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.set_points import Level
from weldcal.systems.drivers.ur.shared import Given, Memory
from weldcal.systems.drivers.ur.supervisor import OBEYING, PLAYING, RUNNING, Limits, RobotSample, VelocityCommand
from weldcal.systems.drivers.ur.worker import Worker, WorkerConfig

ARM = load_arm()
NO_LIMIT = np.full(6, 10.0)
LIMITS = Limits(
    position_lower=-NO_LIMIT,
    position_upper=NO_LIMIT,
    speed=NO_LIMIT,
    acceleration=NO_LIMIT,
    stale_s=10.0,
    stale_process_s=10.0,
    jump_s=10.0,
)
FRESH, LATE = range(5, 15), range(30, 40)  # passes of 4 ms; the cell computes from pass 15 to pass 45


class RecordingRobot:
    """A healthy robot. Its set points are `right` or not. The cell's commands stop for 30 passes."""

    def __init__(self, memory: Memory, right: bool, moves: int = 0, share: float = math.nan) -> None:
        self.clock = SimpleNamespace(to_host=float, residual_s=0.0, drift=0.0)
        self.numbers, self.echo_latency, self.process_on, self.powered = (0.0, 0.0, 0.0), 0.0, False, False
        self.sent: dict[int, tuple[bool, bool]] = {}
        self._memory, self._right, self._passes = memory, right, 0
        self._shares, self.shares = (
            np.array([share, math.nan]),
            [0.0],
        )  # of the schedule; of the outputs, as they were sent
        self._moves, self.ended = moves, 0  # passes in which the arm still moves; the pass in which its program ended

    def sample(self, now: float) -> RobotSample:
        self._passes += 1
        if not 15 <= self._passes < 45:
            self._memory.command.write(
                Given(
                    number=self._passes,
                    host_time=now,
                    stop=self._passes > 60,
                    process=True,
                    qd=np.zeros(6),
                    shares=self._shares,
                )
            )
        return RobotSample(
            robot_time=now,
            fresh_at=now,
            q=np.zeros(6),
            qd=np.full(6, 0.1 * (self._passes < self._moves)),
            robot_mode=RUNNING,
            safety_mode=1,
            runtime_state=PLAYING,
            speed_scaling=1.0,
            guard=OBEYING,
            connected=True,
            set_points=((0.5, 0.5) if self._right else (0.0, 0.0),),
        )

    def send(
        self,
        qd: np.ndarray,
        acceleration: float,
        process: bool = False,
        armed: bool = False,
        shares: np.ndarray | None = None,
    ) -> bool:
        self.sent[self._passes] = (process, armed)
        self.shares.append(CONFIG.levels[0].wanted(shares))
        return True

    def end_program(self) -> None:
        self.ended = self._passes

    def __getattr__(self, name: str) -> Any:
        return lambda *_: None  # torch_off, gas, excuse, forget


def memory_of() -> Memory:
    """Memory that no other process has."""
    descriptor = os.memfd_create("test")
    os.ftruncate(descriptor, Memory.size())
    memory = Memory(descriptor)
    os.close(descriptor)
    return memory


CONFIG = WorkerConfig(
    host="",
    arm=ARM,
    limits=LIMITS,
    rate_hz=250.0,
    upper_registers=True,
    payload_kg=0.0,
    payload_cog_m=(0.0, 0.0, 0.0),
    parent=os.getppid(),
    levels=(Level(output=0, volts=True, share=0.5),),
)


def run(right: bool, moves: int = 0, share: float = math.nan) -> tuple[RecordingRobot, Fault]:
    """Run a worker for which the torch is wanted, until it is stopped."""
    memory = memory_of()
    robot = RecordingRobot(memory, right, moves, share)
    assert Worker(CONFIG, memory).run(robot) == 0  # type: ignore[arg-type]
    published = memory.state.read()
    assert published is not None
    return robot, Fault(published.fault)


@pytest.fixture(autouse=True)
def passes_of_one_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that only sleeping moves: the passes are 4 ms apart on a busy computer too."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr("time.monotonic", lambda: clock.now)
    monkeypatch.setattr("time.sleep", lambda s: setattr(clock, "now", clock.now + s))


def test_set_points_that_wait_for_the_torch_go_to_zero_under_a_late_command() -> None:
    robot, fault = run(right=False)
    assert {robot.sent[k] for k in FRESH} == {(False, True)}
    assert {robot.sent[k] for k in LATE} == {(False, False)}
    assert {robot.sent[k] for k in range(50, 60)} == {(False, True)}, "a cell that goes on gets them again"
    assert fault is Fault.NONE


def test_the_torch_waits_for_the_share_of_the_schedule() -> None:
    """The output shows 0.5, which is the scenario's share."""
    robot, _ = run(right=True, share=0.7)
    assert {robot.sent[k] for k in FRESH} == {(False, True)}
    assert robot.shares[10] == 0.7
    robot, _ = run(right=True, share=0.5)
    assert robot.sent[16] == (True, True)


def test_a_late_command_with_the_torch_on_is_a_fault_and_the_torch_stays_off() -> None:
    robot, fault = run(right=True)
    assert robot.sent[16] == (True, True)
    assert {robot.sent.get(k, (False, False)) for k in range(30, 60)} == {(False, False)}
    assert fault is Fault.COMMAND_LATE


def test_the_program_ends_once_the_braked_arm_is_at_rest() -> None:
    """A late command with the torch on brakes the arm from pass 28 on."""
    resting, moving = run(right=True)[0], run(right=True, moves=50)[0]
    assert 28 < resting.ended < 50
    assert moving.ended >= 50 + 0.05 * 250.0, "0.05 s at rest"


@pytest.mark.parametrize(("process", "scale"), [(False, 0.0), (True, 1.0)])
def test_a_late_velocity_slows_the_arm_but_not_under_a_burning_torch(process: bool, scale: float) -> None:
    """The torch goes out first: an arm that slowed under it would burn a hole."""
    memory = memory_of()
    sample = RecordingRobot(memory, right=True).sample(100.0)
    late = VelocityCommand(number=1, given_at=99.94, qd=np.full(6, 0.1), process=process)
    assert Worker(CONFIG, memory)._scaled(late, 100.0, sample).scale == scale
