"""Messages of the calibration in motion: the procedure's state, what was collected, and the result."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.motion.estimate import MotionEstimate
from weldcal.models.arrays import Array
from weldcal.systems.messages import Message


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionState(Message):
    """State of the procedure. `phase`: start, approach, collect, home, calibrate, done or held."""

    phase: str = "start"
    since: float = 0.0
    goal_id: int = 0
    q_goal: Array | None = None
    corner: int = -1
    legs: int = 0
    reason: str = ""


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
