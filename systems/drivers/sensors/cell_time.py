"""The clock by which devices are judged to be silent or late: the host's, or that of an emulated robot that the cell
follows."""

import math
import threading
import time
from collections.abc import Callable
from typing import Protocol

from weldcal.systems.drivers.sensors.stamps import DiagramTime
from weldcal.systems.drivers.station_build import StationBuild


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
    """The clock of a robot that the cell follows: its world may be slower than real time, and stands while it waits for
    the cell.

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
    """The clock of a station's devices."""
    clock = None if build.robot is None else build.robot.clock
    return FollowedTime(clock.now) if clock is not None and clock.follows else HostTime()
