"""DriftMonitor: tests a calibration on streamed observations of the flange and says whether the scanner has moved."""

import copy
import dataclasses as dc
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import (
    DEVICE,
    ScannerClock,
    ScannerCorrection,
    correction_from_document,
)
from weldcal.calibration.motion.drift.residuals import CLOCK, TrackedFrame, tracked_rows
from weldcal.calibration.motion.drift.sequential import WARM_UP, DriftConfig, DriftEvent, DriftTest, drift_config
from weldcal.models.arms.kinematics import ArmModel, chain_poses
from weldcal.models.arrays import Array
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, Message, believed_arm
from weldcal.systems.motion.buffers import PoseHistory

SEARCHED_S = 0.3  # by which a frame may come later or earlier than usual
_APART_S = 0.5  # a frame that is this early is of a clock that was set anew; one this late may be late
_RELEARN_S = 3.0  # frames that stay so late for so long belong to a clock that was set back
_NEVER_S = 5.0  # no frame is so late
_STEP_S = 0.02  # of the fit's grid of shifts
_FEWEST, _MOST = 12, 60  # frames
_CERTAIN_S = 1e-3  # half of _CONFIRMED_S: two sigma of a learnt shift are what the test lets a known clock be wrong
_CONFIRMED_S = 2e-3  # as far as the drift test lets a known clock be wrong
_REST_M = 1e-4  # by which the feature moves in SEARCHED_S at rest
_ROUNDS = 8


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RunClock:
    """A device time and the robot's time then (s), and the robot's rate over the device's.

    ``learnt``: frames in motion have shown it. Until then it is what the calibration's clock says (``known``), which is
    of another run and another start of the robot's clock, or what the earliest arrival says, wrong by what that frame
    came late. ``waiting`` are the frames that could not be used yet; ``late_since``: the arrival (s) of the first of
    those that come very late now.
    """

    device_s: float
    robot_s: float
    rate: float = 1.0
    known: bool = False
    learnt: bool = False
    waiting: tuple[FlangeEstimate, ...] = ()
    late_since: float | None = None

    def time(self, device_s: float) -> float:
        """Return a device time on the robot's clock, s."""
        return self.robot_s + self.rate * (device_s - self.device_s)


@dc.dataclass(frozen=True, eq=False)
class Seen:
    """What a clock is learnt with.

    The calibration, the arm and where the feature is on its flange, and the arm's recent motion.
    """

    X_BC: RigidTransform
    correction: ScannerCorrection
    arm: ArmModel
    X_FR: RigidTransform
    history: PoseHistory

    def features(self, times: Array) -> Array:
        """Return the feature in the base by the robot (..., 3) m at times (...) s; NaN outside the history."""
        t, q = self.history.times, self.history.positions
        if t.size < 2:
            return np.full((*times.shape, 3), np.nan)
        flat = times.ravel()
        joints = np.column_stack([np.interp(flat, t, q[:, k]) for k in range(q.shape[1])])
        p = (chain_poses(self.arm, joints) @ self.X_FR.GetAsMatrix4())[:, :3, 3]
        p[(flat < t[0]) | (flat > t[-1])] = np.nan
        return np.asarray(p.reshape(*times.shape, 3))


def followed(
    clock: RunClock | None, estimate: FlangeEstimate, delay_s: float, known: ScannerClock | None
) -> RunClock | None:
    """The clock with a new frame's times. ``known`` is the calibration's clock. None where a frame has no device time.

    No frame comes before its time, so that a clock that is not learnt yet moves to the earliest. One that was set anew
    is learnt again: at once where a frame is too early for it, or later than any frame is, else where frames stay late.
    """
    device, arrival = estimate.device_time, estimate.arrival_time
    if device is None or not np.isfinite(arrival):
        return None
    expected = None if known is None else known.capture(arrival, device)
    by_device = known is not None and known.kind == DEVICE
    usual = arrival - delay_s if by_device or expected is None else expected
    rate = 1.0 if known is None else 1.0 + (known.drift or 0.0)
    late = 0.0 if clock is None else usual - clock.time(device)
    if clock is None or late >= _NEVER_S or late <= -(_APART_S if clock.learnt else _NEVER_S):
        if by_device and expected is not None and abs(expected - usual) < SEARCHED_S:
            return RunClock(device_s=device, robot_s=expected, rate=rate, known=True)
        return RunClock(device_s=device, robot_s=usual, rate=rate)
    if not clock.learnt and (abs(late) >= SEARCHED_S if clock.known else late < 0.0):
        return dc.replace(clock, device_s=device, robot_s=usual, known=False, late_since=None)
    if late < _APART_S:
        return clock if clock.late_since is None else dc.replace(clock, late_since=None)
    if clock.late_since is None:
        return dc.replace(clock, late_since=arrival)
    return clock if arrival - clock.late_since < _RELEARN_S else RunClock(device_s=device, robot_s=usual, rate=rate)


