"""From a wanted twist to the command on the wire: guarded, chosen by the job, finite, and within the arm's limits."""

from __future__ import annotations

import dataclasses as dc

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from tests.systems.cells import Q_HOME, TOOL, the_arm
from weldcal.models.arms.kinematics import forward_kinematics, kinematics_and_jacobian
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.jobs.weld.welding_velocity_servo import TELEMETRY, ServoReport, WeldingVelocityServo
from weldcal.systems.messages import JobCommand, PlannedSeam, UrStatus
from weldcal.systems.motion.guarded_path import SingularityGuard
from weldcal.systems.motion.spine import CommandArbiter, SlewLimiter
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.guards import SlewLimits
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import DeflectionSample
from weldcal.welding.servo.touch import touch_start_pose

WELD = JobCommand(phase="weld", mode="weld", process_on=True)


def feed(system: LeafSystem, context: object, **values: object) -> None:
    """Fix input ports by name: arrays as vectors, messages as abstract values."""
    for name, value in values.items():
        fixed = np.atleast_1d(value) if isinstance(value, list | float | np.ndarray) else AbstractValue.Make(value)
        system.GetInputPort(name).FixValue(context, fixed)


def guard(V_BT: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    system = SingularityGuard(the_arm(), TOOL.X_FT)
    context = system.CreateDefaultContext()
    feed(system, context, V_BT=V_BT, position_measured=q)
    return system.GetOutputPort("velocity").Eval(context), system.GetOutputPort("margin").Eval(context)


def test_away_from_singularities_the_tip_moves_as_it_is_told() -> None:
    V = np.array([0.02, -0.01, 0.03, 0.008, -0.004, 0.002])
    q_dot, (sigma, stopped) = guard(V, Q_HOME)
    h = 1e-6
    before, after = (forward_kinematics(the_arm(), Q_HOME + s * h * q_dot) @ TOOL.X_FT for s in (-1.0, 1.0))
    assert (after.translation() - before.translation()) / (2.0 * h) == pytest.approx(V[3:], abs=1e-8)
    turn = RollPitchYaw(after.rotation() @ before.rotation().inverse()).vector()
    assert turn / (2.0 * h) == pytest.approx(V[:3], abs=1e-6)
    assert sigma > 0.08
    assert stopped == 0.0


def test_a_stretched_arm_is_stopped_and_says_so() -> None:
    straight = Q_HOME.copy()
    straight[2] = 0.0
    q_dot, (sigma, stopped) = guard(np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]), straight)
    assert (q_dot == 0.0).all()
    assert sigma < 0.03
    assert stopped == 1.0


def test_no_joint_is_asked_for_more_than_half_its_speed() -> None:
    q_dot, _ = guard(np.array([0.0, 0.0, 9.0, 3.0, 0.0, 0.0]), Q_HOME)
    share = np.abs(q_dot) / the_arm().velocity_limit
    assert share.max() == pytest.approx(0.5)
    _, _, J = kinematics_and_jacobian(the_arm(), Q_HOME, np.array(TOOL.X_FT.translation()))
    got = J @ q_dot
    assert got / np.linalg.norm(got) == pytest.approx(np.array([0, 0, 9.0, 3.0, 0, 0]) / np.hypot(9.0, 3.0), abs=1e-9)


@pytest.mark.parametrize("port", ["V_BT", "position_measured"])
def test_what_is_no_number_moves_nothing(port: str) -> None:
    V, q = np.full(6, 0.01), Q_HOME.copy()
    (V if port == "V_BT" else q)[3] = np.nan
    q_dot, margin = guard(V, q)
    assert (q_dot == 0.0).all()
    assert margin[1] == 1.0


MOVER, SERVO = np.full(6, 0.1), np.full(6, 0.2)


