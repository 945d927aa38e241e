"""The base of the jobs' procedures: phases, timeouts, the operator, and descents that the arm guard slows and stops."""

from __future__ import annotations

import dataclasses as dc
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from tests.systems.cells import Q_HOME, TOOL, the_arm
from weldcal.models.arms.kinematics import jacobian
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.jobs.procedure import SLOWED, Inputs, Procedure, ProcedureState
from weldcal.systems.jobs.profiler.config import ProfilerJob
from weldcal.systems.jobs.profiler.plan import Goal, JointPath, PlanningContext
from weldcal.systems.jobs.profiler.procedure import ProfilerProcedure, ProfilerState
from weldcal.systems.jobs.tablet.config import TabletTouch, WristPicture
from weldcal.systems.jobs.tablet.procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.jobs.touch.planner import PlannedTouches, TouchPlace
from weldcal.systems.jobs.touch.procedure import TouchMotion, TouchProcedure, TouchState
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.messages import ProfileScan, TorchTouch, UrStatus
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.welding.servo.guards import SPEED_SHARE

DOWN = np.array([0.0, 0.0, -1.0])
ASLANT = np.array([0.48, 0.64, -0.6])
PEN = np.array([0.0, -0.022, 0.165])


def bent(joint: int, angle: float) -> np.ndarray:
    """Home, with one joint at another angle: the fifth at 0 and the third at 0 are singular."""
    q = Q_HOME.copy()
    q[joint] = angle
    return q


WRIST, ELBOW = bent(4, 0.002), bent(2, 0.002)


class Descent:
    """A procedure by itself in the middle of a descent, with the arm at given joints."""

    def __init__(self, system: Any, state: ProcedureState, p_FP: np.ndarray, way: np.ndarray, **inputs: Any) -> None:
        self.system, self.p_FP, self.way = system, p_FP, way
        self.simulator = Simulator(system)
        self.context = self.simulator.get_mutable_context()
        self.context.SetAbstractState(0, state)
        self.tell(settled_goal=[0.0], hold=[0.0], robot_status=UrStatus(), history=PoseHistory())
        self.tell(**inputs)

    def tell(self, **inputs: Any) -> None:
        for name, value in inputs.items():
            if self.system.HasInputPort(name):
                fixed = value if isinstance(value, list | np.ndarray) else AbstractValue.Make(value)
                self.system.GetInputPort(name).FixValue(self.context, fixed)

    def at(self, q: np.ndarray) -> np.ndarray:
        """Joint velocity (6,) rad/s after a tick with the arm at ``q``."""
        self.tell(position=q, position_measured=q)
        self.simulator.AdvanceTo(self.context.get_time() + 0.01)
        return np.array(self.system.GetOutputPort(self.system.velocity_port).Eval(self.context))

    def plain(self, q: np.ndarray) -> np.ndarray:
        """The solution of the Jacobian's equations there."""
        twist = np.concatenate([np.zeros(3), 0.02 * self.way])
        return np.asarray(np.linalg.solve(jacobian(the_arm(), q, self.p_FP), twist))

    @property
    def state(self) -> ProcedureState:
        found: ProcedureState = self.system.state_in(self.context)
        return found


def tablet() -> Descent:
    plan = TabletPlan(
        q_look=Q_HOME, q_above=np.array([Q_HOME]), q_home=Q_HOME, p_FP=PEN, descent_m_s=0.02, longest_descent_s=0.05
    )
    state = TabletState(phase="descend")
    return Descent(TabletProcedure(the_arm(), plan), state, PEN, DOWN, picture=WristPicture(), touch=TabletTouch())


def touch() -> Descent:
    motion = TouchMotion(
        q_home=Q_HOME, descent_m_s=0.02, press_m=1e-3, deepest_m=9.0, move_timeout_s=20.0, maximum_time_s=99.0
    )
    place = TouchPlace(Q_HOME, np.zeros(3), -ASLANT, 1e-5, np.zeros(3), -ASLANT)
    state = TouchState(phase="descend", places=(place,), zero=np.zeros(3))
    p_FT = np.array(TOOL.X_FT.translation())
    told = {"planned_touches": PlannedTouches(), "deformation": Deformation()}
    return Descent(TouchProcedure(the_arm(), TOOL, motion), state, p_FT, ASLANT, **told)


def planning() -> PlanningContext:
    job = ProfilerJob(stages=["sphere"])
    job.sphere.descent_mm_s = 20.0
    tip, ball = np.array(job.torch.tip_m), np.array(job.ball.xyz_m)
    return PlanningContext(arm=the_arm(), job=job, q_home=Q_HOME, X_FS=RigidTransform(), p_FTip=tip, center=ball)


def profiler(goal: Goal | None = None) -> Descent:
    plan = planning()
    goals = (goal or Goal("touch", Q_HOME, way=ASLANT),)
    phase = "descend" if goal is None else "run"
    state = ProfilerState(phase=phase, step="touch", goals=goals, planning=plan)
    procedure = ProfilerProcedure(plan, RenderedProfiler(), 0)
    return Descent(procedure, state, plan.p_FTip, ASLANT, profile=ProfileScan(), touch=TorchTouch())


every_descent = pytest.mark.parametrize("made", [tablet, touch, profiler])


