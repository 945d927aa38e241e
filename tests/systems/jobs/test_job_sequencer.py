"""The job goes through its phases in order, only when each is done; whatever goes wrong, it holds and says why, for
good."""

from __future__ import annotations

import dataclasses as dc
import re
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from tests.systems.cells import Q_HOME
from weldcal.calibration.eye_on_base.solve import CalibrationEstimate, HeldOut
from weldcal.systems.jobs.weld.iterative_calibrator import PoseRequest
from weldcal.systems.jobs.weld.job import SHARES
from weldcal.systems.jobs.weld.sequencer import PHASES, JobInputs, JobPlan, JobSequencer, JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import (
    CalibrationStatus,
    JobCommand,
    PlannedSeam,
    Scan,
    ScanView,
    UrStatus,
    VerificationResult,
)
from weldcal.systems.motion.drift_monitor import DriftStatus
from weldcal.welding.seam.curve import SeamCurve

PLAN = JobPlan(
    calibrate=True,
    weld=True,
    q_home=Q_HOME,
    maximum_scans=8,
    verification_scans=2,
    verification_limit_m=0.5e-3,
    required_error_m=0.1e-3,
    minimum_scans=6,
)
SEAM = SeamCurve.from_points(np.column_stack([np.linspace(0.0, 0.2, 20), np.zeros(20), np.zeros(20)]))
PLANNED = PlannedSeam(
    sequence=99, seam=SEAM, q_start=np.full(6, 0.1), q_above=np.full(6, 0.2), q_retract=np.full(6, 0.3)
)
ESTIMATE = CalibrationEstimate(
    X_BC=RigidTransform(),
    covariance=np.eye(6) * 1e-10,
    inliers=np.ones(4, bool),
    position_residuals_m=np.zeros(4),
    tilt_residuals_rad=np.zeros(4),
    held_out=HeldOut(np.zeros(4), np.zeros(4)),
    sigma_position_m=1e-4,
    sigma_normal_rad=1e-3,
    unobservable=(),
    warnings=(),
)


class World:
    """What the sequencer sees, changed by hand; time goes on by a tick at each look."""

    def __init__(self, plan: JobPlan = PLAN, state: JobState | None = None) -> None:
        self.system, self.plan = JobSequencer(plan), plan
        self.state, self.time = state or JobState(), 0.0
        self.now = JobInputs(
            time=0.0,
            robot=UrStatus(),
            settled_goal=0,
            q=Q_HOME,
            next_pose=PoseRequest(0, 0, "pose01", Q_HOME),
            calibration_status=CalibrationStatus(),
            planned_seam=PlannedSeam(),
            servo_report=ServoReport(),
        )

    @property
    def command(self) -> JobCommand:
        return self.system.command(self.state)

    @property
    def phase(self) -> str:
        return self.state.phase

    def look(self, duration: float = 0.02, **changes: Any) -> str:
        """Let the time pass, with one look at its end."""
        self.time += duration
        self.now = dc.replace(self.now, time=self.time, **changes)
        self.state = self.system.next_state(self.state, self.now)
        return self.phase

    def arrive(self) -> str:
        """The arm settles at the goal that stands and stays there for the dwell time."""
        self.look(1.0, settled_goal=self.command.goal_id)
        return self.look(self.plan.dwell_s + 0.01)

    def digest(self, **changes: Any) -> str:
        """The calibrator takes in the newest scan, and the pose planner looks at what it says."""
        n = self.command.scan_sequence
        counts = self.now.calibration_status.calibration_scans + int(self.command.scan_purpose == "calibrate")
        status = dc.replace(self.now.calibration_status, sequence=n, calibration_scans=counts, **changes)
        return self.look(
            0.3, calibration_status=status, next_pose=PoseRequest(n, n, f"pose{n + 1:02d}", np.full(6, 0.01 * n))
        )


def in_phase(phase: str, **command: Any) -> World:
    """A job in the middle of a phase."""
    return World(state=JobState(phase=phase, goal_id=5, trigger=4, **command))


