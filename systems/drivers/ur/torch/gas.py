"""Shielding gas: on before the arc is asked for, and on for some time after it."""

from dataclasses import dataclass


@dataclass
class Gas:
    """The gas valve's sequence, s of the controller's time: `before_s` of gas, then the torch, then `after_s` of gas."""

    before_s: float = 0.0
    after_s: float = 0.0
    _opened_at: float | None = None
    _needed_at: float = float("-inf")

    def step(self, now: float, wanted: bool) -> tuple[bool, bool]:
        """Whether the valve is open, and whether the torch may be on, at `now` while the cell wants the torch or not."""
        if wanted:
            self._opened_at = now if self._opened_at is None else self._opened_at
            self._needed_at = now
            return True, now - self._opened_at >= self.before_s
        flows = self._opened_at is not None and now - self._needed_at < self.after_s
        if not flows:
            self._opened_at = None
        return flows, False
