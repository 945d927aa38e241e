"""The error budget of a calibration.

What each source contributes to the error at the work point, and what to reduce next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import skew
from weldcal.models.arrays import Array

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