def test_a_whole_job_goes_through_its_phases_in_order() -> None:
    world = World()
    assert world.look() == "move_to_pose"
    for k in range(6):
        assert world.arrive() == "scan_pose"
        assert (world.command.scan_sequence, world.command.scan_purpose) == (k + 1, "calibrate")
        assert world.digest(done=k == 5) == ("move_to_verify" if k == 5 else "move_to_pose")
    good = VerificationResult("pose08", 0.1e-3, 0.001)
    assert world.arrive() == "scan_verify"
    assert world.command.scan_purpose == "verify"
    assert world.digest(verifications=(good,)) == "move_to_verify"  # two were asked for
    assert world.arrive() == "scan_verify"
    assert world.digest(verifications=(good, good)) == "park"
    assert world.command.q_goal is Q_HOME
    assert world.arrive() == "scan_workpiece"
    assert world.command.scan_purpose == "workpiece"
    assert world.look(0.3, planned_seam=PLANNED) == "approach_above"
    assert world.command.q_goal is PLANNED.q_above
    assert world.arrive() == "approach"
    assert world.command.q_goal is PLANNED.q_start
    assert not world.command.process_on
    assert world.arrive() == "weld"
    assert (world.command.mode, world.command.process_on, world.command.streaming) == ("weld", True, True)
    assert world.look(5.0, servo_report=ServoReport(phase="TRACK", torch_on=True)) == "weld"
    assert world.look(20.0, servo_report=ServoReport(phase="DONE")) == "retract"
    assert (world.command.process_on, world.command.streaming) == (False, False)
    assert world.arrive() == "home"
    assert world.arrive() == "done"
    assert (world.command.mode, world.command.finished, world.command.held) == ("hold", True, False)
    passed = [phase for _, phase in world.state.log]
    others = {"move_home", "move_to_scan", "leave_scan", "interpass", "plan_pass", "plan_seam", "confirm"}
    assert {*PHASES, "done"} == {*passed, *others}, "it stood at home already, and one pass was ordered"


def test_each_pass_waits_for_its_plan_and_for_the_interpass_time() -> None:
    world = World(dc.replace(PLAN, interpass_s=(5.0, 40.0)), JobState(phase="weld", goal_id=5, process_on=True))
    planned = PLANNED
    for number in (1, 2):
        assert world.look(1.0, planned_seam=planned, servo_report=ServoReport(phase="DONE")) == "retract"
        out_s = world.time
        assert world.arrive() == "interpass"
        assert world.command.q_goal is PLAN.q_home
        assert world.arrive() == "plan_pass"
        assert world.command.weld_pass == number
        assert world.look(1.0, servo_report=ServoReport()) == "plan_pass", "the plan of the pass before is no plan"
        planned = dc.replace(PLANNED, weld_pass=number, q_above=np.full(6, 0.2 + number))
        while world.look(1.0, planned_seam=planned) == "plan_pass":
            pass
        assert world.phase == "approach_above"
        assert world.command.q_goal is planned.q_above
        assert world.time - out_s == pytest.approx((5.0, 40.0)[number - 1], abs=4.0)
        assert world.time - out_s >= (5.0, 40.0)[number - 1]
        assert world.arrive() == "approach"
        assert world.arrive() == "weld"
    assert world.look(1.0, servo_report=ServoReport(phase="DONE")) == "retract"
    assert world.arrive() == "home"


def test_a_pass_that_cannot_be_planned_holds_the_job() -> None:
    state = JobState(phase="plan_pass", goal_id=5, weld_pass=1)
    world = World(dc.replace(PLAN, interpass_s=(0.0,)), state)
    why = PlannedSeam(sequence=99, weld_pass=1, reason="welding.passes[1]: the arm does not reach it.")
    assert world.look(0.3, planned_seam=why) == "held"
    assert world.state.reason == why.reason
    assert [t for t, _ in world.state.log] == sorted(t for t, _ in world.state.log)


