"""A scan of the workpiece becomes the line on which the tip will run, with an arm's way to it; or a reason why not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator

from tests.systems.cells import EXACT_PLATE, Q_HOME, SMALL_IDEAL_SCANNER, TOOL, Drive, plain_station, scenario, the_arm
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.background import Answer
from weldcal.systems.jobs.weld.arm_way import SeamOutOfReach, arm_waypoints
from weldcal.systems.jobs.weld.seam_planner import SeamPlanner
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning, plan_drawn_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import CalibrationStatus, JobCommand, PlannedSeam, Scan, ScanView
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.welding.locate.planning import PlanningMethod, tip_seam
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.touch import touch_start_pose

STRAIGHT = make_workpiece("straight", length_m=0.200)
X_BP = RigidTransform(RollPitchYaw(0.0, 0.0, np.pi / 2), [0.65, 0.0, 0.02])
JOB = JobCommand(scan_sequence=1, scan_purpose="workpiece", scan_label="workpiece")
CLEARANCE_M = 0.025


@pytest.fixture(scope="module")
def config() -> ServoConfig:
    return servo_config(scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE), plain_station())


@pytest.fixture(scope="module")
def workpiece_scan() -> Scan:
    """What the ideal scanner sees of the straight plate from its place above, the arm parked out of its sight."""
    drive = Drive(plain_station())
    drive.place_arm(Q_HOME)
    drive.set("scanner.trigger", [1.0])
    drive.run(0.15)
    scan: Scan = drive.get("scanner.scan")
    return scan


def planned(
    scan: Scan,
    config: ServoConfig,
    job: JobCommand = JOB,
    X_BC: RigidTransform | None = None,
    offset_m: float = 0.0,
    method: PlanningMethod | None = None,
    then: JobCommand | None = None,
) -> PlannedSeam:
    """What the system makes of one scan; the guess of the plate's place is off by some millimetres and a degree.

    then: of the job afterwards, for the answer of another kind.
    """
    error = RigidTransform(RollPitchYaw(0.0, 0.0, np.radians(1.0)), [0.004 + offset_m, -0.003, 0.0])
    planning = SeamPlanning(
        arm=the_arm(),
        tool=TOOL,
        workpiece=STRAIGHT,
        X_BP_guess=X_BP @ error,
        config=config,
        q_near=Q_HOME,
        clearance_m=CLEARANCE_M,
        seam_length_m=0.1,
        method=method or PlanningMethod(),
        keeps_scan=then is not None,
    )
    system = SeamPlanner(planning, X_BC)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in {"scan": scan, "job": job, "calibration_status": CalibrationStatus()}.items():
        system.GetInputPort(name).FixValue(context, AbstractValue.Make(value))
    simulator.AdvanceTo(0.01)
    if then is not None:
        system.GetInputPort("job").FixValue(context, AbstractValue.Make(then))
        simulator.AdvanceTo(0.05)
    answer: PlannedSeam = system.GetOutputPort("planned_seam").Eval(context)
    return answer


@pytest.fixture(scope="module")
def plan(workpiece_scan: Scan, config: ServoConfig) -> PlannedSeam:
    return planned(workpiece_scan, config, X_BC=plain_station().truth.X_BC)


def test_the_tips_line_runs_above_the_root_as_high_as_the_tip_sits() -> None:
    seam = tip_seam(STRAIGHT, X_BP, TOOL, None)
    height = STRAIGHT.tip_height(TOOL.tip_radius_m) - TOOL.seat_sink_m
    root = (X_BP @ STRAIGHT.seam_P.T).T
    gap = np.asarray(seam.position(np.array([0.0, 0.5 * seam.length, seam.length]))) - root[[0, len(root) // 2, -1]]
    assert gap == pytest.approx(np.tile([0.0, 0.0, height], (3, 1)), abs=3e-4)  # the curve is sampled anew
    assert gap[:, 2] == pytest.approx(height, abs=1e-9)
    assert seam.length == pytest.approx(STRAIGHT.length_m, abs=1e-6)
    assert seam.frame(0.05).tangent == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)


def test_a_weld_may_take_only_a_part_of_the_seam() -> None:
    assert tip_seam(STRAIGHT, X_BP, TOOL, 0.060).length == pytest.approx(0.060, abs=1e-3)


def test_a_seam_too_short_to_be_touched_is_refused_before_the_arm_goes_there(config: ServoConfig) -> None:
    planning = SeamPlanning(
        arm=the_arm(),
        tool=TOOL,
        workpiece=STRAIGHT,
        X_BP_guess=X_BP,
        config=config,
        q_near=Q_HOME,
        clearance_m=CLEARANCE_M,
        seam_length_m=0.001,
    )
    found = plan_drawn_seam(planning, 1)
    assert found.seam is None
    assert "only 1 mm long: too short for the touch-on" in str(found.reason)


def test_the_line_lies_on_the_side_of_the_plate_that_is_up() -> None:
    tilted = X_BP @ RigidTransform(RollPitchYaw(0.1, 0.0, 0.0), np.zeros(3))
    assert tip_seam(STRAIGHT, tilted, TOOL, None).frame(0.1).up == pytest.approx(
        tilted.rotation().matrix()[:, 2], abs=1e-6
    )


def test_the_waypoints_put_the_tool_where_the_touch_begins_above_it_and_above_the_end(config: ServoConfig) -> None:
    seam = tip_seam(STRAIGHT, X_BP, TOOL, None)
    q_start, q_above, q_retract = arm_waypoints(the_arm(), TOOL, seam, config, Q_HOME, CLEARANCE_M)
    start, above, end = (forward_kinematics(the_arm(), q) @ TOOL.X_FT for q in (q_start, q_above, q_retract))
    assert start.IsNearlyEqualTo(touch_start_pose(seam, config), 1e-6)
    assert above.translation() - start.translation() == pytest.approx([0.0, 0.0, CLEARANCE_M], abs=1e-6)
    assert above.rotation().matrix() == pytest.approx(start.rotation().matrix(), abs=1e-6)
    lifted = end.translation() - seam.frame(seam.length).position
    assert lifted == pytest.approx([0.0, 0.0, CLEARANCE_M + 0.05], abs=1e-6)


def test_the_way_down_is_one_short_motion_of_the_same_arm_configuration(config: ServoConfig) -> None:
    q_start, q_above, _ = arm_waypoints(the_arm(), TOOL, tip_seam(STRAIGHT, X_BP, TOOL, None), config, Q_HOME, 0.025)
    assert np.abs(q_start - q_above).max() < 0.1


def test_a_seam_out_of_reach_is_refused_in_one_sentence(config: ServoConfig) -> None:
    far = RigidTransform(X_BP.rotation(), [1.6, 0.0, 0.02])
    seam: SeamCurve = tip_seam(STRAIGHT, far, TOOL, None)
    with pytest.raises(SeamOutOfReach, match="move the workpiece towards the robot"):
        arm_waypoints(the_arm(), TOOL, seam, config, Q_HOME, CLEARANCE_M)


def test_the_plate_is_found_where_it_lies_and_the_seam_with_it(plan: PlannedSeam) -> None:
    assert plan.reason is None
    assert plan.X_BP is not None
    # An ideal scanner with pixels of 2 mm on a flat plate: in its plane the edges fix it to a quarter of a pixel.
    assert plan.X_BP.translation() == pytest.approx(X_BP.translation(), abs=0.5e-3)
    assert plan.X_BP.translation()[2] == pytest.approx(0.02, abs=0.1e-3)
    assert np.degrees((plan.X_BP.rotation().inverse() @ X_BP.rotation()).ToAngleAxis().angle()) < 0.3
    assert plan.seam is not None
    expected = tip_seam(STRAIGHT, plan.X_BP, TOOL, 0.1)
    assert plan.seam.length == pytest.approx(expected.length)
    assert plan.seam.frame(0.05).position == pytest.approx(expected.frame(0.05).position)
    assert plan.sequence == 1
    assert plan.rms_m < 0.5e-3


def test_the_plan_holds_the_arms_way_to_it(plan: PlannedSeam, config: ServoConfig) -> None:
    assert plan.seam is not None
    expected = arm_waypoints(the_arm(), TOOL, plan.seam, config, Q_HOME, CLEARANCE_M)
    assert plan.q_start == pytest.approx(expected[0])
    assert plan.q_above == pytest.approx(expected[1])
    assert plan.q_retract == pytest.approx(expected[2])


def test_the_next_seam_is_planned_from_the_same_scan(
    workpiece_scan: Scan, config: ServoConfig, plan: PlannedSeam
) -> None:
    X_BC = plain_station().truth.X_BC
    then = replace(JOB, phase="plan_seam", seam=1)
    found = planned(workpiece_scan, config, X_BC=X_BC, then=then)
    assert (found.key, [record.seam for record in found.records]) == ((1, 1, 0), [0, 1])
    assert found.direct, "above the plate nothing is in the way"
    assert found.seam is not None
    assert plan.seam is not None
    assert found.seam.position(0.05) == pytest.approx(plan.seam.position(0.05), abs=1e-9)
    assert (plan.key, plan.direct) == ((1, 0, 0), False)


def test_the_plan_states_what_errors_of_the_arm_do(plan: PlannedSeam, config: ServoConfig) -> None:
    """The same of a scanned and of a drawn seam; less where a refinement has found the links' errors."""
    planning = SeamPlanning(
        arm=the_arm(),
        tool=TOOL,
        workpiece=STRAIGHT,
        X_BP_guess=X_BP,
        config=config,
        q_near=Q_HOME,
        clearance_m=CLEARANCE_M,
        seam_length_m=0.1,
    )
    drawn = plan_drawn_seam(replace(planning, number=1), 1)
    assert [record.seam for record in drawn.records] == [1], "a weld that goes on begins with a later seam"
    assert 2e-5 < plan.arm_sigma_m < 2e-4
    assert drawn.arm_sigma_m == pytest.approx(plan.arm_sigma_m, rel=0.05)
    assert plan.arm_turn_rad < np.radians(0.5)
    known = {"which": [13], "covariance": [[0.0]]}  # the elbow's turn
    assert plan_drawn_seam(replace(planning, arm_errors=known), 1).arm_sigma_m < drawn.arm_sigma_m


