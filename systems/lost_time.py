"""How far the Diagram had fallen behind its clock at any earlier time: it stands where the computer is late, and goes slower where its path is slowed."""

from collections import deque

KEPT = 8192  # corners of the course: 16 s of a rate that changes with every tick, and hours of one that does not


class LostTime:
    """The course of the time lost over a clock, both s, as a line through corners: flat while the Diagram keeps its pace.

    A device with a clock of its own goes on while the Diagram stands. What the Diagram knows by its own time, such as where
    the arm was, is paired with the device's time less the time lost by then.
    """

    def __init__(self) -> None:
        self._corners: deque[tuple[float, float]] = deque(maxlen=KEPT)

    @property
    def newest(self) -> float:
        """The time lost so far, s."""
        return self._corners[-1][1] if self._corners else 0.0

    def reach(self, clock_s: float, lost_s: float = 0.0) -> None:
        """The clock has come to `clock_s`, and since the last call the Diagram has lost `lost_s` more, evenly."""
        corners, total = self._corners, self.newest + lost_s
        if len(corners) > 1 and corners[-2][1] == corners[-1][1] == total:
            corners.pop()
        corners.append((clock_s, total))

    def at(self, clock_s: float) -> float:
        """The time lost by a time of the clock, s; before the first corner that is kept as at it, after the newest as at that."""
        later: tuple[float, float] | None = None
        for t, lost in reversed(self._corners):
            if t <= clock_s:
                return lost if later is None else lost + (later[1] - lost) * (clock_s - t) / (later[0] - t)
            later = t, lost
        return 0.0 if later is None else later[1]
