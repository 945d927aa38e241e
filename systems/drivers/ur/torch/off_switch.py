"""Turns the torch off with its set points, and the gas on and off, over a separate RTDE connection, independent of the program on the controller."""

import contextlib
import struct
from collections.abc import Sequence

from weldcal.systems.drivers.ur.errors import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.torch.set_points import Level
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe

TIMEOUT_S = 2.0
MASK, VALUE = "standard_digital_output_mask", "standard_digital_output"
ANALOG = (
    "standard_analog_output_mask",
    "standard_analog_output_type",
    "standard_analog_output_0",
    "standard_analog_output_1",
)


class OffSwitch:
    """Turns the torch's output off and its analog outputs (`levels`) to zero; only the guard script turns it on, because it detects a lost client.

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