def with_frame(clock: RunClock, estimate: FlangeEstimate, seen: Seen) -> tuple[RunClock, tuple[FlangeEstimate, ...]]:
    """Return the clock after a frame with a fit, and the frames that can be used now.

    At rest each at once, because no time is wrong there; in motion those that waited, once they show the clock. One
    that has left the history is given up. By a clock that is learnt only a very late frame waits, for the next: then it
    was late, and the clock is right.
    """
    assert estimate.device_time is not None
    if clock.learnt and clock.late_since is not None:
        return dc.replace(clock, waiting=(*clock.waiting, estimate)), ()
    if clock.learnt:
        return dc.replace(clock, waiting=()) if clock.waiting else clock, (*clock.waiting, estimate)
    time = clock.time(estimate.device_time)
    around = seen.features(time + np.array([-SEARCHED_S, 0.0, min(SEARCHED_S, seen.history.times[-1] - time)]))
    if np.linalg.norm(around - around[1], axis=1).max() < _REST_M:
        return clock, (estimate,)
    begins = seen.history.times[0] + SEARCHED_S
    waiting = [f for f in clock.waiting if f.device_time is not None and clock.time(f.device_time) > begins]
    waiting = [*waiting, estimate][-_MOST:]
    shift = _shift(clock, waiting, seen) if len(waiting) >= _FEWEST else None
    if shift is None:
        return dc.replace(clock, waiting=tuple(waiting)), ()
    if clock.known and abs(shift) < _CONFIRMED_S:
        shift = 0.0
    return dc.replace(clock, robot_s=clock.robot_s + shift, learnt=True, waiting=()), tuple(waiting)


def _shift(clock: RunClock, frames: list[FlangeEstimate], seen: Seen) -> float | None:
    """By how much (s) the robot's time is later than the clock says; None where the frames do not show it.

    The least squares of e_k = X_BC p_C,k - p_BR(t_k + shift) - o, whose common part o takes out a scanner that was
    moved before: first over steps of _STEP_S, then by Gauss-Newton.
    """
    times = np.array([clock.time(f.device_time) for f in frames if f.device_time is not None])
    centers = np.array([f.fit.center_C for f in frames if f.fit is not None])
    q = np.array([seen.X_BC @ p for p in seen.correction.points(centers)])
    shifts = np.arange(-SEARCHED_S, SEARCHED_S + 0.5 * _STEP_S, _STEP_S)
    e = q - seen.features(times + shifts[:, None])
    e -= np.nanmean(e, axis=1, keepdims=True)
    inside = np.isfinite(e[:, :, 0]).all(axis=1)  # a later time may not have been recorded yet
    if not inside.any():
        return None
    spread = np.einsum("dkx,dkx->d", e[inside], e[inside])
    shift = float(shifts[inside][np.argmin(spread)])
    for _ in range(_ROUNDS):
        before, now, after = seen.features(times + shift + np.array([-_HALF_S, 0.0, _HALF_S])[:, None])
        v = (after - before) / (2.0 * _HALF_S)
        e, v = q - now, v - v.mean(axis=0)
        e -= e.mean(axis=0)
        told = float(np.einsum("kx,kx", v, v))
        if not np.isfinite(told) or told <= 0.0:
            return None
        step = float(np.einsum("kx,kx", v, e)) / told
        shift += step
        if abs(step) < 1e-6:
            break
    sigma = np.sqrt(float(np.einsum("kx,kx", e, e)) / (3 * len(frames) - 4) / told)
    return shift if sigma < _CERTAIN_S and abs(shift) <= SEARCHED_S else None


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
    def of(result: CalibrationResult, delay_s: float, *, false_alarms_per_hour: float = 1e-3) -> "MonitoredCalibration":
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
    def made(status: CalibrationStatus, delay_s: float, config: DriftConfig) -> "MonitoredCalibration | None":
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
    waited = 0 if watch.clock is None else len(watch.clock.waiting)
    clock, done = followed(watch.clock, estimate, c.delay_s, c.clock), 1
    usable: tuple[FlangeEstimate, ...] = (estimate,)
    if clock is not None:
        clock, usable = with_frame(clock, estimate, Seen(c.X_BC, c.correction, arm, X_FR, history))
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
