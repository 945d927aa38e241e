"""Read dataset.yaml and CSV tables, and check them: rows, numbers, quaternions and units; hashes of files."""

import math
import re
from collections.abc import Iterator
from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.cloud_files.body import VIEWPOINTS, measured
from weldcal.calibration.data.cloud_files.depth import checked_intrinsics
from weldcal.calibration.data.clouds import CloudError, CloudForm, read_cloud
from weldcal.calibration.data.header import DatasetHeader, Feature, PoseForm, ScannerGuess, SecondRobot, Units
from weldcal.calibration.data.poses.names import mounting_name
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.documents import parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import (
    LARGEST_DOCUMENT,
    LARGEST_NUMBER,
    MOST_CELLS,
    MOST_COLUMNS,
    read_text,
    require_few_lines,
    sha256,
)
from weldcal.models.flanges import is_part_file
from weldcal.models.text_tables import LONGEST_CELL, cells_of, lines_of, separator_of

Row = dict[str, str]
Angles = dict[str, dict[str, float]]

JOINT_NAME = re.compile(r"(second_)?q[1-7]")
"""Columns of joint angles, rad, in this package's own tables."""

UNITS = {"m": 1.0, "mm": 1e-3}
AUTO = "auto"
CONFIGURATIONS = ("eye_on_base", "eye_in_hand")
IN_HAND = "eye_in_hand"
CARRIED = ("eye_on_arm_target_on_flange", "eye_on_arm_target_on_base", "co_manipulation")
"""Other mountings, which are calibrated from scans at rest."""
ALIASES = {"eye_on_arm": CARRIED[0], "eye_on_arm_base": CARRIED[1]}
# a choice: ten times what a maker's calibration leaves (ARM_ERROR_M); a larger figure is micrometres
LARGEST_ARM_MM = 5.0
MODES = ("static", "motion")
_SAMPLE = 10_000  # points whose distance is enough to tell metres from millimetres
# Median distances that a flange has from its base, and a scanned point from its camera. The bounds are a factor of 1000
# apart, so that metres called millimetres, or the reverse, always fall outside.
REACH_M = (0.01, 10.0)


def read_rows(path: Path) -> tuple[list[str], list[Row]]:
    """Names of the columns (lower case) and the rows by name, all stripped; a cell that is missing is empty.

    Lines that begin with #, empty lines and rows without a value are skipped. Decimal commas become points where the
    comma separates nothing.
    Raises InputError: no regular file, no UTF-8 text, larger than the bounds in models/files.py, a column named twice,
    a row with more values than columns, a quote that does not end; with the line's number.
    """
    names: list[str] = []
    rows: list[Row] = []
    for k, (line, values) in enumerate(_cells(path)):
        if k == 0:
            names = _names(path, values)
            continue
        if any(values[len(names) :]):
            raise InputError(
                f"'{path.name}', line {line}: {len(values)} cells, and the header names {len(names)} columns; decimal"
                " commas need semicolons or tabs between the columns."
            )
        if any(values):
            rows.append(dict.fromkeys(names, "") | dict(zip(names, values, strict=False)))
        if len(rows) * len(names) > MOST_CELLS:
            raise InputError(f"'{path.name}' has more than {MOST_CELLS} cells, the most that are read.")
    return names, rows


def cut_off(path: Path) -> str | None:
    """Return a sentence where a CSV file seems to end within its last row, None else.

    That row has fewer cells than the header, or no line break follows it and its last number is shorter than all others
    of its column. Raises what read_rows raises.
    """
    table = [values for _, values in _cells(path)]
    rows = [row for row in table[1:] if any(row)]
    if not rows:
        return None
    width, last = len(table[0]), rows[-1]
    if len(last) < width:
        return (
            f"The last row of '{path.name}' has {len(last)} of {width} cells: the file is cut off there, and that row"
            " is not used. Copy the file again."
        )
    open_end = not path.read_bytes().endswith((b"\n", b"\r"))
    others = [len(row[width - 1]) for row in rows[:-1] if len(row) >= width and row[width - 1]]
    if open_end and last[width - 1] and len(others) > 1 and len(last[width - 1]) < min(others):
        return (
            f"The last row of '{path.name}' may be cut off within its last number, {last[width - 1]}. Copy the file"
            " again."
        )
    return None