def test_a_part_is_scanned_from_each_pose_then_planned_once() -> None:
    poses = tuple(np.full(6, 0.1 * k) for k in (1, 2, 3))
    world = World(dc.replace(PLAN, calibrate=False, scan_poses=poses), JobState(phase="park", goal_id=5))
    assert world.arrive() == "move_to_scan"
    for k, pose in enumerate(poses):
        assert world.command.q_goal is pose
        assert world.arrive() == "scan_workpiece"
        assert (world.command.view, world.command.views, world.command.scan_sequence) == (k, 3, k + 1)
        view = ScanView(Scan(sequence=k + 1), RigidTransform())
        if k < 2:
            assert world.look(0.3, planned_seam=PlannedSeam(sequence=k + 1, views=(view,) * (k + 1))) == "move_to_scan"
        else:
            assert world.look(0.3, planned_seam=PLANNED) == "leave_scan"
    assert world.command.q_goal is Q_HOME  # from where the way to the seam is planned
    assert world.arrive() == "approach_above"


def test_a_broken_weld_waits_at_home_for_the_operators_yes() -> None:
    plan = dc.replace(PLAN, calibrate=False, first=(1, 2))
    world = World(plan, JobState(phase="scan_workpiece", goal_id=5, trigger=1, seam=1))
    asks = dc.replace(PLANNED, question="Start?")
    assert world.look(0.3, planned_seam=asks) == "confirm"
    assert world.look(60.0) == "confirm", "no time is an answer"
    assert (world.command.question, world.command.mode, world.command.process_on) == ("Start?", "hold", False)
    assert world.look(0.1, answered=1.0) == "approach_above"
    assert world.command.question == ""


def test_a_broken_weld_begins_with_its_seam_and_only_at_home() -> None:
    system = JobSequencer(dc.replace(PLAN, calibrate=False)).begun_at(1, 2)
    first = system.state_in(system.CreateDefaultContext())
    assert (first.seam, first.piece) == (1, 2)
    away = World(dc.replace(PLAN, calibrate=False, first=(0, 0)))
    assert away.look(q=Q_HOME + 0.2) == "held"
    assert "with the pendant" in (away.command.reason or "")
    assert World(dc.replace(PLAN, calibrate=False)).look(q=Q_HOME + 0.2) == "move_home"


def test_a_scan_without_the_arms_pose_holds_the_job_at_once() -> None:
    plan = dc.replace(PLAN, calibrate=False, scan_poses=(np.zeros(6), np.ones(6)))
    world = World(plan, JobState(phase="scan_workpiece", goal_id=5, trigger=1))
    assert world.look(0.3, planned_seam=PlannedSeam(sequence=1, reason="The arm's pose is not known.")) == "held"
    assert world.command.reason == "The arm's pose is not known."


def test_every_seam_is_scanned_planned_and_welded_in_turn() -> None:
    world = World(dc.replace(PLAN, calibrate=False, seams=2))
    assert world.look() == "park"
    for number in (0, 1):
        assert world.arrive() == "scan_workpiece"
        assert (world.command.seam, world.command.scan_sequence) == (number, number + 1)
        assert world.look(0.3) == "scan_workpiece", "the plan of the seam before is no plan"
        assert world.look(0.3, planned_seam=dc.replace(PLANNED, sequence=number + 1)) == "approach_above"
        assert world.arrive() == "approach"
        assert world.arrive() == "weld"
        assert world.look(20.0, servo_report=ServoReport(phase="DONE")) == "retract"
        assert world.arrive() == ("home" if number else "park")
        world.now = dc.replace(world.now, servo_report=ServoReport())
    assert world.arrive() == "done"


@pytest.mark.parametrize("free", [True, False])
def test_the_next_seam_of_the_order_is_planned_where_the_arm_is(free: bool) -> None:
    plan = dc.replace(PLAN, calibrate=False, order=(2, 0, 1), direct=True)
    begun = JobSequencer(plan)
    world = World(plan, begun.state_in(begun.CreateDefaultContext()))
    world.look()
    world.arrive()
    assert world.command.seam == 2
    assert world.look(0.3, planned_seam=dc.replace(PLANNED, sequence=1, number=2)) == "approach_above"
    for number in (0, 1):
        world.arrive()
        assert world.arrive() == "weld"
        assert world.look(20.0, servo_report=ServoReport(phase="DONE")) == "retract"
        assert world.arrive() == "plan_seam"
        assert (world.command.mode, world.command.seam, world.command.scan_sequence) == ("hold", number, 1)
        assert world.look(1.0, servo_report=ServoReport()) == "plan_seam", "the plan of the seam before is no plan"
        planned = dc.replace(PLANNED, sequence=1, number=number, direct=free)
        assert world.look(1.0, planned_seam=planned) == ("approach_above" if free else "leave_scan")
        if not free:
            assert world.command.q_goal is Q_HOME
            assert world.arrive() == "approach_above"
    world.arrive()
    world.arrive()
    world.look(20.0, servo_report=ServoReport(phase="DONE"))
    assert world.arrive() == "home"


