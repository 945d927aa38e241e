"""DriftMonitor: tests a calibration on streamed observations of the flange and says whether the scanner has moved."""

from __future__ import annotations

import copy
import dataclasses as dc
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerClock, ScannerCorrection, correction_from_document
from weldcal.calibration.motion.drift.residuals import CLOCK, TrackedFrame, tracked_rows
from weldcal.calibration.motion.drift.sequential import WARM_UP, DriftConfig, DriftEvent, DriftTest, drift_config
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, Message, believed_arm
from weldcal.systems.motion.buffers import PoseHistory

if TYPE_CHECKING:
    from weldcal.calibration.motion.drift.run_clock import RunClock

_HALF_S = 0.01  # about a capture: its velocity
_RECENT = 400  # frames that the view shows


@dc.dataclass(frozen=True, eq=False)
class MonitoredCalibration:
    """What is watched: X_BC with its covariance (6, 6), the scanner's correction and its clock.

    The covariance is [rotation; translation] about the camera's origin. Without a clock a streamed frame was captured
    ``delay_s`` before its arrival.
    """

    X_BC: RigidTransform
    covariance: Array
    correction: ScannerCorrection = dc.field(default_factory=ScannerCorrection)
    clock: ScannerClock | None = None
    delay_s: float = 0.0
    config: DriftConfig | None = None

    @staticmethod
    def of(result: CalibrationResult, delay_s: float, *, false_alarms_per_hour: float = 1e-3) -> MonitoredCalibration:
        """Return the monitored calibration of a result.

        ``delay_s`` is the usual delay of the scanner, where the result does not know its clock.
        """
        clock = result.clock
        sigma = None if clock is None or clock.offset_s is None else clock.sigma_s
        spread = 1e-3 * result.sigma_position_mm
        config = drift_config(spread, sigma, DriftConfig(false_alarms_per_hour=false_alarms_per_hour))
        correction = correction_from_document(result.scanner_correction) or ScannerCorrection()
        return MonitoredCalibration(result.X_BC, result.covariance, correction, clock, delay_s, config)

    @staticmethod
    def made(status: CalibrationStatus, delay_s: float, config: DriftConfig) -> MonitoredCalibration | None:
        """Return the calibration that a run has made; None until it is done."""
        e = status.estimate
        if e is None or not status.done:
            return None
        config = drift_config(e.sigma_position_m, None, config)
        return MonitoredCalibration(e.X_BC, e.covariance, status.correction, None, delay_s, config)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class DriftStatus(Message):
    """The state of the watch after its newest frame.

    ``recent`` (n, 6): time s, error (3) m at the time by the clock, offset of the clock s, test statistic.

    ``X_BC`` with its ``covariance`` (6, 6) is the scanner's pose by all frames since the last change: the
    recalibration. ``alarmed``: a change is being measured; ``events``: those that were measured.
    """

    sequence: int = 0
    frames: int = 0
    dropped: int = 0
    recent: Array = dc.field(default_factory=lambda: np.empty((0, 6)))
    statistic: float = 0.0
    threshold: float = np.inf
    alarmed: bool = False
    events: tuple[DriftEvent, ...] = ()
    X_BC: RigidTransform | None = None
    covariance: Array | None = None
    recalibrations: int = 0

    @property
    def moved(self) -> bool:
        """Whether the scanner, or the robot's base, has moved, as far as is known now."""
        return self.alarmed or any(e.kind != WARM_UP for e in self.events)

    @property
    def summary(self) -> str:
        """What was found, in one sentence; empty where nothing was."""
        moves = [e for e in self.events if e.kind != WARM_UP]
        if moves:
            e = moves[-1]
            size, angle = 1e3 * np.linalg.norm(e.translation_m), np.degrees(np.linalg.norm(e.rotation_rad))
            return (
                f"The scanner's pose changed by {size:.2f} mm and {angle:.3f} degrees at {e.time_s:.1f} s ({e.cause});"
                " calibrate again."
            )
        if self.alarmed:
            return "The scanner's pose has changed; how far is being measured. Calibrate again."
        return ""


