"""A list of poses as a file gives it, and how its numbers are to be read."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.rotations import notation, rotations
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import nearest_rotation, pose
from weldcal.models.arrays import Array
from weldcal.models.files import LARGEST_NUMBER

_RIGID = 2e-3  # of a rotation's columns from orthonormal: three printed decimals


@dataclass(frozen=True, eq=False)
class PoseList:
    """Poses (n, 4, 4) with positions in the file's own unit; ``ids`` (n) or empty where the file names none, ``times`` (n) s where it
    has some, ``unit`` where its form fixes it (m or mm), ``read_as`` a phrase for the user."""

    source: str
    X: Array
    ids: tuple[str, ...] = ()
    times: Array | None = None
    unit: str = ""
    read_as: str = ""


def poses_from_array(values: Array, form: PoseForm, where: str) -> tuple[Array, str]:
    """Poses (n, 4, 4) of an array of a usual shape, and what it was read as.

    Shapes: (4, 4), (3, 4), (n, 4, 4), (n, 3, 4), (4 n, 4), (n, 16), (n, 12) row by row, (n, 6) x,y,z and three numbers of a rotation (by
    ``form.rotation``, else a rotation vector as a UR shows it), (n, 7) x,y,z and a quaternion (its order must be said).

    Raises:
        DatasetError: another shape, numbers that are not finite, or no rigid poses.
    """
    v = np.asarray(values, dtype=float)
    if v.size == 0:
        raise DatasetError(f"'{where}' holds no poses.")
    if not np.isfinite(v).all():
        raise DatasetError(f"'{where}' holds a number that is missing or not finite.")
    if float(np.abs(v).max()) > LARGEST_NUMBER:
        raise DatasetError(f"'{where}' holds numbers beyond {LARGEST_NUMBER:g}.")
    if v.ndim == 1 or (v.ndim == 2 and v.shape[1] == 1 and v.shape[0] in (6, 7, 12, 16)):
        v = v.reshape(1, -1)
    if v.ndim == 3 and v.shape[1] == 1:
        v = v[:, 0, :]
    if v.ndim == 2 and v.shape in ((4, 4), (3, 4)):
        v = v[None]
    elif v.ndim == 2 and v.shape[1] == 4 and len(v) % 4 == 0:
        v = v.reshape(-1, 4, 4)
    elif v.ndim == 2 and v.shape[1] in (12, 16):
        v = v.reshape(len(v), -1, 4)
    if v.ndim == 3 and v.shape[1:] in ((4, 4), (3, 4)):
        return matrices(v, where), "4 x 4 matrices"
    name = notation(form.rotation, "dataset.yaml: poses.rotation")
    if v.ndim == 2 and v.shape[1] == 6:
        name = name or "rotation_vector"
        if name.startswith("quaternion"):
            raise DatasetError(f"'{where}' has 6 numbers a pose, and poses.rotation says {name}, which needs 7.")
        said = "UR pose vectors (x, y, z, rotation vector)" if name == "rotation_vector" else f"x, y, z, {name}"
        return pose(rotations(v[:, 3:], name, form.angles, where), v[:, :3]), said
    if v.ndim == 2 and v.shape[1] == 7:
        if not name.startswith("quaternion"):
            raise DatasetError(
                f"'{where}' has 7 numbers a pose and no header: the order of the quaternion is not said; set "
                "'poses: {rotation: quaternion_wxyz}' or quaternion_xyzw in dataset.yaml."
            )
        return pose(rotations(v[:, 3:], name, form.angles, where), v[:, :3]), f"x, y, z, {name}"
    shape = " x ".join(map(str, v.shape))
    raise DatasetError(
        f"'{where}' holds {shape} numbers, which is no list of poses: 6 (x,y,z,rx,ry,rz), 7 (x,y,z and a quaternion) or 16 "
        "(a 4 x 4 matrix) a pose."
    )


def matrices(v: Array, where: str) -> Array:
    """Rigid poses (n, 4, 4) of matrices (n, 4, 4) or (n, 3, 4). Raises DatasetError."""
    if v.shape[1] == 4 and not (np.abs(v[:, 3] - [0.0, 0.0, 0.0, 1.0]) <= 1e-6).all():
        if (np.abs(v[:, :, 3] - [0.0, 0.0, 0.0, 1.0]) <= 1e-6).all():
            raise DatasetError(
                f"The matrices of '{where}' hold the position in their last row: they are written column by column; transpose them."
            )
        raise DatasetError(f"The last row of a matrix of '{where}' is not 0, 0, 0, 1; give rigid poses, row by row.")
    R = v[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    if off.max() > _RIGID or (np.linalg.det(R) < 0.0).any():
        bad = int(np.argmax(np.where(np.linalg.det(R) < 0.0, np.inf, off)))
        raise DatasetError(
            f"Matrix {bad + 1} of '{where}' is no rigid pose: its 3 x 3 part is not a rotation (columns of length 1, at right "
            "angles, right-handed)."
        )
    return pose(R if off.max() < 1e-12 else nearest_rotation(R), v[:, :3, 3])
