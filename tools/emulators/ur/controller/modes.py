"""The controller's enumerations, as RTDE numbers them."""

from __future__ import annotations

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


POWERLESS = frozenset(
    {
        SafetyMode.SYSTEM_EMERGENCY_STOP,
        SafetyMode.ROBOT_EMERGENCY_STOP,
        SafetyMode.VIOLATION,
        SafetyMode.FAULT,
    }
)
_BIT = {
    SafetyMode.NORMAL: 0,
    SafetyMode.REDUCED: 1,
    SafetyMode.PROTECTIVE_STOP: 2,
    SafetyMode.RECOVERY: 3,
    SafetyMode.SAFEGUARD_STOP: 4,
    SafetyMode.SYSTEM_EMERGENCY_STOP: 5,
    SafetyMode.ROBOT_EMERGENCY_STOP: 6,
    SafetyMode.VIOLATION: 8,
    SafetyMode.FAULT: 9,
}


def safety_status_bits(mode: SafetyMode) -> int:
    """RTDE's safety_status_bits: one bit a mode, bit 7 for any emergency stop, bit 10 for stopped due to safety."""
    bits = 1 << _BIT[mode]
    if mode in (SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.ROBOT_EMERGENCY_STOP):
        bits |= 1 << 7
    if mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED, SafetyMode.RECOVERY):
        bits |= 1 << 10
    return bits
