"""Understand the names that files use: of mountings, of numbered files, and of a table's columns."""

import re
from dataclasses import dataclass

TEXT = (
    ".csv", ".txt", ".tsv", ".script", ".urscript", ".dat", ".src", ".ls", ".mod", ".prg", ".tum", ".log", ".asc",
    ".sys", ".jbi",
    ".dtx", ".as", ".py", ".m", ".drl", ".lua", ".pnt", ".pos", ".jsonl", ".out", ".tfm", ".g2o",
)  # fmt: skip
TREES = (".yml", ".yaml", ".json", ".xml", ".samples", ".calib", ".rob")

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

IDS = (
    "id", "name", "pose", "scan", "file", "filename", "image", "cloud", "label", "index", "nr", "no", "sample",
    "frame", "#", "point", "idx",
)  # fmt: skip
TIMES = (
    "time",
    "%time",
    "timestamp",
    "stamp",
    "t",
    "time_s",
    "header.stamp",
    "sec",
    "secs",
    "timestamp_s",
    "time_ns",
    "timestamp_ns",
)
_POSITION = {
    "position",
    "pos",
    "translation",
    "trans",
    "t",
    "p",
    "tvec",
    "xyz",
    "location",
    "origin",
    "linear",
    "coord",
}
_ROTATION = {"rotation", "rot", "orientation", "r", "angle", "euler", "ori", "deg", "rad", "theta"}
_VECTOR = {"rvec", "rotvec", "rv", "axisangle", "aa", "rodrigues"}
_QUATERNION = {"quat", "quaternion", "q"}
_FILLERS = {"field", "pose", "transform", "transforms0", "vector", "tcp", "data", "actual", "x1"}
_OWNERS = (
    "robot",
    "camera",
    "cam",
    "hand",
    "eye",
    "ee",
    "base",
    "flange",
    "target",
    "marker",
    "board",
    "gripper",
    "tool",
)
_WHOLE = {
    "qw", "qx", "qy", "qz", "q0", "q1", "q2", "q3", "q4", "roll", "pitch", "yaw", "a", "b", "c", "w", "p", "r", "o",
    "e", "u", "v", "ez", "ey", "ex", "n1", "n2", "n3", "ox", "oy", "oz",
}  # fmt: skip
_WHOLE_ONLY = (("w", "u", "v"), ("a", "r", "e", "e"), ("ox", "oy", "oz", "th", "th"))
"""Letters of makers whose last two mean nothing without the others: pixels, errors and angles have such names, too."""
_EULER_WORDS = (
    ("alpha", "beta", "gamma"),
    ("phi", "theta", "psi"),
    ("angle1", "angle2", "angle3"),
    ("euler1", "euler2", "euler3"),
)
_JOINT = re.compile(r"(?:(.*)[._\s])?(?:q|j|jt|a|ax|axis|achse|joint|theta|th|position)[_\s]?([0-9])(?:_[a-z])?")
_JOINTS_BY_NAME = (
    ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
    ("base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3"),
    ("s", "l", "u", "r", "b", "t"),
)
"""Names of six joints: Universal Robots in ROS and on the pendant, Yaskawa."""
_FEWEST_JOINTS = 5
_UNIT = re.compile(r"[\[(]\s*([a-zA-Z°]*)\s*[\])]|[_\s](mm|cm|m|in|inch|deg|rad|degrees|radians|°)$")
_UNITS = {
    "degrees": "deg",
    "radians": "rad",
    "°": "deg",
    "meter": "m",
    "metres": "m",
    "meters": "m",
    "in": "inch",
    "degree": "deg",
}


def mounting_name(word: str) -> str:
    """A mounting's name in this package ("Eye-to-Hand" is eye_on_base); an unknown word comes back in lower case."""
    plain = re.sub(r"[\s\-]+", "_", word.strip()).lower()
    return next((name for name, words in MOUNTINGS.items() if plain in words), plain)


