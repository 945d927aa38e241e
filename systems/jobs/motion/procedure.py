"""Systems of the motion job: MotionProcedure, MotionCollector, MotionCalibrator and MotionRecorder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, State

from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream, save_motion_dataset
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.motion.estimate import MotionEstimate
from weldcal.calibration.motion.frames import observed_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.recorded_motion import RecordedMotion, calibrate_frames
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.background import Answer, Background, BackgroundSystem
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import FlangeEstimate, JobCommand, Message, ScanStream

_BLIND_S = 10.0  # without a single frame that shows the flange
_BLOCK = 512  # samples that are joined to one array: copies of short tuples are cheap


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionState(ProcedureState):
    """State of the procedure."""

    corner: int = -1
    legs: int = 0  # moves between corners


@dataclass(frozen=True, eq=False)
class MotionRecord(Message):
    """What was collected: the frames with their flange fits, the reasons of those without, and the arm's joints.

    Joint samples are rows (n, 7) of time s and joints rad: whole ``blocks``, and the newest samples.
    """

    sequence: int = 0
    seen: tuple[tuple[FrameTime, FlangeFit], ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    waits_s: tuple[float, ...] = ()  # from each frame's arrival to its estimate on the port
    blocks: tuple[Array, ...] = ()
    newest: tuple[Array, ...] = ()

    def stream(self, robot: str) -> RobotStream:
        """Return the robot's stream, without poses: they follow from the joints."""
        rows = np.concatenate([*self.blocks, np.array(self.newest).reshape(-1, 7)])
        return RobotStream(rows[:, 0], np.tile(np.eye(4), (len(rows), 1, 1)), rows[:, 1:], robot)


@dataclass(frozen=True, eq=False)
class MotionCalibration(Message):
    """The calibration, or the reason why there is none; `asked` counts what was asked for."""

    asked: int = 0
    found: RecordedMotion | None = None
    reason: str = ""

    @property
    def estimate(self) -> MotionEstimate | None:
        """The estimate of what was found."""
        return None if self.found is None else self.found.estimate


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionInputs(Inputs):
    """Inputs of the procedure at one tick."""

    record: MotionRecord
    calibration: MotionCalibration


class MotionProcedure(Procedure[MotionState, MotionInputs]):
    """Runs the procedure.

    A robot fault, a goal that is not reached, or a scanner that shows nothing holds it with a reason.

    .. pydrake_system::

        name: MotionProcedure
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - record
        - calibration
        output_ports:
        - job
        - state
        - streaming

    A procedure that does not calibrate ends at home, and its port `calibration` stays open. `hold` (1) is the
    operator's stop request. `streaming` (1) turns the scanner on from the first corner to the last.
    """

    inputs = MotionInputs
    moves = ("approach", "collect", "home")
    flags: ClassVar = {"streaming": ("collect",)}
    position_port = trigger_port = ""

    def __init__(
        self,
        corners: Sequence[Array],
        q_home: Array,
        frames: int,
        *,
        speed_share: float = 1.0,
        timeout_s: float = 60.0,
        maximum_time_s: float = np.inf,
        period_s: float = 0.008,
        calibrates: bool = True,
    ) -> None:
        super().__init__(MotionState(), move_timeout_s=timeout_s, maximum_time_s=maximum_time_s, period_s=period_s)
        self._corners, self._home, self._frames = tuple(corners), q_home, frames
        self._speed_share, self._calibrates = speed_share, calibrates
        self.read("calibration", record=MotionRecord(), calibration=MotionCalibration())

    def attend(self, s: MotionState, now: MotionInputs) -> MotionState:
        """See Procedure: a scanner that shows nothing."""
        record = now.record
        if s.phase == "collect" and not record.seen and s.legs > 2 and len(record.waits_s) * 0.05 > _BLIND_S:
            last = record.refused[-1][1] if record.refused else "no frame arrived"
            return self.held(s, now, f"The scanner does not see the flange: {last}")
        return s

    def command(self, s: MotionState, arm: int = 0) -> JobCommand:
        """See Procedure."""
        return replace(super().command(s), speed_share=self._speed_share if s.phase == "collect" else 1.0)

    def _start(self, s: MotionState, now: MotionInputs) -> MotionState:
        return self.go(s, now, "approach", self._corners[0], corner=0)

    def _at_corner(self, s: MotionState, now: MotionInputs) -> MotionState:
        if s.phase == "collect" and len(now.record.seen) >= self._frames:
            return self.go(s, now, "home", self._home, corner=-1)
        corner = (s.corner + 1) % len(self._corners)
        return self.go(s, now, "collect", self._corners[corner], corner=corner, legs=s.legs + 1)

    def _at_home(self, s: MotionState, now: MotionInputs) -> MotionState:
        return self.enter(s, now, "calibrate" if self._calibrates else "done")

    def _calibrated(self, s: MotionState, now: MotionInputs) -> MotionState:
        if not now.calibration.asked:
            return s
        if now.calibration.found is None:
            return self.held(s, now, now.calibration.reason)
        return self.enter(s, now, "done")

    steps: ClassVar = {
        "start": _start,
        "approach": _at_corner,
        "collect": _at_corner,
        "home": _at_home,
        "calibrate": _calibrated,
    }