@dc.dataclass(frozen=True, eq=False)
class _Watch(Message):
    """The status and the test behind it, which is copied before it is changed."""

    status: DriftStatus = dc.field(default_factory=DriftStatus)
    test: DriftTest | None = None
    watched: MonitoredCalibration | None = None
    pivot: Array | None = None
    asked: bool = False
    clock: RunClock | None = None


class DriftMonitor(LeafSystem):
    """Feeds each new estimate of the flange, with the arm's pose at its capture, to the drift test.

    .. pydrake_system::

        name: DriftMonitor
        input_ports:
        - flange_estimate
        - history
        - recalibrate
        - calibration_status
        output_ports:
        - drift
        - moved

    `drift` is a `DriftStatus`; `moved` (1) is 1 from an alarm on. When `recalibrate` (1, may stay open) rises, the pose
    that the frames since the last change show becomes the calibration that is watched. Without a ``calibration`` the
    one on `calibration_status` (may stay open) is watched from when it is done; a streamed frame is then expected
    ``delay_s`` after its capture. All state is in the Context. Theory: docs/drift.md.
    """

    def __init__(
        self,
        arm: ArmModel,
        X_FR: RigidTransform,
        calibration: MonitoredCalibration | None,
        config: DriftConfig | None = None,
        period_s: float = 0.02,
        delay_s: float = 0.0,
    ) -> None:
        super().__init__()
        self._arm, self._X_FR, self._config, self._delay_s = arm, X_FR, config, delay_s
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._recalibrate = self.DeclareVectorInputPort("recalibrate", 1)
        self._calibration = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        first = _begun(calibration)
        self._state = self.DeclareAbstractState(AbstractValue.Make(first))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("drift", lambda: AbstractValue.Make(DriftStatus()), self._drift_out, ticket)
        self.DeclareVectorOutputPort("moved", 1, self._moved_out, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def status(self, context: Context) -> DriftStatus:
        """Return the status in this system's context."""
        watch: _Watch = context.get_abstract_state(self._state).get_value()
        return watch.status

    def _update(self, context: Context, state: State) -> None:
        old: _Watch = context.get_abstract_state(self._state).get_value()
        asked = self._recalibrate.HasValue(context) and float(self._recalibrate.Eval(context)[0]) > 0.5
        new = old
        if asked != old.asked:
            new = dc.replace(recalibrated(new) if asked else new, asked=asked)
        if old.watched is None and self._calibration.HasValue(context):
            config = self._config or DriftConfig()
            new = _begun(MonitoredCalibration.made(self._calibration.Eval(context), self._delay_s, config))
        estimate: FlangeEstimate = self._estimate.Eval(context)
        if new.watched is not None and estimate.sequence > old.status.sequence:
            history: PoseHistory = self._history.Eval(context)
            arm = believed_arm(self._calibration, context, self._arm)
            new = watched_frame(new, estimate, history, arm, self._X_FR, self._config)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)

    def _drift_out(self, context: Context, output: Any) -> None:
        output.set_value(self.status(context))

    def _moved_out(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.status(context).moved))


def _begun(calibration: MonitoredCalibration | None) -> _Watch:
    """Return the watch of a calibration before its first frame."""
    if calibration is None:
        return _Watch()
    return _Watch(DriftStatus(X_BC=calibration.X_BC, covariance=calibration.covariance), watched=calibration)


def watched_frame(
    watch: _Watch,
    estimate: FlangeEstimate,
    history: PoseHistory,
    arm: ArmModel,
    X_FR: RigidTransform,
    config: DriftConfig | None,
) -> _Watch:
    """The watch after one more estimate; a frame without a fit, a time or a pose of the arm is counted as dropped.

    Frames in motion with a device time wait until they show the scanner's clock in this run.
    """
    c, status = watch.watched, dc.replace(watch.status, sequence=estimate.sequence)
    if c is None or estimate.fit is None:
        return dc.replace(watch, status=dc.replace(status, dropped=status.dropped + 1))
    from weldcal.calibration.motion.drift.run_clock import SeenMotion, followed, with_frame

    waited = 0 if watch.clock is None else len(watch.clock.waiting)
    clock, done = followed(watch.clock, estimate, c.delay_s, c.clock), 1
    usable: tuple[FlangeEstimate, ...] = (estimate,)
    if clock is not None:
        clock, usable = with_frame(
            clock, estimate, SeenMotion(c.X_BC, c.correction, arm, X_FR, history.times, history.positions)
        )
        done = waited + 1 - len(clock.waiting)
    tracked = [_tracked(c, f, history, arm, X_FR, clock) for f in usable]
    frames = [f for f in tracked if f is not None]
    dropped = status.dropped + done - len(frames)
    watch = dc.replace(watch, clock=clock, status=dc.replace(status, dropped=dropped))
    return _tested(watch, c, frames, config) if frames else watch


