"""What the worker needs of a connection to the controller, and its own client as one of the two that provide it."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from weldcal.systems.drivers.ur.set_points import ANALOG, MASK, VALUE, Level, OffSwitch
from weldcal.systems.drivers.ur.wire.line import SCRIPT_PORT, SocketLine
from weldcal.systems.drivers.ur.wire.rtde_client import IN_USE, NOT_FOUND, UPPER_OFFSET, RtdeProbe
from weldcal.systems.drivers.ur.wire.rtde_stream import RtdeStream

AUTO, NATIVE, UR_RTDE = "auto", "native", "ur_rtde"
# of the guard: commands in the integer register, with at most eight numbers; what it answers
NO_COMMAND, VELOCITY, SPEED_STOP, SET_PAYLOAD, STOP_SCRIPT = 0, 9, 15, 17, 255
READY, DONE = 1, 2
PLAYING = 2
LINE_LIMIT_S = 2.0  # a choice: a controller accepts within ms, or after a lost packet within 1 s
LOOK_S = 0.01  # five frames of the controller: far shorter than an answer is awaited
# On two cores jobs over ur_rtde had 115 of 50,702 velocities over 8 ms late, natively 6 of 50,376
# (`benchmark robot-jobs`); three were not tried.
ENOUGH_CORES = 4


class Switch(Protocol):
    """The torch's outputs, without the guard."""

    def off(self) -> None:
        """Turn the torch's output off and its set points to zero. A broken connection is ignored."""

    def gas(self, on: bool) -> None:
        """Open or close the gas valve, where one is wired."""


class Transport(Protocol):
    """States of the controller, commands to the guard, and the torch's outputs. Raises as RtdeStream."""

    connected: bool
    not_finite: str  # an output of a state that was dropped because it is not a finite number

    def poll(self) -> None:
        """Take the newest state."""

    def wait(self, seconds: float) -> None:
        """Poll, after the next state or this time."""

    def number(self, name: str) -> float:
        """Return an output in the newest state."""

    def vector(self, name: str) -> tuple[float, ...]:
        """Return an output of several numbers in the newest state."""

    def send(self, *values: float) -> None:
        """Write a command of the guard and its numbers."""

    def once(self, until: float, *values: float) -> bool:
        """Give a command that the guard answers once; returns whether it did before `until` (s, monotonic)."""

    def upload(self, script: str, started: Callable[[], bool], until: float) -> bool:
        """Start this program; returns whether it has started before `until` (s, monotonic)."""

    def switch(self, output: int, gas: int | None, levels: Sequence[Level]) -> Switch:
        """Claim the torch's outputs."""


class NativeTransport(RtdeStream):
    """weldcal's own client: every state is read, in the worker's thread; nothing connects again by itself."""

    def __init__(self, host: str, outputs: Sequence[str], inputs: Sequence[str], answer: str, first_s: float) -> None:
        super().__init__(host, outputs, inputs)
        self._host, self._answer = host, answer
        self.first(first_s)

    def once(self, until: float, *values: float) -> bool:
        """See Transport."""
        for wanted, sent in ((DONE, values), (READY, (NO_COMMAND,))):
            while self.connected and self.number("runtime_state") == PLAYING and time.monotonic() < until:
                self.send(*sent)
                self.wait(LOOK_S)
                if self.number(self._answer) == wanted:
                    break
            else:
                return False
        return True

    def upload(self, script: str, started: Callable[[], bool], until: float) -> bool:
        """See Transport."""
        with SocketLine(self._host, SCRIPT_PORT, "Script", LINE_LIMIT_S) as line:
            line.send(script.encode())
            # the connection stays open until the program runs: to close one with unread data would reset it
            while time.monotonic() < until:
                self.wait(LOOK_S)
                line.drain()
                if started() and self.number(self._answer) == READY:
                    return True
        return False

    def switch(self, output: int, gas: int | None, levels: Sequence[Level]) -> Switch:
        """See Transport."""
        return OffSwitch(self._host, output, gas, levels)


@dataclass(frozen=True, kw_only=True)
class Situation:
    """What the choice depends on: the controller's version, its time, and the outputs that are wired."""

    version: tuple[int, ...]
    own_time: bool = False  # an emulated controller at another pace or in lockstep
    set_points: bool = False
    taken: tuple[str, ...] = ()  # inputs that ur_rtde claims and that are not free
    installed: bool = True
    cores: int = 4  # of this computer, that the program may use


# What ur_rtde cannot do, in the order in which a user reads it.
LIMITS: tuple[tuple[Callable[[Situation], bool], str], ...] = (
    (lambda s: not s.installed, "ur-rtde is not installed; it has no wheel for Python 3.13"),
    (lambda s: s.own_time, "an emulated controller with a time of its own is only timed with the native transport"),
    (lambda s: s.version >= (10,), "ur_rtde cannot stop a program of PolyScope X, which has no dashboard"),
    (
        lambda s: s.set_points,
        "ur_rtde neither writes the registers of the set points nor reads the ranges of the analog outputs",
    ),
    (lambda s: bool(s.taken), "ur_rtde also claims inputs that are not free"),
)


def choose(wanted: str, found: Situation) -> tuple[str, str]:
    """Return the transport, and why in a sentence.

    For `ur_rtde` that is wanted where it cannot be used, the first is `native`.
    """
    why = next((reason for holds, reason in LIMITS if holds(found)), "")
    if wanted == NATIVE:
        return NATIVE, "Transport native: the scenario asks for it."
    if why:
        return NATIVE, f"Transport native: {why}."
    if wanted == AUTO and found.cores < ENOUGH_CORES:
        return NATIVE, f"Transport native: ur_rtde is late on fewer than {ENOUGH_CORES} cores."
    asked = "the scenario asks for it" if wanted == UR_RTDE else "this controller allows it"
    return UR_RTDE, f"Transport ur_rtde: {asked}."


def installed() -> bool:
    """Return whether ur_rtde can be imported; it is imported in the worker process only."""
    return find_spec("rtde_control") is not None


def taken(host: str, upper: bool, outputs: bool) -> tuple[str, ...]:
    """The inputs that ur_rtde claims, those of its RTDEIOInterface where `outputs` are wired, and that are not free."""
    base = UPPER_OFFSET if upper else 0
    names = [f"input_int_register_{base + i}" for i in range(8)]
    names += [f"input_double_register_{base + i}" for i in range(18)]
    if outputs:
        names += [f"input_{kind}_register_{base + i}" for kind in ("int", "double") for i in range(18, 23)]
        names += [f"input_int_register_{base + 23}", MASK, VALUE, *ANALOG, "speed_slider_mask", "speed_slider_fraction"]
        names += [f"{kind}_digital_output{end}" for kind in ("tool", "configurable") for end in ("_mask", "")]
    with RtdeProbe(host) as probe:
        claims = probe.claim(names)
    return tuple(name for name, answer in claims.items() if answer in (IN_USE, NOT_FOUND))
