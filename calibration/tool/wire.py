"""The wire's end on the flange, from touches of a point or of a plate in several orientations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import read_rows
from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.source import metric_poses, read_poses
from weldcal.calibration.errors import ToolNotFound
from weldcal.calibration.geometry.robust import chi2_quantile, f_quantile, f_tail
from weldcal.calibration.geometry.se3 import angle_of, as_transform, frames_along, skew
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

POINT, PLATE = "point", "plate"
_Z = np.array([0.0, 0.0, 1.0])
_STEPS = 30
_NOISE_M = 1e-5  # least deviation of a touch: less than any arm repeats to
_UNSURE_M = 1e-3  # a choice: a wire point with a larger sigma is none
_TURN_PER_M = 2.5  # rad, a choice: of a flange's turn over its shift; scan_fit has 5e-5 rad and 2e-5 m
_CHANCE = 1e-3  # that a good touch is left out
_LONGEST_M = 2.0  # of a tool
_GROWTH = 10.0  # a choice: a TCP that is less certain than one touch by more than this is none
_APART_M = 0.01  # a choice: touches that disagree by more (rms) are not of one point
_READING = 1e-3  # chance that the right reading of the poses is rejected


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


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchedTcp:
    """A TCP from touches of points alone.

    Attributes:
        wire: the TCP in F with its covariance.
        residual_m: distance (n,) of each touch from its point; held_out_m: the same by the other touches alone, NaN
            where they do not determine it.
        growth: sigma of the TCP in its least certain direction over that of one touch.
    """

    wire: WirePoint
    residual_m: Array
    held_out_m: Array
    growth: float


def read_wire_touches(
    path: Path, form: PoseForm | None = None, unit: str = "auto", must_decide: bool = False
) -> tuple[tuple[WireTouch, ...], str]:
    """Return the touches of a file, and how their poses were read: flange poses in any form of docs/datasets.md.

    A CSV may have the columns feature (point or plate) and target (a name). Without them all touch one point. Of
    several readings of the poses the touched points choose.

    Args:
        path: the file; form: of the poses, unit: m, mm or auto, as far as they are stated.
        must_decide: refuse where the touches do not choose; else the usual reading is taken.

    Raises:
        InputError: the file cannot be used.
    """
    if not path.is_file():
        raise InputError(f"There is no file '{path}' of touches: give the flange's pose at each touch, as poses.csv.")
    form = form or PoseForm()
    found = read_poses(path, form)
    if found.unit and unit not in ("auto", found.unit):
        raise InputError(f"'{path.name}' states the unit {found.unit}: omit --unit {unit}.")
    if found.left_out:
        raise InputError(f"'{path.name}', {found.left_out[0][0]}: {found.left_out[0][1]}")
    X = metric_poses(found, unit, form)[0]
    rows: Sequence[dict[str, str]] = [{}] * len(X)
    if path.suffix.lower() == ".csv":
        names, all_rows = read_rows(path)
        if {"feature", "target"} & set(names):
            rows = all_rows
    if len(rows) != len(X):
        raise InputError(f"'{path.name}' has {len(rows)} rows and {len(X)} poses: give each row its pose.")
    ids = found.ids or tuple(str(k + 1) for k in range(len(X)))
    touches: list[WireTouch] = []
    for id, pose, row in zip(ids, X, rows, strict=True):
        feature = (row.get("feature") or POINT).strip().lower()
        if feature not in (POINT, PLATE):
            raise InputError(f"'{path.name}': the feature of touch '{id}' is {POINT} or {PLATE}, not '{feature[:20]}'.")
        touches.append(WireTouch(id, as_transform(pose), feature, (row.get("target") or "").strip()))
    if len(found.readings) < 2 or len(touches) < 4 or any(t.feature == PLATE for t in touches):
        return tuple(touches), found.read_as
    read: list[tuple[str, str, list[WireTouch], _Solution]] = []
    for one in found.readings:
        poses = metric_poses(replace(found, X=one.X), unit, form)[0]
        again = [replace(t, X_BF=as_transform(X_BF)) for t, X_BF in zip(touches, poses, strict=True)]
        read.append((one.form, one.words, again, _solved(again, np.zeros(3), _Z, 0.0, _Z)))
    usual = read[0]
    read.sort(key=lambda r: r[3].square)
    best = read[0]
    free, least = best[3].freedom, max(best[3].square, best[3].freedom * _NOISE_M**2)
    alive = [r for r in read[1:] if free < 1 or float(f_tail(r[3].square / least, free, free)) > _READING]
    rivals = [r for r in alive if float(np.linalg.norm(r[3].p_FW - best[3].p_FW)) > _UNSURE_M]
    if rivals and must_decide:
        raise InputError(
            f"The touches do not show how the poses are written: as {best[1]} they leave {best[3].rms_mm:.2f} mm, as"
            f" {rivals[0][1]} {rivals[0][3].rms_mm:.2f} mm. State it with --as robot-form={best[0]} or --as"
            f" robot-form={rivals[0][0]}."
        )
    chosen = usual if usual in rivals else best
    return tuple(chosen[2]), chosen[1]


def find_tcp(touches: Sequence[WireTouch]) -> TouchedTcp:
    """Find the TCP from touches of points in several orientations, as a pendant's four-point method does.

    Raises:
        ToolNotFound: fewer than four touches, orientations too alike, or touches that are not of one point.
    """
    if any(t.feature != POINT for t in touches):
        raise ToolNotFound("The TCP alone is found by touches of a point: leave the plates out, or use tool measure.")
    wire = find_wire(touches, np.zeros(3), _Z, 0.0, most_m=np.inf)
    kept = [t for t in touches if t.id not in wire.left_out]
    whole = _solved(kept, wire.p_FW, _Z, 0.0, _Z)
    values, vectors = np.linalg.eigh(whole.C)
    growth = float(np.sqrt(values[-1]))
    if growth > _GROWTH:
        R = np.array([t.X_BF.rotation().matrix() for t in kept])
        turn = np.degrees(angle_of(np.swapaxes(R[:, None], -1, -2) @ R[None]).max())
        v = vectors[:, -1] * np.sign(vectors[np.argmax(np.abs(vectors[:, -1])), -1])
        raise ToolNotFound(
            f"The orientations are too alike: the largest turn between two touches is {turn:.1f} degrees, and along"
            f" ({v[0]:.2f}, {v[1]:.2f}, {v[2]:.2f}) of the flange the TCP is open. Tilt the tool by 30 degrees or more"
            " to each side, and turn it about its own axis."
        )
    if wire.rms_m > _APART_M:
        raise ToolNotFound(
            f"The touches disagree by {1e3 * wire.rms_m:.0f} mm (rms), which no TCP explains: check that all are of one"
            " point, and state how the poses are written with --unit and --as robot-form=FORM."
        )
    held = np.full(len(touches), np.nan)
    for k, t in enumerate(touches):
        others = [one for one in kept if one is not t]
        if (t.feature, t.target) in {(one.feature, one.target) for one in others} and len(others) > 2:
            alone = _solved(others, wire.p_FW, _Z, 0.0, _Z)
            if np.linalg.eigvalsh(alone.C)[-1] < _GROWTH**2:
                held[k] = alone.off(t)
    return TouchedTcp(wire=wire, residual_m=np.array([whole.off(t) for t in touches]), held_out_m=held, growth=growth)


def find_wire(
    touches: Sequence[WireTouch],
    p_FW: Array,
    axis: Array,
    wire_m: float,
    normal_B: Array | None = None,
    *,
    most_m: float = _UNSURE_M,
) -> WirePoint:
    """Find the wire's end from touches; start p_FW (3,) m, direction (3,) of the wire, its diameter m.

    A point gives X_BF p_FW = p_B, a plate n (X_BF p_FW) = d. Where the wire leans, the edge of its flat end touches the
    plate. ``normal_B`` (3,) is a start of each plate's normal: upwards where it is not given. One
    touch that contradicts the others is left out. ``most_m``: sigma beyond which it is refused.

    Raises:
        ToolNotFound: the touches do not determine the wire's end.
    """
    normal = _Z if normal_B is None else np.asarray(normal_B, dtype=float)
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
    if not sigma < most_m or float(np.linalg.norm(best.p_FW)) > _LONGEST_M:
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
    place: dict[tuple[str, str], Array]  # (3,) m in B of each point

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals' numbers, mm."""
        return 1e3 * float(np.sqrt(self.square / max(self.freedom, 1)))

    def off(self, touch: WireTouch) -> float:
        """Distance (m) of a touch from its point."""
        return float(np.linalg.norm(touch.X_BF @ self.p_FW - self.place[touch.feature, touch.target]))

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
    return _Solution(p, C[:3, :3], np.array([float(r @ r) for r in e_rows]), len(e) - size, place)
