"""Predict what unknown errors of the arm do to touches after a calibration with the same arm.

The errors are as large as makers leave them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.kinematics_fit import KinematicsFit, arm_errors, usual_scanner
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import known_arms, load_arm
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
