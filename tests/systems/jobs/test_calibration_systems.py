"""Scan by scan: the ring is found where the arm holds it, X_BC comes of it, and a scan that is no use is refused by
name."""

from __future__ import annotations

import dataclasses as dc

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator

from tests.systems.cells import Q_HOME, TOOL, Drive, plain_station, the_arm
from weldcal.calibration.eye_on_base.estimate import sigma_at
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.flanges import get_flange
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator, estimate_flange
from weldcal.systems.jobs.weld.iterative_calibrator import (
    CalibrationPosePlanner,
    CalibratorConfig,
    IterativeCalibrator,
    PoseRequest,
    digest,
    verify_at,
)
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, JobCommand, Scan
from weldcal.systems.motion.buffers import PoseHistory

RING = get_flange("tool-ring-63")
X_BC = RigidTransform(RollPitchYaw(np.pi, 0.0, -np.pi / 2), [0.65, 0.0, 0.95])
CONFIG = CalibratorConfig(
    required_error_m=0.2e-3, minimum_scans=6, maximum_scans=10, p_BWork=np.array([0.65, 0.0, 0.05])
)
JOB = JobCommand(scan_sequence=1, scan_purpose="calibrate", scan_label="pose01")


def ring_pose(k: int) -> RigidTransform:
    """Ring poses X_BR spread over the scanner's view, tilted up to 20 degrees this way and that."""
    rng = np.random.default_rng(k)
    tilt = RollPitchYaw(*rng.uniform(-0.3, 0.3, 2), rng.uniform(-1.0, 1.0))
    return RigidTransform(tilt, [0.65, 0.0, 0.33] + rng.uniform(-1.0, 1.0, 3) * [0.12, 0.12, 0.08])


def seen(k: int, error_m: float = 0.0, purpose: str = "calibrate") -> FlangeEstimate:
    """What the estimator would say of the ring at that pose, its centre off by up to `error_m` along each axis."""
    X_CR = X_BC.inverse() @ ring_pose(k)
    center = X_CR.translation() + error_m * np.random.default_rng(100 + k).uniform(-1.0, 1.0, 3)
    fit = FlangeFit(
        center_C=center,
        normal_C=X_CR.rotation().matrix()[:, 2],
        center_covariance=np.eye(3) * 2e-5**2,
        normal_sigma=3e-4,
        plane_rms_m=1e-5,
        rim_rms_m=2e-5,
        outer_radius_m=0.0315,
        bore_radius_m=None,
        n_points=5000,
        coverage=0.9,
    )
    return FlangeEstimate(sequence=k, capture_time=0.1 * k, purpose=purpose, label=f"pose{k:02d}", fit=fit)


def digested(count: int, error_m: float = 0.0, config: CalibratorConfig = CONFIG) -> CalibrationStatus:
    status = CalibrationStatus()
    for k in range(1, count + 1):
        status = digest(status, seen(k, error_m), ring_pose(k), config)
    return status


@pytest.fixture(scope="module")
def look() -> tuple[Scan, RigidTransform]:
    """One rendered scan of the tool's ring, and the flange pose it was taken at."""
    drive = Drive(plain_station())
    X_BF = RigidTransform(RollPitchYaw(0.1, 0.05, 0.4), [0.62, 0.02, 0.33]) @ TOOL.X_FR.inverse()
    q = nearest_solution(the_arm(), X_BF, Q_HOME)
    assert q is not None
    drive.place_arm(q)
    drive.set("scanner.trigger", [1.0])
    drive.run(0.15)
    return drive.get("scanner.scan"), forward_kinematics(the_arm(), q)


def test_the_ring_is_found_where_the_arm_holds_it(look: tuple[Scan, RigidTransform]) -> None:
    scan, X_BF = look
    guess = RigidTransform(
        X_BC.rotation(), X_BC.translation() + np.array([0.02, -0.01, 0.01])
    )  # a tape measure's worth
    found = estimate_flange(scan, JOB, X_BF, TOOL.X_FR, RING, guess, 0.06)
    assert found.reason is None
    assert found.fit is not None
    assert (found.sequence, found.purpose, found.label) == (1, "calibrate", "pose01")
    X_CR = X_BC.inverse() @ X_BF @ TOOL.X_FR
    # An ideal scanner with pixels of 1 mm: the rim's some two hundred edge points bring the centre to a tenth of one.
    assert found.fit.center_C == pytest.approx(X_CR.translation(), abs=0.15e-3)
    assert np.degrees(np.arccos(found.fit.normal_C @ X_CR.rotation().matrix()[:, 2])) < 0.1


