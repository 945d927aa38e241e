"""Compares touched points with what the calibration states.

Each error with its 95 % limit, and errors from point to point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.eye_on_base.stated_error import (
    USUAL_FIELD_M,
    USUAL_TURN_RAD,
    feature_rotation,
    joint_terms,
    scatter_elsewhere,
)
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.refinement.kinematics_choice import shared_error
from weldcal.calibration.refinement.kinematics_fit import FactoryPrior, KinematicsFit, arm_errors, usual_scanner
from weldcal.calibration.refinement.local_field import field_from_document
from weldcal.calibration.touch.touches import PLANE, POINT, SPHERE, Touch, require_touches
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, known_arms, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEAST_OTHER = 0.05  # a choice: scanner and fit always add some noise; without it the arm's error would be certain
"""Share of the residuals' variance that is always taken as noise."""
_USUAL_POSTURE = np.radians([-90.0, 110.0, -110.0, -90.0, 0.0])  # of the second joint and the others, over a table


@dataclass(frozen=True, eq=False)
class ArmEffect:
    """``effect`` (n, 3, k) m: change of scanned minus touched by each error of the arm of one standard deviation.

    ``derivatives`` (n, 3, p) by what was estimated and its ``covariance`` (p, p) from the scans' noise and the prior
    alone. ``noise``: share of the residuals' variance that is not the arm's.
    """

    effect: Array
    derivatives: Array
    covariance: Array
    noise: float


def arm_effect(
    result: CalibrationResult,
    tips: Sequence[Observation],
    X_BF: Sequence[RigidTransform],
    q_tips: Sequence[Array | None],
) -> ArmEffect | None:
    """Return changes of scanned minus touched at n tips by k errors of the arm.

    The tips have flange poses ``X_BF``, and joint angles where known. Each error is one standard deviation of a maker's
    (FactoryPrior).

    The calibration has seen the same errors and bent to them: with e = A d + B u at its poses (d: camera pose and
    scanner correction, u: errors of the arm) it finds d = -G u, G = (A' W A + P)^-1 A' W B, and a touch errs by (B_t -
    A_t G) u (consider covariance, Schmidt 1966). None where the result does not hold its poses or its arm is not known.

    The calibration's own residuals bound this: their variance s^2 holds the arm's share a^2 = mean |(B - A G) u|^2 /
    redundancy. Second: the share of s^2 that is not the arm's, 1 - a^2 / s^2 (at least 5 %). Where a^2 is larger than
    s^2 this arm is better than usual, and its errors are taken as smaller by s / a. Raises InputError where they cannot
    be read.
    """
    if result.observed is None or result.sigma_position_mm <= 0.0:
        return None
    if result.robot not in known_arms():
        return None
    seen, X_FR, joints = _read(result.observed)
    poses = [o.X_BR @ X_FR.inverse() for o in seen]
    given: list[Array | None] = list(joints) if len(joints) == len(seen) else [None] * len(seen)
    found = _joints(result.robot, [*poses, *X_BF], [*given, *q_tips])
    if found is None:
        return None
    q, q_new = found[: len(seen)], found[len(seen) :]
    errors = arm_errors(load_chain(result.robot), "links")
    k = len(errors.which)
    correction = correction_from_document(result.scanner_correction) or ScannerCorrection()
    fit = KinematicsFit(
        X_BC=result.X_BC,
        correction=correction,
        u=np.zeros(k),
        covariance=np.eye(1),
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=errors,
    )
    J = fit.sensitivity(seen, q)
    theta = J.shape[2] - k
    position = 1e-3 * result.sigma_position_mm
    tilt = max(float(np.radians(result.sigma_normal_deg)), 1e-4)
    has = np.array([o.n_C is not None for o in seen])
    w = np.concatenate([np.full((len(seen), 3), 1.0 / position), has[:, None] * np.full(3, 1.0 / tilt)], axis=1)
    rows = (J * w[:, :, None]).reshape(-1, J.shape[2])
    A, B = rows[:, :theta], rows[:, theta:]
    prior = np.zeros((theta, theta))
    prior[6:, 6:] = np.diag(1.0 / usual_scanner(theta - 6, result.scanner_correction is not None) ** 2)
    N = A.T @ A + prior + 1e-9 * np.eye(theta)
    gain = np.linalg.solve(N, A.T @ B)
    placed = np.tile(np.arange(6) < 3, len(seen))  # rows of positions
    left = (B - A @ gain)[placed]
    spare = float(placed.sum() - np.einsum("ij,ji->", A[placed], np.linalg.solve(N, A[placed].T)))
    share = float((left**2).sum()) / max(spare, 1.0)  # a^2 / s^2: the rows are in units of s
    new = fit.sensitivity(list(tips), q_new)[:, :3]
    effect = (new[:, :, theta:] - new[:, :, :theta] @ gain) * min(1.0, share**-0.5)
    noise = max(1.0 - share, LEAST_OTHER)
    own = np.linalg.solve(N, np.linalg.solve(N, noise * (A.T @ A) + prior).T)
    return ArmEffect(np.asarray(effect), new[:, :, :theta], np.asarray(0.5 * (own + own.T)), noise)


