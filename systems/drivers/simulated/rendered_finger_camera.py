"""Simulated finger camera: renders the tag that moves with the soft tip, and adds noise and latency."""

import dataclasses as dc
from concurrent.futures import Future
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    FramePoseVector,
    RenderCameraCore,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State
from pydrake.systems.sensors import CameraInfo, RgbdSensor
from scipy.special import ndtri

from weldcal.models.tool import FingerCamera
from weldcal.systems.drivers.config import FingerCameraConfig
from weldcal.systems.drivers.simulated.picture_worker import Draw, PictureWorker, Pixels
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import Image, Message


@dc.dataclass
class RenderedFingerCamera(FingerCameraConfig):
    """`!RenderedFingerCamera`: the camera in the tool that observes the tag."""

    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ("finger_camera",)
    SIMULATED: ClassVar[bool] = True
    width: int = 400  # the window that is read out of a 640 x 480 sensor: the tag and its range of motion
    height: int = 300
    focal_px: float = 450.0
    rate_hz: float = 30.0
    latency_s: float = 0.040
    noise_grey: float = 2.0
    hidden_from_s: float | None = (
        None  # spatter on the lens: the tag is not visible from this time after the camera started
    )

    def camera(self) -> FingerCamera:
        """Image size, focal length, frame rate and latency."""
        return FingerCamera(self.width, self.height, self.focal_px, self.rate_hz, self.latency_s, self.noise_grey)


@dc.dataclass(frozen=True, eq=False)
class _Exposed(Message):
    """An exposed frame and its pixels (H, W), which may still be rendering."""

    frame: Image
    pixels: "Future[Pixels]"


@dc.dataclass(frozen=True, eq=False)
class _Stream(Message):
    """The newest frames, oldest first, including those that the latency has not released yet."""

    started: float = -np.inf
    count: int = 0
    frames: tuple[_Exposed, ...] = ()


@lru_cache(maxsize=4)
def _noise_table(sigma: float) -> np.ndarray:
    """65536 equally likely values of Gaussian noise, rounded to whole grey levels as by a camera; a draw is one look-up."""
    return np.asarray(np.floor(sigma * ndtri((np.arange(65536) + 0.5) / 65536)), dtype=np.int16)


