"""The wire's end on the flange, from touches of a point or of a plate in several orientations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import read_rows
from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.source import metric_poses, read_poses
from weldcal.calibration.errors import ToolNotFound
from weldcal.calibration.geometry.robust import chi2_quantile, f_quantile, f_tail
from weldcal.calibration.geometry.se3 import as_transform, frames_along, skew
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

POINT, PLATE = "point", "plate"
_STEPS = 30
_NOISE_M = 1e-5  # least deviation of a touch: less than any arm repeats to
_UNSURE_M = 1e-3  # a choice: a wire point with a larger sigma is none
_TURN_PER_M = 2.5  # rad, a choice: of a flange's turn over its shift; scan_fit has 5e-5 rad and 2e-5 m
_CHANCE = 1e-3  # that a good touch is left out
_LONGEST_M = 2.0  # of a tool


@dataclass(frozen=True, eq=False)
class WireTouch:
    """One touch: flange pose X_BF, whether a point or a plate, and the name of that point or plate."""

    id: str
    X_BF: RigidTransform
    feature: str = POINT
    target: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class WirePoint:
    """The wire's end (3,) m in F with its covariance (3, 3) m^2, widened so that its 95 % region is right.

    ``rms_m`` of the touches, ids of touches that were ``left_out``, and the number that was ``used``.
    """

    p_FW: Array
    covariance: Array
    rms_m: float
    used: int
    left_out: tuple[str, ...] = ()


def read_wire_touches(path: Path) -> tuple[WireTouch, ...]:
    """Return the touches of a file: flange poses in any form of docs/datasets.md.

    A CSV may have the columns feature (point or plate) and target (a name). Without them all touch one point.

    Raises:
        InputError: the file cannot be used.
    """
    if not path.is_file():
        raise InputError(f"There is no file '{path}' of touches: give the flange's pose at each touch, as poses.csv.")
    form = PoseForm()
    found = read_poses(path, form)
    if found.left_out:
        raise InputError(f"'{path.name}', {found.left_out[0][0]}: {found.left_out[0][1]}")
    X, _ = metric_poses(found, "auto", form)
    rows: Sequence[dict[str, str]] = [{}] * len(X)
    if path.suffix.lower() == ".csv":
        names, all_rows = read_rows(path)
        if {"feature", "target"} & set(names):
            rows = all_rows
    if len(rows) != len(X):
        raise InputError(f"'{path.name}' has {len(rows)} rows and {len(X)} poses: give each row its pose.")
    ids = found.ids or tuple(str(k + 1) for k in range(len(X)))
    touches = []
    for id, pose, row in zip(ids, X, rows, strict=True):
        feature = (row.get("feature") or POINT).strip().lower()
        if feature not in (POINT, PLATE):
            raise InputError(f"'{path.name}': the feature of touch '{id}' is {POINT} or {PLATE}, not '{feature[:20]}'.")
        touches.append(WireTouch(id, as_transform(pose), feature, (row.get("target") or "").strip()))
    return tuple(touches)


def find_wire(
    touches: Sequence[WireTouch], p_FW: Array, axis: Array, wire_m: float, normal_B: Array | None = None
) -> WirePoint:
    """Find the wire's end from touches; start p_FW (3,) m, direction (3,) of the wire, its diameter m.

    A point gives X_BF p_FW = p_B, a plate n (X_BF p_FW) = d. Where the wire leans, the edge of its flat end touches the
    plate. ``normal_B`` (3,) is a start of each plate's normal: upwards where it is not given. One
    touch that contradicts the others is left out.

    Raises:
        ToolNotFound: the touches do not determine the wire's end.
    """
    normal = np.array([0.0, 0.0, 1.0]) if normal_B is None else np.asarray(normal_B, dtype=float)
    if len(touches) < 4:
        raise ToolNotFound(f"{len(touches)} touches are too few: touch in four orientations or more.")
    best = _solved(touches, p_FW, axis, wire_m, normal)
    k = int(np.argmax(best.squares))
    alone = _solved([t for t in touches if t is not touches[k]], p_FW, axis, wire_m, normal)
    left_out: tuple[str, ...] = ()
    paid = best.freedom - alone.freedom
    if paid > 0 and alone.freedom > 0:
        gain = (best.square - alone.square) / paid / max(alone.square / alone.freedom, _NOISE_M**2)
        if float(f_tail(gain, paid, alone.freedom)) * len(touches) < _CHANCE:
            best, left_out = alone, (touches[k].id,)
    if best.freedom < 1:
        raise ToolNotFound("The touches only just determine the wire's end: add touches, so that an error shows.")
    variance = max(best.square / best.freedom, _NOISE_M**2)
    widened = 3.0 * f_quantile(0.95, 3, best.freedom) / chi2_quantile(0.95, 3)
    # eigenvalues of the normal matrix tell what the orientations leave open
    sigma = np.sqrt(variance * float(np.linalg.eigvalsh(best.C).max()))
    if not sigma < _UNSURE_M or float(np.linalg.norm(best.p_FW)) > _LONGEST_M:
        raise ToolNotFound(
            f"The touches leave the wire's end open by {1e3 * sigma:.1f} mm: turn the tool more between them, by 30"
            " degrees or more to each side and about the wire."
        )
    return WirePoint(
        p_FW=best.p_FW,
        covariance=widened * variance * best.C,
        rms_m=float(np.sqrt(variance)),
        used=len(touches) - len(left_out),
        left_out=left_out,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    p_FW: Array
    C: Array  # (3, 3) for unit variance
    squares: Array  # (touches,) m^2
    freedom: int

    @property
    def square(self) -> float:
        """Sum of squares, m^2."""
        return float(self.squares.sum())


def _solved(touches: Sequence[WireTouch], p: Array, axis: Array, wire_m: float, normal: Array) -> _Solution:
    """Solve for the wire's end, a point (3,) of each touched point, a normal and a distance of each plate."""
    targets = list(dict.fromkeys((t.feature, t.target) for t in touches))
    at = {target: 3 + 3 * k for k, target in enumerate(targets)}
    place = {
        target: np.mean([t.X_BF @ p for t in touches if (t.feature, t.target) == target], axis=0) for target in targets
    }
    planes = dict.fromkeys(targets, normal / np.linalg.norm(normal))
    size = 3 + 3 * len(targets)
    N, e, e_rows = np.eye(size), np.zeros(0), [np.zeros(0)]
    p = np.asarray(p, dtype=float)
    # a turn of the flange moves the wire's end across its lever only: rows of one deviation
    even = np.linalg.inv(np.linalg.cholesky(np.eye(3) + _TURN_PER_M**2 * skew(p) @ skew(p).T))
    for _ in range(_STEPS):
        J_rows, e_rows = [], []
        for t in touches:
            target = (t.feature, t.target)
            R, k = t.X_BF.rotation().matrix(), at[target]
            off = np.asarray(t.X_BF @ p) - place[target]
            J = np.zeros((3 if t.feature == POINT else 1, size))
            if t.feature == POINT:
                whole = even @ R.T  # in F
                J[:, :3], J[:, k : k + 3] = even, -whole
                e_rows.append(whole @ off)
            else:
                n = planes[target]
                lean = float(np.linalg.norm(np.cross(R @ axis, n)))
                J[0, :3] = n @ R
                J[0, k : k + 2] = off @ frames_along(n[None])[0][:, :2]
                J[0, k + 2] = -1.0
                weight = 1.0 / np.hypot(1.0, _TURN_PER_M * np.linalg.norm(np.cross(p, n @ R)))
                J *= weight
                e_rows.append(weight * np.array([n @ off - 0.5 * wire_m * lean]))
            J_rows.append(J)
        J, e = np.concatenate(J_rows), np.concatenate(e_rows)
        N = J.T @ J
        x = -np.linalg.lstsq(J, e, rcond=1e-10)[0]
        p = p + x[:3]
        for target, k in at.items():
            if target[0] == POINT:
                place[target] = place[target] + x[k : k + 3]
            else:
                frame = frames_along(planes[target][None])[0]
                moved = planes[target] + frame[:, :2] @ x[k : k + 2]
                planes[target] = moved / np.linalg.norm(moved)
                place[target] = place[target] + x[k + 2] * planes[target]
        if float(np.abs(x).max()) < 1e-10:
            break
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-30))
    C = scale[:, None] * np.linalg.inv(scale[:, None] * N * scale + 1e-12 * np.eye(size)) * scale
    return _Solution(p, C[:3, :3], np.array([float(r @ r) for r in e_rows]), len(e) - size)
