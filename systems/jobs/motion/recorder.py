"""MotionRecorder: writes each streamed frame to a folder as it arrives, for a recording in motion."""

from pathlib import Path

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus

from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream, save_motion_dataset
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import ScanStream


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

    def finish(self, stream: RobotStream, robot: str, flange: str, scanner: ScannerPreset) -> int:
        """Write dataset.yaml, stream.csv and frames.csv; returns the number of frames."""
        header = DatasetHeader(
            robot=robot,
            flange=flange,
            scanner=scanner.name,
            configuration="eye_on_base",
            note="a run of the motion job",
        )
        save_motion_dataset(self.folder, header, stream, self._frames, ())
        return len(self._frames)
