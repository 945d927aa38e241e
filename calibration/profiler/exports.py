"""Read profiles from the exports of laser profilers.

Tables, blocks, grids of heights, LMI Gocator sections and OpenCV documents.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.poses.listing import Listing
from weldcal.calibration.data.poses.names import columns_of, number_of
from weldcal.calibration.data.poses.storage import read_tree
from weldcal.calibration.data.poses.text import table_lists
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.text_blocks import NumberRows, blocks_of, gocator_profiles, is_gocator
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, MOST_COLUMNS, read_text, require_short_numbers

TREES = (".yml", ".yaml", ".json", ".xml")
TABLES = (".csv", ".txt", ".tsv", ".asc", ".dat", ".xyz", ".xz")
UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "inch": 0.0254}
"""Metres of the units of length that a profile may state."""
EXAMPLE = "scan,x_mm,y_mm,z_mm,qw,qx,qy,qz,px_mm,pz_mm"
_POINT_PREFIX = r"(?:p|profile|profil|point|laser|scan|scanner|sensor|line)"
_X = re.compile(rf"(?i){_POINT_PREFIX}[_. ]?x")
_Z = re.compile(rf"(?i){_POINT_PREFIX}[_. ]?z")
_SCAN = re.compile(
    r"(?i)(scan|profile?|frame|shot|measurement|messung|bild)([_. ]?(no|nr|num|number|id|index|count|counter)\.?)?|idx"
)
_TIME = re.compile(r"(?i)(time|time_?stamp|stamp|zeit|zeitstempel|t)(?:[ _.]*[\[(]?(s|sec|ms|µs|μs|us|ns)[\])]?)?")
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds of the units of time that an export may state."""
_NUMBERED = re.compile(r"(?i)(profile?|z|height|h|scan|head [a-z])?[ _.]*\d+|profile?|height")
_UNIT = re.compile(r"(.*?)[ _.]*(?<![a-zµμ])[\[(]?(m|mm|cm|µm|μm|um|inch)[\])]?")
_POINT = re.compile(r"(?i)(feature|edge)_?points?")
_KEYS = re.compile(r"(?i)(scan_?line|profiles?|points?|line|xz|data)")
_REPEATED = 5  # rows with one and the same pose that make a profile
_RAW = 1e5  # integers beyond it are raw heights, in units of 0.01 micrometres
_RAW_MM = 1e-5  # 0.01 micrometres, see _RAW
_EVEN = 0.02  # of the step: columns of x are evenly spaced
_FEWEST_COLUMNS = 8  # of a grid of heights


@dataclass(frozen=True, eq=False, kw_only=True)
class Profiles:
    """Profiles of a file, and what else it holds.

    Attributes:
        source: the file's name.
        points: profile points [x, z] (m, 2) of each profile, in ``unit``; NaN where nothing was measured.
        unit: m, mm, cm, um or inch where the file states it, else empty.
        form: a phrase for the reader.
        columns: the names of the columns that the file has, for messages.
        ids: a name for each profile, or empty.
        times: a time for each profile (n), or None; time_unit: its unit of SECONDS where the file states it, else
            empty.
        poses: the poses of the same table, one for each profile, or None.
        single: whether each profile is one point of a table without a number of the scan.
        found: the edge's point [x, z] (n, 2) in each profile, where the files hold it as well.
    """

    source: str
    points: tuple[Floats, ...]
    unit: str = ""
    form: str = ""
    columns: tuple[str, ...] = ()
    ids: tuple[str, ...] = ()
    times: Floats | None = None
    time_unit: str = ""
    poses: Listing | None = None
    single: bool = False
    found: Floats | None = None

    def __len__(self) -> int:
        return len(self.points)


