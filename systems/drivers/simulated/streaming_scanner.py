"""Simulated streaming scanner, rendered while the cell runs or replayed from frames that were rendered before."""

import dataclasses as dc
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from weldcal.models.scanner_streams import ScannerStream, get_stream, mixed_exposure
from weldcal.models.scanners import ScannerPreset, apply_noise, depth_to_points, get_scanner
from weldcal.systems.drivers.config import check_range
from weldcal.systems.drivers.simulated.rendered_scanner import (
    DepthSensor,
    MountedScanner,
    RenderedScanner,
    darkness,
    mount_scanner,
)
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message, ScanStream, StreamedScan

_KEPT = 8  # arrived frames on the port
_SHOWN = 4  # newest frames on the port


@dc.dataclass(kw_only=True)
class StreamingScanner(RenderedScanner):
    """`!StreamingScanner`: a scanner that streams. Timing is the preset's where it is null; the shutter is global.

    It also takes single scans with the noise of `static_preset`, in the same view."""

    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ()
    preset: str = "motioncam_3d_stream_half"
    static_preset: str = "motioncam_3d_static"
    static_exposure_s: float = 0.25
    width: int | None = None
    height: int | None = None
    exposure_s: float = 0.010
    exposure_samples: int = 3  # instants of the exposure that are rendered and mixed
    fps: float | None = None
    delay_ms: float | None = None
    jitter_ms: float | None = None
    device_epoch_s: float | None = None  # the device's clock at time 0
    device_drift_ppm: float | None = None
    device_clock: bool = True  # false: frames carry no stamp of the device

    def stream(self) -> ScannerStream:
        """Return the timing of the stream. Raises InputError for times that no scanner has."""
        given = {
            "fps": self.fps,
            "delay_s": None if self.delay_ms is None else 1e-3 * self.delay_ms,
            "delay_jitter_s": None if self.jitter_ms is None else 1e-3 * self.jitter_ms,
            "device_epoch_s": self.device_epoch_s,
            "device_drift_ppm": self.device_drift_ppm,
        }
        known: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        return dc.replace(get_stream(self.preset), exposure_s=self.exposure_s, **known)

    def stream_delay_s(self) -> float | None:
        """Return the mean delay of the stream."""
        return self.stream().delay_s


@dc.dataclass(frozen=True, eq=False)
class _Streaming(Message):
    """Hold the instants of the frame that is being exposed, and the frames in transit or arrived."""

    count: int = 0
    instants: tuple[NDArray[np.float32], ...] = ()
    dark: NDArray[np.float32] | None = None
    frames: tuple[StreamedScan, ...] = ()


