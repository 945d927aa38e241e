"""The mover takes the arm to its goal on a path that starts and ends at rest and keeps its limits on the way."""

from __future__ import annotations

import dataclasses as dc

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Integrator, VectorLogSink

from tests.systems.cells import Q_HOME
from weldcal.systems.messages import JobCommand
from weldcal.systems.motion.flange_mover import SETTLED_RAD, SETTLED_RAD_S, FlangeMover, move_duration, quintic

GOAL = Q_HOME + np.array([0.4, -0.2, 0.1, 0.0, -0.05, 0.3])
DT = 1e-4


def path(duration: float) -> tuple[np.ndarray, np.ndarray]:
    answers = [quintic(Q_HOME, GOAL, u, duration) for u in np.arange(0.0, 1.0 + DT / 2, DT)]
    return np.array([q for q, _ in answers]), np.array([v for _, v in answers])


def test_the_path_goes_from_rest_to_rest() -> None:
    q, v = path(2.0)
    assert q[0] == pytest.approx(Q_HOME)
    assert q[-1] == pytest.approx(GOAL)
    assert v[[0, -1]] == pytest.approx(0.0, abs=1e-12)
    # It starts and ends without a jerk in acceleration, too: over the first and last thousandth it gains next to
    # nothing.
    assert np.abs(v[[10, -11]]).max() < 1e-5
    assert q[len(q) // 2] == pytest.approx(0.5 * (Q_HOME + GOAL))


def test_the_velocity_is_the_paths_own_slope() -> None:
    q, v = path(2.0)
    slope = (q[2:] - q[:-2]) / (2.0 * DT * 2.0)
    assert v[1:-1] == pytest.approx(slope, abs=1e-6)  # central differences err by u''' (DT duration)^2 / 6


def test_all_joints_stay_on_one_straight_line() -> None:
    q, _ = path(1.0)
    share = (q[:, [0, 1, 2, 4, 5]] - Q_HOME[[0, 1, 2, 4, 5]]) / (GOAL - Q_HOME)[[0, 1, 2, 4, 5]]
    assert np.ptp(share, axis=1).max() < 1e-9
    assert (q[:, 3] == Q_HOME[3]).all()


@pytest.mark.parametrize(("speed", "acceleration"), [(0.2, 50.0), (50.0, 0.5), (1.0, 2.5)])
def test_the_duration_is_the_shortest_that_keeps_both_limits(speed: float, acceleration: float) -> None:
    duration = move_duration(Q_HOME, GOAL, speed, acceleration)
    _, v = path(duration)
    fastest, hardest = np.abs(v).max(), np.abs(np.diff(v, axis=0)).max() / (DT * duration)
    assert fastest <= speed * (1.0 + 1e-6)
    assert hardest <= acceleration * (1.0 + 1e-3)
    assert max(fastest / speed, hardest / acceleration) == pytest.approx(1.0, rel=1e-3)


def test_a_move_to_where_one_is_takes_no_time_worth_speaking_of() -> None:
    assert 0.0 < move_duration(Q_HOME, Q_HOME, 1.0, 2.5) <= 0.1


class Loop:
    """The mover with an arm that does exactly what it is told."""

    def __init__(self, q_start: np.ndarray = Q_HOME) -> None:
        builder = DiagramBuilder()
        self.mover = builder.AddSystem(FlangeMover())
        self.arm = builder.AddSystem(Integrator(6))
        builder.Connect(self.mover.GetOutputPort("velocity"), self.arm.get_input_port())
        builder.Connect(self.arm.get_output_port(), self.mover.GetInputPort("position_measured"))
        builder.Connect(self.mover.GetOutputPort("velocity"), self.mover.GetInputPort("velocity_measured"))
        builder.ExportInput(self.mover.GetInputPort("job"), "job")
        self.sink = builder.AddSystem(VectorLogSink(6, 0.008))
        builder.Connect(self.mover.GetOutputPort("velocity"), self.sink.get_input_port())
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.arm.set_integral_value(self.arm.GetMyMutableContextFromRoot(self.context), q_start)
        self.tell(JobCommand())

    def tell(self, job: JobCommand) -> None:
        self.diagram.GetInputPort("job").FixValue(self.context, AbstractValue.Make(job))

    def run(self, duration: float) -> tuple[np.ndarray, int]:
        """Position (6,) and the settled goal after some more time."""
        self.simulator.AdvanceTo(self.context.get_time() + duration)
        context = self.mover.GetMyContextFromRoot(self.context)
        q = self.arm.get_output_port().Eval(self.arm.GetMyContextFromRoot(self.context))
        return np.array(q), int(self.mover.GetOutputPort("settled_goal").Eval(context)[0])

    def velocity(self) -> np.ndarray:
        return np.array(self.mover.GetOutputPort("velocity").Eval(self.mover.GetMyContextFromRoot(self.context)))


MOVE = JobCommand(phase="park", mode="move", goal_id=3, q_goal=GOAL)


def test_the_arm_comes_to_rest_at_its_goal_and_says_so_by_its_number() -> None:
    loop = Loop()
    loop.tell(MOVE)
    duration = move_duration(Q_HOME, GOAL, 1.0, 2.5)
    _, settled = loop.run(0.9 * duration)
    assert settled == 0
    q, settled = loop.run(0.1 * duration + 0.6)
    assert settled == 3
    assert q == pytest.approx(GOAL, abs=2e-4)


def test_the_speed_stays_within_its_limit() -> None:
    loop = Loop()
    loop.tell(MOVE)
    loop.run(2.0)
    data = loop.sink.FindLog(loop.context).data()
    # The feedback adds what one tick of delay leaves behind: 8 /s times 8 ms of the way.
    assert 0.5 < np.abs(data).max() < 1.0 * (1.0 + 8.0 * 0.008)


def test_it_stands_still_while_the_job_holds() -> None:
    loop = Loop()
    q, settled = loop.run(0.2)
    assert (q == Q_HOME).all()
    assert settled == 0


def test_a_hold_in_the_middle_stops_it_and_the_goal_is_not_called_reached() -> None:
    loop = Loop()
    loop.tell(MOVE)
    loop.run(0.4)
    assert np.abs(loop.velocity()).max() > 0.1
    loop.tell(dc.replace(MOVE, mode="hold", held=True))
    before, _ = loop.run(0.02)
    after, settled = loop.run(0.5)
    assert (after == before).all()
    assert settled == 0


def test_a_new_goal_starts_from_where_the_arm_is() -> None:
    loop = Loop()
    loop.tell(MOVE)
    loop.run(0.4)
    loop.tell(dc.replace(MOVE, goal_id=4, q_goal=Q_HOME))
    q, settled = loop.run(2.5)
    assert settled == 4
    assert q == pytest.approx(Q_HOME, abs=2e-4)


def settled(turns_rad_s: float) -> float:
    """The settled goal 3 s after a move to where the arm is, where each joint is measured to turn at 2 mrad/s, and
    swings about its goal at this speed.
    """
    mover = FlangeMover()
    simulator = Simulator(mover)
    context = simulator.get_mutable_context()
    job = JobCommand(mode="move", goal_id=7, q_goal=Q_HOME)
    mover.GetInputPort("job").FixValue(context, AbstractValue.Make(job))
    mover.GetInputPort("velocity_measured").FixValue(context, np.full(6, 2.0 * SETTLED_RAD_S))
    for t in np.arange(0.0, 3.0, 0.008):
        swing = 0.9 * SETTLED_RAD * np.sin(turns_rad_s / (0.9 * SETTLED_RAD) * t)
        mover.GetInputPort("position_measured").FixValue(context, Q_HOME + swing)
        simulator.AdvanceTo(t)
    return float(mover.GetOutputPort("settled_goal").Eval(context)[0])


def test_an_arm_whose_measured_velocity_is_noisy_is_at_rest_where_its_joints_stay() -> None:
    assert settled(0.0) == 7.0


def test_an_arm_that_swings_about_its_goal_is_not_at_rest() -> None:
    assert settled(10.0 * SETTLED_RAD_S) == 0.0