def _cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and stripped cells of all rows, the header first, with decimal points.

    Raises InputError as read_rows.
    """
    lines = list(lines_of(read_text(path), ("#",)))
    separator = separator_of([line for _, line in lines])
    for number, line in lines:
        cells = cells_of(line, separator)
        if len(line) > LONGEST_CELL and max(map(len, cells)) > LONGEST_CELL:
            raise InputError(f"'{path.name}', line {number}, has a cell of more than {LONGEST_CELL} characters.")
        if any(cell.startswith('"') for cell in cells):
            raise InputError(f"'{path.name}', line {number}, cannot be read: a quote does not end.")
        yield number, cells


def _names(path: Path, cells: list[str]) -> list[str]:
    """The columns' names; refuses two of one name."""
    names = [name.lower() for name in cells]
    if len(names) > MOST_COLUMNS:
        raise InputError(f"'{path.name}' has {len(names)} columns, more than {MOST_COLUMNS}, the most that are read.")
    again = next((name for name in names if name and names.count(name) > 1), None)
    if again is not None:
        raise InputError(f"'{path.name}' has two columns '{again[:40]}'; keep one.")
    return names


def read_header(path: Path) -> DatasetHeader:
    """Contents of a dataset.yaml, checked. Raises DatasetError, one sentence that names the key."""
    if not path.exists():
        if path.is_symlink():
            raise DatasetError(
                f"'{path.parent.name}' has a dataset.yaml that is a link to no file; replace or remove the link."
            )
        raise DatasetError(
            f"'{path.parent.name}' has no dataset.yaml; add one with schema, robot, flange, scanner, configuration "
            "and units."
        )
    try:
        text = read_text(path, LARGEST_DOCUMENT)
        given = parse_document(path.name, text)  # within bounds, no key twice
        header: DatasetHeader = yaml_load_typed(schema=DatasetHeader, data=text, defaults=DatasetHeader())
    except InputError as e:
        raise DatasetError(str(e)) from e
    except Exception as e:
        # pydrake raises whatever its YAML reader meets; the first line names the key
        raise DatasetError(_unread(path.name, given, str(e).splitlines()[0])) from e
    given = given if isinstance(given, dict) else {}
    # what is not stated is taken as without the file
    header.schema = header.schema if "schema" in given else 1
    header.configuration = header.configuration if "configuration" in given else CONFIGURATIONS[0]
    units = given.get("units")
    units = units if isinstance(units, dict) else {}
    header.units.clouds = header.units.clouds if "clouds" in units else AUTO
    header.units.poses = header.units.poses if "poses" in units else AUTO
    if header.schema != 1:
        raise DatasetError(f"'{path.name}' says schema {header.schema}; this software reads schema 1.")
    for name, unit in (("clouds", header.units.clouds), ("poses", header.units.poses)):
        if unit not in (*UNITS, AUTO):
            raise DatasetError(f"'{path.name}' gives the unit '{unit}' for {name}; write m or mm.")
    if header.mode not in MODES:
        raise DatasetError(f"'{path.name}' gives the mode '{header.mode}'; write {' or '.join(MODES)}.")
    header.configuration = mounting_name(header.configuration)
    header.configuration = ALIASES.get(header.configuration, header.configuration)
    known = CONFIGURATIONS if header.mode == "motion" else (*CONFIGURATIONS, *CARRIED)
    if header.configuration not in known:
        raise DatasetError(
            f"'{path.name}' asks for the configuration '{header.configuration}'; calibrate handles {', '.join(known)}"
            f"{' in motion' if header.mode == 'motion' else ''}."
        )
    if not 0.0 < header.arm_error_mm <= LARGEST_ARM_MM:
        raise DatasetError(
            f"'{path.name}': arm_error_mm must be above 0 and at most {LARGEST_ARM_MM:g}, and it is"
            f" {header.arm_error_mm:g}."
        )
    _check_poses(header, path)
    _check_clouds(header, path)
    return _with_own_ring(header, path.parent)


