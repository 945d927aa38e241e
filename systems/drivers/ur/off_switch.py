"""Turns a digital output off over an RTDE connection of its own, whatever program runs or stands still on the controller."""

import contextlib
import struct

from weldcal.systems.drivers.ur.errors import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.rtde_wire import RtdeProbe

TIMEOUT_S = 2.0
MASK, VALUE = "standard_digital_output_mask", "standard_digital_output"


class OffSwitch:
    """Only off: what turns the output on is the guard script, which knows when nobody is there any more.

    The connection is opened at the start and held, so that one package of five bytes is all that is left to do.

    Raises:
        RobotRefused: another client writes the outputs; RobotUnreachable: no RTDE there.
    """

    def __init__(self, host: str, output: int) -> None:
        self._probe = RtdeProbe(host, TIMEOUT_S)
        recipe = self._probe.grant((MASK, VALUE))
        if recipe is None:
            self._probe.close()
            raise RobotRefused("Another RTDE client or a fieldbus writes the controller's digital outputs.")
        self._package = struct.pack(">BBB", recipe, 1 << output, 0)

    def off(self) -> None:
        """One package; a connection that is gone is left alone: then the guard and the controller turn it off."""
        with contextlib.suppress(RobotUnreachable):
            self._probe.write(self._package)
