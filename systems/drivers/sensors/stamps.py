"""Clocks of the sensors: from a device to the host and to the Diagram, and the clock that judges silent devices."""

import math
import threading
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from weldcal.systems.drivers.station_build import StationBuild

KEPT = 4096  # pairs of host and Diagram time: 32 s at 125 Hz
# a choice: 15 frames at 30 Hz, of which the earliest is rarely late; twice of it doubles the time to a drift
BIN_S = 0.5
BINS = 120
DRIFT_LIMIT = 5e-4  # the drift of two quartz clocks is below 1e-4
BINS_FOR_DRIFT = 8
SET_S = 0.02  # by which the host's clock is set and not only disciplined, between two frames
SET_KEPT_S = 10.0  # a choice: longer than a frame is under way; half of it suits frames that are at most 5 s late
READINGS, QUICK_S = 5, 1e-4  # of two clocks one after the other, between which this process may have to wait
RELEARN_S = 3.0  # frames that stay late for so long belong to another offset: the device's clock was set back


@dataclass(frozen=True)
class Stamp:
    """When a frame was captured (s, host monotonic), by which clock, and by how much it came late (s).

    Late is what came after the earliest frames.
    """

    captured: float
    clock: str  # device, host or arrival
    late_s: float = 0.0


def unix_now() -> float:
    """Return the host's clock, Unix time in s."""
    return time.time()


class UnixClock:
    """Maps Unix time to the host's monotonic time, also while somebody sets the host's clock.

    A frame on its way when the clock is set has a stamp of the clock as it was before. For SET_KEPT_S both are tried:
    the stamp that makes the frame the least late is right, because no frame comes before its time.
    """

    def __init__(self, unix: Callable[[], float] = unix_now, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._unix, self._monotonic = unix, monotonic
        self._offset = self._read()[1]
        self._before: float | None = None
        self._set_at = float("-inf")

    def to_monotonic(self, unix_s: float, arrived: float) -> float:
        """The host's monotonic time (s) of a frame's Unix time; the frame arrived at `arrived` (s, monotonic)."""
        now, offset = self._read()
        if abs(offset - self._offset) > SET_S:
            self._before, self._set_at = self._offset, now
        self._offset = offset
        found = unix_s + offset
        if self._before is None or now - self._set_at > SET_KEPT_S:
            return found
        return min(found, unix_s + self._before, key=lambda t: abs(arrived - t))

    def _read(self) -> tuple[float, float]:
        """Return the monotonic time and its distance from Unix time (s), of the quickest of some readings."""
        readings = []
        for _ in range(READINGS):
            before, unix, after = self._monotonic(), self._unix(), self._monotonic()
            readings.append((after - before, after, 0.5 * (before + after) - unix))
            if after - before < QUICK_S:
                break
        _, now, offset = min(readings)
        return now, offset


class EarliestLine:
    """The line below all (device time, arrival - device time), s, that is nearest to them.

    Offset and drift of two clocks.

    A frame can only be late. Of the lines that no frame undercuts, the one with the smallest mean distance is an edge
    of the lower convex hull, above the mean time (Moon, Skelly and Towsley, Estimation and removal of clock skew from
    network delay measurements, INFOCOM 1999). The hull is taken of the earliest frame of each half second of the last
    minute.
    """

    def __init__(self) -> None:
        self._bins: deque[tuple[float, float]] = deque(maxlen=BINS)
        self._bin_end = float("-inf")
        self._origin: float | None = None
        self._offset = 0.0
        self.drift = 0.0
        self.error_s = 0.0

    def add(self, device_s: float, arrived: float) -> None:
        """Take a frame into account."""
        if self._origin is None:
            self._origin, self._offset = device_s, arrived - device_s
        t, seen = device_s - self._origin, arrived - device_s
        if t >= self._bin_end:
            self._bins.append((t, seen))
            self._bin_end = t + BIN_S
            self._fit()
        elif seen < self._bins[-1][1]:
            self._bins[-1] = (t, seen)
        self._offset = min(self._offset, seen - self.drift * t)

    def at(self, device_s: float) -> float:
        """Host time (s) at which the earliest frames of this device time arrive."""
        t = device_s - (self._origin or 0.0)
        return device_s + self._offset + self.drift * t

    def _fit(self) -> None:
        points = sorted(self._bins)
        mean = sum(t for t, _ in points) / len(points)
        hull: list[tuple[float, float]] = []
        for t, y in points:
            while len(hull) > 1 and _turns_down(hull[-2], hull[-1], (t, y)):
                hull.pop()
            hull.append((t, y))
        self.drift = 0.0
        if len(points) >= BINS_FOR_DRIFT:
            k = min(max(bisect_right([t for t, _ in hull], mean), 1), len(hull) - 1)
            (t0, y0), (t1, y1) = hull[k - 1], hull[k]
            self.drift = min(max((y1 - y0) / (t1 - t0), -DRIFT_LIMIT), DRIFT_LIMIT)
        above = [y - self.drift * t for t, y in points]
        self._offset = min(above)
        self.error_s = (sum((y - self._offset) ** 2 for y in above) / len(above)) ** 0.5


def _turns_down(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])