def read_profiles(path: Path, pitch_mm: float | None = None) -> Profiles:
    """Return the profiles of one file.

    Args:
        path: an export of a profiler, or a table.
        pitch_mm: distance of neighbouring columns where the file holds heights only.

    Raises:
        InputError: the file holds no profiles that can be read; the sentence names what it holds.
    """
    if path.suffix.lower() in TREES:
        return _from_tree(path)
    text = read_text(path)
    require_short_numbers(text, path.name)
    if is_gocator(text):
        found = gocator_profiles(text, path.name)
        return Profiles(
            source=path.name,
            points=found.points,
            unit="mm",
            form=f"LMI Gocator {found.section}",
            columns=found.columns,
            ids=found.ids,
            times=found.times,
        )
    blocks = blocks_of(text, path.name)
    if not blocks:
        raise InputError(f"'{path.name}' holds no row of numbers. A table of profiles has columns such as {EXAMPLE}.")
    profiles = _with_header(blocks, path.name) if blocks[0].header else _bare(blocks, path.name, pitch_mm)
    _check(profiles)
    return profiles


def _check(profiles: Profiles) -> None:
    for k, p in enumerate(profiles.points):
        if not float(np.nanmax(np.abs(p), initial=0.0)) <= LARGEST_NUMBER:
            raise InputError(
                f"Profile {k} of '{profiles.source}' holds a number that is infinite or beyond {LARGEST_NUMBER:g}."
            )


def _with_header(blocks: list[NumberRows], name: str) -> Profiles:
    """Tables with named columns: x and z of each point, with the scan's number, or a block for each profile."""
    header = blocks[0].header
    if any(b.header != header for b in blocks):
        many = [b for b in blocks if _point_columns(b.header) is not None]
        if not many:
            raise InputError(_no_columns(name, header))
        header = many[0].header
        blocks = [b for b in blocks if b.header == header]
    if len(header) > MOST_COLUMNS and _point_columns(header) is None:
        raise InputError(f"'{name}' has {len(header)} columns, more than {MOST_COLUMNS}, the most that are read.")
    place = _point_columns(header)
    if place is None:
        return _columns_of_heights(blocks, header, name)
    ix, iz = place
    plain = [_split(h) for h in header]
    unit = plain[iz][1] or plain[ix][1]
    if plain[ix][1] and plain[iz][1] and plain[ix][1] != plain[iz][1]:
        raise InputError(
            f"The columns {header[ix]} and {header[iz]} of '{name}' state units that differ; give one unit."
        )
    scan = next((k for k, (h, _) in enumerate(plain) if k not in place and _SCAN.fullmatch(h)), None)
    clocks = {k: found for k, h in enumerate(header) if k not in place and (found := _TIME.fullmatch(h.strip()))}
    time = next(iter(clocks), None)
    table = np.vstack([b.table for b in blocks])
    rest = [k for k in range(len(header)) if k not in (ix, iz, scan)]
    posed = _has_poses([header[k] for k in rest])
    table = table[np.isfinite(table).any(axis=1)]
    if scan is None and len(blocks) > 1:
        of = np.repeat(np.arange(len(blocks)), [len(b.table) for b in blocks])[: len(table)]
    elif scan is not None:
        table = table[np.isfinite(table[:, scan])]
        of = _numbered(table[:, scan])
    elif posed:
        of = _runs(table[:, [k for k in rest if k != time]])
    elif time is not None:
        table = table[np.isfinite(table[:, time])]
        of = _numbered(table[:, time])
    else:
        of = np.zeros(len(table), int)
    if not len(table):
        raise InputError(f"'{name}' has a header and no row of numbers.")
    n = int(of.max()) + 1
    first = np.unique(of, return_index=True)[1]
    points = _without_empty(table[:, [ix, iz]])
    split = np.split(points[np.argsort(of, kind="stable")], np.cumsum(np.bincount(of, minlength=n))[:-1])
    ids = tuple(f"{table[k, scan]:.0f}" for k in first) if scan is not None else _captions(blocks)
    poses = None
    if posed:
        poses = _one_list(
            table_lists([header[k].lower() for k in rest], table[first][:, rest], name, ids if len(ids) == n else ()),
            name,
        )
    return Profiles(
        source=name,
        points=tuple(split),
        unit=unit,
        form="one row a point" if n == len(table) else f"{n} profiles, one row a point",
        columns=header,
        ids=ids,
        times=None if time is None else table[first, time],
        poses=poses,
        time_unit=re.sub("[µμ]", "u", clocks[time][2] or "").lower().replace("sec", "s") if time is not None else "",
        single=scan is None and n == len(table) > 1,
    )


