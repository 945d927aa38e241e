"""Tries how stated rotations can be misread where the centres fit by their positions alone: Euler orders, degrees, mirrored scans.

With the flange's centre at the origin of its frame, a wrong rotation moves no centre; it shows only between the faces' normals and
the poses' z axes. Then R_BC follows from the centres, and each misreading is judged by the normals.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.doctor.case import Case
from weldcal.calibration.doctor.fit import Fit, fit
from weldcal.calibration.geometry.se3 import pose
from weldcal.models.arrays import Array

_FIT_RAD = 0.02  # normals agree with a reading
_WRONG_RAD = 0.05  # normals disagree with the poses as they are
_SAME = 3.0  # a mirrored scan must bring the residuals down by this factor
_Order = Literal["xyz", "zyx", "XYZ", "ZYX", "zyz", "ZYZ", "yxz", "YXZ"]
_ORDERS: tuple[_Order, ...] = ("xyz", "zyx", "XYZ", "ZYX", "zyz", "ZYZ", "yxz", "YXZ")


@dataclass(frozen=True, eq=False)
class Misread:
    """A way of misreading rotations or scans: the cause, its words, the corrected case and its fit."""

    cause: str
    words: str
    case: Case
    fit: Fit


def misread_rotations(case: Case, null: Fit) -> Misread | None:
    """The misreading that explains why normals disagree with the poses while the centres agree; None where there is none."""
    seen = np.asarray(np.isfinite(case.m).all(axis=1))
    if seen.sum() < 5:
        return None
    by_centres = fit(case, normals=False)
    u = case.m[seen] @ by_centres.R[0].T
    if by_centres.rms > 3e-3 or _off(u, case.z[seen]) < _WRONG_RAD:
        return None
    best: tuple[float, str, Array] | None = None
    for words, R in _readings(case.X_BF[:, :3, :3]):
        off = _off(u, (R @ case.X_FR[:3, :3])[seen][:, :, 2])
        if off < _FIT_RAD and (best is None or off < best[0]):
            best = off, words, R
    if best is None:
        return None
    other = case.with_poses(pose(best[2], case.X_BF[:, :3, 3]))
    return Misread("wrong rotation convention", best[1], other, fit(other))


def _off(u: Array, z: Array) -> float:
    """Median angle (rad) between two lists of directions."""
    return float(np.median(np.arctan2(np.linalg.norm(np.cross(u, z), axis=1), (u * z).sum(axis=1))))


def _readings(R: Array) -> Iterator[tuple[str, Array]]:
    turn = Rotation.from_matrix(R)
    for read in _ORDERS:
        angles = turn.as_euler(read)
        for order in _ORDERS:
            if order != read:
                words = f"the rotations are Euler angles in the order {order}, and they were read in the order {read}"
                yield words, np.asarray(Rotation.from_euler(order, angles).as_matrix())
        yield (
            f"the rotations are rotation vectors, and they were read as Euler angles in the order {read}",
            np.asarray(Rotation.from_rotvec(angles).as_matrix()),
        )
        yield (
            f"the rotations are Euler angles in the order {read}, and they were read as rotation vectors",
            np.asarray(Rotation.from_euler(read, turn.as_rotvec()).as_matrix()),
        )
        yield (
            "the angles are radians, and they were read as degrees",
            np.asarray(Rotation.from_euler(read, np.degrees(angles)).as_matrix()),
        )
    yield (
        "the angles are radians, and they were read as degrees",
        np.asarray(Rotation.from_rotvec(np.degrees(turn.as_rotvec())).as_matrix()),
    )


def rotations_disagree(case: Case) -> dict[str, float] | None:
    """The figures where the centres agree and the normals do not: wrong rotations of an unknown kind; None where both agree."""
    seen = np.asarray(np.isfinite(case.m).all(axis=1))
    if seen.sum() < 5:
        return None
    by_centres = fit(case, normals=False)
    off = _off(case.m[seen] @ by_centres.R[0].T, case.z[seen])
    if by_centres.rms > 3e-3 or off < _WRONG_RAD:
        return None
    return {"centres_mm": 1e3 * by_centres.rms, "normals_deg": float(np.degrees(off))}


def mirrored(case: Case, null: Fit) -> Misread | None:
    """The case with the scanner's x axis turned round, where only that fits; one mirror stands for all, the others are turned ones."""
    flip = np.array([-1.0, 1.0, 1.0])
    other = replace(case, c=case.c * flip, m=case.m * flip)
    one = fit(other)
    if null.rms < _SAME * max(one.rms, 3e-4):
        return None
    return Misread(
        "scanner axes mirrored", "the scanner's frame is left-handed: one of its axes is mirrored", other, one
    )


def reordered(case: Case, null: Fit) -> Misread | None:
    """The case with scans and poses paired in another order: backwards, or as names sort as text ("10" before "2")."""
    n = case.n
    text = np.array(sorted(range(n), key=lambda k: str(k + 1)))
    back = np.argsort(text)
    for words, order in (
        ("the scans stand in the reverse order of the poses", np.arange(n)[::-1]),
        ("the scans are sorted as text (1, 10, 11, 2) and the poses by number", text),
        ("the poses are sorted as text (1, 10, 11, 2) and the scans by number", back),
    ):
        other = case.with_poses(case.X_BF[order])
        one = fit(other)
        if null.rms > _SAME * max(one.rms, 3e-4):
            return Misread("scans and poses in different orders", words, other, one)
    return None