def with_noise(grey: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """A picture (H, W) uint8 with Gaussian noise of `sigma` grey levels on each pixel, as uint8."""
    drawn = np.frombuffer(rng.bytes(2 * grey.size), dtype=np.uint16).reshape(grey.shape)
    return np.asarray(cv2.add(grey, np.take(_noise_table(sigma), drawn), dtype=cv2.CV_8U), dtype=np.uint8)


class StreamingColourCamera(LeafSystem):
    """Takes grey frames at the camera's rate while streaming is on.

    .. pydrake_system::

        name: StreamingColourCamera
        input_ports:
        - streaming
        - frame_poses
        output_ports:
        - image
        - capture_time

    A frame shows the world at the plant's last step, and its capture time is the time of that step. `frame_poses`
    (FramePoseVector): poses of the bodies in the camera's scene; `draw` starts a picture of them. Where it is not ready when
    the frame arrives the system waits for it, or with `waits` off, beside a robot, the frame arrives later.
    """

    def __init__(
        self, config: RenderedFingerCamera, seed: int, plant_period_s: float, draw: Draw, waits: bool = True
    ) -> None:
        super().__init__()
        self._config = config
        self._seed = seed
        self._plant_period_s = plant_period_s
        self._draw, self._waits = draw, waits
        self._streaming = self.DeclareVectorInputPort("streaming", 1)
        self._poses = self.DeclareAbstractInputPort("frame_poses", AbstractValue.Make(FramePoseVector()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(_Stream()))
        ticket = {self.abstract_state_ticket(self._state), self.time_ticket()}
        self.DeclareAbstractOutputPort("image", lambda: AbstractValue.Make(Image()), self._image, ticket)
        self.DeclareVectorOutputPort("capture_time", 1, self._capture_time, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(1.0 / config.rate_hz, 0.0, self._expose)

    def first_picture(self, context: Context) -> Pixels:
        """Render and return the colours (H, W, 4) at the current poses; a renderer's first picture takes a second."""
        return self._draw(self._poses.Eval(context), lambda colours: colours.copy()).result()

    def _expose(self, context: Context, state: State) -> None:
        stream: _Stream = context.get_abstract_state(self._state).get_value()
        if self._streaming.Eval(context)[0] < 0.5:
            return
        if not self._waits and stream.frames and not stream.frames[-1].pixels.done():
            return  # the renderer is late: this frame is dropped, so that pictures do not pile up
        now = context.get_time()
        started = stream.started if np.isfinite(stream.started) else now
        hidden = self._config.hidden_from_s is not None and now - started >= self._config.hidden_from_s
        rng = np.random.default_rng([self._seed, stream.count])
        covered = np.full((self._config.height, self._config.width), 25, dtype=np.uint8)

        def finish(colours: Pixels) -> Pixels:
            # The tag is black on white: one channel is sufficient.
            grey = covered if hidden else np.asarray(cv2.extractChannel(colours, 1), dtype=np.uint8)
            return with_noise(grey, self._config.noise_grey, rng)

        pixels = self._draw(self._poses.Eval(context), finish)
        step = self._plant_period_s
        taken = (
            np.ceil(now / step - 1e-6) - 1.0
        ) * step  # at the time of a tick the plant's outputs still show the previous step
        frame = _Exposed(Image(stream.count + 1, taken, exposed_at=now), pixels)
        kept = 4 + int(self._config.latency_s * self._config.rate_hz)  # enough frames to cover the latency
        new = dc.replace(stream, started=started, count=stream.count + 1, frames=(*stream.frames[-kept:], frame))
        state.get_mutable_abstract_state(self._state).set_value(new)

    def _arrived(self, context: Context) -> Image:
        stream: _Stream = context.get_abstract_state(self._state).get_value()
        now = context.get_time()
        ripe = [e for e in stream.frames if now >= e.frame.exposed_at + self._config.latency_s - 1e-9]
        ripe = [e for e in ripe if self._waits or e.pixels.done()]
        return dc.replace(ripe[-1].frame, pixels=ripe[-1].pixels.result()) if ripe else Image()

    def _image(self, context: Context, output: Any) -> None:
        output.set_value(self._arrived(context))

    def _capture_time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._arrived(context).capture_time)


def ApplyDriverConfig(config: RenderedFingerCamera, build: StationBuild) -> None:
    """Add a colour camera to the tool and its streaming system to the station."""
    world, tool = build.require(SimulatedWorld), build.tool
    view = world.finger_view
    if tool is None or view is None or view.apart is None:
        return
    camera = config.camera()
    K = camera.camera_matrix
    info = CameraInfo(
        config.width, config.height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
    )  # half pixel: VTK's convention
    core = RenderCameraCore(view.renderer, info, ClippingRange(0.005, 0.5), RigidTransform())
    color, depth = ColorRenderCamera(core, False), DepthRenderCamera(core, DepthRange(0.01, 0.4))
    frame = view.frames[world.plant.GetBodyByName("tool_plate", world.tool).index()]
    sensor = view.apart.AddSystem(RgbdSensor(frame, tool.X_FK, color, depth))
    view.apart.Connect(view.scene_graph.get_query_output_port(), sensor.query_object_input_port())
    worker = PictureWorker(view.apart, sensor)
    build.parts = (*build.parts, worker)
    stream = build.builder.AddSystem(
        StreamingColourCamera(
            config, int(build.rng.integers(2**31)), world.plant.time_step(), worker.draw, build.may_wait
        )
    )
    stream.set_name("finger_camera")
    build.builder.Connect(view.poses.GetOutputPort("frame_poses"), stream.GetInputPort("frame_poses"))
    build.inputs["finger_camera.streaming"] = stream.GetInputPort("streaming")
    build.outputs["finger_camera.image"] = stream.GetOutputPort("image")
    build.outputs["finger_camera.capture_time"] = stream.GetOutputPort("capture_time")