def test_the_points_kept_are_the_rings_own(look: tuple[Scan, RigidTransform]) -> None:
    scan, X_BF = look
    found = estimate_flange(scan, JOB, X_BF, TOOL.X_FR, RING, X_BC, 0.06)
    assert found.points_C is not None
    p_R = (X_BF @ TOOL.X_FR).inverse() @ X_BC @ found.points_C.T
    assert p_R.shape[1] > 500
    assert np.abs(p_R[2]).max() < 0.005
    assert np.hypot(p_R[0], p_R[1]).max() < 0.5 * RING.outer_m + 0.002


def test_a_scan_without_the_ring_comes_back_with_its_reason(look: tuple[Scan, RigidTransform]) -> None:
    scan, X_BF = look
    elsewhere = RigidTransform(X_BF.rotation(), X_BF.translation() + np.array([0.0, 0.3, 0.0]))
    answer = estimate_flange(scan, JOB, elsewhere, TOOL.X_FR, RING, X_BC, 0.02)
    assert answer.fit is None
    assert answer.reason
    assert (answer.sequence, answer.label) == (1, "pose01")
    empty = Scan(1, 0.0, np.full((20, 30, 3), np.nan, np.float32))
    assert estimate_flange(empty, JOB, X_BF, TOOL.X_FR, RING, X_BC, 0.06).reason


def test_a_scan_of_an_unknown_moment_is_refused() -> None:
    answer = estimate_flange(Scan(3), JOB, None, TOOL.X_FR, RING, X_BC, 0.06)
    assert answer.fit is None
    assert answer.reason == "the arm's pose at the time of the scan is not known"
    assert answer.sequence == 3


@pytest.mark.parametrize(
    ("job", "answered"),
    [
        (JOB, True),
        (dc.replace(JOB, scan_purpose="workpiece"), False),
        (dc.replace(JOB, scan_sequence=2), False),  # an old scan: a newer one was asked for
    ],
)
def test_the_estimator_answers_the_scan_that_was_asked_for_and_leaves_the_workpiece_alone(
    look: tuple[Scan, RigidTransform], job: JobCommand, answered: bool
) -> None:
    system = FlangeEstimator(the_arm(), TOOL.X_FR, RING, X_BC, 0.06)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    inputs = {"scan": look[0], "job": job, "history": PoseHistory(), "calibration_status": CalibrationStatus()}
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, AbstractValue.Make(value))
    simulator.AdvanceTo(0.05)
    answer: FlangeEstimate = system.GetOutputPort("flange_estimate").Eval(context)
    assert answer.sequence == (1 if answered else 0)
    assert (answer.reason is not None) == answered  # the empty history knows no pose


def test_exact_observations_give_the_exact_camera() -> None:
    status = digested(6)
    assert status.estimate is not None
    assert status.X_BC is not None
    assert status.X_BC.IsNearlyEqualTo(X_BC, 1e-7)
    assert status.calibration_scans == len(status.observations) == 6
    assert status.done


def test_it_is_not_done_before_the_least_number_of_scans_however_good() -> None:
    assert not digested(5).done
    assert digested(6).done


def test_it_is_not_done_before_its_own_expected_error_is_small_enough() -> None:
    rough = digested(6, error_m=1e-3)
    assert rough.estimate is not None
    assert rough.predicted_error_m > CONFIG.required_error_m
    assert not rough.done
    easy = dc.replace(CONFIG, required_error_m=2.0 * rough.predicted_error_m)
    assert digested(6, error_m=1e-3, config=easy).done


def test_the_expected_error_falls_with_more_scans_and_counts_at_the_work_point() -> None:
    errors = [row[1] for row in digested(10, error_m=0.5e-3).history]
    assert errors[-1] < errors[0]
    status = digested(8, error_m=0.5e-3)
    assert status.estimate is not None
    near = sigma_at(status.estimate, np.array([0.65, 0.0, 0.33]))
    far = sigma_at(status.estimate, np.array([0.65, 0.0, -1.0]))
    assert status.predicted_error_m == pytest.approx(sigma_at(status.estimate, CONFIG.p_BWork))
    assert near < status.predicted_error_m < far


def test_the_true_error_is_of_the_size_that_is_expected() -> None:
    # Errors uniform within half a millimetre per axis: their rms is what the estimator should find in its residuals.
    status = digested(10, error_m=0.5e-3)
    assert status.X_BC is not None
    p_CWork = X_BC.inverse() @ CONFIG.p_BWork
    error = float(np.linalg.norm(status.X_BC @ p_CWork - CONFIG.p_BWork))
    assert 0.1 * status.predicted_error_m < error < 3.0 * status.predicted_error_m


