"""Reads the names of mountings and sorts file names as people number them."""

import re

MOUNTINGS = {
    "eye_on_base": ("eye_to_hand", "eye_on_base", "eye_off_hand", "fixed", "static", "stationary"),
    "eye_in_hand": (
        "eye_in_hand",
        "eye_on_hand",
        "eye_on_flange",
        "on_hand",
        "on_arm",
        "hand_mounted",
        "robot_mounted",
    ),
}
"""This package's names of the two usual mountings, and other tools' words for them."""


FLANGES = ("tool0", "flange", "tool0_controller", "wrist_3_link", "ee_link", "link_6", "panda_link8", "fr3_link8")
"""Frames that arms' descriptions call their flange, the likeliest first."""
BASES = ("base", "base_link", "world")


def mounting_name(word: str) -> str:
    """A mounting's name in this package ("Eye-to-Hand" is eye_on_base); an unknown word comes back in lower case."""
    plain = re.sub(r"[\s\-]+", "_", word.strip()).lower()
    return next((name for name, words in MOUNTINGS.items() if plain in words), plain)


def natural(name: str) -> tuple[tuple[bool, int, str], ...]:
    """Sort key: numbers within a name count as numbers, so that img2 comes before img10."""
    parts = re.split(r"(\d+)", name.lower())
    return tuple((part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts if part)


def number_of(name: str) -> int | None:
    """The last whole number in a name: 7 of "img_0007"; None where there is none."""
    found: list[str] = re.findall(r"\d+", name)
    return int(found[-1]) if found else None