def _one_list(lists: list[Listing], name: str) -> Listing:
    if len(lists) > 1:
        raise DatasetError(
            f"'{name}' holds {len(lists)} lists of poses: {', '.join(repr(one.name) for one in lists[:4])}. Keep the"
            " one of the flange in the base."
        )
    return lists[0]


def _split(name: str) -> tuple[str, str]:
    """Return a column's name and its unit: "X [mm]" and "x_mm" are x in mm."""
    plain = name.strip().lower()
    found = _UNIT.fullmatch(plain)
    if found is None or not found[1].strip(" _[("):
        return plain, ""
    return found[1].strip(" _"), {"µm": "um", "μm": "um"}.get(found[2], found[2])


def _point_columns(header: tuple[str, ...]) -> tuple[int, int] | None:
    """Places of the x and z of a profile point; None where no columns are named so."""
    names = [_split(h)[0] for h in header]
    xs, zs = ([k for k, n in enumerate(names) if mark.fullmatch(n)] for mark in (_X, _Z))
    if len(xs) == len(zs) == 1:
        return xs[0], zs[0]
    xs, zs = ([k for k, n in enumerate(names) if n == a] for a in "xz")
    y = [k for k, n in enumerate(names) if n == "y"]
    if len(xs) == len(zs) == 1 and (not y or not _turns(header)):
        return xs[0], zs[0]
    return None


def _turns(header: tuple[str, ...]) -> bool:
    """Return whether the columns name rotations: x, y and z are then those of a pose."""
    return any(c.role not in ("x", "y", "z") for c in columns_of(list(header))[0])


def _has_poses(names: list[str]) -> bool:
    return len(columns_of(names)[0]) >= 6


def _numbered(scan: Floats) -> np.ndarray[Any, Any]:
    """Return the number of each row's profile, in the order of the scans' numbers."""
    return np.asarray(np.unique(scan, return_inverse=True)[1]).ravel()


def _runs(poses: Floats) -> np.ndarray[Any, Any]:
    """Return the number of each row's profile where no column has it.

    Rows that follow each other with one pose, else each row.
    """
    new = np.concatenate([[True], (np.abs(np.diff(poses, axis=0)) > 0.0).any(axis=1)])
    if np.count_nonzero(new) * _REPEATED <= len(poses):
        return np.asarray(np.cumsum(new) - 1)
    return np.arange(len(poses))


def _captions(blocks: list[NumberRows]) -> tuple[str, ...]:
    """Names of profiles by the captions of their blocks, such as "Profile 3".

    Empty where they have no numbers of their own.
    """
    numbers = [number_of(b.caption) for b in blocks]
    if None in numbers or len(set(numbers)) < len(numbers):
        return ()
    return tuple(str(k) for k in numbers)


def _without_empty(points: Floats) -> Floats:
    """Points [x, z] with NaN where the sensor wrote 0, 0 or one of its marks for nothing."""
    p = points.copy()
    p[(p == 0.0).all(axis=1) | _empty(p[:, 1])] = np.nan
    return p


def _empty(z: Floats) -> np.ndarray[Any, Any]:
    """Heights that mean that nothing was measured.

    -99.9999 ... -99999.9999, -10000, -100000, and -2147483648 and its neighbours in raw integers.
    """
    marks = np.zeros(z.shape, bool)
    for power in (2, 3, 4, 5):
        mark = (z > -(10.0**power)) & (z <= -(10.0**power) + 2.5e-3) | ((power > 3) & (z == -(10.0**power)))
        marks |= mark
    return marks | (z < -2.1e9)


def _columns_of_heights(blocks: list[NumberRows], header: tuple[str, ...], name: str) -> Profiles:
    """Return a column of x and one column of heights for each profile."""
    names = [_split(h) for h in header]
    x = [k for k, (n, _) in enumerate(names) if n in ("x", "x coordinate", "x coordinates", "x position")]
    others = [k for k, (n, _) in enumerate(names) if k not in x and _NUMBERED.fullmatch(n)]
    if len(x) != 1 or not others or len(others) + 1 < len(header) or len(blocks) != 1:
        raise InputError(_no_columns(name, header))
    table = blocks[0].table
    points = tuple(_without_empty(table[:, [x[0], k]]) for k in others)
    return Profiles(
        source=name, points=points, unit=names[x[0]][1], form=f"{len(points)} profiles, a column each", columns=header
    )


