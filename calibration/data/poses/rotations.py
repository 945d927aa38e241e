"""Makes rotation matrices from rotation vectors, quaternions and Euler angles of a named convention."""

import re

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array

ALIASES = {
    "roll_pitch_yaw": "euler_xyz", "rpy": "euler_xyz", "fanuc_wpr": "euler_xyz", "kuka_abc": "euler_ZYX",
    "ur": "rotation_vector", "axis_angle": "rotation_vector", "quaternion_ros": "quaternion_xyzw",
}  # fmt: skip
NOTATIONS = (
    "rotation_vector, quaternion_wxyz, quaternion_xyzw, euler_xyz (fixed axes, lower case), euler_ZYX (moving axes, upper case), "
    "kuka_abc or fanuc_wpr"
)
_TURN = 7.0  # rad: a whole turn and a little
_LENGTH = 1e-2  # of a quaternion from 1


def notation(word: str, where: str) -> str:
    """A notation by its name; empty stays empty. Raises DatasetError naming those known."""
    name = ALIASES.get(word.strip().lower(), word.strip())
    if name in ("", "rotation_vector", "quaternion_wxyz", "quaternion_xyzw"):
        return name
    axes = name.removeprefix("euler_")
    if axes != name and re.fullmatch("[xyz]{3}|[XYZ]{3}", axes) and axes[0] != axes[1] != axes[2]:
        return name
    raise DatasetError(f"'{where}' names the rotation '{word[:40]}'; use {NOTATIONS}.")


def width(name: str) -> int:
    """How many numbers a rotation has in a notation."""
    return 4 if name.startswith("quaternion") else 3


def rotations(values: Array, name: str, angles: str, where: str) -> Array:
    """Rotations (n, 3, 3) of numbers (n, 3 or 4) in a notation; ``angles`` is rad, deg or empty (rad, checked).

    Raises:
        DatasetError: the numbers are no such rotations; the sentence says what to set.
    """
    if angles not in ("", "rad", "deg"):
        raise DatasetError(f"'{where}' gives angles in '{angles[:20]}'; write rad or deg.")
    if name.startswith("quaternion"):
        length = np.linalg.norm(values, axis=1)
        if not (np.abs(length - 1.0) <= _LENGTH).all():
            worst = float(length[np.argmax(np.abs(length - 1.0))])
            raise DatasetError(f"A quaternion of '{where}' has the length {worst:.3f}, not 1.")
        return np.asarray(Rotation.from_quat(values, scalar_first=name.endswith("wxyz")).as_matrix())
    largest = float(np.abs(values).max(initial=0.0))
    if angles != "deg" and largest > _TURN:
        raise DatasetError(
            f"The angles of '{where}' reach {largest:.0f}, more than a whole turn in radians: they look like degrees; set "
            "'poses: {angles: deg}' in dataset.yaml."
        )
    if angles == "deg" and len(values) > 2 and 0.1 < largest <= np.pi + 1e-3:
        raise DatasetError(
            f"No angle of '{where}' exceeds {largest:.2f}, as degrees: they look like radians; set 'poses: {{angles: rad}}' in dataset.yaml."
        )
    turn = np.radians(values) if angles == "deg" else values
    if name == "rotation_vector":
        return np.asarray(Rotation.from_rotvec(turn).as_matrix())
    return np.asarray(Rotation.from_euler(name.removeprefix("euler_"), turn).as_matrix())