class MotionCollector(LeafSystem):
    """Adds each new estimate, and a sample of the joints per tick.

    .. pydrake_system::

        name: MotionCollector
        input_ports:
        - flange_estimate
        - position_measured
        - sample_time
        - state
        output_ports:
        - record
    """

    def __init__(self, period_s: float = 0.008) -> None:
        super().__init__()
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._time = self.DeclareVectorInputPort("sample_time", 1)
        self._job = self.DeclareAbstractInputPort("state", AbstractValue.Make(MotionState()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(MotionRecord()))
        self.DeclareStateOutputPort("record", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._collect)

    def _collect(self, context: Context, state: State) -> None:
        old: MotionRecord = context.get_abstract_state(self._state).get_value()
        if self._job.Eval(context).phase not in ("approach", "collect", "home"):
            return
        row = np.append(self._time.Eval(context), self._position.Eval(context))
        new = _sampled(old, row)
        estimate: FlangeEstimate = self._estimate.Eval(context)
        if estimate.sequence > old.sequence and np.isfinite(estimate.arrival_time):
            new = _with_frame(new, estimate, context.get_time())
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)


def _sampled(record: MotionRecord, row: np.ndarray) -> MotionRecord:
    """Return the record with one more sample; a repeated time is left out."""
    last = record.newest[-1] if record.newest else (record.blocks[-1][-1] if record.blocks else None)
    if last is not None and row[0] <= last[0]:
        return record
    newest = (*record.newest, row)
    if len(newest) < _BLOCK:
        return replace(record, newest=newest)
    return replace(record, blocks=(*record.blocks, np.array(newest)), newest=())


def _with_frame(record: MotionRecord, estimate: FlangeEstimate, now: float) -> MotionRecord:
    """Return the record with one more frame."""
    id = f"{estimate.sequence:05d}"
    record = replace(record, sequence=estimate.sequence, waits_s=(*record.waits_s, now - estimate.arrival_time))
    if estimate.fit is None:
        return replace(record, refused=(*record.refused, (id, estimate.reason or "")))
    frame = FrameTime(id, estimate.arrival_time, estimate.device_time)
    return replace(record, seen=(*record.seen, (frame, estimate.fit)))


class MotionCalibrator(BackgroundSystem):
    """Calibrates when the procedure asks for it, beside the control loop.

    .. pydrake_system::

        name: MotionCalibrator
        input_ports:
        - record
        - state
        output_ports:
        - calibration
    """

    def __init__(
        self,
        arm: ArmModel,
        background: Background | None = None,
        period_s: float = 0.02,
        header: DatasetHeader | None = None,
    ) -> None:
        super().__init__("calibration", MotionCalibration(), background, period_s)
        self._arm, self._header = arm, header or DatasetHeader()
        self._record = self.DeclareAbstractInputPort("record", AbstractValue.Make(MotionRecord()))
        self._job = self.DeclareAbstractInputPort("state", AbstractValue.Make(MotionState()))

    def ask(self, context: Context, newest: MotionCalibration) -> Answer[MotionCalibration] | None:
        """Ask for the calibration once, when everything has been collected."""
        if newest.asked or self._job.Eval(context).phase != "calibrate":
            return None
        return self.background.ask(calibrate_record, self._record.Eval(context), self._arm, self._header)


def calibrate_record(record: MotionRecord, arm: ArmModel, header: DatasetHeader) -> MotionCalibration:
    """Calibrate from a record; without a result, the reason is given and no exception is raised.

    The robot's own kinematics are used, so that its factory calibration counts. ``header`` names robot, flange and
    scanner.
    """
    frames = observed_frames([f for f, _ in record.seen], {f.id: fit for f, fit in record.seen})
    try:
        motion = ContinuousMotion(posed_stream(record, arm))
        return MotionCalibration(
            1,
            calibrate_frames(
                frames, motion, record.refused, robot=header.robot, flange=header.flange, scanner=header.scanner
            ),
        )
    except WeldcalError as error:
        return MotionCalibration(1, reason=str(error))


def posed_stream(record: MotionRecord, arm: ArmModel) -> RobotStream:
    """Return the robot's stream as flange poses by its own kinematics."""
    stream = record.stream(arm.name)
    assert stream.joints is not None
    poses = np.array([forward_kinematics(arm, q).GetAsMatrix4() for q in stream.joints])
    return RobotStream(stream.time, poses, None, arm.name)


class MotionRecorder(LeafSystem):
    """Writes clouds in publish events; `finish` writes the tables beside them.

    .. pydrake_system::

        name: MotionRecorder
        input_ports:
        - stream
    """

    def __init__(self, folder: Path, period_s: float = 0.02) -> None:
        super().__init__()
        self.folder = folder
        self._frames: list[FrameTime] = []
        self._newest = 0
        self._stream = self.DeclareAbstractInputPort("stream", AbstractValue.Make(ScanStream()))
        self.DeclarePeriodicPublishEvent(period_s, 0.0, self._write)

    def _write(self, context: Context) -> EventStatus:
        stream: ScanStream = self._stream.Eval(context)
        for frame in stream.frames:
            if frame.sequence <= self._newest:
                continue
            self._newest, id = frame.sequence, f"{frame.sequence:05d}"
            (self.folder / "clouds").mkdir(parents=True, exist_ok=True)
            points = np.asarray(frame.points_C, dtype=np.float64)
            save_cloud(self.folder / "clouds" / f"{id}.npz", points)
            self._frames.append(FrameTime(id, frame.arrival_time, frame.device_time))
        return EventStatus.Succeeded()

    def finish(self, stream: RobotStream, header: DatasetHeader) -> int:
        """Write dataset.yaml, stream.csv and frames.csv; returns the number of frames."""
        save_motion_dataset(self.folder, header, stream, self._frames, ())
        return len(self._frames)