@pytest.mark.parametrize(
    ("job", "robot", "wanted"),
    [
        (JobCommand(mode="move"), UrStatus(), MOVER),
        (JobCommand(mode="weld"), UrStatus(), SERVO),
        (JobCommand(mode="hold"), UrStatus(), np.zeros(6)),
        (JobCommand(mode="dance"), UrStatus(), np.zeros(6)),
        (JobCommand(mode="move"), UrStatus(fault="stopped"), np.zeros(6)),
        (JobCommand(mode="weld"), UrStatus(safety_mode="PROTECTIVE_STOP"), np.zeros(6)),
        (JobCommand(mode="weld"), UrStatus(program_running=False), np.zeros(6)),
        (JobCommand(mode="move"), UrStatus(safety_mode="REDUCED"), MOVER),
    ],
    ids=str,
)
def test_the_one_the_job_names_drives_while_the_robot_is_ready(
    job: JobCommand, robot: UrStatus, wanted: np.ndarray
) -> None:
    system = CommandArbiter()
    context = system.CreateDefaultContext()
    feed(system, context, job=job, robot_status=robot, mover_velocity=MOVER, servo_velocity=SERVO)
    assert (system.GetOutputPort("velocity_wanted").Eval(context) == wanted).all()


LIMITS = SlewLimits(speed=1.0, acceleration=4.0, jerk=80.0)


class Limited:
    """The limiter alone, asked by hand."""

    def __init__(self) -> None:
        self.system = SlewLimiter(LIMITS)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.v = [np.zeros(6)]

    def ask(self, wanted: np.ndarray, duration: float) -> np.ndarray:
        feed(self.system, self.context, velocity_wanted=wanted)
        start = int(np.ceil(self.context.get_time() / 0.002 - 1e-6))
        for k in range(round(duration / 0.002)):
            self.simulator.AdvanceTo((start + k + 0.5) * 0.002)
            self.v.append(np.array(self.system.GetOutputPort("velocity_command").Eval(self.context)))
        return self.v[-1]


def test_a_wanted_velocity_is_reached_and_kept() -> None:
    wanted = np.array([0.3, -0.3, 0.1, -0.1, 0.0, 0.5])
    assert Limited().ask(wanted, 0.5) == pytest.approx(wanted, abs=1e-9)


def test_speed_acceleration_and_jerk_stay_within_their_limits_whatever_is_asked() -> None:
    rng, limited = np.random.default_rng(0), Limited()
    for _ in range(20):
        limited.ask(rng.uniform(-5.0, 5.0, 6), 0.05)
    v = np.array(limited.v)
    a = np.diff(v, axis=0) / 0.002
    assert np.abs(v).max() <= 1.0 + 1e-9
    assert np.abs(a).max() <= 4.0 + 1e-6
    assert np.abs(np.diff(a, axis=0)).max() / 0.002 <= 80.0 + 1e-3
    assert np.abs(v).max() > 0.5  # it was not idle


def test_a_command_that_is_no_number_brings_it_to_rest_smoothly() -> None:
    limited = Limited()
    limited.ask(np.full(6, 0.5), 0.5)
    assert limited.ask(np.array([0.5, np.nan, 0.5, 0.5, 0.5, 0.5]), 0.5) == pytest.approx(np.zeros(6), abs=1e-9)
    assert np.isfinite(limited.v).all()
    assert np.abs(np.diff(limited.v, axis=0)).max() <= 4.0 * 0.002 + 1e-9


SEAM = SeamCurve.from_points(np.column_stack([np.full(50, 0.65), np.linspace(-0.1, 0.1, 50), np.full(50, 0.02)]))


class Servo:
    """The servo alone, at the start of a straight seam, its tip free."""

    def __init__(self) -> None:
        config = ServoConfig()
        self.system = WeldingVelocityServo(the_arm(), TOOL, config)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.X_BT = touch_start_pose(SEAM, config)
        feed(
            self.system,
            self.context,
            planned_seam=PlannedSeam(sequence=1, seam=SEAM),
            position_measured=Q_HOME,
            sample_time=0.0,
        )
        feed(self.system, self.context, job=JobCommand(), deformation=self.deformation(0.0, True))

    def deformation(self, time: float, valid: bool) -> Deformation:
        return Deformation(1, DeflectionSample(time, self.X_BT, np.zeros(3), valid), "" if valid else "not in sight")

    def run(self, time: float) -> None:
        feed(self.system, self.context, sample_time=time)
        self.simulator.AdvanceTo(time)

    def out(self, name: str) -> object:
        return self.system.GetOutputPort(name).Eval(self.context)

    def report(self) -> ServoReport:
        report = self.out("servo_report")
        assert isinstance(report, ServoReport)
        return report


