"""Find lists of poses in text.

Tables with or without a header, blocks of numbers, robot programs and what ROS prints.
"""

import re
import zipfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from weldcal.calibration.data.poses.listing import Listing, listing_of, listing_of_array
from weldcal.calibration.data.poses.names import PoseColumn, columns_of, distinct, joint_columns, whose
from weldcal.calibration.data.poses.programs import NUMBER, list_of_program
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.files import MOST_CELLS, require_short_numbers
from weldcal.models.text_tables import cells_of, lines_of, separator_of

_CELL = re.compile(rf"{NUMBER}|[-+]?(?:nan|inf(?:inity)?)", re.IGNORECASE)
_KEYED = re.compile(rf"[\"']?\b([A-Za-z_][\w.]{{0,40}})[\"']?\s{{0,9}}[:=]\s{{0,9}}[\"']?({NUMBER})(?![\w.])")
_UNIT_CELL = re.compile(r"(?i)[\[(]?(mm|cm|m|in|inch|deg|rad|degrees?|radians?|°|-|s|ms)?[\])]?")
_BRACKETS = re.compile(r"[\[\](){}]")
_COMMENT = ("#", "%", "//", "!", ";")
_BEYOND = 1e300  # a number of so many digits that it has no value
_COSINE = 1.1  # no element of a rotation matrix exceeds it
_ARRAY = re.compile(r"\b(?:np\.|numpy\.)?(?:array|matrix)\s*\(")
_NAMED_ARRAY = re.compile(r"(?m)^[ \t]*[A-Za-z_]\w{0,40}[ \t]*=[ \t]*(?=\[\[)")
"""What stands before the numbers of an array that was pasted from Python."""
_SECONDS = 1e8  # a choice: a first column from here on counts seconds since 1970, and below it rows
_NANOSECONDS = 1e14  # a time above it is in nanoseconds
_TURN_RAD = 7.0  # a whole turn and a little: larger joint angles are degrees
_MOST_TURNS_DEG = 3600.0  # a choice: beyond ten turns numbers are pulses of an encoder
_NUMBERED = ("q0 q1 q2 q3", "q1 q2 q3 q4")
_ROTATIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    *(
        (names, {"rotation": "quaternion_wxyz", "form": "x, y, z, quaternion"})
        for names in ("qw qx qy qz", "q0 qx qy qz")
    ),
    *((names, {"form": "x, y, z, quaternion"}) for names in _NUMBERED),
    ("vx vy vz", {"rotation": "rotation_vector", "form": "x, y, z, rotation vector"}),
    ("rx ry rz", {"form": "x, y, z, rx, ry, rz"}),
    ("roll pitch yaw", {"usual": "euler_xyz", "vector": False, "form": "x, y, z, roll, pitch, yaw"}),
    ("a b c", {"usual": "euler_ZYX", "firm": True, "vector": False, "angles": "deg", "form": "x, y, z, A, B, C"}),
    ("w p r", {"rotation": "euler_xyz", "angles": "deg", "form": "x, y, z, Fanuc W, P, R"}),
    ("o a t", {"rotation": "euler_ZYZ", "angles": "deg", "form": "x, y, z, O, A, T"}),
    ("a e r", {"rotation": "euler_ZYZ", "angles": "deg", "form": "x, y, z, Comau A, E, R"}),
    ("u v w", {"rotation": "euler_ZYX", "angles": "deg", "form": "x, y, z, Epson U, V, W"}),
    ("ez ey ex", {"rotation": "euler_ZYX", "angles": "deg", "form": "x, y, z, ABB EZ, EY, EX"}),
    ("n1 n2 n3", {"usual": "euler_ZYX", "vector": False, "angles": "deg", "form": "x, y, z, Nachi R, P, Y"}),
    ("e1 e2 e3", {"vector": False, "form": "x, y, z and three angles"}),
)
"""The columns of a rotation, and what they say of it, in the order in which they are sought."""


