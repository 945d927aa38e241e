"""Finds positions and rotations among named columns, however robots, loggers and ROS spell them."""

import re

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.form import poses_from_array
from weldcal.calibration.data.poses.rotations import notation, rotations, width
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import pose
from weldcal.models.arrays import Array

_SPELLED = {
    **{axis: (axis, f"p{axis}", f"t{axis}", f"p_{axis}", f"t_{axis}", f"pos_{axis}", f"position_{axis}", f"translation_{axis}",
              f"trans_{axis}", f"position.{axis}", f"translation.{axis}", f"xyz.{k}", f"actual_tcp_pose_{k}")
       for k, axis in enumerate("xyz")},
    **{f"q{axis}": (f"q{axis}", f"q_{axis}", f"quat_{axis}", f"orientation_{axis}", f"rotation_{axis}", f"orientation.{axis}",
                    f"rotation.{axis}", f"quaternion.{axis}", f"quaternion_{axis}") for axis in "wxyz"},
    **{f"r{axis}": (f"r{axis}", f"r_{axis}", f"rvec_{axis}", f"rotvec_{axis}", f"rotation_vector_{axis}", f"rotation_vector.{axis}",
                    f"actual_tcp_pose_{k + 3}") for k, axis in enumerate("xyz")},
}  # fmt: skip
_KNOWN = {spelling: name for name, spellings in _SPELLED.items() for spelling in spellings}
_EULER = (
    (("roll", "pitch", "yaw"), "euler_xyz", ""),
    (("a", "b", "c"), "euler_ZYX", "deg"),  # KUKA
    (("w", "p", "r"), "euler_xyz", "deg"),  # Fanuc
)
_UNIT = re.compile(r"(.+?)[\s_]*[\[(]?\s*(mm|m|deg|rad)\s*[\])]?")
IDS = ("id", "name", "pose", "scan", "file", "filename", "image", "cloud", "label", "index", "nr", "no")
TIMES = ("time", "%time", "timestamp", "stamp", "t", "time_s", "header.stamp")


def plain_names(names: list[str]) -> tuple[list[str], dict[str, str]]:
    """Column names in this package's spelling (x, y, z, qw ..., rx ..., or as given), and the units that some of them state."""
    found, units = [], {}
    for given in names:
        name, unit = given.strip().lower(), ""
        stated = _UNIT.fullmatch(name)
        if _short(name) not in _KNOWN and stated and len(stated[1]) < len(name):
            name, unit = stated[1].strip(" _"), stated[2]
        name = _KNOWN.get(_short(name), name)
        if unit:
            units[name] = unit
        found.append(name)
    return found, units


def _short(name: str) -> str:
    return ".".join(name.split(".")[-2:])


def column_poses(names: list[str], table: Array, form: PoseForm, where: str) -> tuple[Array, str, str]:
    """Poses (n, 4, 4) in the table's unit, what they were read as, and the unit of length that its header states (or "").

    ``names`` are those of the columns of ``table`` (n, columns), NaN where a cell holds no number.

    Raises:
        DatasetError: no position, no rotation, or one whose convention is not said.
    """
    plain, units = plain_names(names)
    grid = {
        tuple(map(int, m.groups())): k for k, n in enumerate(plain) if (m := re.fullmatch(r"[a-z]*_?([0-4])([0-4])", n))
    }
    if len(grid) in (12, 16) and "qw" not in plain:
        chosen = table[:, [grid[key] for key in sorted(grid)]]
        return *poses_from_array(chosen, form, where), units.get("x", "")
    if not {"x", "y", "z"} <= set(plain):
        raise DatasetError(
            f"'{where}' names no columns x, y, z; a table of poses has id,x,y,z and qw,qx,qy,qz or rx,ry,rz, or 6, 7 or 16 numbers a row "
            "without a header."
        )
    name, angles, columns = _rotation(plain, units, form, where)
    cells = table[:, [plain.index(c) for c in ("x", "y", "z", *columns)]]
    if not np.isfinite(cells).all():
        row = int(np.flatnonzero(~np.isfinite(cells).all(axis=1))[0])
        raise DatasetError(f"Row {row + 1} of '{where}' has an empty cell, or one that is not a finite number.")
    unit = units.get("x", "")
    if len({units.get(axis, "") for axis in "xyz"}) > 1 or unit not in ("", "m", "mm"):
        raise DatasetError(f"The columns x, y and z of '{where}' state units that differ or are not m or mm.")
    said = "UR pose vectors (x, y, z, rotation vector)" if name == "rotation_vector" else f"x, y, z, {name}"
    return pose(rotations(cells[:, 3:], name, angles, where), cells[:, :3]), said, unit


def _rotation(plain: list[str], units: dict[str, str], form: PoseForm, where: str) -> tuple[str, str, tuple[str, ...]]:
    """Notation, unit of the angles and columns of the rotation."""
    wanted = notation(form.rotation, "dataset.yaml: poses.rotation")
    if {"qw", "qx", "qy", "qz"} <= set(plain):
        if wanted and not wanted.startswith("quaternion"):
            raise DatasetError(
                f"'{where}' holds quaternions (qw, qx, qy, qz), and poses.rotation says {wanted}; correct one."
            )
        return "quaternion_wxyz", "", ("qw", "qx", "qy", "qz")
    numbered = next((c for c in (("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4")) if set(c) <= set(plain)), None)
    if numbered is not None and not {"rx", "ry", "rz"} <= set(plain):
        if not wanted.startswith("quaternion"):
            raise DatasetError(
                f"The columns {', '.join(numbered)} of '{where}' do not say the order of the quaternion; set 'poses: {{rotation: "
                "quaternion_wxyz}' or quaternion_xyzw in dataset.yaml."
            )
        return wanted, "", numbered
    if {"rx", "ry", "rz"} <= set(plain):
        angles = form.angles or (units.get("rx", "") if units.get("rx") in ("deg", "rad") else "")
        if wanted and width(wanted) != 3:
            raise DatasetError(f"'{where}' has columns rx, ry, rz, and poses.rotation says {wanted}; correct one.")
        return wanted or "rotation_vector", angles, ("rx", "ry", "rz")
    for columns, known, angle in _EULER:
        if set(columns) <= set(plain):
            stated = units.get(columns[0], "")
            return wanted or known, form.angles or (stated if stated in ("deg", "rad") else angle), columns
    other = [c for c in plain if c not in ("x", "y", "z", *IDS, *TIMES)]
    if len(other) >= 3 and wanted and width(wanted) == 3:
        return wanted, form.angles, (other[0], other[1], other[2])
    raise DatasetError(
        f"'{where}' lacks columns of a rotation that it names: qw,qx,qy,qz, or rx,ry,rz, or roll,pitch,yaw; other Euler angles need their "
        "convention, 'poses: {rotation: euler_ZYX}' in dataset.yaml."
    )
