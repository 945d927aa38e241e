"""Simulated finger camera: draws the tag that moves with the soft tip, and adds noise and latency."""

import dataclasses as dc
from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State
from scipy.special import ndtri

from weldcal.models.arrays import Array
from weldcal.models.tool import FingerCamera, WeldingTool
from weldcal.systems.bodies.tool import SOFT, TAG_PLATE_DEPTH_M, printed_tag, tool_tag
from weldcal.systems.drivers.config import FingerCameraConfig
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Image, Message

Pixels = NDArray[np.uint8]
_SUBPIXEL_BITS = 8
COVERED_GREY = 25  # of a lens under spatter


class TagView:
    """Render the tag of a tool in a pinhole camera. The tag is flat, so its picture is a homography of the print.

    A renderer takes ten times as long for the same picture.
    """

    def __init__(self, tool: WeldingTool, camera: FingerCamera) -> None:
        self._X_KF = tool.X_FK.inverse()
        self._K, self._size = camera.camera_matrix, (camera.height, camera.width)
        self._print, size = printed_tag(tool_tag(tool))
        h, w = self._print.shape
        # the outer corners of the print's first and last texels, clockwise from the upper left
        self._texels = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]], dtype=np.float32)
        square = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        self._print_M, self._plate_M = (
            0.5 * size * square,
            0.5 * tool.tag_plate_m * square - [0.0, 0.0, TAG_PLATE_DEPTH_M],
        )

    def picture(self, X_FM: RigidTransform) -> Pixels:
        """The grey picture (H, W) of the tag at X_FM in the flange frame; M: x right, y up, z out of the print."""
        X_KM = self._X_KF @ X_FM
        found = np.full(self._size, round(255 * SOFT[1]), dtype=np.uint8)
        plate = np.round(self._pixels(X_KM, self._plate_M) * 2**_SUBPIXEL_BITS).astype(np.int32)
        cv2.fillConvexPoly(found, plate, 255, cv2.LINE_AA, _SUBPIXEL_BITS)
        corners = self._pixels(X_KM, self._print_M)
        # only where the print is: to go over the whole picture takes ten times as long
        low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, (found.shape[1], found.shape[0]))
        if (low >= high).any():
            return found
        H = cv2.getPerspectiveTransform(self._texels, corners.astype(np.float32))
        H = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]]) @ H
        seen = found[low[1] : high[1], low[0] : high[0]]
        size = (seen.shape[1], seen.shape[0])
        cv2.warpPerspective(self._print, H, size, seen, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
        return found

    def _pixels(self, X_KM: RigidTransform, corners_M: Array) -> Array:
        """Pixels (4, 2) of corners (4, 3) m in M; the centre of the first pixel is (0, 0)."""
        p = corners_M @ X_KM.rotation().matrix().T + X_KM.translation()
        return np.asarray((p @ self._K.T)[:, :2] / p[:, 2:])


@dc.dataclass(kw_only=True)
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
    # spatter on the lens: the tag is not visible from this time after the camera started
    hidden_from_s: float | None = None

    def camera(self) -> FingerCamera:
        """Image size, focal length, frame rate and latency."""
        return FingerCamera(self.width, self.height, self.focal_px, self.rate_hz, self.latency_s, self.noise_grey)


@dc.dataclass(frozen=True, eq=False)
class _Stream(Message):
    """The newest frames, oldest first, including those that the latency has not released yet."""

    started: float = -np.inf
    count: int = 0
    frames: tuple[Image, ...] = ()


_NO_IMAGE = Image()


@lru_cache(maxsize=4)
def _noise_table(sigma: float) -> np.ndarray:
    """65536 equally likely values of Gaussian noise, rounded to whole grey levels as by a camera.

    A draw is one look-up.
    """
    return np.asarray(np.floor(sigma * ndtri((np.arange(65536) + 0.5) / 65536)), dtype=np.int16)


def with_noise(grey: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Return a picture (H, W) uint8 with Gaussian noise of `sigma` grey levels on each pixel, as uint8."""
    drawn = np.frombuffer(rng.bytes(2 * grey.size), dtype=np.uint16).reshape(grey.shape)
    return np.asarray(cv2.add(grey, np.take(_noise_table(sigma), drawn), dtype=cv2.CV_8U), dtype=np.uint8)


class StreamingCamera(LeafSystem):
    """Takes grey frames at the camera's rate while streaming is on.

    .. pydrake_system::

        name: StreamingCamera
        input_ports:
        - streaming
        - body_poses
        output_ports:
        - image
        - capture_time

    A frame shows the world at the plant's last step, and its capture time is the time of that step. `body_poses`: the
    plant's; `draw` makes the grey picture (H, W) of them. A frame arrives after the camera's latency.
    """

    def __init__(
        self,
        config: RenderedFingerCamera,
        seed: int,
        plant_period_s: float,
        draw: Callable[[list[RigidTransform]], Pixels],
    ) -> None:
        super().__init__()
        self._config = config
        self._seed = seed
        self._plant_period_s = plant_period_s
        self._draw = draw
        self._streaming = self.DeclareVectorInputPort("streaming", 1)
        self._poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self._state = self.DeclareAbstractState(AbstractValue.Make(_Stream()))
        ticket = {self.abstract_state_ticket(self._state), self.time_ticket()}
        self.DeclareAbstractOutputPort("image", lambda: AbstractValue.Make(Image()), self._image, ticket)
        self.DeclareVectorOutputPort("capture_time", 1, self._capture_time, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(1.0 / config.rate_hz, 0.0, self._expose)

    def _expose(self, context: Context, state: State) -> None:
        stream: _Stream = context.get_abstract_state(self._state).get_value()
        if self._streaming.Eval(context)[0] < 0.5:
            return
        now = context.get_time()
        started = stream.started if np.isfinite(stream.started) else now
        hidden = self._config.hidden_from_s is not None and now - started >= self._config.hidden_from_s
        covered = np.full((self._config.height, self._config.width), COVERED_GREY, dtype=np.uint8)
        grey = covered if hidden else self._draw(self._poses.Eval(context))
        pixels = with_noise(grey, self._config.noise_grey, np.random.default_rng([self._seed, stream.count]))
        step = self._plant_period_s
        # at the time of a tick the plant's outputs still show the previous step
        taken = (np.ceil(now / step - 1e-6) - 1.0) * step
        frame = Image(stream.count + 1, taken, pixels, exposed_at=now)
        kept = 4 + int(self._config.latency_s * self._config.rate_hz)  # enough frames to cover the latency
        new = dc.replace(stream, started=started, count=stream.count + 1, frames=(*stream.frames[-kept:], frame))
        state.get_mutable_abstract_state(self._state).set_value(new)

    def _arrived(self, context: Context) -> Image:
        stream: _Stream = context.get_abstract_state(self._state).get_value()
        now, latency = context.get_time(), self._config.latency_s
        return next((f for f in reversed(stream.frames) if now >= f.exposed_at + latency - 1e-9), _NO_IMAGE)

    def _image(self, context: Context, output: Any) -> None:
        output.set_value(self._arrived(context))

    def _capture_time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._arrived(context).capture_time)


def ApplyDriverConfig(config: RenderedFingerCamera, build: StationBuild) -> None:
    """Add the streaming camera in the tool to the station."""
    world, tool = build.require(SimulatedWorld), build.tool
    if tool is None or world.tool is None:
        return
    plate, tip = (int(world.plant.GetBodyByName(name, world.tool).index()) for name in ("tool_plate", "tip_z"))
    view, X_TM = TagView(tool, config.camera()), tool.X_FT.InvertAndCompose(tool.X_FM_rest)

    def draw(body_poses: list[RigidTransform]) -> Pixels:
        return view.picture(body_poses[plate].InvertAndCompose(body_poses[tip]) @ X_TM)

    camera = StreamingCamera(config, int(build.rng.integers(2**31)), world.plant.time_step(), draw)
    build.add("finger_camera", camera, *(f"finger_camera.{name}" for name in ("streaming", "image", "capture_time")))
    build.builder.Connect(world.plant.get_body_poses_output_port(), camera.GetInputPort("body_poses"))
