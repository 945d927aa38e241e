"""What the release of the controller's software means for us and for ur_rtde 1.6."""

from __future__ import annotations

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