@pytest.mark.parametrize("unfelt", [(), (0,), (1,)])
def test_a_seam_that_only_the_scan_locates_is_scanned_again(unfelt: tuple[int, ...]) -> None:
    world = World(dc.replace(PLAN, calibrate=False, seams=2, order=(0, 1), direct=True, unfelt=unfelt))
    world.look()
    world.arrive()
    assert world.look(0.3, planned_seam=dc.replace(PLANNED, sequence=1)) == "approach_above"
    world.arrive()
    world.arrive()
    assert world.look(20.0, servo_report=ServoReport(phase="DONE")) == "retract"
    assert world.arrive() == ("park" if 1 in unfelt else "plan_seam")
    if 1 in unfelt:
        assert world.arrive() == "scan_workpiece"
        assert (world.command.seam, world.command.scan_sequence) == (1, 2)


@pytest.mark.parametrize("calibrate", [True, False])
def test_an_arm_that_stands_elsewhere_goes_home_first(calibrate: bool) -> None:
    world = World(dc.replace(PLAN, calibrate=calibrate))
    assert world.look(q=Q_HOME + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.02])) == "move_home"
    assert (world.command.mode, world.command.process_on) == ("move", False)
    assert world.command.q_goal is Q_HOME
    before = world.command.goal_id
    assert world.arrive() == ("move_to_pose" if calibrate else "park")
    assert world.command.goal_id == before + 1


def test_a_job_that_only_calibrates_ends_at_home() -> None:
    world = World(dc.replace(PLAN, weld=False, verification_scans=1), in_phase("scan_verify").state)
    assert world.digest(verifications=(VerificationResult("pose08", 0.1e-3, 0.001),)) == "park"
    assert world.arrive() == "done"
    assert world.command.finished


def test_a_job_that_only_welds_goes_home_first() -> None:
    world = World(dc.replace(PLAN, calibrate=False))
    assert world.look() == "park"
    assert world.arrive() == "scan_workpiece"


def test_each_move_has_a_new_number_and_the_old_ones_arrival_does_not_count() -> None:
    world = World()
    world.look()
    world.arrive()
    before = world.command.goal_id
    world.digest()
    assert world.command.goal_id == before + 1
    assert world.look(1.0, settled_goal=before) == "move_to_pose"
    assert world.look(1.0, settled_goal=before) == "move_to_pose"


def test_it_waits_for_the_arm_to_have_been_still_for_its_dwell_time() -> None:
    world = in_phase("move_to_pose")
    assert world.look(1.0, settled_goal=5) == "move_to_pose"
    assert world.look(0.2, settled_goal=5) == "move_to_pose"
    assert world.look(0.02, settled_goal=4) == "move_to_pose"  # it moved again: the wait starts anew
    assert world.look(0.2, settled_goal=5) == "move_to_pose"
    assert world.look(0.2, settled_goal=5) == "move_to_pose"
    assert world.look(0.2, settled_goal=5) == "scan_pose"


def test_it_does_not_go_to_a_pose_that_was_chosen_before_the_newest_scan() -> None:
    world = in_phase("scan_pose", purpose="calibrate")
    old = PoseRequest(3, 3, "pose04", Q_HOME)
    assert world.look(0.1, calibration_status=CalibrationStatus(sequence=4), next_pose=old) == "scan_pose"
    assert world.look(0.1, next_pose=PoseRequest(4, 4, "pose05", Q_HOME)) == "move_to_pose"


def test_the_camera_streams_before_the_tip_touches() -> None:
    world = in_phase("approach")
    world.look()
    assert world.command.streaming
    assert world.phase == "approach"