def _joints(robot: str, X_BF: Sequence[RigidTransform], known: Sequence[Array | None]) -> Array | None:
    """Joint angles (n, 6) rad at flange poses, all of one kind of posture: the known ones, else elbow up.

    None out of reach.
    """
    arm = load_arm(robot)
    p = np.mean([X.translation() for X in X_BF], axis=0)
    near = np.append(np.arctan2(p[1], p[0]) + np.pi, _USUAL_POSTURE)
    near = next((q for q in known if q is not None), near)
    out = []
    for X, q in zip(X_BF, known, strict=True):
        found = nearest_solution(arm, X, near) if q is None else q
        if found is None:
            return None
        out.append(found)
    return np.array(out)


def _read(document: dict[str, Any]) -> tuple[list[Observation], RigidTransform, list[Array]]:
    try:
        X_FR = RigidTransform(_turn(document["feature_wxyz"]), np.array(document["feature_xyz"], dtype=float))
        rows = zip(document["xyz"], document["wxyz"], document["camera"], document["normals"], strict=True)
        seen = [
            Observation(
                str(i),
                RigidTransform(_turn(wxyz), np.array(p, dtype=float)),
                np.array(c, dtype=float),
                None if n is None else np.array(n, dtype=float),
            )
            for i, (p, wxyz, c, n) in enumerate(rows)
        ]
        return seen, X_FR, [np.array(q, dtype=float) for q in document["joints"]]
    except (KeyError, TypeError, ValueError, RuntimeError) as problem:
        raise InputError(
            "The poses (observed) in the result cannot be read; run 'weldcal calibrate' again."
        ) from problem


def _turn(wxyz: Any) -> RotationMatrix:
    return RotationMatrix(Quaternion(np.array(wxyz, dtype=float)))


LEVEL = 0.95  # the usual level of a region, as everywhere in the reports
FALSE_ALARM = 0.01  # the usual level of a test
"""Of verifications of a calibration as good as it states in which more touches lie outside than the limit allows."""
_PRIOR = FactoryPrior()
USUAL_TILT_RAD = float(np.sqrt((6.0 * _PRIOR.offset_rad**2 + 12.0 * _PRIOR.turn_rad**2) / 3.0))
"""Error per axis of the flange's orientation that a maker's calibration of six joints leaves: zeros and two turns of
each axis."""
_DRAWS, _SEED = 4000, 1
_FIELD_LENGTH_M = 0.2  # over which what an arm leaves at another orientation is alike
_LEAST_FREE = 3.0  # as in eye_on_base/stated_error.py


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchErrors:
    """Touches (n) judged.

    ``error_m`` (n,) distance of touched from scanned (signed where it has one direction), ``limit_m`` (n,) of the
    stated 95 % region in the direction of the error, ``inside`` (n,). ``relative_m`` (n,) is what is left of each error
    after the shift that the other touches show, ``relative_limit_m`` its stated 95 % limit: NaN where the others show
    no shift. ``most_outside``: touches that may lie outside by chance.
    """

    ids: tuple[str, ...]
    features: tuple[str, ...]
    error_m: Array
    limit_m: Array
    inside: NDArray[np.bool_]
    relative_m: Array
    relative_limit_m: Array
    relative_inside: NDArray[np.bool_]
    most_outside: int
    stated_poses: bool

    @property
    def outside(self) -> int:
        """How many touches lie outside their region."""
        return int((~self.inside).sum())


