"""A station is the same to the cell whatever its robot is: the same ports, and the same answers to what a cell may do
wrong."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import Context, Diagram, EventStatus, InputPort, OutputPort, PortDataType

from tests.systems.cells import EXACT_PLATE, SMALL_IDEAL_SCANNER, Drive, scenario
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.messages import UrStatus
from weldcal.systems.pacing import CELL_PRIORITY, LOOP_PRIORITY
from weldcal.systems.station import make_station
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

SPEEDS = "arm.velocity_command"
PACE = 0.5
SLOWLY = np.array([0.02, -0.03, 0.04, 0.05, -0.05, 0.06])  # rad/s
REST_S = 0.3  # within which the arm must have come to rest, of the robot's time
STILL_RAD = 1e-5


class PacedDrive(Drive):
    """A station driven by hand, kept to the wall clock where its robot is real."""

    true_arm: Callable[[], np.ndarray]

    def keep_time(self) -> None:
        """From now on."""
        clock = self.station.robot.clock
        if clock is None:
            self.simulator.clear_monitor()
            return

        def wait(root: Context) -> EventStatus:
            clock.wait_for(root.get_time(), moving=True)
            return EventStatus.DidNothing()

        self.simulator.set_monitor(wait)

    @property
    def lost_s(self) -> float:
        """Time in which the robot went on and the Diagram did not."""
        clock = self.station.robot.clock
        return 0.0 if clock is None else clock.lost_s

    @property
    def status(self) -> UrStatus:
        found: UrStatus = self.get("arm.status")
        return found

    def moves_within(self, duration_s: float) -> float:
        """How far (rad) a joint truly goes while the Diagram advances."""
        before = self.true_arm()
        self.run(duration_s)
        return float(np.abs(self.true_arm() - before).max())


@dataclass(frozen=True)
class Backend:
    """How to get a station of one kind; `latches_silence`: whether a cell that falls silent is told so afterwards."""

    name: str
    drive: Callable[[], PacedDrive]
    latches_silence: bool


def build(robot: SimulatedUr | UrRtde) -> PacedDrive:
    described = scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE)
    described.robot = robot
    drive = PacedDrive(make_station(described, 0))
    drive.keep_time()
    return drive


@pytest.fixture(scope="module", params=["simulated", "emulated"])
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    """The kinds of station; the emulated controller serves all statements of this file, one start after the other."""
    if request.param == "simulated":

        def simulated() -> PacedDrive:
            drive = build(SimulatedUr())
            world = drive.station.world
            drive.true_arm = lambda: np.array(world.plant.GetPositions(drive.plant, world.arm))
            return drive

        yield Backend("simulated", simulated, latches_silence=False)
        return
    home = np.deg2rad(scenario().home_deg).tolist()
    with emulator_process(q=home, pace=PACE, lockstep=LOCKSTEP_S) as emulator:

        def emulated() -> PacedDrive:
            drive = build(UrRtde(host=emulator.host, pace=PACE))
            drive.true_arm = lambda: np.array(emulator.state()["q"])
            return drive

        yield Backend("emulated", emulated, latches_silence=True)


@pytest.fixture
def drive(backend: Backend) -> Iterator[PacedDrive]:
    """A fresh station whose arm stands still."""
    made = backend.drive()
    with closing(made.station):
        yield made


def port_kinds(diagram: Diagram) -> dict[tuple[str, str], int | type]:
    """Every port by direction and name, with its size or the type of its message."""

    def kind(port: InputPort | OutputPort) -> int | type:
        if port.get_data_type() == PortDataType.kVectorValued:
            return int(port.size())
        value = port.Allocate() if isinstance(port, OutputPort) else diagram.AllocateInputAbstract(port)
        return type(value.get_value())

    inputs = (diagram.get_input_port(k) for k in range(diagram.num_input_ports()))
    outputs = (diagram.get_output_port(k) for k in range(diagram.num_output_ports()))
    found = {("in", port.get_name()): kind(port) for port in inputs}
    return found | {("out", port.get_name()): kind(port) for port in outputs}


def test_the_ports_have_the_names_types_and_sizes_of_the_simulated_station(drive: PacedDrive) -> None:
    simulated = build(SimulatedUr()).station
    assert port_kinds(drive.station.diagram) == port_kinds(simulated.diagram)
    assert ("in", SPEEDS) in port_kinds(simulated.diagram)


def workers() -> list[Path]:
    """/proc folders of this process's workers."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    folders = [Path("/proc") / child for child in children]
    return [folder for folder in folders if b"weldcal.systems.drivers.ur.worker" in (folder / "cmdline").read_bytes()]


