"""Tries the ways in which a list of poses is misread: the quaternion's order, the inverse, a mixed unit, scans against poses."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.doctor.case import Case
from weldcal.calibration.doctor.fit import Fit, fit
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arrays import Array

UNITS = (1e3, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1, 100.0, 0.01)
"""Millimetres, inches, decimetres and centimetres for metres, and the reverse."""
_WITHIN = 0.5  # of the logarithm of a unit's factor: a TCP or a quaternion's order changes spreads, too
_REACH_M = (0.02, 9.0)
FEWEST = 5
LOOKS_WRONG_M, LOOKS_WRONG_RAD = 3e-3, 0.03  # residuals of no arm and scanner that work
_LEAST_GAIN = 3.0  # a reading must bring the residuals down by this factor: nothing less is a misreading


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to read the poses: the cause's name, what it is in words, the case so read and its fit."""

    cause: str
    words: str
    case: Case
    fit: Fit


def _turned(case: Case, R: Array) -> Case:
    return case.with_poses(pose(R, case.X_BF[:, :3, 3]))


def _other_order(case: Case) -> Case:
    """The poses as if (x, y, z, w) had been taken for (w, x, y, z)."""
    wxyz = Rotation.from_matrix(case.X_BF[:, :3, :3]).as_quat(scalar_first=True)
    return _turned(case, np.asarray(Rotation.from_quat(wxyz, scalar_first=False).as_matrix()))


def _other_order_back(case: Case) -> Case:
    """The poses as if (w, x, y, z) had been taken for (x, y, z, w)."""
    xyzw = Rotation.from_matrix(case.X_BF[:, :3, :3]).as_quat(scalar_first=False)
    return _turned(case, np.asarray(Rotation.from_quat(xyzw, scalar_first=True).as_matrix()))


def _vector_as_euler(case: Case) -> Case:
    turn = Rotation.from_matrix(case.X_BF[:, :3, :3])
    return _turned(case, np.asarray(Rotation.from_euler("xyz", turn.as_rotvec()).as_matrix()))


def _euler_as_vector(case: Case) -> Case:
    turn = Rotation.from_matrix(case.X_BF[:, :3, :3])
    return _turned(case, np.asarray(Rotation.from_rotvec(turn.as_euler("xyz")).as_matrix()))


READINGS: dict[str, tuple[str, Callable[[Case], Case]]] = {
    "the quaternions' order is (x, y, z, w), and they were read as (w, x, y, z)": ("wrong quaternion order", _other_order),
    "the quaternions' order is (w, x, y, z), and they were read as (x, y, z, w)": ("wrong quaternion order", _other_order_back),
    "the poses are the base in the flange, the inverse of what is expected": ("poses inverted", lambda c: c.with_poses(inverse(c.X_BF))),
    "the rotations are transposed": ("poses inverted", lambda c: _turned(c, np.swapaxes(c.X_BF[:, :3, :3], 1, 2))),
    "the rotations are roll, pitch and yaw, and they were read as rotation vectors": ("wrong rotation convention", _vector_as_euler),
    "the rotations are rotation vectors, and they were read as roll, pitch and yaw": ("wrong rotation convention", _euler_as_vector),
}  # fmt: skip


def looks_wrong(one: Fit) -> bool:
    """Whether residuals are larger than those of any arm and scanner that works, in the centres or in the normals."""
    tilted = bool(np.isfinite(one.tilt).any()) and float(np.nanmedian(one.tilt)) > LOOKS_WRONG_RAD
    return one.rms > LOOKS_WRONG_M or tilted


def best_reading(case: Case, null: Fit) -> Reading | None:
    """The misreading whose correction lowers the criterion most, if what remains looks like a working cell's; else None."""
    found: list[Reading] = []
    for words, (cause, change) in READINGS.items():
        other = change(case)
        found.append(Reading(cause, words, other, fit(other)))
    for shift in (1, -1):
        if case.n > 6:
            inside = case.pick(np.arange(1, case.n) if shift == 1 else np.arange(case.n - 1))
            X = case.X_BF[:-1] if shift == 1 else case.X_BF[1:]
            moved = inside.with_poses(X)
            words = f"each scan belongs to the pose {'before' if shift == 1 else 'after'} its own"
            one = fit(moved)
            # one scan fewer: compared on the same scans
            if fit(inside).bic - one.bic > 0.0:
                found.append(Reading("scans and poses shifted by one", words, moved, one))
    found = [r for r in found if not looks_wrong(r.fit)]
    found.sort(key=lambda r: r.fit.bic / r.case.n)
    best = found[0] if found else None
    if best is None or best.fit.bic / best.case.n >= null.bic / case.n:
        return None
    tilts = [float(np.nanmedian(f.tilt)) if np.isfinite(f.tilt).any() else 0.0 for f in (null, best.fit)]
    better = null.rms > _LEAST_GAIN * max(best.fit.rms, 2e-4) or tilts[0] > _LEAST_GAIN * max(tilts[1], 0.02)
    return best if better else None


def mixed_units(case: Case) -> tuple[Case, float, tuple[str, ...]] | None:
    """The case in one unit, the factor and the scans that were in another one; None where all are in one.

    Distances of poses from the base, or of scans from the camera, in two groups that a unit's factor separates: those within the reach of
    an arm are in metres. Else one factor between the spreads of both sides.
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


def _scaled(case: Case, what: str, factor: Array) -> Case:
    if what == "scans":
        return replace(case, c=case.c * factor[:, None])
    X = case.X_BF.copy()
    X[:, :3, 3] *= factor[:, None]
    return case.with_poses(X)