def judge_touches(result: CalibrationResult, touches: Sequence[Touch], kinematics: Path | None = None) -> TouchErrors:
    """Judge a calibration by touches that it did not use.

    ``kinematics`` is the file of a result with refined kinematics.

    The error of touch k in its directions D_k (all three for a point, the normal for a surface touched by a ball) is
    e_k = D_k (touched - scanned) - clearance. Its stated covariance adds pose and scanner correction (and errors of the
    arm, where the result states them), the spread of robot and scanner with what an arm usually leaves at another
    orientation, what it leaves of the flange's orientation times the length of the tool, the scan, and place and radius
    of the tip, which all touches share. The spread was estimated from few residuals, so the limit is that of F.
    Derivation: docs/calibration.md, "A touch as the judge".

    Raises:
        InputError: a touch or what the result states cannot be used.
    """
    require_touches(touches)
    correction = correction_from_document(result.scanner_correction)
    arm_known = bool(result.kinematics_file) and kinematics is not None and all(t.q is not None for t in touches)
    if arm_known:
        assert kinematics is not None
        arm = load_arm(result.robot, kinematics)
        touches = [replace(t, X_BF=forward_kinematics(arm, np.asarray(t.q))) for t in touches]
    scanned, tips = _scanned(result, correction, touches)
    shared = _calibration_terms(result, correction, touches, tips, kinematics if arm_known else None)
    usual = None if arm_known else arm_effect(result, tips, [t.X_BF for t in touches], [t.q for t in touches])
    spread = _spread(result, touches, tips, usual is None and not arm_known)
    if usual is not None:
        shared, spread = (usual.derivatives, usual.covariance), usual.noise * spread
    local = field_from_document(result.local_field)
    if local is not None:
        shift, per_axis = local.at([o.X_BR for o in tips])
        scanned, spread = scanned - shift, np.diag(per_axis**2)
    rows, errors, owner = _components(result, correction, touches, scanned)
    C = _covariance(result, touches, shared, spread, rows, owner, None if usual is None else usual.effect)
    free = max(3.0 * sum(p.used for p in result.poses) - 6.0, _LEAST_FREE)
    signed, limit, inside = _marginal(errors, C, owner, len(touches), free)
    A = _without_shift(rows, owner)
    left, left_limit, left_inside = _marginal(A @ errors, A @ C @ A.T, owner, len(touches), free)
    blind = np.array([not np.abs(A[owner == k]).sum() > 1e-9 for k in range(len(touches))])
    left[blind] = left_limit[blind] = np.nan
    return TouchErrors(
        ids=tuple(t.id for t in touches),
        features=tuple(t.feature for t in touches),
        error_m=signed,
        limit_m=limit,
        inside=inside,
        relative_m=left,
        relative_limit_m=left_limit,
        relative_inside=left_inside | blind,
        most_outside=_most_outside(C, owner, len(touches), free),
        stated_poses=bool(result.kinematics_file) and not arm_known,
    )


def _scanned(
    result: CalibrationResult, correction: ScannerCorrection | None, touches: Sequence[Touch]
) -> tuple[Array, list[Observation]]:
    """Scanned points (n, 3) m in the base, and the tips as observations."""
    seen = np.array([t.p_C for t in touches])
    moved = seen if correction is None else correction.points(seen)
    scanned = moved @ result.X_BC.rotation().matrix().T + result.X_BC.translation()
    R_FR = feature_rotation(result)  # as the calibration's poses were turned
    tips = [Observation(t.id, t.X_BF @ RigidTransform(R_FR, t.p_FT), t.p_C) for t in touches]
    return scanned, tips