def test_the_cloud_is_shown_in_the_base(plan: PlannedSeam) -> None:
    assert plan.points_B is not None
    on_top = np.abs(plan.points_B[:, 2] - 0.02) < 0.5e-3
    assert on_top.sum() > 1000


class Keeping(SeamPlanner):
    """A planner that keeps the views it would plan from."""

    views: tuple[ScanView, ...] = ()

    def plan(
        self, planning: SeamPlanning, views: tuple[ScanView, ...], correction: ScannerCorrection
    ) -> Answer[PlannedSeam]:
        self.views = views
        return super().plan(planning, (ScanView(Scan(sequence=views[-1].scan.sequence), None),), correction)


def test_each_scan_has_the_pose_at_which_it_was_taken(config: ServoConfig) -> None:
    X_FC = RigidTransform(RollPitchYaw(0.0, 0.1, np.pi / 2), [-0.16, 0.01, 0.02])
    joints = [Q_HOME, Q_HOME + np.array([0.3, -0.1, 0.05, 0.0, 0.1, 0.2])]
    history = PoseHistory(np.array([0.0, 1.0, 1.1, 2.0]), np.array([joints[0], joints[0], joints[1], joints[1]]))
    planning = SeamPlanning(
        arm=the_arm(),
        tool=TOOL,
        workpiece=STRAIGHT,
        X_BP_guess=X_BP,
        config=config,
        q_near=Q_HOME,
        clearance_m=CLEARANCE_M,
        seam_length_m=0.1,
    )
    system = Keeping(planning, X_FC_known=X_FC)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in {"calibration_status": CalibrationStatus(), "history": history}.items():
        system.GetInputPort(name).FixValue(context, AbstractValue.Make(value))
    for view, time in enumerate((0.5, 1.5)):
        job = replace(JOB, scan_sequence=view + 1, view=view, views=2)
        for name, message in {"scan": Scan(view + 1, time), "job": job}.items():
            system.GetInputPort(name).FixValue(context, AbstractValue.Make(message))
        simulator.AdvanceTo(0.1 * (view + 1))
        answer: PlannedSeam = system.GetOutputPort("planned_seam").Eval(context)
        assert len(answer.views) == (1 if view == 0 else 0)
    for found, q in zip(system.views, joints, strict=True):
        assert found.X_BC is not None
        assert found.X_BC.GetAsMatrix4() == pytest.approx((forward_kinematics(the_arm(), q) @ X_FC).GetAsMatrix4())