def sheets_of(path: Path) -> dict[str, str]:
    """Return the sheets of an Excel file that hold anything, as text with semicolons. Raises DatasetError."""
    try:
        from openpyxl import load_workbook
    except ImportError as problem:
        raise DatasetError(
            f"'{path.name}' is an Excel file: save each sheet as CSV, or install the extra 'excel' (pip install"
            " openpyxl)."
        ) from problem
    try:
        book = load_workbook(path, read_only=True, data_only=True)
        sheets = {
            sheet.title: "\n".join(
                ";".join("" if cell is None else str(cell) for cell in row)
                for row in sheet.iter_rows(max_row=MOST_CELLS, values_only=True)
            )
            for sheet in book.worksheets
        }
    except (zipfile.BadZipFile, KeyError, ValueError, OSError) as problem:
        raise DatasetError(
            f"'{path.name}' cannot be read as an Excel file ({type(problem).__name__}); save it as CSV."
        ) from problem
    return {title: text for title, text in sheets.items() if text.strip()}


def lists_of_text(text: str, name: str) -> list[Listing]:
    """Return every list of poses of a text.

    Args:
        text: of a table, a program or a log.
        name: of the file, for messages.

    Raises:
        DatasetError: it holds no pose, or one that cannot be read; the sentence says what to change.
    """
    text = text.lstrip("\ufeff")
    require_short_numbers(text, name)
    text = _ARRAY.sub("", text)
    if len(_NAMED_ARRAY.findall(text)) == 1:
        text = _NAMED_ARRAY.sub("", text)
    if re.search(r"IMAGE_ID,\s*QW|two lines of data per image", text):
        raise DatasetError(
            f"'{name}' is COLMAP's images.txt, whose poses are inverted (world in camera) and have no unit of length."
            " Invert them, scale them to metres by a known length, and write them as a table x,y,z,qw,qx,qy,qz."
        )
    found = list_of_program(text, name)
    return [found] if found is not None else keyed_lists(text, name) or _numbers(text, name)


def keyed_lists(text: str, name: str) -> list[Listing]:
    """Return the lists of lines such as ``x: 0.1, y: 0.2 ...`` or ``X=1 Y=2 ...`` with the same names in each.

    Empty where it has none.
    """
    rows = [found for _, line in lines_of(text) if len(found := _KEYED.findall(line)) >= 6]
    names = [key for key, _ in rows[0]] if len(rows) > 1 else []
    if not names or any([key for key, _ in row] != names for row in rows) or _named(names) < 5:
        return []
    return table_lists(names, np.array([[float(value) for _, value in row] for row in rows]), name)


class _Line:
    """One line of a table: its cells, and which of them are numbers."""

    def __init__(self, number: int, cells: list[str]) -> None:
        self.number, self.cells = number, cells
        self.values = [_value(c) for c in cells]

    @property
    def numeric(self) -> int:
        return sum(v is not None for v in self.values)


def _value(cell: str) -> float | None:
    if _CELL.fullmatch(cell):
        value = float(cell)
        return value if np.isfinite(value) or not cell.lstrip("+-")[:1].isdigit() else _BEYOND
    return np.nan if cell == "" else None