class DeviceClock:
    """Capture times of frames with stamps of a clock that is not the host's.

    The earliest arrivals give the clock's offset and drift; `latency_s` is the time from the capture to the arrival of
    the earliest frames, which stamps alone cannot tell. A frame that comes more than `late_s` after its time is late,
    and is not used for the clock.
    """

    def __init__(self, latency_s: float, late_s: float) -> None:
        self._latency_s, self._late_s = latency_s, late_s
        self._line: EarliestLine | None = None
        self._late_since: float | None = None
        self.restarts = 0

    @property
    def error_s(self) -> float:
        """Distance (rms, s) of each half second's earliest frame from the line; 0 before there are some."""
        return 0.0 if self._line is None else self._line.error_s

    @property
    def drift(self) -> float:
        """Rate of the host's clock over the device's, less 1."""
        return 0.0 if self._line is None else self._line.drift

    def stamp(self, device_s: float, arrived: float) -> Stamp:
        """Return the stamp of a frame that the device captured at `device_s` of its own clock."""
        late = 0.0 if self._line is None else arrived - self._line.at(device_s)
        if self._line is not None and late > self._late_s:
            self._late_since = arrived if self._late_since is None else self._late_since
            if arrived - self._late_since < RELEARN_S:
                return Stamp(self._line.at(device_s) - self._latency_s, "device", late)
        if abs(late) > self._late_s:  # the device's clock was set
            self._line, self.restarts = None, self.restarts + 1
        self._late_since = None
        if self._line is None:
            self._line = EarliestLine()
        self._line.add(device_s, arrived)
        at = self._line.at(device_s)
        return Stamp(min(at, arrived) - self._latency_s, "device", max(arrived - at, 0.0))


class DiagramTime:
    """Maps the host's time to the Diagram's, which may have run slower or stood still in between."""

    def __init__(self) -> None:
        self._host: deque[float] = deque(maxlen=KEPT)
        self._diagram: deque[float] = deque(maxlen=KEPT)

    def add(self, host_s: float, diagram_s: float) -> None:
        """Note that the Diagram's time is `diagram_s` now; earlier notes of a later time are dropped."""
        while self._host and (host_s <= self._host[-1] or diagram_s < self._diagram[-1]):
            self._host.pop()
            self._diagram.pop()
        self._host.append(host_s)
        self._diagram.append(diagram_s)

    def at(self, host_s: float) -> float:
        """Return the Diagram's time (s) at a host time.

        Minus infinity before the first note, the newest note's after the last.
        """
        k = bisect_right(self._host, host_s)
        if k == 0:
            return float("-inf")
        if k == len(self._host):
            return self._diagram[-1]
        h0, h1, d0, d1 = self._host[k - 1], self._host[k], self._diagram[k - 1], self._diagram[k]
        return d0 + (d1 - d0) * (host_s - h0) / (h1 - h0)


class CellTime(Protocol):
    """A clock, s, of which any earlier time of the host (s, monotonic) can be asked."""

    def now(self) -> float:
        """Its time now."""

    def at(self, host_s: float) -> float:
        """Its time at a time of the host."""

    def look(self) -> None:
        """Note its time now; called often."""


class HostTime:
    """The host's own monotonic clock."""

    def now(self) -> float:
        """See CellTime."""
        return time.monotonic()

    def at(self, host_s: float) -> float:
        """See CellTime."""
        return host_s

    def look(self) -> None:
        """See CellTime."""


class FollowedTime:
    """The clock of a robot that the cell follows.

    Its world may be slower than real time, and stands while it waits for the cell.

    The threads of the acquisition and of the Diagram both ask it.
    """

    def __init__(self, robot_time: Callable[[], float]) -> None:
        self._robot_time = robot_time
        self._times, self._lock = DiagramTime(), threading.Lock()
        self._first = robot_time()

    def now(self) -> float:
        """See CellTime."""
        return self._robot_time()

    def at(self, host_s: float) -> float:
        """See CellTime; the first noted time before it."""
        with self._lock:
            self._times.add(time.monotonic(), self._robot_time())
            found = self._times.at(host_s)
        return found if math.isfinite(found) else self._first

    def look(self) -> None:
        """See CellTime."""
        with self._lock:
            self._times.add(time.monotonic(), self._robot_time())


def cell_time(build: StationBuild) -> CellTime:
    """Return the clock of a station's devices."""
    clock = None if build.robot is None else build.robot.clock
    return FollowedTime(clock.now) if clock is not None and clock.follows else HostTime()
