"""Supported controller software, the limits of ur_rtde 1.6 with it, and the check that ur_rtde is installed."""

import importlib.util

from weldcal.systems.drivers.ur.errors import RobotRefused

POLYSCOPE_X = 10
OLDEST_5, OLDEST_X = (5, 12), (10, 10)


def is_supported(version: tuple[int, ...]) -> bool:
    """Whether it is PolyScope 5.12 or newer, or PolyScope X 10.10 or newer; ur_rtde uploads nothing to an older X (observed on
    the wire)."""
    return OLDEST_X <= version[:2] < (11, 0) or OLDEST_5 <= version[:2] < (6, 0)


def upper_range_works(version: tuple[int, ...]) -> bool:
    """Whether ur_rtde 1.6 can use the upper registers of this controller.

    From PolyScope 5.23 and 10.9 on it subscribes to output_int_register_0 but expects the answer of a command in register
    24, which never arrives (observed on the wire).
    """
    return version[:2] < ((10, 9) if version[0] >= POLYSCOPE_X else (5, 23))


def require_ur_rtde() -> None:
    """Check that ur_rtde is installed, which only jobs on a robot need.

    Raises:
        RobotRefused: it is not installed; the message says what to install.
    """
    if importlib.util.find_spec("rtde_control") is None:
        raise RobotRefused(
            "The package ur-rtde, which a robot needs, is not installed: install it with pip, or, as it has no wheel for "
            "Python 3.13 yet, set weldcal up with Python 3.12."
        )
