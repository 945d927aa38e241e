"""MotionProcedure: moves the flange between the corners of a cube until enough frames are collected, then asks for the
result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.motion.estimate import MotionEstimate
from weldcal.models.arrays import Array
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.messages import JobCommand, Message

_BLIND_S = 10.0  # without a single frame that shows the flange


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
        """The robot's stream, without poses: they follow from the joints."""
        rows = np.concatenate([*self.blocks, np.array(self.newest).reshape(-1, 7)])
        return RobotStream(rows[:, 0], np.tile(np.eye(4), (len(rows), 1, 1)), rows[:, 1:], robot)


@dataclass(frozen=True, eq=False)
class MotionCalibration(Message):
    """The calibration, or the reason why there is none; `asked` counts what was asked for."""

    asked: int = 0
    estimate: MotionEstimate | None = None
    reason: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionInputs(Inputs):
    """Inputs of the procedure at one tick."""

    record: MotionRecord
    calibration: MotionCalibration


class MotionProcedure(Procedure[MotionState, MotionInputs]):
    """Runs the procedure; a robot fault, a goal that is not reached, or a scanner that shows nothing holds it with a
    reason.

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
        if now.calibration.estimate is None:
            return self.held(s, now, now.calibration.reason)
        return self.enter(s, now, "done")

    steps: ClassVar = {
        "start": _start,
        "approach": _at_corner,
        "collect": _at_corner,
        "home": _at_home,
        "calibrate": _calibrated,
    }