def _no_columns(name: str, header: tuple[str, ...]) -> str:
    return (
        f"'{name}' has the columns {_listed(header)}: no x and z of profile points. Name them px_mm and pz_mm (or X"
        f" [mm] and Z [mm]), for example {EXAMPLE}."
    )


def _listed(header: tuple[str, ...]) -> str:
    return ", ".join(h[:24] for h in header[:14]) + (" ..." if len(header) > 14 else "")


def listed_columns(profiles: Profiles) -> str:
    """Return the columns of a file for a message."""
    return _listed(profiles.columns)


def _bare(blocks: list[NumberRows], name: str, pitch_mm: float | None) -> Profiles:
    """Numbers without names: x z, x z intensity or x y z a row; a grid with a row or a column of x; heights alone."""
    width = blocks[0].table.shape[1]
    if any(b.table.shape[1] != width for b in blocks):
        raise InputError(
            f"'{name}' has {width} numbers in its first row and"
            f" {next(b.table.shape[1] for b in blocks if b.table.shape[1] != width)} in a later one."
        )
    if 2 <= width <= 4:
        iz = _place_of_z(np.vstack([b.table for b in blocks]), name)
        points = tuple(_without_empty(b.table[:, [0, iz]]) for b in blocks)
        return Profiles(source=name, points=points, form="x and z a row", columns=("x", "z"), ids=_captions(blocks))
    if width == 1:
        heights = [b.table[:, 0] for b in blocks]
        return _of_heights(heights, name, pitch_mm, "heights, a line each")
    table = np.vstack([b.table for b in blocks])
    for grid, what in ((table, "row"), (table.T, "column")):
        if len(grid) > 1 and _even(grid[0]):
            raw = _is_raw(table)
            x = grid[0] * (_RAW_MM if raw else 1.0)
            points = tuple(np.column_stack([x, _height(z, raw)]) for z in grid[1:])
            return Profiles(
                source=name,
                points=points,
                unit="mm" if raw else "",
                form=f"heights, a {what} a profile, x in the first {what}",
                columns=tuple(f"x = {v:g}" for v in x[:3]),
            )
    if width < _FEWEST_COLUMNS:
        raise InputError(
            f"'{name}' has {width} numbers a row and no header: name its columns in a first row, for example {EXAMPLE}."
        )
    return _of_heights(list(table), name, pitch_mm, "heights, a row a profile")


def _place_of_z(table: Floats, name: str) -> int:
    """The column of z in rows of two to four numbers: the last, but for intensities and a y that hardly changes."""
    if table.shape[1] == 2:
        return 1
    second, third = table[:, 1], table[:, 2]
    second, third = second[np.isfinite(second)], third[np.isfinite(third)]
    if not len(second) or float(np.ptp(second)) <= 1e-9 * max(1.0, float(np.abs(second).max())):
        return 2
    whole = len(third) and bool((third == np.round(third)).all()) and float(third.min()) >= 0.0
    if whole and not bool((second == np.round(second)).all()):
        return 1
    raise InputError(
        f"'{name}' has {table.shape[1]} numbers a row and no header: which one is z? Name the columns in a first row,"
        " for example X [mm];Z [mm]."
    )


def _even(x: Floats) -> bool:
    """Whether numbers rise by one step, as the x of the columns of a grid do; those before them may be missing."""
    if len(x) < _FEWEST_COLUMNS or not np.isfinite(x).all():
        return False
    step = np.diff(x)
    return bool(step.min() > 0.0 and float(np.ptp(step)) <= _EVEN * float(step.mean()))


def _is_raw(table: Floats) -> bool:
    known = table[np.isfinite(table)]
    return bool(len(known)) and bool((known == np.round(known)).all()) and float(np.abs(known).max()) > _RAW


def _height(z: Floats, raw: bool) -> Floats:
    out = np.where(_empty(z), np.nan, z)
    return out * _RAW_MM if raw else out


