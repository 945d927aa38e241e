"""A sensor's datum meets the pose of its own time, between samples too, and a time that is not remembered has no
pose."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.symbolic import Variable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import SymbolicVectorSystem

from tests.systems.cells import Q_HOME, the_arm
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.motion.buffers import PoseHistory, PoseRecorder

STEP = np.array([0.02, -0.01, 0.03, 0.0, 0.01, -0.02])
HISTORY = PoseHistory(np.array([1.0, 1.008, 1.016]), np.array([Q_HOME, Q_HOME + STEP, Q_HOME + 3.0 * STEP]))


@pytest.mark.parametrize(
    ("time", "steps"), [(1.0, 0.0), (1.004, 0.5), (1.008, 1.0), (1.012, 2.0), (1.014, 2.5), (1.016, 3.0)]
)
def test_between_two_samples_the_joints_are_where_a_straight_line_puts_them(time: float, steps: float) -> None:
    assert HISTORY.joints_at(time) == pytest.approx(Q_HOME + steps * STEP, abs=1e-12)


def test_the_flange_is_where_those_joints_put_it() -> None:
    X_BF = HISTORY.pose_at(the_arm(), 1.012)
    assert X_BF is not None
    assert X_BF.IsNearlyEqualTo(forward_kinematics(the_arm(), Q_HOME + 2.0 * STEP), 1e-12)


@pytest.mark.parametrize("time", [0.999, 0.0, -1.0, 1.0250, 2.0, np.inf, -np.inf, np.nan])
def test_a_time_outside_the_memory_has_no_pose(time: float) -> None:
    assert HISTORY.joints_at(time) is None
    assert HISTORY.pose_at(the_arm(), time) is None


def test_the_newest_motion_is_carried_on_by_at_most_one_sample() -> None:
    assert HISTORY.joints_at(1.020) == pytest.approx(Q_HOME + 4.0 * STEP)
    assert HISTORY.joints_at(1.0239) is not None


@pytest.mark.parametrize("count", [0, 1])
def test_less_than_two_samples_are_no_memory(count: int) -> None:
    assert PoseHistory(np.arange(float(count)), np.tile(Q_HOME, (count, 1))).joints_at(0.0) is None


def test_the_recorder_keeps_the_last_moments_in_order_and_forgets_the_rest() -> None:
    builder = DiagramBuilder()
    t = Variable("t")
    joints = builder.AddSystem(SymbolicVectorSystem(time=t, output=[t * (k + 1.0) for k in range(6)]))
    clock = builder.AddSystem(SymbolicVectorSystem(time=t, output=[t]))
    recorder = builder.AddSystem(PoseRecorder(period_s=0.01, length_s=0.2))
    builder.Connect(joints.get_output_port(), recorder.GetInputPort("position_measured"))
    builder.Connect(clock.get_output_port(), recorder.GetInputPort("sample_time"))
    builder.ExportOutput(recorder.GetOutputPort("history"), "history")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.005)
    history: PoseHistory = diagram.GetOutputPort("history").Eval(simulator.get_context())
    assert history.times == pytest.approx(np.arange(0.80, 1.001, 0.01), abs=1e-9)
    assert history.positions == pytest.approx(np.outer(history.times, np.arange(1.0, 7.0)))
    assert history.joints_at(0.855) == pytest.approx(0.855 * np.arange(1.0, 7.0))


def test_a_sample_that_comes_twice_is_kept_once() -> None:
    recorder = PoseRecorder(period_s=0.01)
    simulator = Simulator(recorder)
    context = simulator.get_mutable_context()
    recorder.GetInputPort("position_measured").FixValue(context, Q_HOME)
    for time, stamp in ((0.1, 0.5), (0.2, 0.6)):
        recorder.GetInputPort("sample_time").FixValue(context, [stamp])
        simulator.AdvanceTo(time)
    history: PoseHistory = recorder.GetOutputPort("history").Eval(context)
    assert history.times.tolist() == [0.5, 0.6]
