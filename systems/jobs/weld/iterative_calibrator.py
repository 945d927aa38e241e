"""IterativeCalibrator: estimates X_BC until its error is small enough; CalibrationPosePlanner: the next pose."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, State

from weldcal.calibration.calibrate import PLAIN, Refined, Steps, calibrate
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import corrected_observation, sigma_at
from weldcal.calibration.eye_on_base.few_poses import ENOUGH
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.observation import observation_from_fit
from weldcal.calibration.planning.calibration_poses import NextBest, PlannedPose, PlannerConfig, predicted_sigma
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, with_link_transforms
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.background import Answer, Background, BackgroundSystem
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, Message, Refinement, VerificationResult
from weldcal.systems.motion.buffers import PoseHistory

TIME_S = 120.0  # for which the job waits, at rest, for the folds beside a robot


def refined_status(status: CalibrationStatus, kind: str, arm: ArmModel, correct_scanner: bool) -> CalibrationStatus:
    """The status with its estimate refined by ``kind`` of LIVE_KINDS, or as it was with the reason.

    ``arm`` is the one that observed.
    """
    if status.estimate is None or kind == PLAIN:
        return status
    steps = Steps(
        patterns=status.patterns,
        correct_scanner=correct_scanner,
        refine=kind,
        arm=None if kind == "local" else arm,
        joints=np.array(status.joints),
        note=f"{arm.name}, refined by a live calibration (calibration.refine: {kind})",
    )
    try:
        found = calibrate(status.observations, steps)
    except WeldcalError as error:
        return dc.replace(status, refinement=Refinement(kind=kind, sentence=f"The calibration is not refined: {error}"))
    assert found.refined is not None
    return dc.replace(status, estimate=found.estimate, refinement=_message(kind, found.refined, arm))


def _message(kind: str, found: Refined, arm: ArmModel) -> Refinement:
    corrected = None
    if found.stack is not None:
        corrected = with_link_transforms(arm, found.stack, "", "The refined kinematics")
    return Refinement(
        kind=kind,
        sentence=found.sentence,
        accepted=found.accepted,
        arm=corrected,
        local_field=found.field,
        kinematics=found.kinematics,
        arm_errors=found.arm,
        document=found.document(kind),
    )


@dc.dataclass(frozen=True, eq=False)
class PoseRequest(Message):
    """The pose to visit after the calibration status with this sequence number; q (6,) rad, None when none is left."""

    after_sequence: int = -1
    index: int = 0
    label: str = ""
    q: Array | None = None


class CalibrationPosePlanner(LeafSystem):
    """Steps through the planned poses, the most informative first, one for each scan that the calibrator has processed.

    .. pydrake_system::

        name: CalibrationPosePlanner
        input_ports:
        - calibration_status
        output_ports:
        - next_pose

    The plan is made before any motion (and raises where the scanner cannot be reached). pose_planning orders it
    greedily by the information that each pose adds, so that each prefix is the greedy set of that size.
    """

    def __init__(self, plan: tuple[PlannedPose, ...], period_s: float = 0.02) -> None:
        super().__init__()
        self._plan = plan
        self._status = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        self._state = self.DeclareAbstractState(
            AbstractValue.Make(PoseRequest(-1, 0, "pose01", plan[0].q if plan else None))
        )
        self.DeclareStateOutputPort("next_pose", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        status: CalibrationStatus = self._status.Eval(context)
        newest: PoseRequest = context.get_abstract_state(self._state).get_value()
        if status.sequence <= newest.after_sequence:
            return
        index = status.sequence  # one pose per scan
        q = self._plan[index].q if index < len(self._plan) else None
        new = PoseRequest(status.sequence, index, f"pose{index + 1:02d}", q)
        state.get_mutable_abstract_state(self._state).set_value(new)


@dc.dataclass(frozen=True, kw_only=True)
class CalibratorConfig:
    """The stop criterion of the live calibration (m), and the work point p_BWork (3,) in B at which it holds."""

    required_error_m: float
    minimum_scans: int
    maximum_scans: int
    p_BWork: Array
    correct_scanner: bool = True
    refine: str = PLAIN


class IterativeCalibrator(BackgroundSystem):
    """Computes the robust estimate from all scans.

    .. pydrake_system::

        name: IterativeCalibrator
        input_ports:
        - flange_estimate
        - history
        output_ports:
        - calibration_status

    The estimate is that of `weldcal calibrate` (calibration/calibrate.py): it contains a correction of the scanner's
    own errors where the scans show one, unless `correct_scanner` is off. It is done when the expected error at the work
    point is within the required one; then it is refined (`refine`), and what the status says of the arm holds for the
    verification and all that follows.
    """

    def __init__(
        self,
        arm: ArmModel,
        X_FR: RigidTransform,
        config: CalibratorConfig,
        background: Background | None = None,
        period_s: float = 0.02,
    ) -> None:
        super().__init__("calibration_status", CalibrationStatus(), background, period_s)
        self._arm, self._X_FR, self._config = arm, X_FR, config
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))

    def status(self, context: Context) -> CalibrationStatus:
        """The newest status in this system's context."""
        status: CalibrationStatus = self.newest(context)
        return status

    def ask(self, context: Context, newest: CalibrationStatus) -> Answer[CalibrationStatus] | None:
        """Ask for the status with a new flange estimate."""
        estimate: FlangeEstimate = self._estimate.Eval(context)
        if estimate.sequence <= newest.sequence:
            return None
        arm, q = newest.arm_or(self._arm), self._history.Eval(context).joints_at(estimate.capture_time)
        X_BR = None if q is None else forward_kinematics(arm, q) @ self._X_FR
        return self.background.ask(digest, newest, estimate, X_BR, self._config, q, self._arm)