def _calibration_terms(
    result: CalibrationResult,
    correction: ScannerCorrection | None,
    touches: Sequence[Touch],
    tips: list[Observation],
    kinematics: Path | None,
) -> tuple[Array, Array]:
    """Derivatives (n, 3, p) of scanned minus touched by what was estimated, and its covariance (p, p)."""
    if kinematics is not None:
        stated = shared_error(result, kinematics, correction, tips, np.array([t.q for t in touches]))
        if stated is not None:
            return stated
    joint, correction = joint_terms(result, correction)
    J = []
    R = result.X_BC.rotation()
    for t in touches:
        c = t.p_C if correction is None else correction.points(t.p_C)
        one = np.hstack([-skew(np.asarray(R @ c)), np.eye(3)])
        J.append(one if correction is None else np.hstack([one, np.outer(R @ t.p_C, correction.terms(t.p_C))]))
    return np.array(J), joint


def _spread(result: CalibrationResult, touches: Sequence[Touch], tips: list[Observation], arm_unknown: bool) -> Array:
    """Covariance (n, n) m^2, per axis, of the spread of robot and scanner between the touches.

    Where nothing else says what the arm's errors do (``arm_unknown``): their usual size at another orientation, and the
    usual error of a flange's orientation times the length of the tool, for the calibration is bent by as much.
    """
    n, own = len(tips), (1e-3 * result.sigma_position_mm) ** 2
    if not arm_unknown:
        return own * np.eye(n)
    grown = scatter_elsewhere(result, tips)
    beyond = np.full(n, USUAL_FIELD_M**2) if grown is None else np.maximum(grown**2 - own, 0.0)
    tool = np.array([np.linalg.norm(t.p_FT) for t in touches]) * USUAL_TILT_RAD
    usual = np.sqrt(beyond + tool**2)
    return np.asarray(own * np.eye(n) + np.outer(usual, usual) * _alike(tips))


def _alike(tips: list[Observation]) -> Array:
    """Correlation (n, n) of what an arm leaves at two poses of the tip."""
    places = np.array([o.p_BR for o in tips])
    turned = Rotation.from_matrix(np.array([o.X_BR.rotation().matrix() for o in tips]))
    d = np.linalg.norm(places[:, None] - places[None], axis=2)
    a = np.array([(one.inv() * turned).magnitude() for one in turned])
    return np.asarray(np.exp(-0.5 * (d / _FIELD_LENGTH_M) ** 2 - 0.5 * (a / USUAL_TURN_RAD) ** 2))


