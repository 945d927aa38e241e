"""Set points of the power source, wire feed and arc voltage, at the controller's analog outputs."""

import contextlib
import dataclasses as dc
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe


@dataclass(frozen=True)
class ArcInputs:
    """Standard digital inputs of the power source: arc established, arc fault; None where one is not wired."""

    established: int | None = None
    arc_fault: int | None = None

    @property
    def wired(self) -> bool:
        """Whether there is one."""
        return self.established is not None or self.arc_fault is not None

    def arc(self, bits: int) -> bool | None:
        """Return whether the arc is established; None where that is not wired."""
        return None if self.established is None else bool(bits >> self.established & 1)

    def fault(self, bits: int) -> bool:
        """Return whether the power source reports a fault."""
        return self.arc_fault is not None and bool(bits >> self.arc_fault & 1)


@dataclass
class Gas:
    """The gas valve's sequence, s of the controller's time.

    `before_s` of gas, then the torch, then `after_s` of gas.
    """

    before_s: float = 0.0
    after_s: float = 0.0
    _opened_at: float | None = None
    _needed_at: float = float("-inf")

    def step(self, now: float, wanted: bool) -> tuple[bool, bool]:
        """Whether the valve is open, and whether the torch may be on, at `now`; `wanted`: the cell wants the torch."""
        if wanted:
            self._opened_at = now if self._opened_at is None else self._opened_at
            self._needed_at = now
            return True, now - self._opened_at >= self.before_s
        flows = self._opened_at is not None and now - self._needed_at < self.after_s
        if not flows:
            self._opened_at = None
        return flows, False


OUTPUTS = (0, 1)
VOLT, MILLIAMPERE = "V", "mA"
FULL_V = 10.0  # of a UR's analog outputs: 0 V to 10 V (user manual, controller I/O)
ZERO_A, FULL_A = 0.004, 0.020
SETTLES_S = 0.05  # of the controller's time, from the set points at the outputs to the torch
TOLERANCE = 0.02  # of the range
DOMAINS = 2  # bit of output 0 in analog_io_types; the inputs' come before it


@dc.dataclass
class AnalogSetPoint:
    """A set point of the power source at a standard analog output, and how the power source reads it."""

    output: int = 0  # standard analog output, 0 or 1
    unit: str = VOLT  # of the output: V (0 to 10) or mA (4 to 20)
    at_zero: float = 0.0  # what the power source makes of 0 V or 4 mA, in its own unit
    at_full: float = 0.0  # what it makes of 10 V or 20 mA
    value: float = 0.0  # while the torch is asked for; the output is at 0 V or 4 mA otherwise

    def share(self, value: float) -> float:
        """Return the share of the output's range for a value; NaN for none."""
        return (value - self.at_zero) / (self.at_full - self.at_zero)

    def level(self, key: str) -> "Level":
        """Return the output's level, for `key` of the scenario. Raises InputError where no output can show it."""
        if self.output not in OUTPUTS:
            raise InputError(f"robot.{key}.output must be a standard analog output, 0 or 1, not {self.output}.")
        if self.unit not in (VOLT, MILLIAMPERE):
            raise InputError(f"robot.{key}.unit must be V (0 to 10 V) or mA (4 to 20 mA), not '{self.unit}'.")
        if not all(map(math.isfinite, (self.at_zero, self.at_full, self.value))) or self.at_full == self.at_zero:
            full = "10 V" if self.unit == VOLT else "20 mA"
            raise InputError(
                f"robot.{key}.at_full must say what the power source makes of {full}, and it must differ from at_zero "
                f"({self.at_zero:g})."
            )
        share = self.share(self.value)
        if not 0.0 < share <= 1.0:
            raise InputError(
                f"robot.{key}.value must be between at_zero ({self.at_zero:g}, which is off) and at_full"
                f" ({self.at_full:g}), not {self.value:g}."
            )
        return Level(self.output, self.unit == VOLT, share)


