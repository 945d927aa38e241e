"""The controller software that the driver supports."""

POLYSCOPE_X = 10
OLDEST_5, OLDEST_X = (5, 12), (10, 10)


def is_supported(version: tuple[int, ...]) -> bool:
    """Whether it is PolyScope 5.12 or newer, or PolyScope X 10.10 or newer."""
    return OLDEST_X <= version[:2] < (11, 0) or OLDEST_5 <= version[:2] < (6, 0)