def _components(
    result: CalibrationResult, correction: ScannerCorrection | None, touches: Sequence[Touch], scanned: Array
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Directions (m, 3) in the base, errors (m,) m along them, and the touch (m,) of each."""
    rows: list[Array] = []
    errors: list[float] = []
    owner: list[int] = []
    R = result.X_BC.rotation()
    for k, (t, p) in enumerate(zip(touches, scanned, strict=True)):
        v = t.p_BT - p
        if t.feature == POINT:
            if t.radius > 0.0:
                raise InputError(
                    f"Touch '{t.id}': a ball cannot touch a point. Give tip_radius 0 for a pointed tip, or the plane,"
                    " sphere or edge that it touches."
                )
            directions, clearance = np.eye(3), 0.0
        elif t.feature == SPHERE:
            directions, clearance = (v / np.linalg.norm(v))[None], t.feature_radius + t.radius
        else:
            assert t.direction_C is not None
            d = t.direction_C / np.linalg.norm(t.direction_C)
            if t.feature == PLANE:
                d = d if correction is None else correction.normals(t.p_C, d)
                directions, clearance = np.asarray(R @ d)[None], t.radius
            else:
                d = np.asarray(R @ d)
                v = v - (v @ d) * d
                directions, clearance = (v / np.linalg.norm(v))[None], t.radius
                if t.radius == 0.0:  # a pointed tip on a line: across it in both directions
                    directions, clearance = np.linalg.svd(d[None])[2][1:], 0.0
        for row in directions:
            rows.append(row)
            errors.append(float(row @ v) - clearance)
            owner.append(k)
    return np.array(rows), np.array(errors), np.array(owner)


def _covariance(
    result: CalibrationResult,
    touches: Sequence[Touch],
    shared: tuple[Array, Array],
    spread: Array,
    rows: Array,
    owner: NDArray[np.int64],
    effect: Array | None,
) -> Array:
    """Stated covariance (m, m) m^2 of the errors."""
    J, S = shared
    each = np.einsum("mi,mip->mp", rows, J[owner])
    C = each @ S @ each.T
    across = rows @ rows.T
    C = C + across * spread[np.ix_(owner, owner)]
    on_flange = np.einsum("mi,mij->mj", rows, np.array([t.X_BF.rotation().matrix() for t in touches])[owner])
    tip, radius, scan = (
        np.array([getattr(t, f"sigma_{name}") for t in touches])[owner] for name in ("tip", "radius", "scan")
    )
    C = C + np.outer(tip, tip) * (on_flange @ on_flange.T)
    if effect is not None:
        bent = np.einsum("mi,mik->mk", rows, effect[owner])
        C = C + bent @ bent.T
    same = owner[:, None] == owner[None, :]
    ball = np.array([t.radius > 0.0 for t in touches])[owner] * radius
    C = C + np.outer(ball, ball)
    return np.asarray(C + same * across * np.outer(scan, scan))


def _marginal(
    errors: Array, C: Array, owner: NDArray[np.int64], n: int, free: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Size (n,) of each touch's error, limit (n,) of its region along it, and whether it lies inside."""
    size, limit, inside = np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool)
    for k in range(n):
        rows = np.flatnonzero(owner == k)
        e, S = errors[rows], C[np.ix_(rows, rows)]
        m = len(rows)
        size[k] = e[0] if m == 1 else np.linalg.norm(e)
        along = np.array([1.0]) if m == 1 else e / max(float(np.linalg.norm(e)), 1e-12)
        inverse = np.linalg.pinv(S)
        bound = m * f_quantile(LEVEL, m, free)
        limit[k] = np.sqrt(bound / max(float(along @ inverse @ along), 1e-300))
        inside[k] = abs(size[k]) <= limit[k]
    return size, limit, inside


def _without_shift(rows: Array, owner: NDArray[np.int64]) -> Array:
    """Matrix (m, m) that takes from each touch's errors the shift that the errors of the others show.

    Zero where they show none.
    """
    m = len(owner)
    A = np.zeros((m, m))
    for k in np.unique(owner):
        mine, others = np.flatnonzero(owner == k), np.flatnonzero(owner != k)
        if not len(others):
            continue
        shift = np.linalg.pinv(rows[others], rcond=1e-3)  # (3, others)
        shown = shift @ rows[others]  # projects on what the others show
        if np.abs(rows[mine] @ shown - rows[mine]).max() > 0.2:
            continue  # no other touch has this direction
        A[np.ix_(mine, mine)] = np.eye(len(mine))
        A[np.ix_(mine, others)] = -rows[mine] @ shift
    return A


def _most_outside(C: Array, owner: NDArray[np.int64], n: int, free: float) -> int:
    """Return the number of touches outside in more than 1 - FALSE_ALARM of draws of errors as stated.

    The draws have all errors that are shared.
    """
    rng = np.random.default_rng(_SEED)
    values, vectors = np.linalg.eigh(0.5 * (C + C.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = rng.standard_normal((_DRAWS, len(values))) @ root.T * np.sqrt(free / rng.chisquare(free, _DRAWS))[:, None]
    outside = np.zeros(_DRAWS, dtype=int)
    for k in range(n):
        rows = np.flatnonzero(owner == k)
        S = np.linalg.pinv(C[np.ix_(rows, rows)])
        square = np.einsum("di,ij,dj->d", drawn[:, rows], S, drawn[:, rows])
        outside += square > len(rows) * f_quantile(LEVEL, len(rows), free)
    return int(np.quantile(outside, 1.0 - FALSE_ALARM, method="higher"))
