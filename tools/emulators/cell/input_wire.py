"""The wires from the power source to the controller's digital inputs, which may be cut, stick, be slow or be noisy."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

DELAY_S = 2.0
NOISE_S = 0.02  # a noisy wire has another value so often
SEED = 11


@dataclass
class InputWire:
    """What the two inputs (arc established, arc fault) read.

    `how`: killed (off), frozen (as they are), delayed, garbage, or "" (right).
    """

    how: str = ""
    _shown: tuple[bool, bool] = (False, False)
    _sent: deque[tuple[float, tuple[bool, bool]]] = field(default_factory=deque)
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(SEED))
    _noise_until: float = 0.0

    def step(self, now: float, established: bool, fault: bool) -> tuple[bool, bool]:
        """The inputs at `now` (s) for an arc that is established and a power source at fault, or not."""
        right = (established, fault)
        if not self._sent or self._sent[-1][1] != right:
            self._sent.append((now, right))
        while len(self._sent) > 1 and self._sent[1][0] <= now - DELAY_S:
            self._sent.popleft()
        if self.how == "killed":
            self._shown = (False, False)
        elif self.how == "delayed":
            self._shown = self._sent[0][1] if self._sent[0][0] <= now - DELAY_S else self._shown
        elif self.how == "garbage":
            if now >= self._noise_until:
                self._noise_until = now + NOISE_S
                self._shown = (bool(self._rng.integers(2)), bool(self._rng.integers(2)))
        elif self.how != "frozen":
            self._shown = right
        return self._shown
