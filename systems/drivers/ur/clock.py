"""Maps robot time to the host's clock: a line fitted to the earliest package arrivals, with offset and drift."""

from collections import deque

import numpy as np

BIN_S = 0.5
BINS = 60  # half a minute of bins
BINS_FOR_DRIFT = 8
DRIFT_LIMIT = 5e-4  # the drift of two quartz clocks is below 1e-4
STEP_S = 0.005  # more than this off the line for a whole bin: the controller stalled, or its clock was set


class ClockMap:
    """host time = robot time / pace + offset + drift * robot time.

    A package can only be late, so the minimum of (host - robot) in each half second is the best estimate of the offset. An
    unweighted line through these minima gives offset and drift; its residual is a measure of the accuracy.
    Where a whole bin is off the line by more than STEP_S, all earlier data are dropped. Where the slope exceeds the drift of
    two quartz clocks, the controller does not keep its pace, and only the last bin is used.
    """

    def __init__(self, pace: float = 1.0) -> None:
        self._pace = pace
        self._bins: deque[tuple[float, float]] = deque(maxlen=BINS)
        self._bin_end = -np.inf
        self._least: tuple[float, float] | None = None
        self._origin = 0.0
        self._offset = 0.0
        self.drift = 0.0
        self.residual_s = 0.0

    def update(self, robot_time: float, host_time: float) -> None:
        """Add a package with this robot time (s), received at this host time (s, monotonic)."""
        seen = host_time - robot_time / self._pace
        if self._least is None:
            self._origin, self._offset = robot_time, seen
            self._bin_end = robot_time + BIN_S
        if robot_time >= self._bin_end and self._least is not None:
            at, least = self._least
            if abs(least - self._offset - self.drift * (at - self._origin)) > STEP_S:
                self._bins.clear()
            self._bins.append(self._least)
            self._least, self._bin_end = None, robot_time + BIN_S
            self._fit()
        if self._least is None or seen < self._least[1]:
            self._least = (robot_time, seen)
            if not self._bins:
                self._offset = seen

    def _fit(self) -> None:
        t, seen = (np.array(column) for column in zip(*self._bins, strict=True))
        if t.size < BINS_FOR_DRIFT:
            self._offset, self.drift = float(seen.min()), 0.0
        else:
            slope, at_origin = np.polyfit(t - self._origin, seen, 1)
            self.drift, self._offset = float(slope), float(at_origin)
            if abs(slope) > DRIFT_LIMIT:
                # Above quartz drift: the controller lost time, and only the newest packages show the present offset.
                self.drift, self._offset = 0.0, float(seen[-1])
        line = self._offset + self.drift * (t - self._origin)
        self.residual_s = float(np.sqrt(np.mean((seen - line) ** 2)))

    def to_host(self, robot_time: float) -> float:
        """Convert robot time (s) to host time (s)."""
        return robot_time / self._pace + self._offset + self.drift * (robot_time - self._origin)
