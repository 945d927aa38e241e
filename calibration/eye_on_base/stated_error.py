"""The error that a calibration states: the limit of the median error of new scans, and the budget of its sources."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.results import (
    KINEMATICS_FILE,
    CalibrationResult,
    pose_records,
    software_version,
    statistics,
    tilt_summary,
)
from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import skew
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

FALSE_ALARM = 0.01  # of verifications of a good calibration that exceed the limit
_DRAWS = 6_000  # the limit's own error is then 1 to 2 %
_SEED = 1
_LEAST_FREE = 3.0  # as of one pose to spare: the 95 % quantile of F(3, m) is 9 with 3 spare numbers, and 216 with one
USUAL_FIELD_M = 1.5e-4  # the usual spread of solve.py: a maker's arm and a scanner
"""Spread per axis of what an arm leaves of a calibration from place to place."""
USUAL_TURN_RAD = float(np.radians(10.0))
"""Angle over which that is alike."""


def stated_median_limit(
    result: CalibrationResult,
    observations: Sequence[Observation],
    correction: ScannerCorrection | None,
    scatter_m: Array | None = None,
    shared: tuple[Array, Array] | None = None,
) -> float | None:
    """Limit (mm) that the median error at these new observations (n) exceeds by chance in FALSE_ALARM of verifications.

    The median of n errors has no closed form where all share the calibration's own error, so it is simulated. One error
    of pose and scanner correction is drawn from their joint covariance for all scans. For each scan the spread of robot
    and scanner and the noise of its fit are drawn. The spread was estimated from few residuals, so its square is drawn
    as well (scaled inverse chi-square). ``scatter_m`` (n,) m per axis: the spread that a local field leaves at each
    scan. ``shared``: for errors of the arm, derivatives (n, 3, p) of the positions and the covariance (p, p) in place
    of the result's. The 95 % percentile of the stated held-out errors counts where it is larger. None where the result
    states no error at all. Deterministic.
    """
    stated = result.held_out_mm.get("p95")
    floor = float(stated) if stated is not None and np.isfinite(stated) else None
    if not result.sigma_position_mm > 0.0 or not observations:
        return floor
    rng = np.random.default_rng(_SEED)
    whole, correction = joint_terms(result, correction)
    J = np.array([place_sensitivity(result, o.p_CR, correction) for o in observations])
    if shared is not None:
        J, whole = shared
    values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    used = sum(p.used for p in result.poses)
    free = max(3.0 * used - 6.0, _LEAST_FREE)
    own = np.array([np.zeros((3, 3)) if o.center_covariance is None else o.center_covariance for o in observations])
    R = result.X_BC.rotation().matrix()
    fits = np.linalg.cholesky(R @ own @ R.T + 1e-18 * np.eye(3))
    medians = np.empty(_DRAWS)
    for first in range(0, _DRAWS, 1000):
        k, n = slice(first, first + 1000), len(observations)
        together = (rng.standard_normal((1000, root.shape[1])) @ root.T @ J.reshape(3 * n, -1).T).reshape(1000, n, 3)
        own_sigma = 1e-3 * result.sigma_position_mm * np.ones(n) if scatter_m is None else scatter_m
        sigma = own_sigma * np.sqrt(free / rng.chisquare(free, 1000))[:, None]
        scatter = sigma[:, :, None] * rng.standard_normal((1000, n, 3))
        noise = np.swapaxes(np.swapaxes(rng.standard_normal((1000, n, 3)), 0, 1) @ np.swapaxes(fits, 1, 2), 0, 1)
        error = together + scatter + noise
        medians[k] = np.median(np.sqrt(np.vecdot(error, error)), axis=1)
    limit = 1e3 * float(np.quantile(medians, 1.0 - FALSE_ALARM))
    return limit if floor is None else max(limit, floor)


def joint_terms(
    result: CalibrationResult, correction: ScannerCorrection | None
) -> tuple[Array, ScannerCorrection | None]:
    """Return the covariance (6 + K, 6 + K) of X_BC and correction, and the correction with its K terms.

    The correction changes nothing where the scanner was not found wrong. Where the two do not fit: the covariance of
    X_BC alone, and None.
    """
    joint = result.joint_covariance
    if joint is not None and correction is None and len(joint) - 6 in TERMS.values():
        correction = ScannerCorrection.unchanged(len(joint) - 6)
    if joint is None or correction is None or len(joint) != 6 + len(correction.values):
        return result.covariance, None
    return joint, correction


def estimate_result(
    e: CalibrationEstimate,
    observations: Sequence[Observation],
    refused: Iterable[tuple[str, str]],
    X_FR: RigidTransform | None,
    joints: Sequence[Array],
    *,
    kinematics: str = "",
    **more: Any,
) -> CalibrationResult:
    """Return an estimate as a result folder holds it, recorded or live.

    Args:
        observations: as measured (n).
        refused: id and reason of each scan that cannot be used; the outliers' reasons are added.
        X_FR: the feature in the flange; None for poses of the feature.
        joints: joint angles of the inliers, rad, where they are known.
        kinematics: text of the refined kinematics' file.
        more: other fields of the result.
    """
    inliers = [o for o, keep in zip(observations, e.inliers, strict=True) if keep]
    values = {
        "residual_mm": 1e3 * e.position_residuals_m,
        "held_out_mm": 1e3 * e.held_out.position_m,
        "tilt_deg": np.degrees(e.tilt_residuals_rad),
        "held_out_tilt_deg": np.degrees(e.held_out.tilt_rad),
    }
    fields: dict[str, Any] = {
        "X_BC": e.X_BC,
        "covariance": e.covariance,
        "held_out_mm": statistics(1e3 * e.held_out.position_m[e.inliers]),
        "tilt_deg": tilt_summary(e.held_out.tilt_rad[e.inliers]),
        "poses": pose_records(
            [o.id for o in observations], e.inliers, values, [*disagreeing(e, observations).items(), *refused]
        ),
        "warnings": e.warnings,
        "unobservable": e.unobservable,
        "sigma_position_mm": 1e3 * e.sigma_position_m,
        "sigma_normal_deg": float(np.degrees(e.sigma_normal_rad)),
        "software": software_version(),
        "kinematics_file": KINEMATICS_FILE if kinematics else "",
        "joint_covariance": e.joint,
        "orientations": orientations_of(inliers, X_FR),
        "observed": observed_document(inliers, X_FR, joints),
    }
    return CalibrationResult(**fields | more)


def disagreeing(e: CalibrationEstimate, observations: Sequence[Observation]) -> dict[str, str]:
    """Return the reason why each outlier is not used, by its id."""
    off = zip(observations, e.inliers, 1e3 * e.position_residuals_m, strict=True)
    why = "Its centre disagrees by {:.1f} mm with the other poses; it is not used."
    return {o.id: why.format(mm) for o, keep, mm in off if not keep}


def observed_document(
    observations: Sequence[Observation], X_FR: RigidTransform | None = None, joints: Sequence[Array] = ()
) -> dict[str, Any]:
    """Return the poses that a calibration used, for CalibrationResult.observed.

    They are the feature in the base, the observed centre and normal, and the joints where they are known.
    """
    X = X_FR or RigidTransform()
    return {
        "feature_xyz": [float(v) for v in X.translation()],
        "feature_wxyz": [float(v) for v in X.rotation().ToQuaternion().wxyz()],
        "xyz": [[float(v) for v in o.p_BR] for o in observations],
        "wxyz": [[float(v) for v in o.X_BR.rotation().ToQuaternion().wxyz()] for o in observations],
        "camera": [[float(v) for v in o.p_CR] for o in observations],
        "normals": [None if o.n_C is None else [float(v) for v in o.n_C] for o in observations],
        "joints": [[float(v) for v in q] for q in joints],
    }


def orientations_of(observations: Sequence[Observation], X_FR: RigidTransform | None = None) -> dict[str, Any]:
    """Summarise the feature's orientations in the base for CalibrationResult.orientations.

    They are the mean and the largest angle (deg) from it, with the feature's orientation on the flange where X_FR turns
    it.
    """
    turned = Rotation.from_matrix(np.array([o.X_BR.rotation().matrix() for o in observations]))
    mean = turned.mean()
    x, y, z, w = (float(v) for v in mean.as_quat())
    found: dict[str, Any] = {
        "wxyz": [w, x, y, z],
        "spread_deg": float(np.degrees((mean.inv() * turned).magnitude().max())),
    }
    if X_FR is not None and not X_FR.rotation().IsNearlyIdentity():
        found["feature_wxyz"] = [float(v) for v in X_FR.rotation().ToQuaternion().wxyz()]
    return found


def feature_rotation(result: CalibrationResult) -> RotationMatrix:
    """Orientation on the flange of the feature that was measured. Raises InputError where it cannot be read."""
    wxyz = (result.orientations or {}).get("feature_wxyz")
    try:
        return RotationMatrix() if wxyz is None else RotationMatrix(Quaternion(np.array(wxyz, dtype=float)))
    except (TypeError, ValueError, RuntimeError) as problem:
        raise InputError("The orientations in the result cannot be read; run 'weldcal calibrate' again.") from problem


def scatter_elsewhere(result: CalibrationResult, observations: Sequence[Observation]) -> Array | None:
    """Spread (n,) m per axis of new scans, grown where the flange is turned beyond the orientations of the calibration.

    The arm's error at one orientation says nothing about another orientation. There its usual size is added, with the
    covariance over angles that a local field has before any scan (0.15 mm per axis, 10 degrees). None where the result
    does not hold its orientations. Raises InputError where they cannot be read.
    """
    if result.orientations is None:
        return None
    try:
        w, x, y, z = (float(v) for v in result.orientations["wxyz"])
        mean, spread = Rotation.from_quat([x, y, z, w]), np.radians(float(result.orientations["spread_deg"]))
    except (KeyError, TypeError, ValueError) as problem:
        raise InputError("The orientations in the result cannot be read; run 'weldcal calibrate' again.") from problem
    turned = Rotation.from_matrix(np.array([o.X_BR.rotation().matrix() for o in observations]))
    beyond = np.maximum((mean.inv() * turned).magnitude() - spread, 0.0)
    unknown = USUAL_FIELD_M**2 * (1.0 - np.exp(-0.5 * (beyond / USUAL_TURN_RAD) ** 2))
    return np.asarray(np.sqrt((1e-3 * result.sigma_position_mm) ** 2 + unknown))


def place_sensitivity(result: CalibrationResult, p_CQ: Array, correction: ScannerCorrection | None) -> Array:
    """How the base position of a scanned point moves with pose and, where there is one, correction (3, 6 + K)."""
    p = np.asarray(result.X_BC @ p_CQ)
    J = np.hstack([-skew(p - result.X_BC.translation()), np.eye(3)])
    if correction is None:
        return np.asarray(J)
    return np.hstack([J, np.outer(result.X_BC.rotation() @ p_CQ, correction.terms(p_CQ))])


MEASURED, SHEET, ASSUMED = "measured", "data sheet", "assumed"
USUAL_SCALE = 2e-3  # what _USUAL of scanner_correction.py takes for a scale's sigma
"""Scale error of a scanner that is not corrected."""
_USUAL_REPEAT_M = 5e-5  # of an arm without a data sheet
_WARMING_K = 5.0  # a choice: a workshop's day; the row of the budget scales with it
_EXPANSION = 2.3e-5  # 1/K, aluminium: the links of an arm
_IT8 = 25.0  # tolerance units of grade 8 (ISO 286-1), which ISO 9409-1 asks of the outer diameter


@dataclass(frozen=True)
class Contribution:
    """One source of error, with what would reduce it.

    It adds the root mean square distance ``mm`` at the work point, and rests on a measurement, a data sheet or an
    assumption. ``left`` is the share of it that then remains.
    """

    source: str
    mm: float
    basis: str
    remedy: str
    left: float


@dataclass(frozen=True)
class ErrorBudget:
    """Contributions at ``p_B_mm`` in the base, independent of each other.

    ``held_out_mm`` is the root mean square of the held-out errors, None where there are too few.
    """

    p_B_mm: tuple[float, float, float]
    rows: tuple[Contribution, ...]
    held_out_mm: float | None

    @property
    def total_mm(self) -> float:
        """Root of the sum of squares."""
        return float(np.sqrt(sum(r.mm**2 for r in self.rows)))

    @property
    def next(self) -> Contribution:
        """Return the source whose correction reduces the total most."""
        return max(self.rows, key=lambda r: (1.0 - r.left**2) * r.mm**2)

    @property
    def sentence(self) -> str:
        """What to reduce next, and what that gives."""
        n = self.next
        after = float(np.sqrt(max(self.total_mm**2 - (1.0 - n.left**2) * n.mm**2, 0.0)))
        return (
            f"Reduce next: {n.source} ({n.mm:.3f} of {self.total_mm:.3f} mm rms, {n.basis}). {n.remedy} The total then"
            f" falls to about {after:.3f} mm."
        )

    def document(self) -> dict[str, object]:
        """Return the JSON object."""
        return {
            "p_B_mm": list(self.p_B_mm),
            "total_rms_mm": self.total_mm,
            "held_out_rms_mm": self.held_out_mm,
            "rows": [{"source": r.source, "rms_mm": r.mm, "basis": r.basis, "remedy": r.remedy} for r in self.rows],
            "next": self.sentence,
        }


def error_budget(
    estimate: CalibrationEstimate,
    observations: Sequence[Observation],
    *,
    repeatability_m: float | None = None,
    flange_m: float = 0.063,
    scale_error: float | None = None,
    refined: str = "",
) -> ErrorBudget:
    """Return the budget at the middle of the inlier ``observations`` (as corrected), whose estimate this is.

    Measured: what is estimated (X_BC, correction) from its covariance, the part of the correction being what knowing it
    would take away; the noise of a scan from the fits; and, as the rest of the held-out errors, the arm's kinematics
    with what the correction's model lacks. ``repeatability_m``: the arm's data sheet; ``flange_m``: outer diameter;
    ``scale_error``: of a scanner that is not corrected, as the robot's motion shows it (else the usual one);
    ``refined``: the refinement that was applied. Derivation: docs/calibration.md, "Error budget".
    """
    kept = [o for o, keep in zip(observations, estimate.inliers, strict=True) if keep]
    middle = np.mean([o.p_BR for o in kept], axis=0)
    known = [np.trace(o.center_covariance) for o in kept if o.center_covariance is not None]
    noise2 = float(np.mean(known)) if known else 0.0
    repeat = _USUAL_REPEAT_M if repeatability_m is None else repeatability_m
    pose2, scanner2 = _estimated(estimate, middle)
    held = estimate.held_out.position_m[estimate.inliers]
    held = held[np.isfinite(held)]
    judged = len(held) >= 4
    whole2 = float(np.mean(held**2)) if judged else 3.0 * estimate.sigma_position_m**2 + noise2
    estimated2 = float(np.mean([sum(_estimated(estimate, o.p_BR)) for o in kept])) if judged else 0.0
    corrected = estimate.correction is not None
    if not corrected:
        off = np.array([o.p_BR for o in kept]) - middle
        scanner2 = (USUAL_SCALE if scale_error is None else scale_error) ** 2 * float((off**2).sum(axis=1).mean())
        if judged:
            scanner2 = min(scanner2, max(whole2 - noise2 - estimated2, 0.0))
    rest2 = max(whole2 - noise2 - repeat**2 - estimated2 - (0.0 if corrected else scanner2), 0.0)
    rows = (
        Contribution(
            "pose of the scanner, from these scans",
            1e3 * float(np.sqrt(pose2)),
            MEASURED,
            "Take twice as many scans, spread over the work space.",
            float(np.sqrt(0.5)),
        ),
        Contribution(
            "distortion of the scanner",
            1e3 * float(np.sqrt(scanner2)),
            MEASURED if corrected or scale_error is not None else ASSUMED,
            (
                "Take twice as many scans, over the whole field of view and range."
                if corrected
                else "Show the hole circle in six scans and more, so that the correction can be estimated."
            ),
            float(np.sqrt(0.5)) if corrected else 0.3,
        ),
        Contribution(
            "noise of one scan",
            1e3 * float(np.sqrt(noise2)),
            MEASURED if known else ASSUMED,
            "Average four scans of each pose, or come closer.",
            0.5,
        ),
        Contribution(
            "repeatability of the arm",
            1e3 * repeat,
            SHEET if repeatability_m is not None else ASSUMED,
            "Approach from the same side, and weld at the speed of the calibration.",
            0.7,
        ),
        Contribution(
            "kinematics of the arm and distortion beyond the correction"
            + (f", after --refine {refined}" if refined else ""),
            1e3 * float(np.sqrt(rest2)),
            MEASURED,
            "Calibrate among poses like those of the work, closer together." if refined else _REFINE,
            0.7 if refined else 0.5,
        ),
        Contribution(
            f"temperature, {_WARMING_K:.0f} K since the calibration",
            1e3 * _EXPANSION * _WARMING_K * float(np.linalg.norm(middle)),
            ASSUMED,
            "Warm the arm up for half an hour before the calibration and the work, and let weldcal monitor follow.",
            0.3,
        ),
        Contribution(
            "tolerance of the flange",
            1e3 * float(np.sqrt(2.0 / 12.0)) * _tolerance(flange_m),
            ASSUMED,
            "Turn the flange by 90 degrees and more between the scans.",
            0.5,
        ),
    )
    p = tuple(1e3 * float(v) for v in middle)
    return ErrorBudget((p[0], p[1], p[2]), rows, 1e3 * float(np.sqrt(whole2)) if judged else None)


_REFINE = "Use --refine joints with joint angles and turned poses, or --refine local where poses are close together."


def _estimated(estimate: CalibrationEstimate, p_B: Array) -> tuple[float, float]:
    """Return squared errors (m^2) of a point at p_B (3,) m from the pose with the scanner's factors known.

    The second part is what not knowing them adds.
    """
    whole = float(np.trace(point_error_covariance(estimate, p_B)))
    if estimate.joint is None or estimate.scanner is None:
        return whole, 0.0
    S = estimate.joint
    known = S[:6, :6] - S[:6, 6:] @ np.linalg.pinv(S[6:, 6:]) @ S[6:, :6]
    J = np.hstack([-skew(np.asarray(p_B) - estimate.X_BC.translation()), np.eye(3)])
    pose2 = min(float(np.trace(J @ known @ J.T)), whole)
    return pose2, whole - pose2


def _tolerance(diameter_m: float) -> float:
    """Width (m) of the tolerance of grade 8 at a diameter.

    ISO 286-1: 25 i, i = 0.45 D^(1/3) + 0.001 D in um, D in mm.
    """
    D = 1e3 * diameter_m
    return float(1e-6 * _IT8 * (0.45 * D ** (1.0 / 3.0) + 1e-3 * D))