def status(**changes: Any) -> CalibrationStatus:
    return CalibrationStatus(sequence=4, **changes)


NO_POSE = PoseRequest(4, 14, "pose15", None)
HOLDS: dict[str, tuple[str, float, dict[str, Any], str]] = {
    "protective stop": (
        "weld",
        0.1,
        {"robot": UrStatus(safety_mode="PROTECTIVE_STOP")},
        "The robot stopped: PROTECTIVE",
    ),
    "robot fault": ("park", 0.1, {"robot": UrStatus(fault="WALL: it hit a wall.")}, "^WALL: it hit a wall.$"),
    "a singular arm": ("weld", 0.1, {"arm_stopped": 1.0}, "too near to a singular position"),
    "the operator's wish": ("weld", 0.1, {"hold": True}, "The operator ended the job in phase 'weld'"),
    "time is up": ("weld", 241.0, {}, "took longer than its 240 s, in the phase 'weld'"),
    "goal not reached": ("move_to_pose", 21.0, {}, "did not come to rest at its goal within 20 s"),
    "unseen pose not reached": ("move_to_verify", 21.0, {}, "did not come to rest at its goal within 20 s"),
    "no scan": ("scan_pose", 9.0, {}, "No scan arrived within 8 s"),
    "no verification scan": ("scan_verify", 9.0, {}, "No scan arrived within 8 s"),
    "no workpiece scan": ("scan_workpiece", 9.0, {}, "No workpiece scan arrived within 8 s"),
    "no more poses": (
        "scan_pose",
        0.1,
        {"calibration_status": status(), "next_pose": NO_POSE},
        "free more of the workspace\\.$",
    ),
    "no more poses after refused scans": (
        "scan_pose",
        0.1,
        {"calibration_status": status(refused=(("pose03", "it is too dark"),) * 3), "next_pose": NO_POSE},
        r"poses are used up: .* Scans that could not be used: 3\. The last one: it is too dark",
    ),
    "required error not reached": (
        "scan_pose",
        0.1,
        {"calibration_status": status(calibration_scans=8, estimate=ESTIMATE, predicted_error_m=0.234e-3)},
        r"did not reach the required 0\.100 mm: after 8 scans it expects 0\.234 mm",
    ),
    "required error reached from too few usable scans": (
        "scan_pose",
        0.1,
        {"calibration_status": status(calibration_scans=8, estimate=ESTIMATE, predicted_error_m=0.023e-3)},
        (
            r"^Only 0 of 8 scans could be used, and the calibration needs 6 .*0\.023 mm at the work point, within the"
            r" required 0\.100 mm"
        ),
    ),
    "no calibration at all": (
        "scan_pose",
        0.1,
        {"calibration_status": status(calibration_scans=8, refused=(("pose01", "it is too dark"),))},
        "No calibration after 8 scans: it is too dark",
    ),
    "no calibration from good scans": (
        "scan_pose",
        0.1,
        {"calibration_status": status(calibration_scans=8, message="they lie in one plane")},
        "No calibration after 8 scans: they lie in one plane",
    ),
    "off at the held-out pose": (
        "scan_verify",
        0.1,
        {
            "calibration_status": status(
                verifications=(VerificationResult("pose08", 0.9e-3, 0.0), VerificationResult("pose09", 0.1e-3, 0.0))
            )
        },
        r"0\.90 mm off at the held-out pose 'pose08' \(limit 0\.50 mm\)",
    ),
    "no calibration to verify": (
        "scan_verify",
        0.1,
        {"calibration_status": status(verifications=(VerificationResult("pose08", np.inf, np.inf),) * 2)},
        "inf mm off at the held-out pose",
    ),
    "workpiece not found": (
        "scan_workpiece",
        0.1,
        {"planned_seam": PlannedSeam(sequence=4, reason="The plate is not there.")},
        "The plate is not there",
    ),
    "no seam and no reason": (
        "scan_workpiece",
        0.1,
        {"planned_seam": PlannedSeam(sequence=4)},
        "No seam could be planned",
    ),
    "weld fault": (
        "weld",
        0.1,
        {"servo_report": ServoReport(phase="FAULT", reason="Tag hidden: clean it.")},
        "Tag hidden",
    ),
    "weld fault without a reason": (
        "weld",
        0.1,
        {"servo_report": ServoReport(phase="FAULT")},
        "The welding servo stopped",
    ),
}