def test_without_a_calibration_there_is_no_plan_but_a_reason(workpiece_scan: Scan, config: ServoConfig) -> None:
    answer = planned(workpiece_scan, config)
    assert answer.seam is None
    assert answer.sequence == 1
    assert "not calibrated" in (answer.reason or "")


def test_a_plate_that_is_not_there_is_a_reason(workpiece_scan: Scan, config: ServoConfig) -> None:
    above_the_plate = workpiece_scan.points_C.copy()
    above_the_plate[workpiece_scan.points_C[..., 2] < 0.945] = np.nan  # all but the table is gone
    answer = planned(Scan(1, 0.0, above_the_plate), config, X_BC=plain_station().truth.X_BC)
    assert answer.seam is None
    assert answer.reason
    assert "\n" not in answer.reason


def test_an_empty_scan_is_a_reason(config: ServoConfig) -> None:
    nothing = Scan(1, 0.0, np.full((10, 10, 3), np.nan, np.float32))
    answer = planned(nothing, config, X_BC=plain_station().truth.X_BC)
    assert answer.seam is None
    assert answer.reason


def test_scans_of_anything_else_are_left_alone(config: ServoConfig) -> None:
    nothing = Scan(1, 0.0, np.full((10, 10, 3), np.nan, np.float32))
    calibrating = JobCommand(scan_sequence=1, scan_purpose="calibrate")
    assert planned(nothing, config, job=calibrating).sequence == 0
    assert planned(nothing, config, job=JobCommand(scan_sequence=2, scan_purpose="workpiece")).sequence == 0


def test_the_plate_is_found_from_anywhere_when_the_fixture_is_not_to_be_trusted(
    workpiece_scan: Scan, config: ServoConfig, plan: PlannedSeam
) -> None:
    X_BC = plain_station().truth.X_BC
    beside = planned(workpiece_scan, config, X_BC=X_BC, offset_m=0.12)
    assert beside.seam is None
    anywhere = planned(workpiece_scan, config, X_BC=X_BC, offset_m=0.12, method=PlanningMethod(search="anywhere"))
    assert anywhere.X_BP is not None
    assert plan.X_BP is not None
    assert anywhere.X_BP.translation() == pytest.approx(plan.X_BP.translation(), abs=0.2e-3)
    assert "confidence" in anywhere.summary


def test_a_scan_too_coarse_for_the_groove_is_a_reason_of_the_cloud_method(
    workpiece_scan: Scan, config: ServoConfig
) -> None:
    answer = planned(workpiece_scan, config, X_BC=plain_station().truth.X_BC, method=PlanningMethod(method="cloud"))
    # Pixels of 2.5 mm on a groove of 6.6 mm.
    assert answer.seam is None
    assert "mm apart" in (answer.reason or "") or "V-groove" in (answer.reason or "")
