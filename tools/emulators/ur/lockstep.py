"""Lockstep: the controller's time waits, up to a bound of the host's time, for a client that streams and is late."""

from typing import Any

from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.motions import STEP_S
from weldcal.tools.emulators.ur.controller.registers import RuntimeState
from weldcal.tools.emulators.ur.wire.net import Connection

# so far the controller goes past a stream's newest package, and no further apart are those of a stream
AHEAD_FRAMES = 5
STREAM_PACKAGES = 5  # of one recipe: from then on it is a stream


class Lockstep:
    """Says before every frame whether it has to wait.

    A stream is a run of input packages of one recipe. It ends with a package of another recipe, with its connection,
    with the program, and where the client stays silent for `bound_s`. A client that has let a watchdog be set has
    promised to write, too: half of the watchdog's period passes without it. A connection that a fault keeps from being
    heard is not waited for. `ahead`: frames that the controller may go past a stream's newest package.
    """

    def __init__(self, controller: Controller, bound_s: float, ahead: int = AHEAD_FRAMES) -> None:
        self._controller, self._ahead = controller, ahead
        self._bound_s = bound_s
        self._client: Connection | None = None
        self._silenced: Connection | None = None
        self._recipe = 0
        self._run = 0
        self._silent = False
        self._frame = 0
        self._since: float | None = None
        self._waits = self._given_up = 0
        self._longest_s = self._waited_s = 0.0

    def heard(self, connection: Connection, recipe: int, now: float) -> None:
        """An input package has come."""
        self._end_wait(now)
        frame = self._controller.frame
        again = connection is self._client and recipe == self._recipe and frame - self._frame <= AHEAD_FRAMES
        self._client, self._recipe, self._frame = connection, recipe, frame
        self._run = self._run + 1 if again else 1
        self._silent = False

    def expect_silence(self) -> None:
        """The client that streams now will be silenced on purpose: it is not waited for any more."""
        self._silenced = self._client

    def waits(self, now: float) -> bool:
        """Return whether the next frame has to wait for the client's next package."""
        if not (self._bound_s and self._may_come(now) and self._is_late()):
            self._end_wait(now)
            return False
        if self._since is None:
            self._since = now
            self._waits += 1
        if now - self._since < self._bound_s:
            return True
        self._given_up += 1
        self._end_wait(now)
        self._run, self._silent = 0, True
        return False

    def state(self) -> dict[str, Any]:
        """What it has waited for since the start (s of the host)."""
        return {
            "bound_s": self._bound_s,
            "waits": self._waits,
            "given_up": self._given_up,
            "longest_s": round(self._longest_s, 6),
            "waited_s": round(self._waited_s, 6),
        }

    def _is_late(self) -> bool:
        frame = self._controller.frame
        if self._run >= STREAM_PACKAGES and frame - self._frame >= self._ahead:
            return True
        watchdogs = self._controller.watchdogs.values()
        return any(2.0 * (frame - watchdog.fed_at) * STEP_S >= watchdog.period_s for watchdog in watchdogs)

    def _may_come(self, now: float) -> bool:
        client = self._client
        if client is None or self._silent or client is self._silenced:
            return False
        if self._controller.runtime_state != RuntimeState.PLAYING:
            self._run = 0
            return False
        return client.readable(now) and not client.faults.deaf(now)

    def _end_wait(self, now: float) -> None:
        if self._since is not None:
            self._longest_s = max(self._longest_s, now - self._since)
            self._waited_s += now - self._since
            self._since = None
