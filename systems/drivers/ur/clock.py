"""Robot time on the host's clock: the earliest arrivals of many packages, with a straight line for the drift."""

from collections import deque

import numpy as np

BIN_S = 0.5
BINS = 60  # half a minute of bins
BINS_FOR_DRIFT = 8
DRIFT_LIMIT = 5e-4  # quartz against quartz is below 1e-4
STEP_S = 0.005  # more than this off the line for a whole bin: the controller stood still, or its clock was set


class ClockMap:
    """host time = robot time / pace + offset + drift * robot time.

    A package can only be late, so the least of (host - robot) in each half second is the best sight of the offset; a
    line through these least values, weighted to none, gives offset and drift, and its residual says how good that is.
    Where a whole bin lies off the line by more than STEP_S, what was seen before it belongs to another clock and is dropped;
    where the line is steeper than two quartzes can differ, the controller does not keep its own pace, and the last bin counts.
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
        """A package of this robot time (s) was seen at this host time (s, monotonic)."""
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
                # No quartz: a controller that lost time, and how much is in the newest packages alone.
                self.drift, self._offset = 0.0, float(seen[-1])
        line = self._offset + self.drift * (t - self._origin)
        self.residual_s = float(np.sqrt(np.mean((seen - line) ** 2)))

    def to_host(self, robot_time: float) -> float:
        """The host time (s) at which the robot's clock showed this."""
        return robot_time / self._pace + self._offset + self.drift * (robot_time - self._origin)