def test_the_servo_is_idle_until_the_job_says_weld() -> None:
    servo = Servo()
    servo.run(0.1)
    assert servo.report().phase == "IDLE"
    assert np.all(servo.out("V_BT") == 0.0)
    telemetry = dict(zip(TELEMETRY, servo.out("telemetry"), strict=True))  # type: ignore[call-overload]
    assert telemetry["phase"] == -1.0
    assert telemetry["torch_on"] == 0.0


def test_it_stays_idle_without_a_seam() -> None:
    servo = Servo()
    feed(servo.system, servo.context, planned_seam=PlannedSeam(), job=WELD)
    servo.run(0.1)
    assert servo.report().phase == "IDLE"


def test_a_weld_begins_with_the_touch_and_the_torch_off() -> None:
    servo = Servo()
    feed(servo.system, servo.context, job=WELD)
    for k in range(1, 11):
        feed(servo.system, servo.context, deformation=servo.deformation(0.01 * k, True))
        servo.run(0.01 * k)
    report = servo.report()
    assert report.phase == "TOUCH"
    assert not report.torch_on
    assert np.all(servo.out("torch_on") == 0.0)
    assert report.command is not None
    assert servo.out("V_BT") == pytest.approx(report.command.V_BT)


def test_a_tag_that_is_not_seen_faults_the_weld_and_the_reason_stays() -> None:
    servo = Servo()
    feed(servo.system, servo.context, job=WELD)
    for k in range(1, 60):
        feed(servo.system, servo.context, deformation=servo.deformation(0.01 * k, False))
        servo.run(0.01 * k)
    report = servo.report()
    assert report.phase == "FAULT"
    assert "Tag hidden" in (report.reason or "")
    assert servo.out("V_BT") == pytest.approx(np.zeros(6))
    feed(servo.system, servo.context, job=dc.replace(WELD, mode="hold", held=True))
    servo.run(0.7)
    assert "Tag hidden" in (servo.report().reason or "")


def test_a_hold_in_the_middle_of_the_stop_leaves_no_motion_behind() -> None:
    servo = Servo()
    feed(servo.system, servo.context, job=WELD)
    for k in range(1, 30):
        feed(servo.system, servo.context, deformation=servo.deformation(0.01 * k, True))
        servo.run(0.01 * k)
    feed(servo.system, servo.context, sample_time=float("nan"))
    servo.simulator.AdvanceTo(0.31)
    assert servo.report().phase == "FAULT"
    assert np.linalg.norm(servo.out("V_BT")) > 1e-3, "it still slows down"
    feed(servo.system, servo.context, job=dc.replace(WELD, mode="hold", held=True))
    assert np.all(servo.out("V_BT") == 0.0)


def test_a_job_that_takes_the_weld_back_leaves_no_motion_behind() -> None:
    servo = Servo()
    feed(servo.system, servo.context, job=WELD)
    servo.run(0.05)
    assert servo.report().phase == "TOUCH"
    feed(servo.system, servo.context, job=JobCommand(mode="hold"))
    servo.run(0.07)
    assert servo.report().phase == "IDLE"
    assert np.all(servo.out("V_BT") == 0.0)


@pytest.mark.parametrize(
    ("job", "on"), [(WELD, 1.0), (dc.replace(WELD, process_on=False), 0.0), (dc.replace(WELD, held=True), 0.0)]
)
def test_the_torch_needs_the_jobs_consent_in_the_same_tick(job: JobCommand, on: float) -> None:
    servo = Servo()
    burning = ServoReport(phase="TRACK", torch_on=True)
    servo.context.SetAbstractState(0, burning)
    feed(servo.system, servo.context, job=job)
    assert np.all(servo.out("torch_on") == on)


def test_the_start_pose_stands_upright_with_the_torch_behind() -> None:
    X_BT = Servo().X_BT
    assert X_BT.rotation().matrix()[:, 2] == pytest.approx([0.0, 0.0, 1.0])
    p_TipFromTorch = X_BT.rotation() @ np.array([1.0, 0.0, 0.0])
    assert p_TipFromTorch == pytest.approx([0.0, 1.0, 0.0])  # the seam runs along +y
    assert isinstance(X_BT, RigidTransform)
