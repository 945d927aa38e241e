"""Which controller software is supported, what ur_rtde 1.6 can do with it, and whether ur_rtde is installed."""

import importlib.util

from weldcal.systems.drivers.ur.errors import RobotRefused

POLYSCOPE_X = 10
OLDEST_5, OLDEST_X = (5, 12), (10, 10)


def is_supported(version: tuple[int, ...]) -> bool:
    """PolyScope 5.12 or newer, PolyScope X 10.10 or newer: to an older X ur_rtde uploads nothing (seen on the wire)."""
    return OLDEST_X <= version[:2] < (11, 0) or OLDEST_5 <= version[:2] < (6, 0)


def upper_range_works(version: tuple[int, ...]) -> bool:
    """Whether ur_rtde 1.6 can be told to use the upper registers of this controller.

    From PolyScope 5.23 and 10.9 on it subscribes to output_int_register_0 and then looks for the answer of a command in
    register 24, which never comes (seen on the wire).
    """
    return version[:2] < ((10, 9) if version[0] >= POLYSCOPE_X else (5, 23))


def require_ur_rtde() -> None:
    """Refuses a job on a robot where ur_rtde is not installed; everything else works without it.

    Raises:
        RobotRefused: one sentence that says what to install.
    """
    if importlib.util.find_spec("rtde_control") is None:
        raise RobotRefused(
            "The package ur-rtde, which a robot needs, is not installed: install it with pip, or, as it has no wheel for "
            "Python 3.13 yet, set weldcal up with Python 3.12."
        )
