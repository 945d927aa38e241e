"""Slows the arm while the cell gives no new velocity, or the robot no new state, before the delay is a fault."""

FRESH_S = 0.012  # of robot time; three periods of the commands
ZERO_S = 0.050
RISE_PER_S = 10.0


class TimeScale:
    """The factor of the newest velocity: 1 while it is fresh, falling to 0 at ZERO_S, rising again by RISE_PER_S.

    The direction is kept, so that the arm stays on its path; the cell reads where the arm is and goes on from there.
    """

    def __init__(self, pace: float) -> None:
        self._pace = pace
        self._last = 0.0
        self.factor = 1.0

    def step(self, now: float, age_s: float) -> float:
        """The factor for a velocity that was given `age_s` (host time) before `now` (s, monotonic)."""
        age, passed = self._pace * age_s, self._pace * max(now - self._last, 0.0)
        fresh = min(max((ZERO_S - age) / (ZERO_S - FRESH_S), 0.0), 1.0)
        self.factor = min(fresh, self.factor + RISE_PER_S * passed)
        self._last = now
        return self.factor
