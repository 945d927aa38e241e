"""What all scanners by wire share.

Their configuration, the system that asks for scans, and the one that shows a stream.
"""

import dataclasses as dc
import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset, get_scanner
from weldcal.systems.drivers.config import ScannerConfig, check_range
from weldcal.systems.drivers.sensors.acquisition import AcquiredFrame, Acquisition, Garbage, Rules, Source
from weldcal.systems.drivers.sensors.stamps import DiagramTime
from weldcal.systems.drivers.sensors.watch import OnTrigger, begin
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Scan, ScanStream, StreamedScan
from weldcal.systems.wall_clock import WallClock

Cloud = NDArray[np.float32]
PERIOD_S, STREAM_PERIOD_S = 0.02, 0.004
SHOWN = 8  # frames of a stream on the port
SCAN_TIMEOUTS_S = (0.1, 600.0)
FAR = 1.5  # times the farthest distance of the preset: a cloud beyond it is in another unit
FEWEST_POINTS = 30


@dc.dataclass(kw_only=True)
class WiredScanner(ScannerConfig):
    """The keys of all scanners by wire. `preset` and its view are what poses are planned with."""

    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ()
    preset: str = "phoxi_m"
    width: int | None = None  # of the preset's picture; null: its full resolution
    height: int | None = None
    field_of_view_deg: float | None = None  # horizontal; null: the preset's
    mounted_on: str = "base"  # or flange, or a link of the arm
    unit: str = "m"  # of the points: m or mm
    scan_timeout_s: float = 6.0  # from the trigger to the scan
    latency_s: float = 0.0  # from the middle of the exposure to the arrival of the earliest frames
    streams: bool = False  # the scanner runs freely: a scanner of a motion job
    silent_s: float = 1.0  # of a stream without a usable frame, or with identical ones: a fault
    late_s: float = 1.0  # that a frame of a stream comes late: a fault

    def scanner(self) -> ScannerPreset:
        """Return the preset with the configured resolution and field of view."""
        return get_scanner(self.preset, self.width, self.height, self.field_of_view_deg)

    def stream_delay_s(self) -> float | None:
        """Return the latency, where the scanner runs freely."""
        return self.latency_s if self.streams else None

    @property
    def metres(self) -> float:
        """Metres of one unit of the points. Raises InputError for an unknown unit."""
        if self.unit not in ("m", "mm"):
            raise InputError(f"scanner.unit must be m or mm, not '{self.unit}'.")
        return 1.0 if self.unit == "m" else 1e-3

    def rules(self) -> Rules:
        """When this scanner is at fault. Raises InputError for a time that no scan takes."""
        low, high = SCAN_TIMEOUTS_S
        check_range("scanner.scan_timeout_s", self.scan_timeout_s, low, high)
        if self.streams:
            for name in ("silent_s", "late_s"):
                check_range(f"scanner.{name}", getattr(self, name), 0.1, high)
            return Rules(silent_s=self.silent_s, frozen_s=self.silent_s, late_s=self.late_s)
        return Rules(late_s=float("inf"), answer_s=self.scan_timeout_s)


def checked_cloud(points: NDArray[Any], metres: float, far_m: float) -> Cloud:
    """Points (H, W, 3) or (N, 3) of the camera frame in m, float32, as the cell uses them; zeros are missing pixels.

    Raises:
        Garbage: too few points, or they lie too far away for the scanner, as points in another unit do.
    """
    cloud = np.asarray(points, dtype=np.float32) * np.float32(metres)
    if cloud.ndim not in (2, 3) or cloud.shape[-1] != 3:
        raise Garbage(f"a cloud is (N, 3) or (H, W, 3), and this one is {cloud.shape}")
    if cloud.ndim == 3:
        missing = ~(np.abs(cloud[..., 2]) > 0.0)  # also of NaN
        if missing.any():
            cloud[missing] = np.nan
    z = cloud[..., 2]
    z = z[np.isfinite(z)]
    if z.size < FEWEST_POINTS:
        raise Garbage(f"the cloud has {z.size} points; look whether something is in the scanner's range")
    middle = float(np.median(z))
    if not 0.0 < middle <= FAR * far_m:
        raise Garbage(
            f"the middle of the cloud is {middle:.3g} m away, but the scanner's range is {far_m:.3g} m. Set"
            " scanner.unit to the unit of its points, and send them in the camera frame"
        )
    return cloud


class WiredScanStream(LeafSystem):
    """Shows the newest frames of a scanner that runs freely.

    .. pydrake_system::

        name: WiredScanStream
        input_ports:
        - streaming
        output_ports:
        - stream

    Ports as those of the simulated streaming scanner: `arrival_time` on the arm's clock, `device_time` on the device's
    own, less what the Diagram had lost on its ``clock`` when the frame was taken: the two stay together while the
    computer is late. Where the cell follows an emulated robot's time, a host that is late does not make a frame late.
    """

    def __init__(self, acquisition: Acquisition[Cloud], clock: WallClock | None = None) -> None:
        super().__init__()
        self.acquisition, self._clock = acquisition, clock
        self._times = DiagramTime()
        self._shown: tuple[StreamedScan, ...] = ()
        self._streaming = self.DeclareVectorInputPort("streaming", 1)
        state = self.DeclareDiscreteState(1)
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort("stream", lambda: AbstractValue.Make(ScanStream()), self._output, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(STREAM_PERIOD_S, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        self._times.add(time.monotonic(), context.get_time())
        newest = int(context.get_discrete_state_vector()[0])
        if self._streaming.Eval(context)[0] > 0.5:
            new = [f for f in self.acquisition.frames() if f.number > newest]
            if new:
                self._shown = (*self._shown, *(self._streamed(f, context.get_time()) for f in new))[-SHOWN:]
                newest = new[-1].number
        discrete.set_value([float(newest)])

    def _streamed(self, frame: AcquiredFrame[Cloud], now: float) -> StreamedScan:
        device = frame.device_time
        if device is not None and self._clock is not None:
            device -= self._clock.lost_by(self.acquisition.time.at(frame.stamp.captured))
        return StreamedScan(
            frame.number, points_C=frame.datum, arrival_time=self._arrival(frame.arrived, now), device_time=device
        )

    def _arrival(self, host_s: float, now: float) -> float:
        """Return the Diagram's time at a time of the host."""
        if self._clock is None or not self._clock.follows:
            return self._times.at(host_s)
        return self._clock.diagram_time(self.acquisition.time.at(host_s), now)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(ScanStream(self._shown))


def acquire(config: WiredScanner, source: Source[Cloud]) -> Acquisition[Cloud]:
    """Return the acquisition of a scanner's clouds, not started yet."""
    kept = SHOWN if config.streams else 2
    return Acquisition(source, config.rules(), kept=kept, latency_s=config.latency_s)


def add_scanner(config: WiredScanner, source: Source[Cloud], build: StationBuild) -> None:
    """Start the acquisition and add the scanner's system with its ports to the station.

    Raises:
        DeviceFault: the scanner does not answer.
    """
    acquisition = acquire(config, source)
    begin(build, acquisition, "scanner", first_frame=config.streams)
    if config.streams:
        clock = None if build.robot is None else build.robot.clock
        build.add("scanner", WiredScanStream(acquisition, clock), "scanner.streaming", "scanner.stream")
        return
    sensor = OnTrigger(acquisition, "scan", Scan, PERIOD_S, build.may_wait)
    build.add("scanner", sensor, "scanner.trigger", "scanner.scan")