def natural(name: str) -> tuple[tuple[bool, int, str], ...]:
    """Sort key: numbers within a name count as numbers, so that img2 comes before img10."""
    parts = re.split(r"(\d+)", name.lower())
    return tuple((part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts if part)


def number_of(name: str) -> int | None:
    """Return the last whole number in a name: 7 of "img_0007"; None where there is none."""
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
    """Return the last word of a list's name: its key in the file."""
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


@dataclass(frozen=True)
class PoseColumn:
    """A column that is part of a pose.

    Which list it belongs to, its role in a pose, its unit and its place in the table.
    """

    prefix: str
    role: str
    unit: str
    index: int


@dataclass(frozen=True)
class JointColumns:
    """The columns of a robot's joint angles in the order of the joints: whose, their places, their unit or empty."""

    prefix: str
    indices: tuple[int, ...]
    unit: str


def joint_columns(header: list[str]) -> list[JointColumns]:
    """Return the columns of joint angles of a header, for each robot: five or more of numbered or well known names."""
    plain = [_unit_of(h.strip().lower()) for h in header]
    groups: dict[str, dict[int, int]] = {}
    for k, (name, _) in enumerate(plain):
        if part := _JOINT.fullmatch(name):
            groups.setdefault(f"{part[1] or ''}/{name[len(part[1] or '') : part.start(2)]}", {})[int(part[2])] = k
    names = [re.sub(r"_joint|_(deg|rad|position)$", "", name) for name, _ in plain]
    for words in _JOINTS_BY_NAME:
        if set(words) <= set(names):
            groups[f"/{words[0]}"] = {number: names.index(word) for number, word in enumerate(words)}
    found = []
    for key, places in groups.items():
        numbers = sorted(places)
        if len(numbers) >= _FEWEST_JOINTS and numbers[0] < 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
            units = {plain[k][1] for k in places.values()}
            unit = units.pop() if len(units) == 1 else ""
            found.append(JointColumns(key.partition("/")[0], tuple(places[n] for n in numbers), unit))
    return [one for one in found if not one.prefix.endswith("target")] or found


def columns_of(header: list[str]) -> tuple[list[PoseColumn], dict[str, int]]:
    """Return the columns of poses of a header, and the places of its ids and times.

    Roles are x, y, z; qw, qx, qy, qz; q0 to q4; rx, ry, rz (a rotation vector or angles), vx, vy, vz (a rotation vector
    for sure); roll, pitch, yaw; e1, e2, e3 (other angles); m00 to m33; letters of a maker, see `text`.
    """
    found: list[PoseColumn] = []
    other: dict[str, int] = {}
    plain = [_unit_of(h.strip().lower()) for h in header]
    joints = {k for one in joint_columns(header) for k in one.indices}
    arm = any(name in ("q5", "q6") for name, _ in plain)  # then q1 to q4 are joint angles and no quaternion
    for k, (name, unit) in enumerate(plain):
        if k in joints or (arm and re.fullmatch(r"q[0-9]", name)):
            continue
        if name in IDS and "id" not in other:
            other["id"] = k
            continue
        if (name in TIMES or name.endswith("header.stamp")) and not _is_t_of_oat(name, [n for n, _ in plain]):
            if "time" not in other or name.endswith("header.stamp"):
                other["time"] = k
            continue
        for prefix, role in _roles(name):
            found.append(PoseColumn(prefix, role, unit, k))
            break
    roles = {c.role for c in found}
    alone = {role for whole in _WHOLE_ONLY if not set(whole) <= roles for role in whole[-2:]}
    found = [c for c in found if c.role not in alone]
    return _merged(_with_quaternions(_with_euler(found, plain), plain)), other


def distinct(header: list[str]) -> list[str]:
    """Return a header whose Y after R and P (Nachi: turns about z, y and x) has a name other than the position's."""
    plain = [_unit_of(h.strip().lower())[0] for h in header]
    at = next((k for k in range(3, len(plain) - 2) if plain[k : k + 3] == ["r", "p", "y"] and "y" in plain[:k]), None)
    if at is None:
        return header
    turned = [f"n{k + 1}{header[at + k].strip()[1:]}" for k in range(3)]
    return [*header[:at], *turned, *header[at + 3 :]]


def _is_t_of_oat(name: str, names: list[str]) -> bool:
    return name == "t" and {"o", "a"} <= set(names) and "x" in names


def _unit_of(name: str) -> tuple[str, str]:
    found = _UNIT.search(name)
    if found is None or not name[: found.start()]:
        return name, ""
    word = found[1] or found[2] or ""
    return name[: found.start()].strip(" _"), _UNITS.get(word, word)


def _roles(name: str) -> list[tuple[str, str]]:
    """Prefix and role of a column's name; empty where it has none in a pose."""
    if name in _WHOLE:
        return [("", name)]
    if grid := re.fullmatch(r"(?:(.*)[_.\s])?(?:m|r|t|h|matrix|transform)?[_\s]?([0-4])[_,\s]?([0-4])", name):
        return [(grid[1] or "", f"m{grid[2]}{grid[3]}")]
    if numbered := re.fullmatch(r"actual_tcp_pose_([0-5])", name):
        return [("", ("x", "y", "z", "vx", "vy", "vz")[int(numbered[1])])]
    tokens = [t for t in re.split(r"[._\s/\[\]()\-:]+", name) if t]
    if not tokens:
        return []
    last, before = tokens[-1], tokens[:-1]
    if before[-1:] == ["o"] and last in ("x", "y", "z"):
        return [(_prefix(before[:-1]), f"o{last}")]  # the axis of an orientation vector (viam)
    if last in ("th", "theta"):
        return [(_prefix(before), "th")]
    if last in ("a", "b", "c", "w", "p", "r", "o") and len(before) == 1 and before[0] in _OWNERS:
        return [(before[0], last)]
    if short := re.fullmatch(r"([tpqr]|pos|rot|quat|rvec|tvec|rv|theta)([wxyz])", last):
        before, last = [*before, short[1]], short[2]
    if (short := re.fullmatch(r"(.+?)([xyz]|q[wxyz]|r[xyz])", last)) and short[1] in _OWNERS:
        before, last = [*before, short[1]], short[2]
    if last in ("roll", "pitch", "yaw") or re.fullmatch(r"q[0-4]", last):
        return [(_prefix(before), last)]
    if last not in ("w", "x", "y", "z"):
        return []
    if set(before) & _VECTOR or {"rotation", "vector"} <= set(before):
        return [(_prefix(before), f"v{last}")] if last != "w" else []
    for word in before:  # the first word that names a quantity decides: p_RS_R_x is a position
        if word in _QUATERNION:
            return [(_prefix(before), f"q{last}")]
        if word in _POSITION and last != "w":
            return [(_prefix(before), last)]
        if word in _ROTATION:
            return [(_prefix(before), f"r{last}")]
    return [(_prefix(before), last)]


def _prefix(words: list[str]) -> str:
    skipped = _POSITION | _ROTATION | _VECTOR | _QUATERNION | _FILLERS
    return "_".join(w for w in words if w not in skipped)


def _with_quaternions(columns: list[PoseColumn], names: list[tuple[str, str]]) -> list[PoseColumn]:
    """Rotation columns x, y, z, w of one list are a quaternion."""
    four = {c.prefix for c in columns if c.role == "rw"}
    return [
        (
            PoseColumn(c.prefix, f"q{c.role[1]}", c.unit, c.index)
            if c.prefix in four and re.fullmatch("r[wxyz]", c.role)
            else c
        )
        for c in columns
    ]


def _with_euler(columns: list[PoseColumn], names: list[tuple[str, str]]) -> list[PoseColumn]:
    plain = [n for n, _ in names]
    for words in _EULER_WORDS:
        if set(words) <= set(plain):
            columns += [
                PoseColumn("", f"e{k + 1}", names[plain.index(w)][1], plain.index(w)) for k, w in enumerate(words)
            ]
    if {"o", "a", "t"} <= set(plain) and "x" in plain:
        columns = [c for c in columns if c.role not in ("o", "a")]
        columns += [PoseColumn("", w, names[plain.index(w)][1], plain.index(w)) for w in "oat"]
    return columns


def _merged(columns: list[PoseColumn]) -> list[PoseColumn]:
    """Positions of one prefix and rotations of another are one list where there is one of each."""
    have: dict[str, set[str]] = {}
    for c in columns:
        have.setdefault(c.prefix, set()).add("p" if c.role in "xyz" else "r")
    positions = [p for p, kinds in have.items() if kinds == {"p"}]
    rotations = [p for p, kinds in have.items() if kinds == {"r"}]
    if len(have) == 2 and len(positions) == len(rotations) == 1:
        return [PoseColumn("", c.role, c.unit, c.index) for c in columns]
    whole = {
        p
        for p, kinds in have.items()
        if kinds == {"p", "r"} or any(c.role.startswith("m") for c in columns if c.prefix == p)
    }
    return [c for c in columns if c.prefix in whole] if whole else columns
