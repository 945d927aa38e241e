"""Tries the ways in which poses and scans are misread: rotations, the inverse, a mirrored scanner, the order of rows,
units."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.doctor.case import DoctorCase
from weldcal.calibration.doctor.fit import CauseFit, fit
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arrays import Array

UNITS = (1e3, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1, 100.0, 0.01)
"""Millimetres, inches, decimetres and centimetres for metres, and the reverse."""
_WITHIN = 0.5  # of the logarithm of a unit's factor: a TCP or a quaternion's order changes spreads, too
_REACH_M = (0.02, 9.0)
FEWEST = 5
LOOKS_WRONG_M, LOOKS_WRONG_RAD = 3e-3, 0.03  # residuals of no arm and scanner that work
_Order = Literal["xyz", "zyx", "XYZ", "ZYX", "zyz", "ZYZ", "yxz", "YXZ"]
_ORDERS: tuple[_Order, ...] = ("xyz", "zyx", "XYZ", "ZYX", "zyz", "ZYZ", "yxz", "YXZ")
_LEAST_GAIN = 3.0  # a reading must bring the residuals down by this factor: nothing less is a misreading


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to read the poses: the cause's name, what it is in words, the case so read and its fit."""

    cause: str
    words: str
    case: DoctorCase
    fit: CauseFit


def _rotations(R: Array) -> Iterator[tuple[str, str, Array]]:
    """Other rotations (n, 3, 3) that the same numbers may mean: cause, words, rotations."""
    turn = Rotation.from_matrix(R)
    yield "poses inverted", "the rotations are transposed", np.swapaxes(R, 1, 2)
    for first, order, other in ((True, "x, y, z, w", "w, x, y, z"), (False, "w, x, y, z", "x, y, z, w")):
        q = Rotation.from_quat(turn.as_quat(scalar_first=first), scalar_first=not first)
        words = f"the quaternions' order is ({order}), and they were read as ({other})"
        yield "wrong quaternion order", words, np.asarray(q.as_matrix())
    vector = turn.as_rotvec()
    found = [("angles are radians, and they were read as degrees", Rotation.from_rotvec(np.degrees(vector)))]
    for read in _ORDERS:
        angles = turn.as_euler(read)
        name = f"Euler angles in the order {read}"
        found += [
            (
                f"rotations are Euler angles in the order {order}, and they were read in the order {read}",
                Rotation.from_euler(order, angles),
            )
            for order in _ORDERS
            if order != read
        ]
        found += [
            (f"rotations are rotation vectors, and they were read as {name}", Rotation.from_rotvec(angles)),
            (f"rotations are {name}, and they were read as rotation vectors", Rotation.from_euler(read, vector)),
            ("angles are radians, and they were read as degrees", Rotation.from_euler(read, np.degrees(angles))),
        ]
    for words, other_turn in found:
        yield "wrong rotation convention", f"the {words}", np.asarray(other_turn.as_matrix())


def _misreadings(case: DoctorCase) -> Iterator[tuple[str, str, DoctorCase, DoctorCase]]:
    """Cause, words, the scans as given, and the same scans in another reading."""
    for cause, words, R in _rotations(case.X_BF[:, :3, :3]):
        yield cause, words, case, case.with_poses(pose(R, case.X_BF[:, :3, 3]))
    words = "the poses are the base in the flange, the inverse of what is expected"
    yield "poses inverted", words, case, case.with_poses(inverse(case.X_BF))
    flip = np.array([-1.0, 1.0, 1.0])  # one mirror stands for all: the others are turned ones
    words = "the scanner's frame is left-handed: one of its axes is mirrored"
    yield "scanner axes mirrored", words, case, replace(case, c=case.c * flip, m=case.m * flip)
    text = np.array(sorted(range(case.n), key=lambda k: str(k + 1)))
    for words, order in (
        ("the scans stand in the reverse order of the poses", np.arange(case.n)[::-1]),
        ("the scans are sorted as text (1, 10, 11, 2) and the poses by number", text),
        ("the poses are sorted as text (1, 10, 11, 2) and the scans by number", np.argsort(text)),
    ):
        yield "scans and poses in different orders", words, case, case.with_poses(case.X_BF[order])
    if case.n > 6:
        for shift, words in ((1, "before"), (-1, "after")):
            rows = np.arange(max(shift, 0), case.n + min(shift, 0))
            inside = case.pick(rows)
            words = f"each scan belongs to the pose {words} its own"
            yield "scans and poses shifted by one", words, inside, inside.with_poses(case.X_BF[rows - shift])


def looks_wrong(one: CauseFit) -> bool:
    """Whether residuals are larger than those of any arm and scanner that works, in the centres or in the normals."""
    tilted = bool(np.isfinite(one.tilt).any()) and float(np.nanmedian(one.tilt)) > LOOKS_WRONG_RAD
    return one.rms > LOOKS_WRONG_M or tilted


def best_reading(case: DoctorCase, null: CauseFit) -> Reading | None:
    """The misreading whose correction lowers the criterion most, if what remains looks like a working cell's; else
    None."""
    found: list[Reading] = []
    for cause, words, given, other in _misreadings(case):
        one = fit(other)
        # with a scan fewer it is compared on the same scans
        if given is case or fit(given).bic > one.bic:
            found.append(Reading(cause, words, other, one))
    found = [r for r in found if not looks_wrong(r.fit)]
    found.sort(key=lambda r: r.fit.bic / r.case.n)
    best = found[0] if found else None
    if best is None or best.fit.bic / best.case.n >= null.bic / case.n:
        return None
    tilts = [float(np.nanmedian(f.tilt)) if np.isfinite(f.tilt).any() else 0.0 for f in (null, best.fit)]
    better = null.rms > _LEAST_GAIN * max(best.fit.rms, 2e-4) or tilts[0] > _LEAST_GAIN * max(tilts[1], 0.02)
    return best if better else None


def mixed_units(case: DoctorCase) -> tuple[DoctorCase, float, tuple[str, ...]] | None:
    """The case in one unit, the factor and the scans that were in another one; None where all are in one.

    Distances of poses from the base, or of scans from the camera, in two groups that a unit's factor separates: those
    within the reach of an arm are in metres. Else one factor between the spreads of both sides.
    """
    for name, points in (("poses", case.X_BF[:, :3, 3]), ("scans", case.c)):
        size = np.linalg.norm(points, axis=1)
        near = (size > _REACH_M[0]) & (size < _REACH_M[1])
        for unit in (1e3, 1e-3):
            off = ~near & (size / unit > _REACH_M[0]) & (size / unit < _REACH_M[1])
            if off.any() and (near | off).all():
                return _scaled(case, name, np.where(off, 1.0 / unit, 1.0)), unit, tuple(np.array(case.ids)[off])
    if case.n >= FEWEST:
        spreads = [float(np.sqrt(((v - v.mean(axis=0)) ** 2).sum(axis=1).mean())) for v in (case.b, case.c)]
        ratio = spreads[0] / max(spreads[1], 1e-12)
        for unit in UNITS:
            if abs(np.log(ratio / unit)) < _WITHIN:
                other = _scaled(case, "poses", np.full(case.n, 1.0 / unit))
                if fit(other).rms < 0.05 * spreads[1]:
                    return other, unit, case.ids
    return None


def _scaled(case: DoctorCase, what: str, factor: Array) -> DoctorCase:
    if what == "scans":
        return replace(case, c=case.c * factor[:, None])
    X = case.X_BF.copy()
    X[:, :3, 3] *= factor[:, None]
    return case.with_poses(X)
