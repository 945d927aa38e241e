"""Enumerate the plausible readings of a list of poses.

Notation of the rotation, unit and order of its numbers, transposition.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import inverse, nearest_rotation, pose
from weldcal.models.arrays import Array

_ALIASES = {
    "roll_pitch_yaw": "euler_xyz",
    "rpy": "euler_xyz",
    "fanuc_wpr": "euler_xyz",
    "kuka_abc": "euler_ZYX",
    "ur": "rotation_vector",
    "axis_angle": "rotation_vector",
    "quaternion_ros": "quaternion_xyzw",
}
_NOTATIONS = (
    "rotation_vector, quaternion_wxyz, quaternion_xyzw, euler_xyz (fixed axes, lower case), euler_ZYX (moving axes,"
    " upper case), kuka_abc or fanuc_wpr"
)
CHANGES = ("transposed", "left_handed", "inverse")
"""What a form may add to a notation: rotations transposed, a left-handed frame (y mirrored), poses inverted."""
_TURN_RAD = 7.0  # a whole turn and a little: larger numbers are degrees
_LEAST_DEG = 0.02  # rad: angles that are all below it move too little to be radians or degrees for sure
_LEAST_ANGLE = 0.1  # largest angle of a motion that is worth a calibration, rad: as degrees it would be none
_QUATERNION = 0.05  # deviation of a quaternion's length from 1 that few printed digits explain
# Deviation of a rotation's columns from orthonormal that two printed decimals explain (0.01 sqrt 3, and a margin)
_ORTHOGONAL = 0.05
_MIRROR = np.diag([1.0, -1.0, 1.0])
_CARDAN = tuple("".join(axes) for axes in permutations("xyz"))
_EULER = ("xyx", "xzx", "yxy", "yzy", "zxz", "zyz")


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseNumbers:
    """A list of poses as a file gives it, before a convention is chosen.

    Attributes:
        source: the file's name.
        p: positions (n, 3) in the file's unit.
        r: numbers of the rotations: (n, 3) three angles or a vector, (n, 4) a quaternion, (n, 3, 3) matrices.
        rotation: the notation that the file or the user states; empty where nobody does.
        angles: the stated unit of the angles, deg or rad; empty where nobody states it.
        changes: stated changes, some of CHANGES.
        usual: the notation that comes first where none is stated; a rotation vector where it is empty.
        vector: whether three numbers may be a rotation vector (roll, pitch and yaw are none).
        firm: whether another notation than the usual one is tried only where that contradicts the data.
    """

    source: str
    p: Array
    r: Array
    rotation: str = ""
    angles: str = ""
    changes: tuple[str, ...] = ()
    usual: str = ""
    vector: bool = True
    firm: bool = False

    @property
    def kind(self) -> str:
        """The kind of rotation: vector, quaternion or matrix."""
        return "matrix" if self.r.ndim == 3 else {3: "vector", 4: "quaternion"}[self.r.shape[1]]


@dataclass(frozen=True, eq=False)
class PoseReading:
    """One reading of a list of poses.

    Attributes:
        form: what selects it, such as ``euler_xyz,deg`` or ``matrix,transposed``.
        words: the same for a reader.
        X: the poses (n, 4, 4), positions in the file's unit.
        doubted: whether the data must first contradict the list's usual reading.
    """

    form: str
    words: str
    X: Array
    doubted: bool = False

    def changed(self, change: str) -> "PoseReading":
        """Return the reading with one of CHANGES applied; one that was applied last is taken back."""
        words = {
            "transposed": "rotations transposed",
            "left_handed": "in a left-handed frame (y mirrored)",
            "inverse": "inverted",
        }[change]
        X, last = apply_change(self.X, change), f",{change}"
        if self.form.endswith(last):
            return replace(self, form=self.form.removesuffix(last), words=self.words.removesuffix(f", {words}"), X=X)
        return replace(self, form=self.form + last, words=f"{self.words}, {words}", X=X)


def pick(listed: Sequence[PoseReading], rows: NDArray[np.integer[Any]]) -> list[PoseReading]:
    """Return the readings of some rows."""
    return [replace(one, X=one.X[rows]) for one in listed]


def change_of(one: PoseReading, listed: Sequence[PoseReading]) -> str | None:
    """Return the change by which a reading differs from those that are stated; None: it is one of them."""
    if any(one.form == other.form for other in listed):
        return None
    return next(by for by in CHANGES if any(other.changed(by).form == one.form for other in listed))


def apply_change(X: Array, change: str) -> Array:
    """Poses (n, 4, 4) with one of CHANGES applied."""
    if change == "inverse":
        return inverse(X)
    R, p = X[:, :3, :3], X[:, :3, 3]
    if change == "transposed":
        return pose(np.swapaxes(R, 1, 2), p)
    if change == "left_handed":
        return pose(_MIRROR @ R @ _MIRROR, p @ _MIRROR)
    raise DatasetError(f"There is no change '{change}' of poses; use {', '.join(CHANGES)}.")


def readings(numbers: PoseNumbers) -> list[PoseReading]:
    """List the readings of a list that its numbers and statements allow, the usual one first.

    There are no changes beyond the stated ones.

    Raises:
        DatasetError: no reading is possible, or a stated one contradicts the numbers.
    """
    found = []
    for form, words, R in _rotations(numbers):
        doubted = numbers.firm and not numbers.rotation and not form.startswith(numbers.usual)
        one = PoseReading(form, words, pose(R, numbers.p), doubted)
        for change in numbers.changes:
            one = one.changed(change)
        found.append(one)
    if numbers.usual:
        found.sort(key=lambda one: not one.form.startswith(numbers.usual))
    if not found:
        raise DatasetError(
            f"'{numbers.source}' has {numbers.kind} rotations, and the form states '{numbers.rotation}'; correct it."
        )
    return found


def parse_form(text: str, option: str) -> tuple[str, str, tuple[str, ...]]:
    """Notation, angle unit and changes of a form such as ``euler_xyz,deg`` or ``quaternion_wxyz,inverse``.

    Raises:
        DatasetError: a word that is none of them, with those known.
    """
    rotation, angles, changes = "", "", []
    for word in (w.strip() for w in text.split(",")):
        if word in ("deg", "rad"):
            angles = word
        elif word in CHANGES:
            changes.append(word)
        elif word in ("matrix", "fixed_axes_" + word[-3:]):
            rotation = word
        elif word:
            rotation = notation(word, option)
    return rotation, angles, tuple(changes)


def _rotations(numbers: PoseNumbers) -> Iterator[tuple[str, str, Array]]:
    stated = numbers.rotation
    match numbers.kind:
        case "matrix":
            if stated not in ("", "matrix"):
                return
            yield "matrix", "matrices", _matrices(numbers)
        case "quaternion":
            if stated and not stated.startswith("quaternion"):
                return
            orders = (stated,) if stated else ("quaternion_xyzw", "quaternion_wxyz")
            length = np.linalg.norm(numbers.r, axis=1)
            if not (np.abs(length - 1.0) <= _QUATERNION).all():
                worst = float(length[np.argmax(np.abs(length - 1.0))])
                raise DatasetError(f"A quaternion of '{numbers.source}' has the length {worst:.3f}, not 1.")
            for order in orders:
                words = f"quaternions {', '.join(order[-4:])}"
                first = order.endswith("wxyz")
                yield order, words, np.asarray(Rotation.from_quat(numbers.r, scalar_first=first).as_matrix())
        case _:
            yield from _vectors(numbers)


def _matrices(numbers: PoseNumbers) -> Array:
    R = numbers.r
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    mirrored = np.linalg.det(R) < 0.0
    if off.max() > _ORTHOGONAL or mirrored.any():
        bad = int(np.argmax(np.where(mirrored, np.inf, off)))
        why = (
            "is mirrored (its determinant is -1)"
            if mirrored[bad]
            else "is no rotation (its columns must have length 1)"
        )
        raise DatasetError(f"The 3 x 3 part of matrix {bad + 1} of '{numbers.source}' {why}.")
    return R if off.max() < 1e-12 else nearest_rotation(R)


def _vectors(numbers: PoseNumbers) -> Iterator[tuple[str, str, Array]]:
    largest = float(np.abs(numbers.r).max(initial=0.0))
    if numbers.angles == "rad" and largest > _TURN_RAD:
        raise DatasetError(
            f"The angles of '{numbers.source}' reach {largest:.0f}, more than a turn in rad: they seem to be degrees."
            " State them by 'poses: {angles: deg}' in dataset.yaml, or by --as robot-form=deg or --as camera-form=deg."
        )
    if numbers.angles == "deg" and len(numbers.r) > 2 and _LEAST_ANGLE < largest <= np.pi + 1e-3:
        raise DatasetError(
            f"No angle of '{numbers.source}' exceeds {largest:.2f}, as degrees: they look like radians. State rad"
            " by 'poses: {angles: rad}' in dataset.yaml, or by --as robot-form=rad or --as camera-form=rad."
        )
    units = [numbers.angles] if numbers.angles else ["deg"] if largest > _TURN_RAD else ["rad", "deg"]
    if not numbers.angles and largest <= _LEAST_DEG:
        units = ["rad"]
    stated = numbers.rotation
    for unit in units:
        v = np.radians(numbers.r) if unit == "deg" else numbers.r
        words = "degrees" if unit == "deg" else "radians"
        if stated == "rotation_vector" or (not stated and numbers.vector):
            yield (
                f"rotation_vector,{unit}",
                f"rotation vectors in {words}",
                np.asarray(Rotation.from_rotvec(v).as_matrix()),
            )
        for form, name, axes, columns in _ANGLES:
            if not stated or stated == form:
                R = np.asarray(Rotation.from_euler(axes, v[:, columns]).as_matrix())
                yield f"{form},{unit}", f"{name} in {words}", R


def _angle_readings() -> tuple[tuple[str, str, str, list[int]], ...]:
    """Form, words, axes for SciPy and columns of every convention of three angles; the usual ones first.

    Fixed axes in the columns' order, moving axes in the columns' order, and named axes (the columns are x, y, z) turned
    in any other order.
    """
    found = []
    for axes in (*_CARDAN, *_EULER):
        spelled = ", ".join(axes)
        found.append((f"euler_{axes}", f"fixed angles {spelled}", axes, [0, 1, 2]))
        found.append((f"euler_{axes.upper()}", f"moving angles {spelled.upper()}", axes.upper(), [0, 1, 2]))
    for axes in _CARDAN:
        if axes not in ("xyz", "zyx"):  # the same as fixed xyz and moving XYZ
            columns = ["xyz".index(a) for a in axes]
            found.append((f"fixed_axes_{axes}", f"turns about x, y, z in the order {', '.join(axes)}", axes, columns))
    return tuple(found)


_ANGLES = _angle_readings()


def notation(word: str, where: str) -> str:
    """Return a notation by its name; empty stays empty. Raises DatasetError naming those known."""
    name = _ALIASES.get(word.strip().lower(), word.strip())
    if name in ("", "rotation_vector", "quaternion_wxyz", "quaternion_xyzw"):
        return name
    axes = name.removeprefix("euler_")
    if axes != name and re.fullmatch("[xyz]{3}|[XYZ]{3}", axes) and axes[0] != axes[1] != axes[2]:
        return name
    raise DatasetError(f"'{where}' names the rotation '{word[:40]}'; use {_NOTATIONS}.")
