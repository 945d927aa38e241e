"""Registers and terminals that RTDE and scripts read and write; values outlive programs."""

from dataclasses import dataclass

from weldcal.tools.emulators.ur.script.syntax import ScriptError

N_NUMBERS = 48
N_BITS = 128


class Registers:
    """General purpose registers of one direction."""

    def __init__(self) -> None:
        self.integers = [0] * N_NUMBERS
        self.doubles = [0.0] * N_NUMBERS
        self.bits = [False] * N_BITS

    def word(self, first: int) -> int:
        """32 bits from `first` as one number."""
        return sum(1 << i for i in range(32) if self.bits[first + i])

    def set_word(self, first: int, value: int) -> None:
        """32 bits from `first` out of one number."""
        for i in range(32):
            self.bits[first + i] = bool(value >> i & 1)


@dataclass
class Watchdog:
    """rtde_set_watchdog: an input that must be written again within `period_s`, counted from frame `fed_at`."""

    period_s: float
    action: str
    fed_at: int


@dataclass
class Payload:
    """What the arm carries (kg, m, kg m^2)."""

    mass: float
    center: list[float]
    inertia: list[float]


class Terminals:
    """Digital and analog terminals and the speed slider."""

    def __init__(self) -> None:
        self.digital_inputs = 0
        self.digital_outputs = 0
        # of standard outputs: what set_runstate_standard_digital_output_to_value chose
        self.runstate: dict[int, int] = {}
        # outputs that somebody else than the program writes in every frame (Modbus, a PLC): level, and until which
        # frame
        self.foreign: dict[int, tuple[bool, int]] = {}
        self.analog_outputs = [0.0, 0.0]  # shares of their ranges
        self.analog_output_types = 0  # a bit for each: 0 is 4 to 20 mA, 1 is 0 to 10 V
        self.analog_runstate: dict[int, int] = {}
        self.analog_foreign: dict[int, tuple[float, int]] = {}
        self.tool_voltage = 0
        self.speed_slider = 1.0
        self.limiter = 1.0  # of the trajectory: what RTDE calls speed_scaling

    def set_digital(self, first: int, mask: int, value: int) -> None:
        """Sets the outputs that `mask` names, counted from `first` (0 standard, 8 configurable, 16 tool)."""
        self.digital_outputs = self.digital_outputs & ~(mask << first) | (value & mask) << first

    def set_analog(self, n: int, share: float) -> None:
        """Set an analog output to a share of its range."""
        self.analog_outputs[n] = min(1.0, max(0.0, share))

    def analog_output(self, n: int) -> float:
        """What an analog output shows, V or A."""
        share = self.analog_outputs[n]
        return 10.0 * share if self.analog_output_types >> n & 1 else 0.004 + 0.016 * share

    def write_foreign(self, frame: int) -> None:
        """What that somebody does in this frame, after the programs."""
        for n, (on, until) in list(self.foreign.items()):
            self.set_digital(0, 1 << n, int(on) << n)
            if frame >= until:
                del self.foreign[n]
        for n, (share, until) in list(self.analog_foreign.items()):
            self.set_analog(n, share)
            if frame >= until:
                del self.analog_foreign[n]

    def program_ended(self) -> None:
        """Outputs that follow the program's state take their level for a program that does not run."""
        for n, choice in self.runstate.items():
            if choice in (1, 3):
                self.digital_outputs &= ~(1 << n)
            elif choice == 2:
                self.digital_outputs |= 1 << n
        for n, choice in self.analog_runstate.items():
            if choice in (1, 3):
                self.analog_outputs[n] = 0.0
            elif choice == 2:
                self.analog_outputs[n] = 1.0


def register_index(index: object, count: int) -> int:
    """Raises ScriptError where a script names a register that is not there."""
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < count:
        raise ScriptError(f"There is no register {index!r}; they run from 0 to {count - 1}.")
    return index