def _tested(watch: _Watch, c: MonitoredCalibration, frames: list[TrackedFrame], config: DriftConfig | None) -> _Watch:
    """Return the watch after these frames' test."""
    pivot = frames[0].p_BR if watch.pivot is None else watch.pivot
    test = (
        DriftTest(c.X_BC, c.covariance, pivot, c.config or config) if watch.test is None else copy.deepcopy(watch.test)
    )
    rows = tracked_rows(c.X_BC, pivot, frames)
    events = test.update(rows)
    X, covariance = test.current()
    errors = rows.residuals[:, :3] - test.clock_s * rows.derivatives[:, :3, CLOCK]
    n = len(frames)
    recent = np.column_stack([rows.times, errors, np.full(n, test.clock_s), np.full(n, test.statistic)])
    status = watch.status
    status = dc.replace(
        status,
        frames=status.frames + n,
        recent=np.vstack([status.recent, recent])[-_RECENT:],
        statistic=test.statistic,
        threshold=test.threshold,
        alarmed=test.alarmed,
        events=(*status.events, *events),
        X_BC=X,
        covariance=covariance,
    )
    return dc.replace(watch, status=status, test=test, pivot=pivot)


def recalibrated(watch: _Watch) -> _Watch:
    """Return the watch of the pose that the frames since the last change show; events and alarms are cleared."""
    status, c = watch.status, watch.watched
    if c is None or status.X_BC is None or status.covariance is None or status.alarmed:
        return watch  # a change that is still being measured is no pose to go on with
    watched = dc.replace(c, X_BC=status.X_BC, covariance=status.covariance)
    status = dc.replace(status, events=(), statistic=0.0, recalibrations=status.recalibrations + 1)
    return dc.replace(watch, status=status, test=None, watched=watched)


def _tracked(
    c: MonitoredCalibration,
    estimate: FlangeEstimate,
    history: PoseHistory,
    arm: ArmModel,
    X_FR: RigidTransform,
    clock: RunClock | None,
) -> TrackedFrame | None:
    """Return a frame with the feature's pose and rates at its capture; None where one of them is missing."""
    fit = estimate.fit
    if fit is None:
        return None
    time = _captured(c, estimate, clock)
    X = [history.pose_at(arm, t) for t in (time - _HALF_S, time, time + _HALF_S)]
    before, now, after = (None if x is None else (x @ X_FR).GetAsMatrix4() for x in X)
    if now is None or before is None or after is None:
        return None
    rates = (after - before) / (2.0 * _HALF_S)
    p_C, n_C = c.correction.points(fit.center_C), c.correction.normals(fit.center_C, fit.normal_C)
    return TrackedFrame(
        id=str(estimate.sequence),
        time=time,
        p_BR=now[:3, 3],
        n_B=now[:3, 2],
        v_BR=rates[:3, 3],
        turn_B=rates[:3, 2],
        p_CR=p_C,
        n_C=n_C,
        covariance=fit.center_covariance,
        normal_sigma=fit.normal_sigma,
    )


def _captured(c: MonitoredCalibration, estimate: FlangeEstimate, clock: RunClock | None) -> float:
    """When a frame was captured (s): as its scan was ordered, by the scanner's clock in this run, or by its arrival."""
    if not np.isfinite(estimate.arrival_time):
        return estimate.capture_time
    if clock is not None and estimate.device_time is not None:
        return clock.time(estimate.device_time)
    known = None if c.clock is None else c.clock.capture(estimate.arrival_time, estimate.device_time)
    return estimate.arrival_time - c.delay_s if known is None else known