@pytest.mark.parametrize("name", list(HOLDS))
def test_it_holds_and_says_why(name: str) -> None:
    phase, duration, changes, said = HOLDS[name]
    world = in_phase(phase, process_on=phase == "weld")
    assert world.look(duration, **changes) == "held"
    command = world.command
    assert (command.mode, command.process_on, command.held, command.finished) == ("hold", False, True, True)
    assert re.search(said, command.reason or ""), command.reason


def test_every_phase_that_waits_for_something_can_end_in_a_hold() -> None:
    for phase in PHASES:
        world = in_phase(phase)
        assert world.look(PLAN.maximum_time_s + 1.0) == "held", phase
        assert phase in (world.command.reason or "")


def test_a_held_job_stays_held_when_the_cause_is_gone() -> None:
    world = in_phase("weld", process_on=True)
    world.look(0.1, robot=UrStatus(fault="stopped"))
    held = world.state
    world.look(5.0, robot=UrStatus(), settled_goal=5, servo_report=ServoReport(phase="DONE"))
    assert world.state is held


def test_a_finished_job_stays_finished() -> None:
    world = World(state=JobState(phase="done"))
    done = world.state
    world.look(500.0, robot=UrStatus(fault="stopped"))
    assert world.state is done


def test_the_system_passes_its_command_on_to_everyone() -> None:
    system = JobSequencer(dc.replace(PLAN, calibrate=False))
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in {
        "robot_status": UrStatus(),
        "next_pose": PoseRequest(),
        "calibration_status": CalibrationStatus(),
        "planned_seam": PlannedSeam(),
        "servo_report": ServoReport(),
    }.items():
        system.GetInputPort(name).FixValue(context, AbstractValue.Make(value))
    system.GetInputPort("position_measured").FixValue(context, Q_HOME)
    system.GetInputPort("settled_goal").FixValue(context, [0.0])
    system.GetInputPort("hold").FixValue(context, [0.0])
    system.GetInputPort("arm_stopped").FixValue(context, [0.0])
    simulator.AdvanceTo(0.05)
    job: JobCommand = system.GetOutputPort("job").Eval(context)
    assert (job.phase, job.goal_id) == ("park", 1)
    assert system.GetOutputPort("scan_trigger").Eval(context)[0] == 0.0
    system.GetInputPort("settled_goal").FixValue(context, [1.0])
    simulator.AdvanceTo(0.5)
    assert system.GetOutputPort("job").Eval(context).phase == "scan_workpiece"
    assert system.GetOutputPort("scan_trigger").Eval(context)[0] == 1.0
    assert system.GetOutputPort("streaming").Eval(context)[0] == 0.0
    state: JobState = system.GetOutputPort("job_state").Eval(context)
    assert state is system.state_in(context)
    assert [phase for _, phase in state.log] == ["start", "park", "scan_workpiece"]
    system.GetInputPort("hold").FixValue(context, [1.0])
    simulator.AdvanceTo(0.55)
    assert system.GetOutputPort("job").Eval(context).held


def test_the_progress_told_of_a_run_never_falls_from_phase_to_phase() -> None:
    told = [SHARES[phase] for phase in PHASES if phase in SHARES]
    assert told == sorted(told)
    assert set(PHASES) - set(SHARES) == {"scan_pose"}, "these and move_to_pose are told by the number of scans"


def test_a_scanner_that_moved_holds_the_job_before_the_weld_and_warns_during_it() -> None:
    moved = DriftStatus(alarmed=True)
    world = World()
    world.look(drift=moved)
    assert world.phase == "held"
    assert world.state.reason == moved.summary
    welding = JobState(phase="weld", process_on=True)
    world = World(state=welding)
    world.look(drift=moved)
    assert world.phase == "weld"
    assert world.state.warnings == (moved.summary,)
    world.look(drift=moved)
    assert world.state.warnings == (moved.summary,)
    world.look(drift=DriftStatus())
    assert world.state.warnings == (moved.summary,)