def test_too_few_scans_say_so_and_promise_nothing() -> None:
    status = digested(3)
    assert status.estimate is None
    assert status.X_BC is None
    assert not status.done
    assert status.message
    assert status.predicted_error_m == np.inf


def test_a_scan_without_a_ring_is_refused_by_name_and_still_counts_as_one() -> None:
    status = digested(4)
    bad = FlangeEstimate(sequence=5, capture_time=0.5, purpose="calibrate", label="pose05", reason="no rim was seen")
    status = digest(status, bad, ring_pose(5), CONFIG)
    assert status.refused == (("pose05", "no rim was seen"),)
    assert (status.sequence, status.calibration_scans, len(status.observations)) == (5, 5, 4)
    assert status.estimate is not None  # what was known before is kept


def test_a_scan_of_an_unknown_arm_is_refused_by_name() -> None:
    status = digest(CalibrationStatus(), seen(1), None, CONFIG)
    assert status.refused == (("pose01", "the arm's pose at the time of the scan is not known"),)


def test_a_verification_scan_is_never_calibrated_with() -> None:
    before = digested(6)
    after = digest(before, seen(7, purpose="verify"), ring_pose(7), CONFIG)
    assert after.observations == before.observations
    assert after.estimate is before.estimate
    assert after.calibration_scans == 6
    assert after.sequence == 7
    (result,) = after.verifications
    assert result.label == "pose07"
    assert result.error_m == pytest.approx(0.0, abs=1e-7)


def test_a_verification_measures_the_position_and_the_tilt_of_the_ring() -> None:
    status = digested(6)
    moved = RigidTransform(
        ring_pose(7).rotation() @ RollPitchYaw(0.02, 0.0, 0.5).ToRotationMatrix(),
        ring_pose(7).translation() + np.array([0.0, 3e-4, 4e-4]),
    )
    result = verify_at(status, seen(7, purpose="verify"), moved)
    assert result.error_m == pytest.approx(5e-4, abs=1e-7)
    assert result.tilt_rad == pytest.approx(0.02, abs=1e-6)  # a turn about its own axis is no tilt


def test_without_a_calibration_a_verification_is_infinitely_wrong() -> None:
    assert verify_at(CalibrationStatus(), seen(7), ring_pose(7)).error_m == np.inf


def test_the_calibrator_takes_each_estimate_once() -> None:
    system = IterativeCalibrator(the_arm(), RigidTransform(), CONFIG)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("history").FixValue(
        context, AbstractValue.Make(PoseHistory(np.array([0.0, 1.0]), np.tile(Q_HOME, (2, 1))))
    )
    system.GetInputPort("flange_estimate").FixValue(context, AbstractValue.Make(seen(1)))
    simulator.AdvanceTo(0.1)
    status: CalibrationStatus = system.GetOutputPort("calibration_status").Eval(context)
    assert status is system.status(context)
    assert (status.sequence, len(status.observations)) == (1, 1)
    (observation,) = status.observations
    assert observation.X_BR.IsNearlyEqualTo(forward_kinematics(the_arm(), Q_HOME), 1e-12)
    system.GetInputPort("flange_estimate").FixValue(
        context, AbstractValue.Make(FlangeEstimate(sequence=2, capture_time=0.2, purpose="calibrate", label="b"))
    )
    simulator.AdvanceTo(0.2)
    assert system.status(context).refused[0][0] == "b"


PLAN = tuple(PlannedPose(RigidTransform(), np.full(6, 0.1 * k), RigidTransform(), 1.0, 1e-4) for k in range(3))


def test_the_pose_planner_shows_the_next_pose_after_each_scan_and_none_when_they_are_used_up() -> None:
    system = CalibrationPosePlanner(PLAN)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    shown: list[PoseRequest] = []
    for k in range(4):
        status = CalibrationStatus(sequence=k)
        system.GetInputPort("calibration_status").FixValue(context, AbstractValue.Make(status))
        simulator.AdvanceTo(0.05 + 0.05 * k)
        shown.append(system.GetOutputPort("next_pose").Eval(context))
    assert [pose.after_sequence for pose in shown] == [0, 1, 2, 3]
    assert [pose.label for pose in shown[:3]] == ["pose01", "pose02", "pose03"]
    assert [None if pose.q is None else float(pose.q[0]) for pose in shown] == [0.0, 0.1, 0.2, None]


def test_a_planner_without_a_plan_has_nothing_to_show() -> None:
    system = CalibrationPosePlanner(())
    next_pose: PoseRequest = system.GetOutputPort("next_pose").Eval(system.CreateDefaultContext())
    assert next_pose.q is None
