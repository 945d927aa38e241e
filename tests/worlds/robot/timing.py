"""Times of the robot link: what passes between an arm's LeafSystem and its link."""

from __future__ import annotations

import time
from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from weldcal.systems.drivers.ur.link import LinkState, UrLink

STEP_RAD_S = 0.2
STEP_JOINT = 5
APART_S = 0.45  # from one step to the next: steps come every 0.5 s, a late clock makes up for at most 20 ms


@dataclass(kw_only=True)
class Tap:
    """Sit between the arm's LeafSystem and its link, and record when what passes.

    Times in s of the monotonic clock.
    """

    link: UrLink
    command_times: array[float] = field(default_factory=lambda: array("d"))
    ages: array[float] = field(default_factory=lambda: array("d"))
    echoes: array[float] = field(default_factory=lambda: array("d"))
    motions: array[float] = field(default_factory=lambda: array("d"))
    state_now: LinkState | None = None
    starts: list[int] = field(default_factory=lambda: [0])  # how many commands had been sent when a link began
    _heard: float = -1.0
    _wanted: float = 0.0
    _stepped: tuple[float, float, float] | None = None  # when, from, to
    _changed: float = -np.inf  # when the last step was

    def restart(self, link: UrLink) -> None:
        """Go on with another link."""
        self.link, self.state_now = link, None
        self.starts.append(len(self.command_times))
        self._heard, self._wanted, self._stepped = -1, 0.0, None

    @property
    def periods(self) -> NDArray[np.float64]:
        """From each command to the next, s; NaN over the pause in which a link was made anew."""
        found = np.diff(np.array(self.command_times))
        for start in self.starts[1:]:
            found[start - 1 : start] = np.nan
        return found

    def state(self) -> LinkState:
        """As the link's."""
        found = self.link.state()
        self.state_now = found
        if not self.command_times:
            return found
        self.ages.append(found.age_s)
        if found.echo != self._heard:
            if self._heard >= 0:  # a link's first state may know of no command yet
                self.echoes.append(found.echo_latency)
            self._heard = found.echo
        if self._stepped is not None:
            when, before, after = self._stepped
            if (found.qd[STEP_JOINT] - before) / (after - before) > 0.5:
                self.motions.append(time.monotonic() - when)
                self._stepped = None
        return found

    def command(self, qd: NDArray[np.float64], process: bool = False) -> int:
        """As the link's."""
        number, now = self.link.command(qd, process), time.monotonic()
        self.command_times.append(now)
        # a late computer slows the path for a while: neither its small changes nor a short dip are steps
        if abs(qd[STEP_JOINT] - self._wanted) > 0.5 * STEP_RAD_S and now > self._changed + APART_S:
            self._changed = now
            self._stepped = (now, self._wanted, float(qd[STEP_JOINT]))
            self._wanted = float(qd[STEP_JOINT])
        return number