@dc.dataclass(frozen=True)
class Level:
    """A standard analog output, whether its range is 0 to 10 V or 4 to 20 mA, and the wanted share of it."""

    output: int
    volts: bool
    share: float

    def wanted(self, shares: Sequence[float] | Array | None) -> float:
        """Return the share that the output is to have: of `shares` (2,) its own; where that is NaN, the scenario's."""
        found = math.nan if shares is None else float(shares[self.output])
        return self.share if math.isnan(found) else min(max(found, 0.0), 1.0)

    def shown(self, value: float, domains: int) -> float:
        """Return the share of the range that the controller reports (V or A); NaN where somebody changed the range."""
        if bool(domains >> (DOMAINS + self.output) & 1) != self.volts:
            return math.nan
        return value / FULL_V if self.volts else (value - ZERO_A) / (FULL_A - ZERO_A)


def levels_of(wire_feed: AnalogSetPoint | None, arc_voltage: AnalogSetPoint | None) -> tuple[Level, ...]:
    """Return the levels of the set points that are wired.

    Raises InputError where one cannot be shown, or both are at one output.
    """
    named = {"wire_feed": wire_feed, "arc_voltage": arc_voltage}
    found = tuple(point.level(key) for key, point in named.items() if point is not None)
    if len({level.output for level in found}) < len(found):
        raise InputError(
            f"robot.wire_feed and robot.arc_voltage are both at analog output {found[0].output}: give each its own."
        )
    return found


@dc.dataclass
class SetPoints:
    """The torch waits for the set points: they are at the outputs for SETTLES_S before it."""

    _right_since: float | None = None
    _lit: bool = False

    def step(self, now: float, wanted: bool, right: bool) -> tuple[bool, bool]:
        """Whether the set points are to be given and whether the torch may be on, at `now` (s of the controller).

        `right`: the outputs have them. A burning torch does not wait for them again: the supervisor ends it.
        """
        if not wanted:
            self._right_since, self._lit = None, False
            return False, False
        if not right:
            self._right_since = None
        elif self._right_since is None:
            self._right_since = now
        self._lit = self._lit or (self._right_since is not None and now - self._right_since >= SETTLES_S)
        return True, self._lit


def apart(asked: float, shown: float) -> bool:
    """Return whether an output shows something else than what it is asked for (shares of its range)."""
    return not abs(asked - shown) <= TOLERANCE  # also of NaN


TIMEOUT_S = 2.0  # a choice, as LINE_LIMIT_S in wire/transport.py
MASK, VALUE = "standard_digital_output_mask", "standard_digital_output"
ANALOG = (
    "standard_analog_output_mask",
    "standard_analog_output_type",
    "standard_analog_output_0",
    "standard_analog_output_1",
)


class OffSwitch:
    """Turns the torch's output off and its analog outputs (`levels`) to zero.

    Only the guard script turns it on, because it detects a lost client.

    The connection is opened at the start and held, so that turning off takes one small package.

    Raises:
        RobotRefused: another client writes the outputs; RobotUnreachable: no RTDE server answers.
    """

    def __init__(self, host: str, output: int, gas: int | None = None, levels: Sequence[Level] = ()) -> None:
        self._probe = RtdeProbe(host, TIMEOUT_S)
        recipe = self._probe.grant((MASK, VALUE, *(ANALOG if levels else ())))
        if recipe is None:
            self._probe.close()
            raise RobotRefused("Another RTDE client or a fieldbus writes the controller's digital or analog outputs.")

        def package(mask: int, value: int, analog_mask: int = 0) -> bytes:
            digital = struct.pack(">BBB", recipe, mask, value)
            return digital + (struct.pack(">BBdd", analog_mask, types, 0.0, 0.0) if levels else b"")

        types = sum(level.volts << level.output for level in levels)
        self._package = package(1 << output, 0, sum(1 << level.output for level in levels))
        self._gas = {} if gas is None else {on: package(1 << gas, on << gas) for on in (False, True)}

    def off(self) -> None:
        """Send the package. A broken connection is ignored: the guard and the controller turn the output off then."""
        self._write(self._package)

    def gas(self, on: bool) -> None:
        """Open or close the gas valve, where one is wired. As `off`."""
        if self._gas:
            self._write(self._gas[on])

    def _write(self, package: bytes) -> None:
        with contextlib.suppress(RobotUnreachable):
            self._probe.write(package)
