"""Enumerations of the controller, numbered as in RTDE."""

import enum


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