def digest(
    status: CalibrationStatus,
    seen: FlangeEstimate,
    X_BR: RigidTransform | None,
    config: CalibratorConfig,
    q: Array | None = None,
    arm: ArmModel | None = None,
) -> CalibrationStatus:
    """Compute the status after one more flange estimate.

    An unusable scan is listed as refused with its label and the reason.

    ``q`` (6,) rad are the joint angles of ``arm`` at the scan; a refinement needs both.
    """
    counts = seen.purpose == "calibrate"
    status = dc.replace(status, sequence=seen.sequence, calibration_scans=status.calibration_scans + int(counts))
    if seen.fit is None or X_BR is None:
        reason = seen.reason or "the arm's pose at the time of the scan is not known"
        return dc.replace(status, refused=(*status.refused, (seen.label, reason)), message=reason)
    if seen.purpose == "verify":
        return dc.replace(status, verifications=(*status.verifications, verify_at(status, seen, X_BR)))
    observation = observation_from_fit(seen.label, X_BR, seen.fit)
    observations = (*status.observations, observation)
    joints = status.joints if q is None else (*status.joints, q)
    patterns = status.patterns if seen.pattern is None else {**status.patterns, seen.label: seen.pattern}
    status = dc.replace(status, observations=observations, patterns=patterns, joints=joints)
    try:
        if len(observations) < ENOUGH:
            raise TooFewPoses(f"{len(observations)} usable scans do not fix the scanner's pose; take {ENOUGH} or more.")
        found = calibrate(observations, Steps(patterns=patterns, correct_scanner=config.correct_scanner))
    except WeldcalError as error:
        return dc.replace(status, message=str(error))
    estimate = found.estimate
    if found.warnings:
        estimate = dc.replace(estimate, warnings=(*found.warnings, *estimate.warnings))
    predicted = sigma_at(estimate, config.p_BWork)
    held_out = float(np.median(estimate.held_out.position_m))
    done = len(observations) >= config.minimum_scans and predicted <= config.required_error_m
    status = dc.replace(
        status,
        estimate=estimate,
        predicted_error_m=predicted,
        history=(*status.history, (len(observations), predicted, held_out)),
        done=done,
        message="",
    )
    if not done or arm is None:
        return status
    status = refined_status(status, config.refine, arm, config.correct_scanner)
    assert status.estimate is not None
    return dc.replace(status, predicted_error_m=sigma_at(status.estimate, config.p_BWork))


def verify_at(status: CalibrationStatus, seen: FlangeEstimate, X_BR: RigidTransform) -> VerificationResult:
    """Position error (m) and tilt (rad) of the calibration at one held-out scan."""
    if status.estimate is None or seen.fit is None:
        return VerificationResult(seen.label, np.inf, np.inf)
    seen_at = [corrected_observation(status.correction, observation_from_fit(seen.label, X_BR, seen.fit))]
    X_BC = status.estimate.X_BC
    if status.local_field is not None:
        seen_at = status.local_field.applied(X_BC, seen_at)
    return VerificationResult(
        seen.label, float(position_errors(X_BC, seen_at)[0]), float(tilt_errors(X_BC, seen_at)[0])
    )


def next_scan(status: CalibrationStatus, poses: tuple[PlannedPose, ...], p_BWork: np.ndarray) -> NextBest | None:
    """The unvisited planned pose that reduces the expected error at the work point most.

    All are reachable, visible and clear; None before the first estimate, or where all were visited.

    The gain is computed by the planner; the present error is the estimate's.
    """
    left = poses[status.sequence :]
    if status.estimate is None or not left or not status.observations:
        return None
    config = PlannerConfig(work_point_B=(float(p_BWork[0]), float(p_BWork[1]), float(p_BWork[2])))
    X_BC: RigidTransform = status.estimate.X_BC
    seen = [o.X_BR for o in status.observations]
    before = predicted_sigma(seen, X_BC, config)
    after = [predicted_sigma([*seen, p.X_BR], X_BC, config) for p in left]
    best = int(np.argmin(after))
    share = after[best] / before if np.isfinite(before) else 1.0
    now = status.predicted_error_m
    return NextBest(left[best].q, left[best].X_BF, now, share * now, what="expected error at the work point")