def test_a_worker_is_one_thread_that_runs_before_the_cell(backend: Backend, drive: PacedDrive) -> None:
    if backend.name == "simulated":
        assert workers() == []
        return
    (worker,) = workers()
    assert [task.name for task in (worker / "task").iterdir()] == [worker.name]
    loop = int(worker.name)
    if os.sched_getscheduler(loop) != os.SCHED_RR:
        pytest.skip("this system gives no real-time priority to this user")
    assert os.sched_getparam(loop).sched_priority == LOOP_PRIORITY > CELL_PRIORITY


def test_the_position_is_held_from_the_start_and_zero_moves_nothing(drive: PacedDrive) -> None:
    start = drive.true_arm()
    assert drive.station.q_start == pytest.approx(start, abs=STILL_RAD)
    assert drive.get("arm.position_measured") == pytest.approx(start, abs=STILL_RAD)
    assert drive.moves_within(0.4) < STILL_RAD
    assert drive.get("arm.position_measured") == pytest.approx(start, abs=STILL_RAD)
    assert drive.get("arm.velocity_measured") == pytest.approx(0.0, abs=1e-3)
    X_BF = forward_kinematics(drive.station.arm, drive.get("arm.position_measured"))
    assert drive.get("arm.X_BF").IsNearlyEqualTo(X_BF, 1e-9)
    assert drive.status.ready


def test_a_velocity_is_followed_and_the_sample_carries_its_own_time(drive: PacedDrive) -> None:
    drive.run(0.1)
    drive.set(SPEEDS, SLOWLY)
    drive.run(0.3)
    before, t_before = drive.get("arm.position_measured"), drive.get("arm.sample_time")[0]
    lost_before = drive.lost_s
    drive.run(0.4)
    after, t_after = drive.get("arm.position_measured"), drive.get("arm.sample_time")[0]
    # A busy machine's late commands slow the arm along its path (`time_scale`), and delay a sample's arrival; what it
    # loses the arm goes on for.
    moved = (after - before) / (t_after - t_before)
    kept = float(moved @ SLOWLY / (SLOWLY @ SLOWLY))
    assert moved == pytest.approx(kept * SLOWLY, abs=2e-3)
    assert 0.0 < kept < 1.05 + (drive.lost_s - lost_before) / (t_after - t_before)
    assert t_after == pytest.approx(drive.time, abs=0.03)
    for _ in range(40):
        if drive.get("arm.velocity_measured") == pytest.approx(SLOWLY, abs=2e-3):
            break
        drive.run(0.05)
    assert drive.get("arm.velocity_measured") == pytest.approx(SLOWLY, abs=2e-3), "reached while nothing is late"
    world = drive.station.world
    seen = drive.station.world.plant.GetPositions(drive.plant, world.arm)
    assert seen == pytest.approx(drive.true_arm(), abs=2e-3), "what the cameras see is where the arm is"
    drive.set(SPEEDS, np.zeros(6))
    drive.run(REST_S)
    assert drive.moves_within(0.1) < STILL_RAD
    assert drive.status.ready


def test_a_velocity_that_is_no_number_stops_the_arm_for_good(drive: PacedDrive) -> None:
    drive.set(SPEEDS, SLOWLY)
    drive.run(0.2)
    drive.set(SPEEDS, np.where(np.arange(6) == 3, np.nan, SLOWLY))
    drive.run(REST_S)
    assert drive.moves_within(0.1) < STILL_RAD
    assert drive.status.fault is not None
    assert not drive.status.ready
    assert drive.status.fault.endswith(".")
    drive.set(SPEEDS, np.zeros(6))
    drive.run(0.1)
    drive.set(SPEEDS, SLOWLY)
    assert drive.moves_within(0.2) < STILL_RAD, "nothing resumes by itself"
    assert not drive.status.ready


def test_a_cell_that_falls_silent_leaves_the_arm_at_rest(backend: Backend, drive: PacedDrive) -> None:
    drive.set(SPEEDS, SLOWLY)
    assert drive.moves_within(0.3) > 0.005
    time.sleep((0.1 + REST_S) / PACE)  # the Diagram does not advance, and its last command was to move
    before = drive.true_arm()
    time.sleep(0.2)
    assert np.abs(drive.true_arm() - before).max() < STILL_RAD
    drive.keep_time()
    drive.run(0.02)
    if backend.latches_silence:
        assert drive.status.fault is not None
        assert "COMMAND LATE" in drive.status.fault
        assert drive.moves_within(0.2) < STILL_RAD
    else:
        assert drive.status.ready
