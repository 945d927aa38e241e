"""PolyScope versions that can be emulated, and the features that depend on them."""

from dataclasses import dataclass

from weldcal.models.errors import InputError

KNOWN = {
    "5.12": (5, 12, 6, 1102099),
    "5.21": (5, 21, 1, 0),
    "5.23": (5, 23, 0, 0),
    "10.7": (10, 7, 0, 0),
    "10.12": (10, 12, 0, 0),
}


@dataclass(frozen=True)
class Version:
    """major.minor.bugfix.build of the controller software."""

    major: int
    minor: int
    bugfix: int
    build: int

    @property
    def has_dashboard(self) -> bool:
        """PolyScope X (10.x) has no dashboard server on 29999."""
        return self.major < 10

    @property
    def has_robot_api(self) -> bool:
        """PolyScope X from 10.11 on has an HTTP server in the dashboard's place."""
        return self.at_least((99, 0), (10, 11))

    @property
    def takes_scripts(self) -> bool:
        """Whether the script ports run programs [M]: before 10.10 ur_rtde does not try, and there is no remote mode."""
        return self.at_least((0, 0), (10, 10))

    def at_least(self, five: tuple[int, int], ten: tuple[int, int] = (10, 0)) -> bool:
        """Return whether this is at least the given 5.x, or the given 10.x."""
        return (self.major, self.minor) >= (ten if self.major >= 10 else five)


def parse_version(text: str) -> Version:
    """5.21, or all four numbers.

    Raises:
        InputError: not a version, or one of a controller generation that is not emulated.
    """
    parts = text.split(".")
    if text in KNOWN:
        return Version(*KNOWN[text])
    if not 2 <= len(parts) <= 4 or not all(part.isdigit() for part in parts):
        raise InputError(f"{text!r} is not a PolyScope version; write it as 5.21 or 5.21.1.0.")
    numbers = [int(part) for part in parts] + [0] * (4 - len(parts))
    if numbers[0] not in (5, 10):
        raise InputError(f"PolyScope {text} is not emulated; choose 5.x or 10.x, such as {', '.join(KNOWN)}.")
    return Version(*numbers)
