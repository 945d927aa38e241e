"""What clients of the controller read and write: registers, terminals, modes as in RTDE, and events."""

import enum
from dataclasses import dataclass

from weldcal.tools.emulators.ur.script.syntax import ScriptError

N_NUMBERS = 48
N_BITS = 128


class RuntimeState(enum.IntEnum):
    """What the program does."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class RobotMode(enum.IntEnum):
    """What the arm's power does."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(enum.IntEnum):
    """What the safety system does."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


# as the dashboard names them; the order is the number that MasterboardData carries [M]
OPERATIONAL_MODES = ("NONE", "MANUAL", "AUTOMATIC")
MOVING = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})
_EMERGENCY = frozenset({SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.ROBOT_EMERGENCY_STOP})
POWERLESS = _EMERGENCY | {SafetyMode.VIOLATION, SafetyMode.FAULT}


def safety_status_bits(mode: SafetyMode) -> int:
    """RTDE's safety_status_bits: one bit a mode, bit 7 for any emergency stop, bit 10 for stopped due to safety."""
    bits = 1 << (mode if mode >= SafetyMode.VIOLATION else mode - 1)
    bits |= (mode in _EMERGENCY) << 7
    return bits | (mode not in MOVING | {SafetyMode.RECOVERY}) << 10


@dataclass(frozen=True)
class Started:
    """A program began; `text` is its name."""

    text: str


@dataclass(frozen=True)
class Stopped:
    """A program ended; `text` is its name."""

    text: str


@dataclass(frozen=True)
class Text:
    """textmsg."""

    text: str


@dataclass(frozen=True)
class Popup:
    """A window on the pendant."""

    text: str
    title: str
    warning: bool
    error: bool
    blocking: bool


@dataclass(frozen=True)
class ScriptStopped:
    """A script that does not compile, or that stops at a mistake; line and column count from 1."""

    text: str
    line: int
    column: int


@dataclass(frozen=True)
class ErrorCode:
    """A numbered report such as C209A0; `level` is 1 information, 2 warning, 3 violation, 4 fault."""

    code: int
    argument: int
    level: int
    text: str


@dataclass(frozen=True)
class SafetyChanged:
    """The safety mode has changed to the one with this number."""

    mode: int


Event = Started | Stopped | Text | Popup | ScriptStopped | ErrorCode | SafetyChanged


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
