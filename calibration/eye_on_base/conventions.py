"""Decide how the poses of a set of flange scans are to be read: centres and normals must agree for one X_BC."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.data.poses.readings import CHANGES, PoseReading
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import nearest_rotation
from weldcal.models.arrays import Array

CHANCE = 1e-6
"""Chance that the right reading is rejected in favour of a wrong one."""
FEWEST = 5
_KEPT = 0.7  # share of the scans that must agree: the others may be outliers
_OUTLYING = 4.0  # medians of the scans' residuals: without one beyond, all of them count
_LEVER_M = 0.1  # weight of a normal against a centre: an error of 0.1 rad counts as 10 mm
_NORMAL_FLOOR, _CENTRE_FLOOR_M = 2e-5, 2e-6  # printed digits
_AGREE_RAD, _AGREE_SHARE = (
    0.06,
    0.1,
)  # residuals of normals, and of centres against their spread, of a reading that is right
_SAME_M, _SAME_RAD = 1e-3, 2e-3  # results that are the same
_STEPS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanAgreement:
    """How well the scans agree with a reading: rms angle of the normals (rad) and distance of the centres (m) of so many scans that are no
    outliers, the spread of the centres (m), R_BC and p_BC, and whether a list is changed beyond what is stated."""

    reading: PoseReading
    scans: int
    normal: float
    centre: float
    spread: float
    R: Array
    p: Array
    changed: bool

    @property
    def agrees(self) -> bool:
        """Whether the residuals are those of a working cell."""
        return self.normal < _AGREE_RAD and self.centre < _AGREE_SHARE * self.spread


def choose_reading(
    readings: Sequence[PoseReading], rows: Array, p_CR: Array, n_C: Array, X_FR: Array
) -> tuple[PoseReading | None, str]:
    """The reading of the flange poses with which the scans agree, and a sentence about it; None where the usual one stands.

    Centres of the feature in the base do not depend on the notation of rotations, its normals do. For each reading the rigid X_BC that
    fits centres and normals best leaves residuals of normals with at least 2 m - 3 degrees of freedom, m of the n scans being no outliers,
    and more of centres; a reading whose residuals exceed those of the best by more than the quantile of F(2 m - 3, 2 m - 3) for CHANCE is
    rejected.

    Args:
        readings: poses X_BF (N, 4, 4) in metres, the usual reading first.
        rows: the poses (n) of the scans that show the flange.
        p_CR, n_C: centres (n, 3) m and normals (n, 3) of the feature in the camera.
        X_FR: pose (4, 4) of the feature in the flange.

    Raises:
        InconsistentPoses: several readings agree and their results differ.
    """
    n = len(rows)
    if n < FEWEST:
        return None, ""
    tried = [_fit(one, rows, p_CR, n_C, X_FR, False) for one in readings]
    changes = [
        _fit(one.changed(change), rows, p_CR, n_C, X_FR, True)
        for one in readings
        for change in CHANGES
        if change != "left_handed"
    ]
    best = min(tried + changes, key=_cost)
    dof = max(2 * best.scans - 3, 3)
    limit = float(np.sqrt(f_quantile(1.0 - CHANCE / (2.0 * len(tried + changes)), dof, dof)))
    if best.changed:
        plain = min(tried, key=_cost)
        if plain.agrees and not _rejected(plain, best, limit):
            best = plain
    if not best.agrees:
        return None, ""
    pool = tried + changes if best.changed else tried
    alive = [one for one in pool if one is not best and one.agrees and not _rejected(one, best, limit)]
    rivals = [one for one in alive if not _same(one, best)]
    if rivals and best.reading.form != readings[0].form:
        usual = next((one for one in alive if one.reading.form == readings[0].form), None)
        if usual is not None and not rivals[1:] and _same(usual, best):
            rivals = []
    if rivals:
        other = min(rivals, key=_cost)
        raise InconsistentPoses(
            f"The scans agree with the poses in more than one reading, and the results differ: {best.reading.words} ({_residual(best)}), or "
            f"{other.reading.words} ({_residual(other)}). State the right one in dataset.yaml: {_statement(best.reading.form)}, or "
            f"{_statement(other.reading.form)}."
        )
    dead = [one for one in tried if one is not best and one not in alive]
    text = f"Poses read as {best.reading.words}: {_residual(best)}"
    text += f"; the next best reading leaves {_residual(min(dead, key=_cost))}." if dead else "."
    return best.reading, text


def _statement(form: str) -> str:
    words = form.split(",")
    parts = [f"rotation: {words[0]}"]
    parts += [f"angles: {w}" for w in words[1:] if w in ("deg", "rad")]
    parts += ["frame: base_in_flange" for w in words[1:] if w == "inverse"]
    return f"'poses: {{{', '.join(parts)}}}'"


def _residual(one: ScanAgreement) -> str:
    return f"normals {np.degrees(one.normal):.3g} degrees, centres {1e3 * one.centre:.3g} mm"


def _cost(one: ScanAgreement) -> float:
    return float(np.log(one.normal) + np.log(one.centre / one.spread))


def _rejected(one: ScanAgreement, best: ScanAgreement, limit: float) -> bool:
    return one.normal > limit * best.normal or one.centre / one.spread > limit * best.centre / best.spread


def _same(one: ScanAgreement, other: ScanAgreement) -> bool:
    turn = float(np.linalg.norm(one.R - other.R)) / np.sqrt(2.0)
    return turn < max(_SAME_RAD, 2.0 * other.normal) and float(np.linalg.norm(one.p - other.p)) < max(
        _SAME_M, 3.0 * other.centre
    )


def _fit(reading: PoseReading, rows: Array, p_CR: Array, n_C: Array, X_FR: Array, changed: bool) -> ScanAgreement:
    X = reading.X[rows] @ X_FR
    p_B, n_B = X[:, :3, 3], X[:, :3, 2]
    n = len(rows)
    kept = max(int(np.ceil(_KEPT * n)), min(n, 4))
    weight = np.ones(n)
    for _ in range(_STEPS):
        w = weight[:, None]
        middle_B, middle_C = (w * p_B).sum(axis=0) / w.sum(), (w * p_CR).sum(axis=0) / w.sum()
        R = nearest_rotation((w * (p_B - middle_B)).T @ (p_CR - middle_C) + _LEVER_M**2 * (w * n_B).T @ n_C)
        off = np.linalg.norm((p_B - middle_B) - (p_CR - middle_C) @ R.T, axis=1)
        tilt = np.linalg.norm(n_B - n_C @ R.T, axis=1)
        size = np.hypot(off / _LEVER_M, tilt)
        cut = np.sort(size)[kept - 1] + 1e-9
        weight = np.minimum(1.0, (1.5 * cut / np.maximum(size, 1e-12)) ** 2)
    if size.max() < _OUTLYING * np.median(size):
        kept = n
    return ScanAgreement(
        reading=reading,
        scans=kept,
        normal=float(np.sqrt((np.sort(tilt)[:kept] ** 2).mean())) + _NORMAL_FLOOR,
        centre=float(np.sqrt((np.sort(off)[:kept] ** 2).mean())) + _CENTRE_FLOOR_M,
        spread=float(np.sqrt(p_B.var(axis=0).sum())) + 1e-9,
        R=R,
        p=middle_B - R @ middle_C,
        changed=changed,
    )