def _numbers(text: str, name: str) -> list[Listing]:
    lines, comments = _lines(text)
    if not lines:
        raise DatasetError(f"'{name}' is empty.")
    header = next((k for k, line in enumerate(lines[:40]) if _is_header(line, lines[k + 1 :])), None)
    if header is not None:
        return _table(*_whole_header(lines, header), name)
    rows = [line for line in lines if line.numeric >= 3]
    if len(lines) in (6, 7, 12, 16) and all(line.numeric == 1 == len(line.cells) for line in lines):
        rows = [_Line(lines[0].number, [line.cells[0] for line in lines])]  # a number a line
    if not rows:
        raise DatasetError(
            f"'{name}' holds no poses: no row of it has numbers. A table of poses has columns x,y,z with qw,qx,qy,qz or"
            " rx,ry,rz, or 6, 7 or 16 numbers a row."
        )
    commented = next((c for c in reversed(comments) if c.number < rows[0].number and _named(c.cells) >= 6), None)
    if commented is not None and len(commented.cells) == len(rows[0].cells):
        return _table(commented.cells, rows, name)
    captions = _captioned(lines)
    if captions is not None:
        return [_bare([_tail(r) for r in mine], f"{name}, {label}", ()) for label, mine in captions.items()]
    labelled: dict[str, list[_Line]] = defaultdict(list)
    for row in rows:
        labelled[str(row.cells[0]).lower() if row.values[0] is None else ""].append(row)
    if 2 <= len(labelled) <= 3 and "" not in labelled and min(map(len, labelled.values())) >= 3:
        return [_bare([_tail(r) for r in mine], f"{name}, {label}", ()) for label, mine in labelled.items()]
    ids = tuple(PurePath(str(r.cells[0])).stem for r in rows) if all(r.values[0] is None for r in rows) else ()
    plain = [_tail(r) for r in rows]
    if _two_a_row(plain):
        half = len(plain[0]) // 2  # two poses a row, the robot's first
        return [
            _bare([row[k : k + half] for row in plain], f"{name}, columns {k + 1} to {k + half}, {who}", ids)
            for k, who in ((0, "robot"), (half, "camera"))
        ]
    gap = next((k for k, (a, b) in enumerate(pairwise(rows), 1) if k == len(rows) // 2 and b.number > a.number + 1), 0)
    if (
        gap
        and 2 * gap == len(rows) >= 6
        and len(plain[0]) in (6, 7, 12, 16)
        and rows[-1].number - rows[gap].number == gap - 1 == rows[gap - 1].number - rows[0].number
    ):
        return [  # two blocks of as many rows, the robot's first
            _bare(mine, f"{name}, lines {of[0].number} to {of[-1].number}, {who}", ())
            for mine, of, who in ((plain[:gap], rows[:gap], "robot"), (plain[gap:], rows[gap:], "camera"))
        ]
    return [_bare(plain, name, ids)]


def _two_a_row(rows: list[list[float]]) -> bool:
    """Return whether rows hold two poses each: 14 numbers, or 12 of which those that would be cosines exceed 1."""
    n = len(rows[0])
    if len(rows) < 2 or any(len(row) != n for row in rows):
        return False
    return n == 14 or (n == 12 and float(np.nanmax(np.abs(np.array(rows)[:, [0, 1, 2, 4, 5, 6, 8]]))) > _COSINE)


def _whole_header(lines: list[_Line], at: int) -> tuple[list[str], list[_Line]]:
    """The names of a header of one or two lines with the units of a line below it, and the lines below."""
    names, rest = list(lines[at].cells), lines[at + 1 :]
    above = lines[at - 1].cells if at else []
    if len({n.lower() for n in names}) < len(names) and 1 < len(above) <= len(names) + 1 and not _filled(lines[at - 1]):
        owner, joined = "", []
        names += [""] * (len(above) - len(names))
        for k, name in enumerate(names):
            owner = above[k] if k < len(above) and above[k] else owner
            joined.append(f"{owner} {name}".strip())
        names = joined
    if rest and not _filled(rest[0]) and all(_UNIT_CELL.fullmatch(c) for c in rest[0].cells):
        units = [c.strip("[]() ") for c in rest[0].cells]
        names = [
            f"{n} [{u}]" if u and u != "-" else n for n, u in zip(names, [*units, *[""] * len(names)], strict=False)
        ]
        rest = rest[1:]
    return names, rest


def _filled(line: _Line) -> int:
    """How many cells of a line are numbers that are there."""
    return sum(v is not None and c != "" for v, c in zip(line.values, line.cells, strict=True))


def _captioned(lines: Sequence[_Line]) -> dict[str, list[_Line]] | None:
    """Return the rows of numbers below captions of two kinds, such as ``robot:`` and ``camera:``.

    None where the captions are not of two lists.
    """
    groups: dict[str, list[_Line]] = defaultdict(list)
    label = ""
    for line in lines:
        words = "".join(
            re.findall(
                r"[A-Za-z_]\w*|\s", " ".join(c for c, v in zip(line.cells, line.values, strict=True) if v is None)
            )
        )
        if line.numeric >= 3 and line.values[0] is not None:
            groups[label].append(line)
        elif words.strip():
            label = re.sub(r"\d+", "", " ".join(words.split())).lower()
    if len(groups) != 2 or "" in groups or min(map(len, groups.values())) < 3:
        return None
    return groups if {whose(label) for label in groups} == {"robot", "camera"} else None


def _tail(row: _Line) -> list[float]:
    """Return the numbers of a row, without words."""
    return [v for v in row.values if v is not None]


def _bare(rows: list[list[float]], name: str, ids: tuple[str, ...]) -> Listing:
    n = len(rows[0])
    uneven = next((k for k, row in enumerate(rows) if len(row) != n), None)
    if uneven is not None:
        raise DatasetError(
            f"'{name}' has {n} numbers in its first row and {len(rows[uneven])} in row {uneven + 1}. Remove the rows"
            " that hold no pose, such as a result below the poses."
        )
    table = np.array(rows)
    if n == 4 and len(table) % 4 and len(table) % 3 == 0:
        table = table.reshape(-1, 12)
    elif n == 9 and not ids:
        table = _stamped(table)
    step = np.diff(table[:, 0])
    counted = n in (7, 8, 13, 17) and len(table) > 1 and bool((step == step[0]).all()) and step[0] in (0.0, 1.0)
    if counted and step[0] and table[0, 0] > _SECONDS:
        return replace(listing_of_array(name, table[:, 1:]), ids=ids, times=table[:, 0])
    if counted and (n != 7 or not _quaternion_rows(table)):
        found = listing_of_array(name, table[:, 1:])
        return replace(found, ids=ids or (tuple(str(int(v)) for v in table[:, 0]) if step[0] else ()))
    found = listing_of_array(name, table)
    return replace(found, ids=ids) if ids and len(ids) == len(found) else found


def _stamped(table: Array) -> Array:
    """Rows of seconds, nanoseconds and seven numbers as time and seven numbers."""
    return np.column_stack([table[:, 0] + 1e-9 * table[:, 1], table[:, 2:]])


def _quaternion_rows(table: Array) -> bool:
    return bool(np.abs(np.linalg.norm(table[:, 3:7], axis=1) - 1.0).max() < 1e-2)


def _lines(text: str) -> tuple[list[_Line], list[_Line]]:
    """Return the lines of a table in cells, and its comments."""
    rows = list(lines_of(text, _COMMENT))
    comments = ((k, s.lstrip(" \t#%/!;")) for k, s in lines_of(text) if s.lstrip().startswith(_COMMENT))
    separator = separator_of([_BRACKETS.sub(" ", s) for _, s in rows])
    lines = [_Line(k, _cells(s, separator)) for k, s in rows]
    return lines, [_Line(k, _cells(s, separator if separator in s else " ")) for k, s in comments if s]


def _cells(line: str, separator: str) -> list[str]:
    plain = _BRACKETS.sub(" " if separator == " " else "", line) if separator in ", " else line
    cells = cells_of(plain, separator)
    if separator == ",":  # blanks may separate numbers, too
        cells = [word for cell in cells for word in (cell.split() if _all_numbers(cell) else [cell])]
    while len(cells) > 1 and cells[-1] == "":
        cells.pop()
    return [c.strip("\"'") for c in cells]


def _all_numbers(cell: str) -> bool:
    words = cell.split()
    return len(words) > 1 and all(_CELL.fullmatch(w) for w in words)


def _is_header(line: _Line, rest: Sequence[_Line]) -> bool:
    return _named(line.cells) >= 5 and line.numeric <= len(line.cells) // 3 and any(r.numeric >= 5 for r in rest[:5])


def _named(header: Sequence[str]) -> int:
    """How many columns of poses, or else of joint angles, a header names."""
    columns, joints = columns_of(list(header))[0], joint_columns(list(header))
    return max(len(columns), *(len(one.indices) for one in joints), 0)


def _table(header: list[str], rows: Sequence[_Line], name: str) -> list[Listing]:
    header = distinct(header)
    _, other = columns_of(header)
    child = next((k for k, h in enumerate(header) if h.lower().endswith("child_frame_id")), None)
    if child is not None:
        parent = next((k for k, h in enumerate(header) if h.lower().endswith("frame_id") and k != child), child)
        plain = [h if k not in (child, parent) else "" for k, h in enumerate(header)]
        frames: dict[str, list[_Line]] = defaultdict(list)
        for row in rows:
            frames[f"{row.cells[parent].strip('/')} to {row.cells[child].strip('/')}"].append(row)
        return _frames(plain, frames, name)
    kept = [r for r in rows if r.numeric]
    if not kept:
        raise DatasetError(f"'{name}' has a header and no poses below it.")
    long = next((r for r in kept if any(c for c in r.cells[len(header) :])), None)
    if long is not None:
        raise DatasetError(
            f"'{name}', line {long.number}: {len(long.cells)} cells, and the header names {len(header)} columns;"
            " decimal commas need semicolons or tabs between the columns."
        )
    table = np.full((len(kept), len(header)), np.nan)
    for k, row in enumerate(kept):
        for j, value in enumerate(row.values[: len(header)]):
            table[k, j] = np.nan if value is None else value
    ids: tuple[str, ...] = ()
    if "id" in other:
        words = [r.cells[other["id"]] if other["id"] < len(r.cells) else "" for r in kept]
        ids = tuple(PurePath(w).stem or w for w in words)
        twice = next((i for i in ids if ids.count(i) > 1), None) if len(set(ids)) < len(ids) else None
        if twice is not None:
            raise DatasetError(f"'{name}' gives the id '{twice}' twice; keep one row for each pose.")
    return table_lists(header, table, name, ids)


def _frames(header: list[str], frames: dict[str, list[_Line]], name: str) -> list[Listing]:
    """One list for each pair of frames; pairs that never move hold no pose."""
    found, problem = [], None
    for key, mine in frames.items():
        try:
            found += _table(header, mine, f"{name}, {key}")
        except DatasetError as why:
            problem = why
    if not found and problem is not None:
        raise problem
    return found


def table_lists(header: list[str], table: Array, name: str, ids: tuple[str, ...] = ()) -> list[Listing]:
    """Return the lists of poses of a table (n, columns) of numbers with named columns.

    Raises:
        DatasetError: a list has no position or no rotation, or an angle of a joint is none.
    """
    again = next((h for h in header if h and [x.lower() for x in header].count(h.lower()) > 1), None)
    if again is not None:
        raise DatasetError(f"'{name}' has two columns '{again[:40]}'; keep one.")
    columns, other = columns_of(header)
    times = table[:, other["time"]] if "time" in other else None
    if times is not None:
        times = times * 1e-9 if np.isfinite(times).any() and float(np.nanmax(times)) > _NANOSECONDS else times
        times = times if np.isfinite(times).all() else None
    prefixes = sorted({c.prefix for c in columns}, key=[c.prefix for c in columns].index)
    found, joints = [], joint_columns(header)
    for prefix in prefixes:
        mine = [c for c in columns if c.prefix == prefix]
        alone = len(prefixes) == 1 and not (joints and prefix)
        found.append(_columns(name if alone else f"{name}, {prefix or 'other'}", mine, table, ids, times))
    robots = [one for one in found if whose(one.name) != "camera"]
    if not joints or (robots and float(np.nanmax(np.abs(table[:, joints[0].indices]), initial=0.0)) > _MOST_TURNS_DEG):
        return found
    q, words = joints_rad(table[:, joints[0].indices], joints[0].unit, name)
    if not robots:
        bad = np.flatnonzero(~np.isfinite(q).all(axis=1))
        left_out = tuple((int(k), "A joint angle is missing or not finite.") for k in bad)
        label = f"{name}, robot" if found else name
        more: dict[str, Any] = {"ids": ids, "times": times, "form": words, "left_out": left_out}
        return [*found, Listing(name=label, numbers=(), joints=np.where(np.isfinite(q), q, 0.0), **more)]
    return [replace(one, joints=q) if one in robots else one for one in found]


def joints_rad(q: Array, unit: str, name: str) -> tuple[Array, str]:
    """Joint angles (n, joints) rad, NaN where there is none, and a phrase; ``unit``: deg, rad, or empty.

    Raises DatasetError for no angles.
    """
    largest = float(np.nanmax(np.abs(q), initial=0.0))
    if not np.isfinite(largest) or largest > _MOST_TURNS_DEG:
        raise DatasetError(f"'{name}' has a joint angle of {largest:.6g}: write angles in degrees or radians.")
    degrees = unit == "deg" or (unit != "rad" and largest > _TURN_RAD)
    if unit == "rad" and largest > _TURN_RAD:
        raise DatasetError(f"'{name}' states joint angles in rad, and one is {largest:.4g}: they look like degrees.")
    return np.radians(q) if degrees else q, f"joint angles in {'degrees' if degrees else 'radians'}"


def _columns(name: str, columns: list[PoseColumn], table: Array, ids: tuple[str, ...], times: Array | None) -> Listing:
    at = {c.role: c.index for c in columns}
    units = {c.role: c.unit for c in columns if c.unit}
    length = units.get("x", "")
    if len({units.get(a, "") for a in "xyz"}) > 1:
        raise DatasetError(f"The columns x, y and z of '{name}' state units that differ; give one unit.")
    angle = next((u for r, u in units.items() if r not in "xyz" and u in ("deg", "rad")), "")

    def take(*roles: str) -> Array:
        return table[:, [at[r] for r in roles]]

    grid = sorted(r for r in at if re.fullmatch(r"m\d\d", r))
    more: dict[str, Any] = {"ids": ids, "times": times, "unit": length}
    if len(grid) in (12, 16):
        return listing_of_array(name, take(*grid), **more)
    if not {"x", "y", "z"} <= set(at):
        raise DatasetError(f"'{name}' names no columns x, y, z; it has {', '.join(sorted(at))}.")
    p = take("x", "y", "z")
    if {"ox", "oy", "oz", "th"} <= set(at):
        o, th = take("ox", "oy", "oz"), np.radians(take("th"))
        o = o / np.linalg.norm(o, axis=1, keepdims=True)
        turns = np.column_stack([np.arctan2(o[:, 1], o[:, 0]), np.arccos(np.clip(o[:, 2], -1.0, 1.0)), th[:, 0]])
        more["form"] = "x, y, z, orientation vector"
        return listing_of(name, p, turns, rotation="euler_ZYZ", angles="rad", **more)
    for words, stated in _ROTATIONS:
        roles = words.split()
        if set(roles) <= set(at) and not (words in _NUMBERED and {"rx", "ry", "rz"} <= set(at)):
            angles = {} if roles[0].startswith("q") else {"angles": angle or stated.get("angles", "")}
            return listing_of(name, p, take(*roles), **{**stated, **angles, **more})
    raise DatasetError(
        f"'{name}' has positions and no rotation that it names: add qw,qx,qy,qz, or rx,ry,rz, or roll,pitch,yaw. It"
        f" names {', '.join(sorted(at))}."
    )
