"""What all finger cameras by wire share: their configuration, rectified pictures, and the system that shows them."""

import dataclasses as dc
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from weldcal.models.errors import InputError
from weldcal.models.tool import FingerCamera
from weldcal.models.tools.finger_file import FingerFile, read_finger_file
from weldcal.systems.drivers.config import FingerCameraConfig
from weldcal.systems.drivers.sensors.acquisition import Acquisition, Garbage, Rules, Source
from weldcal.systems.drivers.sensors.stamps import DiagramTime
from weldcal.systems.drivers.sensors.watch import begin
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Image

Picture = NDArray[np.uint8]
PERIOD_S = 0.004  # the period of the robot's commands; a picture is delayed by at most this


@dc.dataclass(kw_only=True)
class WiredFingerCamera(FingerCameraConfig):
    """The keys of all finger cameras by wire."""

    width: int = 400  # of the pictures that the camera sends
    height: int = 300
    focal_px: float = 450.0
    rate_hz: float = 30.0
    latency_s: float = 0.0  # from the middle of the exposure to the arrival; with stamps: that of the earliest pictures
    exposure_ms: float | None = None  # null: as the camera has it
    gain: float | None = None
    # file of `weldcal finger calibrate`: its focal length, distortion and tag take the place of focal_px
    calibration: str = ""
    silent_s: float = 0.5  # without a usable picture: a fault
    frozen_s: float = 0.5  # with identical pictures: a fault
    late_s: float = 0.5  # that a picture comes late: a fault

    def camera(self) -> FingerCamera:
        """Image size, focal length, frame rate and latency."""
        found = self.calibrated()
        focal = self.focal_px if found is None else found.focal_px
        return FingerCamera(self.width, self.height, focal, self.rate_hz, self.latency_s, 0.0)

    def calibrated(self) -> FingerFile | None:
        """The calibration that the scenario names. Raises InputError where it cannot be used with these pictures."""
        if not self.calibration:
            return None
        found = read_finger_file(Path(self.calibration))
        if (found.width, found.height) != (self.width, self.height):
            raise InputError(
                f"'{self.calibration}' was made with pictures of {found.width} x {found.height}, and finger_camera has "
                f"{self.width} x {self.height}: calibrate again, or set width and height."
            )
        return found

    def tag_size_m(self) -> float | None:
        """Return the tag's measured side, m; None where there is no calibration of it."""
        found = self.calibrated()
        return None if found is None else found.tag_size_m

    def rules(self) -> Rules:
        """When this camera is at fault. Raises InputError for times within which no picture can come."""
        least = 3.0 / self.rate_hz
        for name in ("silent_s", "frozen_s", "late_s"):
            if not getattr(self, name) >= least:
                raise InputError(
                    f"finger_camera.{name} must be at least {least:.3g}, three pictures at {self.rate_hz:g} Hz, and it"
                    f" is {getattr(self, name):g}."
                )
        return Rules(self.silent_s, self.frozen_s, self.late_s, lost_s=self.silent_s)


def checked_picture(picture: NDArray[Any], width: int, height: int) -> Picture:
    """Return the picture (H, W) in grey. Raises Garbage where it has another size."""
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.shape[2] == 3 else picture[..., 0]
    if picture.shape != (height, width):
        raise Garbage(
            f"its pictures are {picture.shape[1]} x {picture.shape[0]}, and the scenario has {width} x {height}: "
            "set finger_camera.width and height"
        )
    return np.ascontiguousarray(picture, dtype=np.uint8)


class WiredPictures(LeafSystem):
    """Shows the camera's newest picture while streaming is on.

    .. pydrake_system::

        name: WiredPictures
        input_ports:
        - streaming
        output_ports:
        - image
        - capture_time

    Ports as those of the simulated finger camera. Capture times are on the arm's clock.
    """

    def __init__(self, acquisition: Acquisition[Picture]) -> None:
        super().__init__()
        self.acquisition = acquisition
        self._times, self._shown = DiagramTime(), Image()
        self._streaming = self.DeclareVectorInputPort("streaming", 1)
        state = self.DeclareDiscreteState([0.0, -np.inf])  # number and capture time
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort("image", lambda: AbstractValue.Make(Image()), self._image, ticket)
        self.DeclareVectorOutputPort("capture_time", 1, self._capture_time, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        self._times.add(time.monotonic(), context.get_time())
        if self._streaming.Eval(context)[0] < 0.5:
            return
        frames = self.acquisition.frames()
        if frames and frames[-1].number > context.get_discrete_state_vector()[0]:
            newest = frames[-1]
            captured = self._times.at(newest.stamp.captured)
            self._shown = Image(newest.number, captured, newest.datum, exposed_at=captured)
            discrete.set_value([float(newest.number), captured])

    def _image(self, context: Context, output: Any) -> None:
        shown = context.get_discrete_state_vector()[0] > 0.5
        output.set_value(self._shown if shown else Image())

    def _capture_time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_discrete_state_vector()[1])


def acquire_pictures(config: WiredFingerCamera, source: Source[Picture]) -> Acquisition[Picture]:
    """Return the acquisition of a camera's pictures, not started yet."""
    found = config.calibrated()
    prepare = None if found is None else found.rectifier()
    return Acquisition(source, config.rules(), kept=3, latency_s=config.latency_s, prepare=prepare)


def add_camera(config: WiredFingerCamera, source: Source[Picture], build: StationBuild) -> None:
    """Start the acquisition and add the camera's system with its ports to the station.

    Raises:
        DeviceFault: the camera sends no picture.
    """
    acquisition = acquire_pictures(config, source)
    begin(build, acquisition, "finger_camera", first_frame=True)
    ports = (f"finger_camera.{port}" for port in ("streaming", "image", "capture_time"))
    build.add("finger_camera", WiredPictures(acquisition), *ports)
