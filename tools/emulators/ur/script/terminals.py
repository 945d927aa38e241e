"""URScript functions of the controller's terminals: digital, analog, of the tool; and of the payload."""

from typing import Any

from weldcal.models.robots import get_robot
from weldcal.tools.emulators.ur.controller.registers import register_index
from weldcal.tools.emulators.ur.script.answers import Answers, six
from weldcal.tools.emulators.ur.script.syntax import ScriptError

DIGITAL = {"standard_digital": (0, 8), "digital": (0, 8), "configurable_digital": (8, 8), "tool_digital": (16, 2)}
"""First bit and number of the terminals of each group, as they are named in set_..._out, get_..._out and get_..._in."""
TOOL_VOLTAGES = (0, 12, 24)


class TerminalFunctions(Answers):
    """Outputs keep their level when the program ends, unless they follow its state."""

    def set_runstate_standard_digital_output_to_value(self, outputId: int, state: int) -> None:
        self._controller.terminals.runstate[register_index(outputId, 8)] = register_index(state, 8)

    def set_runstate_standard_analog_output_to_value(self, outputId: int, state: int) -> None:
        self._controller.terminals.analog_runstate[register_index(outputId, 2)] = register_index(state, 8)

    def set_standard_analog_out(self, n: int, f: float) -> None:
        self._controller.terminals.set_analog(register_index(n, 2), float(f))

    set_analog_out = set_standard_analog_out

    def get_standard_analog_out(self, n: int) -> float:
        return self._controller.terminals.analog_outputs[register_index(n, 2)]

    def get_standard_analog_in(self, n: int) -> float:
        register_index(n, 2)
        return 0.0

    def set_analog_outputdomain(self, port: int, domain: int) -> None:
        bit = 1 << register_index(port, 2)
        types = self._controller.terminals.analog_output_types
        self._controller.terminals.analog_output_types = types | bit if domain else types & ~bit

    def set_tool_voltage(self, voltage: float) -> None:
        if voltage not in TOOL_VOLTAGES:
            raise ScriptError(f"The tool's voltage is 0, 12 or 24, not {voltage!r}.")
        self._controller.terminals.tool_voltage = int(voltage)

    def set_payload(self, m: float, cog: Any = None) -> None:
        model = self._controller.arm.model.name
        most = get_robot(model).payload_kg
        if not 0.0 <= float(m) <= most:  # [M] what a controller answers is not documented
            raise ScriptError(f"The payload of a {model} is 0 to {most:g} kg, not {m!r}.")
        self._controller.payload.mass = float(m)
        if cog is not None:
            self.set_payload_cog(cog)

    set_payload_mass = set_payload

    def set_payload_cog(self, CoG: Any) -> None:
        self._controller.payload.center = six(CoG, "The centre of gravity", 3).tolist()

    def set_target_payload(self, m: float, cog: Any, inertia: Any = None, transition_time: float = 0.0) -> None:
        self.set_payload(m, cog)
        if inertia is not None:
            self._controller.payload.inertia = six(inertia, "The inertia", 6).tolist()

    def set_gravity(self, d: Any) -> None:
        self._controller.gravity = six(d, "Gravity", 3).tolist()

    def _set(self, first: int, count: int, n: int, b: bool) -> None:
        self._controller.terminals.set_digital(first, 1 << register_index(n, count), (1 if b else 0) << n)

    def _get(self, bank: str, first: int, count: int, n: int) -> bool:
        return bool(getattr(self._controller.terminals, bank) >> (first + register_index(n, count)) & 1)