def _with_own_ring(header: DatasetHeader, folder: Path) -> DatasetHeader:
    """Return the header with the ring of a part's file as its flange, where `flange` names such a file beside it.

    `feature_in_flange` then states the pose of the file's frame, and becomes that of the ring. Raises InputError.
    """
    if is_part_file(header.flange):
        from weldcal.models.tools.own_ring import own_ring  # reads parts: few datasets need it

        ring, given = own_ring(folder / header.flange), header.feature_in_flange
        X_FR = RigidTransform(unit_quaternion(given.wxyz, "feature_in_flange"), given.xyz) @ ring.X_SR
        quaternion = X_FR.rotation().ToQuaternion().wxyz()
        header.flange = ring.name
        header.feature_in_flange = Feature(X_FR.translation().tolist(), quaternion.tolist())
    return header


_PARTS = {
    "units": Units,
    "feature_in_flange": Feature,
    "scanner_guess": ScannerGuess,
    "poses": PoseForm,
    "second_robot": SecondRobot,
}
"""The keys of dataset.yaml that hold keys of their own."""


def _unread(name: str, given: object, problem: str) -> str:
    """Why a dataset.yaml cannot be read: the unknown key and the nearest known one, or the reader's words."""
    for part, kind in (("", DatasetHeader), *_PARTS.items()):
        keys = given.get(part) if part and isinstance(given, dict) else given
        known = {f.name for f in fields(kind)}
        if part and keys is not None and not isinstance(keys, dict):
            return f"'{name}' gives {part} as '{str(keys)[:40]}'; it holds the keys {', '.join(sorted(known))}."
        wrong = next((str(key) for key in keys if key not in known), None) if isinstance(keys, dict) else None
        if wrong is not None:
            near = get_close_matches(wrong, known, 1, 0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"use {', '.join(sorted(known))}."
            return f"'{name}' has no key '{f'{part}.' if part else ''}{wrong[:40]}'; {hint}"
    return f"'{name}' cannot be read as a dataset description: {problem}"


def cloud_form(header: DatasetHeader, folder: Path) -> CloudForm:
    """What dataset.yaml states of the clouds in the dataset's folder."""
    c = header.intrinsics
    return CloudForm(
        intrinsics=None if c is None else (c.fx, c.fy, c.cx, c.cy),
        depth_scale=header.depth_scale / UNITS.get(header.units.clouds, 1.0),
        viewpoint=header.viewpoint,
        folder=folder,
    )


def header_of(folder: Path) -> DatasetHeader | None:
    """Return what a folder's dataset.yaml states; None where there is none, or none that can be read."""
    path = Path(folder) / "dataset.yaml"
    try:
        return read_header(path) if path.is_file() else None
    except DatasetError:
        return None


def is_motion(folder: Path) -> bool:
    """Return whether a folder's dataset.yaml says `mode: motion`. False where it cannot be read."""
    header = header_of(folder)
    return header is not None and header.mode == "motion"


def is_carried(folder: Path) -> bool:
    """Return whether a folder's dataset.yaml is of scans at rest by a scanner that an arm carries.

    False where it cannot be read.
    """
    header = header_of(folder)
    return header is not None and header.mode != "motion" and header.configuration != CONFIGURATIONS[0]


def metric_cloud(path: Path, header: DatasetHeader, folder: Path) -> Array:
    """Points of one cloud in metres, (N, 3) or organised (H, W, 3). Raises CloudError with the reason."""
    points = read_cloud(path, cloud_form(header, folder))
    return to_metres(points, header.units.clouds, path.name)


def to_metres(points: Array, unit: str, name: str) -> Array:
    """The measured points, in place where none is left out, in metres; the unit is m, mm or auto (see cloud_unit).

    Raises CloudError.
    """
    points = measured(points, name)
    if unit == AUTO:
        unit = cloud_unit(points, name)
    points *= UNITS[unit]
    distance = _distance(points)
    if not REACH_M[0] <= distance <= REACH_M[1]:
        other = "mm" if unit == "m" else "m"
        raise CloudError(
            f"The points of {name} lie {distance:.3g} m from the camera, as {unit}: they look like {other}; correct "
            f"units in dataset.yaml to 'clouds: {other}'."
        )
    return points


def cloud_unit(points: Array, name: str) -> str:
    """The unit in which points (..., 3) lie 10 mm to 10 m from the camera (median): m, or mm.

    Raises CloudError: neither is.
    """
    distance = _distance(points)
    for unit, metres in UNITS.items():
        if REACH_M[0] <= metres * distance <= REACH_M[1]:
            return unit
    raise CloudError(
        f"The points of {name} lie {distance:.3g} from the camera: neither m nor mm puts them 10 mm to 10 m away."
        " Convert the file to metres."
    )


def _distance(points: Array) -> float:
    """Median distance of the measured points (..., 3) from the camera, of a sample."""
    finite = np.flatnonzero(np.isfinite(points[..., 2]))
    some = points.reshape(-1, points.shape[-1])[finite[:: 1 + len(finite) // _SAMPLE]]
    return float(np.median(np.linalg.norm(some, axis=1)))


def _check_clouds(header: DatasetHeader, path: Path) -> None:
    """The header's keys of depth images and VIEWPOINT."""
    if header.viewpoint not in ("", *VIEWPOINTS):
        raise DatasetError(
            f"'{path.name}' gives the viewpoint '{header.viewpoint[:40]}'; write {' or '.join(VIEWPOINTS)}."
        )
    if not 0.0 <= header.depth_scale <= 1.0:
        raise DatasetError(
            f"'{path.name}': depth_scale {header.depth_scale:g} must be the metres of one unit of a depth image, such"
            " as 0.001 for millimetres or 0.0002 for 5000 units a metre."
        )
    if (c := header.intrinsics) is not None:
        try:
            checked_intrinsics((c.fx, c.fy, c.cx, c.cy), path.name)
        except CloudError as e:
            raise DatasetError(e.reason) from None


def _check_poses(header: DatasetHeader, path: Path) -> None:
    """The lists of the header's poses: their lengths, finite numbers, metres, unit quaternions."""
    guess = header.scanner_guess
    second = ("second_robot", header.second_robot)
    for key, found in (("feature_in_flange", header.feature_in_flange), ("scanner_guess", guess), second):
        if found is None:
            continue
        for name, values, n in ((f"{key}.xyz", found.xyz, 3), (f"{key}.wxyz", found.wxyz, 4)):
            if len(values) != n:
                raise DatasetError(f"'{path.name}': {name} must hold {n} numbers, not {len(values)}.")
            if not np.isfinite(values).all():
                raise DatasetError(f"'{path.name}': {name} holds a number that is not finite.")
        if float(np.abs(found.xyz).max()) > REACH_M[1]:
            raise DatasetError(
                f"'{path.name}': {key}.xyz must be in metres; {REACH_M[1]:g} m or more is no place of a scanner."
            )
        unit_quaternion(found.wxyz, key)
    if guess is not None and not 0.0 < guess.radius_m <= REACH_M[1]:
        raise DatasetError(
            f"'{path.name}': scanner_guess.radius_m must be a positive number of metres up to {REACH_M[1]:g}, not"
            f" {guess.radius_m:g}."
        )


def table_rows(path: Path, required: tuple[str, ...]) -> list[dict[str, str]]:
    """Rows of a table with the column `id`, each id a plain name that occurs once. Raises DatasetError."""
    try:
        require_few_lines(path)
        names, rows = read_rows(path)
    except InputError as e:
        raise DatasetError(str(e)) from e
    missing = [c for c in required if c not in names]
    if missing:
        raise DatasetError(
            f"'{path.name}' lacks the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}; the header is "
            f"{','.join(required)}."
        )
    if not rows:
        raise DatasetError(f"'{path.name}' holds no poses below its header.")
    seen: set[str] = set()
    for row in rows:
        if not row["id"] or Path(row["id"]).name != row["id"]:
            raise DatasetError(f"'{path.name}' has a row whose id '{row['id'][:40]}' is empty or not a plain name.")
        if row["id"] in seen:
            raise DatasetError(f"'{path.name}' gives the id '{row['id']}' twice; keep one row for each scan.")
        seen.add(row["id"])
    return rows


def row_numbers(row: dict[str, str], columns: tuple[str, ...], path: Path) -> list[float]:
    """Finite numbers in these columns of one row. Raises DatasetError naming the cell."""
    out = []
    for c in columns:
        try:
            value = float(row[c])
        except ValueError:
            raise DatasetError(
                f"'{path.name}' has '{row[c][:40]}' in column {c} of '{row['id']}'; a number is needed."
            ) from None
        if not np.isfinite(value):
            raise DatasetError(
                f"'{path.name}' has {row[c]} in column {c} of '{row['id']}'; remove the row or give a finite number."
            )
        if abs(value) > LARGEST_NUMBER:
            raise DatasetError(f"'{path.name}' has {row[c]} in column {c} of '{row['id']}', beyond {LARGEST_NUMBER:g}.")
        out.append(value)
    return out


def row_angles(rows: list[Row], path: Path) -> Angles:
    """Joint angles q1 ... and second_q1 ... rad by id and name. Raises DatasetError for a cell that is no number."""
    names = [name for name in rows[0] if JOINT_NAME.fullmatch(name)]
    given = {row["id"]: tuple(name for name in names if row[name]) for row in rows}
    return {
        row["id"]: dict(zip(given[row["id"]], row_numbers(row, given[row["id"]], path), strict=True)) for row in rows
    }


def unit_quaternion(wxyz: list[float], where: str) -> RotationMatrix:
    """Return the rotation of a unit quaternion (4,), wxyz. Raises DatasetError naming ``where``."""
    norm = math.hypot(*wxyz)
    if not abs(norm - 1.0) < 1e-3:
        raise DatasetError(
            f"The quaternion of '{where}' has the length {norm:.4f}; a rotation needs length 1 (order qw, qx, qy, qz)."
        )
    return RotationMatrix(Quaternion(np.asarray(wxyz) / norm))


def check_reach(points: Array, path: Path, unit: str, of: str = "robot's base") -> None:
    """Raise DatasetError where the median of points (n, 3) m lies where no robot or scanner has any: another unit."""
    reach = float(np.median(np.linalg.norm(points, axis=1)))
    if reach > REACH_M[1] or reach < REACH_M[0]:
        other = "mm" if unit == "m" else "m"
        raise DatasetError(
            f"The positions in '{path.name}' lie {reach:.4g} m from the {of}, which is out of reach: they look "
            f"like {other}; correct units in dataset.yaml to '{'clouds' if of == 'camera' else 'poses'}: {other}'."
        )


def digest(path: Path) -> str:
    """SHA-256 of a file. Raises DatasetError."""
    try:
        return sha256(path)
    except InputError as e:
        raise DatasetError(str(e)) from e


class Recorded:
    """What a recording's header states of the calibration's poses."""

    header: DatasetHeader

    @property
    def X_FR(self) -> RigidTransform:
        """Pose of the calibration feature in the flange frame."""
        f = self.header.feature_in_flange
        return RigidTransform(unit_quaternion(f.wxyz, "feature_in_flange"), f.xyz)

    @property
    def X_BC_guess(self) -> RigidTransform | None:
        """The header's guess of the scanner's pose; None without one."""
        g = self.header.scanner_guess
        return None if g is None else RigidTransform(unit_quaternion(g.wxyz, "scanner_guess"), g.xyz)
