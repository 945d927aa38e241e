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


_ROBOT_FRAMES = r"(g|gripper|grip|e|ee|eef|tcp|h|hand|f|flange|tool|tool0|end|endeffector|effector)"
_BASE_FRAMES = r"(b|base|base_link|r|robot|w|world)"
_CAMERA_FRAMES = r"(c|cam|camera|s|sensor|optical)"
_TARGET_FRAMES = r"(t|target|m|marker|o|obj|object|b|board|p|pattern|tag|chess\w*|g|grid|w|world)"
_BETWEEN = r"(2|_?to_?|_?in_?|_?[HTXM]_?|_)"


def _either_way(one: str, other: str) -> re.Pattern[str]:
    return re.compile(rf"(?i)^(T_?)?({one}{_BETWEEN}{other}|{other}{_BETWEEN}{one})$")


_FRAME_ROBOT, _FRAME_CAMERA = _either_way(_ROBOT_FRAMES, _BASE_FRAMES), _either_way(_CAMERA_FRAMES, _TARGET_FRAMES)
_CAMERA = re.compile(
    r"(?i)(target|board|marker|object|chess|pattern|tag|camera|vision|(^|[^a-z])cam([^a-z]|$)|cam\d|eye"
    r"|optical|sensor|tracking|cpo|x_cm|aruco|charuco)"
)
_ROBOT = re.compile(
    r"(?i)(robot|hand|grip|(^|[^a-z])ee([^a-z]|$)|ee2|2ee|effector|flange|tcp|tool|(^|[^a-z])arm([^a-z]|$)"
    r"|fpe|x_bf|base_t|t_base|o_t_ee)"
)
_POSES = re.compile(r"(?i)(^|[^a-z])pos(es?)?([^a-z]|$)")


def last_key(name: str) -> str:
    """The last word of a list's name: its key in the file."""
    return re.split(r"[/,\s]+", name)[-1]


def whose(name: str) -> str:
    """Whose list a name says it is: the robot's, the camera's, or empty.

    The last part that says something decides; ``poses`` alone is the robot's where no other part says more.
    """
    parts = (last_key(name), *reversed(re.split(r"[/,]+", name)))
    for part in parts:
        found = _whose_part(re.sub(r"(?i)^(r|rot|rotation|rvecs?|tvecs?|t|x|h|q)_", "", part.strip()))
        if found is not None:
            return found
    return "robot" if any(_POSES.search(part.strip()) for part in parts) else ""


def _whose_part(plain: str) -> str | None:
    if re.search(r"(?i)wrt_world|wrt_base", plain):
        return "robot"
    if re.search(r"(?i)wrt_(sensor|camera)", plain):
        return "camera"
    if plain in ("A", "a", "B", "b"):
        return "robot" if plain in "Aa" else "camera"
    frames = bool(_FRAME_ROBOT.search(plain)), bool(_FRAME_CAMERA.search(plain))
    if frames[0] != frames[1]:
        return "robot" if frames[0] else "camera"
    if re.search(r"(?i)hand_?eye", plain):
        return None
    robot, camera = bool(_ROBOT.search(plain)), bool(_CAMERA.search(plain))
    if robot and camera:
        return "camera" if re.search(r"(?i)(target|board|marker|object|chess|pattern|tag)", plain) else ""
    return "robot" if robot else "camera" if camera else None