def _of_heights(heights: list[Floats], name: str, pitch_mm: float | None, form: str) -> Profiles:
    if pitch_mm is None:
        raise InputError(
            f"'{name}' holds {len(heights)} profiles of {len(heights[0])} heights and no x. Give the distance of the"
            " points in mm, for example --as pitch=0.0125, or write the x of each column into a first row."
        )
    if not 1e-6 < pitch_mm < 10.0:
        raise InputError(f"A distance of {pitch_mm:g} mm between points cannot be used; give --as pitch in mm.")
    raw = _is_raw(np.concatenate(heights))
    points = []
    for z in heights:
        x = pitch_mm * (np.arange(len(z)) - 0.5 * (len(z) - 1))
        points.append(np.column_stack([x, _height(z, raw)]))
    return Profiles(source=name, points=tuple(points), unit="mm", form=form, columns=("z",))


def _from_tree(path: Path) -> Profiles:
    """One profile of a document with a list of numbers, [x, z] or [x, y, z] each, nested or in one row."""
    tree = _plain(read_tree(path))
    found = [(key, a) for key, a in _lists(tree, "") if a is not None]
    named = [(k, a) for k, a in found if _KEYS.fullmatch(k.rpartition("/")[2])] or found
    if len(named) != 1:
        held = ", ".join(k.strip("/") for k, _ in _lists(tree, ""))[:120] or "no list of numbers"
        raise InputError(
            f"'{path.name}' holds {held}; a profile is one list of [x, z] or [x, y, z] under a key such as scan_line."
        )
    key, a = named[0]
    point = next((v for k, v in tree.items() if _POINT.fullmatch(k)), None) if isinstance(tree, dict) else None
    at = np.zeros(0) if point is None else np.array([v for v in np.ravel(point) if isinstance(v, int | float)])
    return Profiles(
        found=at[None, [0, -1]] if len(at) in (2, 3) else None,
        source=path.name,
        points=(_without_empty(a[:, [0, -1]]),),
        form="a document for each profile",
        columns=(key.strip("/"),),
    )


def _plain(node: Any) -> Any:
    """Return the tree with words such as .Nan as numbers."""
    if isinstance(node, Mapping):
        return {str(k): _plain(v) for k, v in node.items()}
    if isinstance(node, list):
        return [_plain(v) for v in node]
    if isinstance(node, str) and node.strip().lower().lstrip(".") == "nan":
        return float("nan")
    return node


def _lists(node: Any, at: str) -> list[tuple[str, Floats | None]]:
    """Lists of points by their key paths: (m, 2) or (m, 3) each, None where a list is none."""
    if isinstance(node, Mapping):
        return [one for k, v in node.items() for one in _lists(v, f"{at}/{k}")]
    if not isinstance(node, list | np.ndarray):
        return []
    try:
        a = np.asarray(node, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return [(at, None)]
    if a.ndim == 1 and len(a) >= 15 and len(a) % 3 == 0 and float(np.nanmax(np.abs(a[1::3]), initial=0.0)) < 1e-9:
        return [(at, a.reshape(-1, 3))]
    if a.ndim == 1 and len(a) >= 10 and len(a) % 2 == 0:
        return [(at, a.reshape(-1, 2))]
    if a.ndim == 2 and a.shape[1] in (2, 3) and len(a) >= 5:
        return [(at, a)]
    return [(at, None)]


def joined(parts: list[Profiles], name: str) -> Profiles:
    """Return the profiles of several files as one list, a file for each."""
    units = {p.unit for p in parts}
    if len(units) > 1:
        raise InputError(
            f"The files of '{name}' state different units ({', '.join(sorted(u or 'none' for u in units))}); give one."
        )
    times = [p.times for p in parts if p.times is not None]
    found = [p.found for p in parts if p.found is not None]
    return replace(
        parts[0],
        source=name,
        points=tuple(p.points[0] for p in parts),
        ids=tuple(Path(p.source).stem for p in parts),
        poses=None,
        times=np.concatenate(times) if len(times) == len(parts) else None,
        form=f"one file per profile, {parts[0].form}",
        found=np.concatenate(found) if len(found) == len(parts) else None,
        single=False,
    )