def exposed_cloud(
    preset: ScannerPreset,
    instants: Sequence[NDArray[np.float32]],
    dark: NDArray[np.float32] | None,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Return the organised cloud (H, W, 3) m of the depth pictures (H, W) of one exposure, with the scanner's noise."""
    p, noise = preset, preset.noise
    depth = mixed_exposure(np.stack(list(instants)), noise.edge_step_m, noise.flying, rng)
    noisy = apply_noise(depth, p, rng, dark)
    return np.asarray(depth_to_points(noisy, p.fx, p.fy, p.cx, p.cy).astype(np.float32))


class DepthStream(LeafSystem):
    """Takes a frame per period while streaming is on; it is on the port from its arrival on.

    .. pydrake_system::

        name: DepthStream
        input_ports:
        - streaming
        - depth_image
        - color_image
        output_ports:
        - stream
        - newest_capture

    The instants of an exposure are whole steps of the plant. `newest_capture` (2), the number and the true time (s) of
    the newest exposed frame, is for reports and tests only. `streaming` (1) may stay open: nothing streams then.
    """

    def __init__(
        self, preset: ScannerPreset, timing: ScannerStream, config: StreamingScanner, seed: int, plant_period_s: float
    ) -> None:
        super().__init__()
        self._preset, self._timing, self._config, self._seed = preset, timing, config, seed
        n, step = config.exposure_samples, plant_period_s
        spacing = max(1, round(timing.exposure_s / n / step))
        period = max(n * spacing, round(1.0 / timing.fps / step)) * step
        # before a tick's own update the plant's pictures show its last step, and the first exposure ends after n - 1
        # spacings
        self._capture_before_s = 0.5 * (n - 1) * spacing * step + step
        self._streaming = self.DeclareVectorInputPort("streaming", 1)
        self._depth = self.DeclareAbstractInputPort(
            "depth_image", AbstractValue.Make(ImageDepth32F(preset.width, preset.height))
        )
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(preset.width, preset.height))
        )
        self._state = self.DeclareAbstractState(AbstractValue.Make(_Streaming()))
        ticket = {self.abstract_state_ticket(self._state), self.time_ticket()}
        self.DeclareAbstractOutputPort("stream", lambda: AbstractValue.Make(ScanStream()), self._arrived, ticket)
        captured = self.DeclareDiscreteState(2)
        self.DeclareVectorOutputPort("newest_capture", 2, self._newest_capture, {self.discrete_state_ticket(captured)})
        for k in range(n):
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, (k + 1) * spacing * step, partial(self._instant, k=k))

    def _instant(self, context: Context, state: State, k: int) -> None:
        old: _Streaming = context.get_abstract_state(self._state).get_value()
        on = self._streaming.HasValue(context) and self._streaming.Eval(context)[0] > 0.5
        if not on or (k > 0 and len(old.instants) != k):
            return
        depth = np.array(self._depth.Eval(context).data[:, :, 0])
        new = dc.replace(old, instants=(*old.instants[:k], depth))
        if k == self._config.exposure_samples // 2:
            rgb = np.asarray(self._color.Eval(context).data[:, :, :3], dtype=np.float32)
            new = dc.replace(new, dark=darkness(rgb))
        if len(new.instants) == self._config.exposure_samples:
            capture = context.get_time() - self._capture_before_s
            state.get_mutable_discrete_state().set_value(np.array([new.count + 1.0, capture]))
            new = self._exposed(new, capture)
        state.get_mutable_abstract_state(self._state).set_value(new)

    def _exposed(self, s: _Streaming, capture: float) -> _Streaming:
        """Add the frame of the completed exposure to those in transit; no frame overtakes another one."""
        rng = np.random.default_rng([self._seed, s.count])
        points = exposed_cloud(self._preset, s.instants, s.dark, rng)
        arrival = capture + self._timing.delay(rng)
        if s.frames:
            arrival = max(arrival, s.frames[-1].arrival_time)
        stamp = self._timing.device_time(capture, rng) if self._config.device_clock else None
        frame = StreamedScan(s.count + 1, points_C=points, arrival_time=arrival, device_time=stamp)
        lost = rng.random() < self._timing.loss
        frames = s.frames if lost else (*s.frames[-_KEPT - 8 :], frame)
        return _Streaming(s.count + 1, frames=frames)

    def _arrived(self, context: Context, output: Any) -> None:
        s: _Streaming = context.get_abstract_state(self._state).get_value()
        now = context.get_time() + 1e-9
        output.set_value(ScanStream(tuple(f for f in s.frames if f.arrival_time <= now)[-_KEPT:]))

    def _newest_capture(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value())


def ApplyDriverConfig(config: StreamingScanner, build: StationBuild) -> RigidTransform:
    """Mount the scanner as a RenderedScanner is, add its stream and its single scans.

    Returns its true pose in its carrier's frame.
    """
    check_range("scanner.exposure_samples", config.exposure_samples, 1, 16)
    timing, world = config.stream(), build.require(SimulatedWorld)
    mounted = mount_scanner(config, build)
    seed = int(build.rng.integers(2**31))
    stream = DepthStream(mounted.device, timing, config, seed, world.plant.time_step())
    build.add("scanner", stream, "scanner.streaming", "scanner.stream")
    build.builder.Connect(mounted.sensor.depth_image_32F_output_port(), stream.GetInputPort("depth_image"))
    build.builder.Connect(mounted.sensor.color_image_output_port(), stream.GetInputPort("color_image"))
    build.outputs["cheat.scanner_capture"] = stream.GetOutputPort("newest_capture")
    _add_static_mode(config, build, mounted)
    build.outputs["cheat.joints"] = world.plant.get_state_output_port(world.arm)
    return mounted.X_LC


def _add_static_mode(config: StreamingScanner, build: StationBuild, mounted: MountedScanner) -> None:
    """Add the mode that takes a scan per trigger.

    The device's own errors are those of the stream, its noise is smaller.
    """
    own, at_rest = mounted.device.noise, get_scanner(config.static_preset).noise
    kept = ("scale_error", "gradient_per_m", "warp_m", "device")
    noise = dc.replace(at_rest, **{name: getattr(own, name) for name in kept})
    device = dc.replace(mounted.device, noise=noise)
    scans = DepthSensor(device, int(build.rng.integers(2**31)), config.static_exposure_s)
    build.add("scanner_at_rest", scans, "scanner.trigger", "scanner.scan")
    build.builder.Connect(mounted.sensor.depth_image_32F_output_port(), scans.GetInputPort("depth_image"))
    build.builder.Connect(mounted.sensor.color_image_output_port(), scans.GetInputPort("color_image"))