# with the wrist stretched, straight down is no singular direction
@pytest.mark.parametrize(
    ("made", "q"),
    [(tablet, ELBOW), (touch, ELBOW), (touch, WRIST), (profiler, ELBOW), (profiler, WRIST)],
    ids=["tablet-elbow", "touch-elbow", "touch-wrist", "profiler-elbow", "profiler-wrist"],
)
def test_a_descent_at_a_singular_position_holds_with_a_reason(made: Callable[[], Descent], q: np.ndarray) -> None:
    descent = made()
    assert np.abs(descent.plain(q)).max() > 3.0, "without the guard the joints would be this fast, rad/s"
    assert not descent.at(q).any()
    assert descent.state.held
    assert "too near to a singular position in the phase" in descent.state.reason
    assert not descent.at(Q_HOME).any(), "a hold stays"


@every_descent
def test_a_descent_near_a_singular_position_is_slowed_on_its_line(made: Callable[[], Descent]) -> None:
    descent, q = made(), bent(4, 0.12)
    v, plain = descent.at(q), descent.plain(q)
    share = np.abs(v).max() / np.abs(plain).max()
    assert 0.0 < share < 0.9
    np.testing.assert_allclose(v, share * plain, atol=1e-9)
    assert np.all(np.abs(v) <= SPEED_SHARE * the_arm().velocity_limit)
    assert descent.state.phase == "descend"
    assert descent.state.slowed == SLOWED


def test_a_slowed_descent_that_meets_nothing_names_the_cause() -> None:
    descent = tablet()
    for _ in range(8):
        descent.at(bent(4, 0.12))
    assert descent.state.phase == "lift"
    assert descent.state.reason.endswith(SLOWED)


@every_descent
def test_away_from_singular_positions_a_descent_is_as_the_jacobian_says(made: Callable[[], Descent]) -> None:
    descent = made()
    np.testing.assert_array_equal(descent.at(Q_HOME), descent.plain(Q_HOME))
    assert descent.state.slowed == ""


def test_a_path_at_a_singular_position_holds_with_a_reason() -> None:
    ways = {"free": np.array([Q_HOME, Q_HOME + 1e-3]), "wrist": np.array([WRIST, WRIST + 1e-3])}
    for name, q in ways.items():
        path = JointPath(np.array([0.0, 0.1]), q, 0.02)
        run = profiler(Goal("torch", q[0], path=path))
        run.at(q[0])
        assert run.state.held == (name == "wrist"), name
    assert "too near to a singular position in the phase 'touch'" in run.state.reason


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ScanInputs(Inputs):
    scan: float


class OneScan(Procedure[ProcedureState, ScanInputs]):
    """A job of one file: to home, one scan, done."""

    inputs = ScanInputs
    moves = ("home",)

    def __init__(self) -> None:
        super().__init__(
            ProcedureState(), move_timeout_s=5.0, maximum_time_s=60.0, timeouts={"scan": (2.0, "No scan arrived.")}
        )
        self.read(scan=0.0)

    def _start(self, s: ProcedureState, now: ScanInputs) -> ProcedureState:
        return self.go(s, now, "home", Q_HOME)

    def _at_home(self, s: ProcedureState, now: ScanInputs) -> ProcedureState:
        return self.request(s, now, "scan")

    def _scanned(self, s: ProcedureState, now: ScanInputs) -> ProcedureState:
        if now.scan < 0.0:
            raise InputError("The scan is empty.")
        return self.enter(s, now, "done") if now.scan >= s.trigger else s

    steps: ClassVar = {"start": _start, "home": _at_home, "scan": _scanned}


def inputs(time: float, **changes: Any) -> ScanInputs:
    given: dict[str, Any] = {"settled_goal": 0, "robot": UrStatus(), "q": Q_HOME, "scan": 0.0, **changes}
    return ScanInputs(time=time, **given)


def test_a_job_is_its_phases_and_what_it_reads() -> None:
    job = OneScan()
    s = job.next_state(ProcedureState(), inputs(0.0))
    assert (s.phase, s.goal_id, job.command(s).mode) == ("home", 1, "move")
    s = job.next_state(s, inputs(1.0, settled_goal=1))
    assert (s.phase, s.trigger, job.command(s).mode) == ("scan", 1, "hold")
    assert job.next_state(s, inputs(1.1)) is s
    s = job.next_state(s, inputs(1.2, scan=1.0))
    assert (s.phase, s.finished, s.held) == ("done", True, False)


@pytest.mark.parametrize(
    ("phase", "changes", "reason"),
    [
        ("home", {"time": 5.1}, "The arm did not come to rest at its goal within 5 s."),
        ("scan", {"time": 2.1}, "No scan arrived."),
        ("scan", {"scan": -1.0}, "The scan is empty."),
        ("scan", {"hold": True}, "The operator ended the job in phase 'scan'."),
        ("scan", {"robot": UrStatus(fault="It stopped.")}, "It stopped."),
        ("scan", {"robot": UrStatus(safety_mode="PROTECTIVE_STOP")}, "The robot stopped: PROTECTIVE_STOP."),
        ("scan", {"robot": UrStatus(program_running=False)}, "The robot does not obey velocity commands."),
        (
            "start",
            {"time": 60.1},
            "The job took longer than its 60 s, in the phase 'start': allow more with job.maximum_time_s.",
        ),
    ],
)
def test_what_goes_wrong_in_any_job_holds_it_with_one_reason(phase: str, changes: dict[str, Any], reason: str) -> None:
    job = OneScan()
    s = job.next_state(ProcedureState(phase=phase, goal_id=1, trigger=1), inputs(**{"time": 0.1, **changes}))
    assert (s.phase, s.reason) == ("held", reason)
    assert job.next_state(s, inputs(9.0)) is s
