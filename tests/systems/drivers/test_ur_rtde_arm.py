"""The arm behind a link: when its sample was taken, where it will be next, and what it is told."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, VectorSystem

from tests.systems.drivers.still_link import StillLink
from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.rtde import UrRtdeArm
from weldcal.systems.drivers.ur.set_points import AnalogSetPoint
from weldcal.systems.wall_clock import WallClock

Q = np.array([0.0, -1.4, 1.9, -2.1, -1.6, 0.0])


@pytest.fixture
def link() -> StillLink:
    return StillLink(Q)


class Driven:
    """The system alone in a simulator."""

    def __init__(self, link: StillLink, pace: float = 1.0, clock: WallClock | None = None) -> None:
        self.clock = clock or WallClock(pace)
        self.system = UrRtdeArm(load_arm(), link, self.clock)
        self.simulator = Simulator(self.system)
        self.tell(np.zeros(6))

    @property
    def context(self) -> Context:
        return self.simulator.get_mutable_context()

    def tell(self, qd: np.ndarray) -> None:
        self.system.GetInputPort("velocity_command").FixValue(self.context, qd)

    def get(self, port: str) -> np.ndarray:
        return np.array(self.system.GetOutputPort(port).Eval(self.context))


@pytest.mark.parametrize("pace", [1.0, 0.5])
def test_a_sample_is_as_old_on_the_diagrams_clock_as_the_pace_makes_it(link: StillLink, pace: float) -> None:
    link.age_s = 0.004
    driven = Driven(link, pace)
    driven.simulator.AdvanceTo(0.1)
    # the newest update was at 0.1 s or one period before
    assert driven.get("sample_time")[0] == pytest.approx(0.1 - pace * 0.004, abs=0.0021)


def test_the_clock_of_the_samples_never_runs_backwards(link: StillLink) -> None:
    driven = Driven(link)
    times = []
    for k in range(50):
        link.age_s = 0.03 if k % 7 == 0 else 0.001
        driven.simulator.AdvanceTo(0.01 * (k + 1))
        times.append(driven.get("sample_time")[0])
    assert np.all(np.diff(times) >= 0.0)


def test_the_clock_of_the_samples_goes_on_after_the_cell_has_stood_at_rest_and_its_robot_has_not(
    link: StillLink,
) -> None:
    """The first call of a compiled function takes 16 s: the pose of no scan after it may be lost."""
    driven = Driven(link, clock=WallClock.following(lambda: link.robot_time))
    times = []
    for k in range(1, 40):
        link.robot_time += 16.0 if k == 20 else 0.002
        driven.simulator.AdvanceTo(0.002 * k)
        driven.clock.wait_for(0.002 * k, moving=False)
        times.append(driven.get("sample_time")[0])
    assert np.abs(np.array(times) - 0.002 * np.arange(1, 40)).max() < 0.005


def test_the_shadow_is_where_the_arm_will_be_at_the_next_tick(link: StillLink) -> None:
    link.qd, link.age_s = np.array([0.1, 0, 0, 0, 0, -0.2]), 0.003
    driven = Driven(link)
    driven.simulator.AdvanceTo(0.1)
    desired = driven.get("desired_state")
    assert desired[:6] == pytest.approx(Q + link.qd * (0.003 + 0.002), abs=1e-12)
    assert desired[6:] == pytest.approx(link.qd)


def test_each_command_is_sent_and_next_to_nothing_is_sent_as_nothing(link: StillLink) -> None:
    driven = Driven(link)
    driven.tell(np.full(6, 1e-12))
    driven.simulator.AdvanceTo(0.02)
    assert link.commands
    assert not np.any(link.commands)
    sent = len(link.commands)
    driven.tell(np.full(6, 0.1))
    driven.simulator.AdvanceTo(0.04)
    assert len(link.commands) == sent + 5  # every 4 ms
    assert link.commands[-1] == pytest.approx(np.full(6, 0.1))


class ComputesLong(VectorSystem):
    """A source of a velocity that takes so long to compute that the robot's time goes on."""

    def __init__(self, robot_time: list[float]) -> None:
        super().__init__(0, 6, direct_feedthrough=False)
        self.takes_s, self._robot_time = 0.0, robot_time

    def DoCalcVectorOutput(self, context: Context, inputs: object, state: object, output: np.ndarray) -> None:
        self._robot_time[0] += self.takes_s
        output[:] = 0.1


@pytest.mark.parametrize(("takes_s", "leaves"), [(0.003, True), (0.005, False)])
def test_a_robot_that_waits_is_sent_no_velocity_that_has_become_late_while_it_was_computed(
    link: StillLink, takes_s: float, leaves: bool
) -> None:
    robot_time = [0.0]
    clock = WallClock.following(lambda: robot_time[0])
    builder = DiagramBuilder()
    source = builder.AddSystem(ComputesLong(robot_time))
    arm = builder.AddSystem(UrRtdeArm(load_arm(), link, clock))
    builder.Connect(source.get_output_port(), arm.GetInputPort("velocity_command"))
    simulator = Simulator(builder.Build())
    clock.wait_for(0.0, moving=True)
    simulator.Initialize()
    sent = len(link.commands)
    robot_time[0], source.takes_s = 0.004, takes_s
    clock.wait_for(0.004, moving=True)  # the tick begins in time
    simulator.AdvanceTo(0.004)
    simulator.AdvancePendingEvents()
    assert (len(link.commands) > sent) == leaves
    assert clock.lateness.worst_ms <= 4.0


def test_the_process_is_asked_for_with_the_velocity_of_the_same_tick_and_off_where_nobody_asks(link: StillLink) -> None:
    driven = Driven(link)
    driven.simulator.AdvanceTo(0.02)
    assert link.processes
    assert not any(link.processes)
    driven.system.GetInputPort("process_on").FixValue(driven.context, [1.0])
    driven.simulator.AdvanceTo(0.03)
    assert link.processes[-1]
    assert len(link.processes) == len(link.commands)


def test_a_command_that_is_no_number_goes_to_the_worker_which_refuses_it(link: StillLink) -> None:
    driven = Driven(link)
    driven.tell(np.full(6, np.nan))
    driven.simulator.AdvanceTo(0.02)
    assert np.isnan(link.commands[-1]).all()


def test_a_fault_of_the_link_is_the_status_of_the_arm(link: StillLink) -> None:
    driven = Driven(link)
    status = driven.system.GetOutputPort("status")
    assert status.Eval(driven.context).ready
    link.fault = Fault.PROTECTIVE_STOP
    driven.simulator.AdvanceTo(0.02)
    assert not status.Eval(driven.context).ready
    assert status.Eval(driven.context).fault.startswith("PROTECTIVE STOP")


def test_set_values_of_the_power_source_become_shares_of_the_analog_outputs(link: StillLink) -> None:
    points = {1: AnalogSetPoint(output=1, at_zero=0.0, at_full=20.0), 2: AnalogSetPoint(output=0, at_full=40.0)}
    system = UrRtdeArm(load_arm(), link, WallClock(1.0), points=points)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("velocity_command").FixValue(context, np.zeros(6))
    simulator.AdvanceTo(0.01)
    assert link.shares is None, "nothing sets them: the scenario's values"
    system.GetInputPort("set_values").FixValue(context, [3.0, 8.0, np.nan, 200.0])
    simulator.AdvanceTo(0.02)
    np.testing.assert_allclose(link.shares, [np.nan, 0.4])
