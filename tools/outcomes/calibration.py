"""The results that the reports of `calibrate` and `verify` show, and their JSON objects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import RESULT_FILE, CalibrationResult, correction_note, matrix4
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.nested import bootstrap_interval, mean_interval
from weldcal.calibration.eye_on_base.self_calibration import SelfCalibration
from weldcal.calibration.eye_on_base.solve import CalibrationEstimate
from weldcal.calibration.eye_on_base.validation import Algorithm1Run, Convergence
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.budget import USUAL_SCALE, ErrorBudget, error_budget
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.models.robots import get_robot
from weldcal.tools.outcomes.first_screen import (
    CARE,
    DO_NOT,
    ENOUGH_UNSEEN,
    USE,
    Expected,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    refused_note,
    work_point_expected,
)
from weldcal.tools.outcomes.poses import SCANNER, WorkPoint, work_point_error

__all__ = ["CARE", "DO_NOT", "NONE", "USE", "CalibrationReport", "Verdict", "VerifyReport", "error_summary"]


def error_summary(values: Array) -> dict[str, float]:
    """Median, mean, 95th percentile and maximum of the finite values (n,), in their unit; NaN where there are none."""
    v = np.asarray(values, dtype=float)
    v = v[np.isfinite(v)]
    if len(v) == 0:
        return dict.fromkeys(("median", "mean", "p95", "max"), float("nan"))
    return {
        "median": float(np.median(v)),
        "mean": float(v.mean()),
        "p95": float(np.percentile(v, 95)),
        "max": float(v.max()),
    }


@dataclass(frozen=True, kw_only=True)
class Algorithm1Outcome:
    """Algorithm 1 on the same data: its reported figure, its errors at unused poses, and what the figure is insensitive to.

    ``verification``: id of the pose held out for it. ``figure_mm``: reported by Algorithm 1; ``true_mm``: its errors at the
    flange at unused poses; ``unseen``: components of a true error of which less than half appears in the figure.
    """

    verification: str
    metric: str
    figure_mm: float
    true_mm: dict[str, float]
    at_verification_mm: float
    unseen: tuple[str, ...]
    shares: tuple[float, ...]
    run: Algorithm1Run

    @property
    def sentence(self) -> str:
        """One sentence for the terminal."""
        blind = f" ({self.metric}), insensitive to: {'; '.join(self.unseen)}" if self.unseen else f" ({self.metric})"
        return (
            f"Algorithm 1 reports {self.figure_mm:.3f} mm at its verification pose {self.verification}{blind}. "
            f"Its error at unused poses: {self.true_mm['median']:.3f} mm median."
        )


@dataclass(frozen=True, kw_only=True)
class CalibrationReport:
    """The result of `weldcal calibrate`: the estimate, the records written, and the folder. ``observations`` include the
    scanner correction where one was accepted; ``notes`` say in which form the dataset was read; ``limit_mm`` is the error that the
    job allows (None: not stated)."""

    result: CalibrationResult
    estimate: CalibrationEstimate
    observations: tuple[Observation, ...]
    scanner: SelfCalibration | None
    fits: dict[str, FlangeFit]
    refused: tuple[tuple[str, str], ...]
    outliers: tuple[str, ...]
    algorithm1: Algorithm1Outcome | None
    convergence: Convergence
    k_fold_mm: dict[str, float]
    seconds: float
    out: Path
    advice: tuple[str, ...] = ()
    patterns: dict[str, HolePattern] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    refinement: dict[str, Any] | None = None
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen. The error is the larger of two at 95 %: the calibration's own at the work point, and the held-out one."""
        r, work = self.result, self.work_point
        said = self._remarks
        # what is not observable and matters to X_BC is among the warnings
        concerns = [text for text in r.warnings if text not in said]
        expected, figure = work_point_expected(work)
        tolerance = None
        if self.limit_mm is not None:
            tolerance = Tolerance("the error at the work point, 95 %,", figure, self.limit_mm, "--limit-mm")
        corrected = correction_note(r, self.out / RESULT_FILE)
        notes = [*filter(None, (corrected,)), *refused_note(self.refused, len(r.poses)), *self._refined]
        found = Findings(tolerance=tolerance, unseen=work.unseen_poses, concerns=concerns, notes=notes)
        return FirstScreen(found, expected, self._next(tolerance, concerns), (scanner_pose(r),))

    @property
    def _remarks(self) -> list[str]:
        """Those of the warnings that tell what was done, not what could be wrong."""
        applied = self.scanner is not None and self.scanner.accepted is not None
        return [*([self.scanner.sentence] if applied and self.scanner is not None else []), *self._refined]

    @property
    def _refined(self) -> list[str]:
        """What --refine found and applied."""
        return [] if self.refinement is None else [str(self.refinement["sentence"])]

    def _next(self, tolerance: Tolerance | None, concerns: Sequence[str]) -> Next:
        missed = tolerance is not None and not tolerance.met
        if self.advice and (missed or self.work_point.unseen_poses < ENOUGH_UNSEEN):
            return Next(f"{' '.join(self.advice[:2])} Then calibrate again.")
        if concerns:
            return Next(
                "See what disturbs the scans, then verify on scans that the calibration has not seen.",
                f"weldcal doctor {self.out}",
            )
        return Next("Take four or more new scans, and verify with them.", f"weldcal verify {self.out} NEW_SCANS")

    @property
    def work_point(self) -> WorkPoint:
        """The expected error at the middle of the flange centres that were used."""
        used = [o.p_BR for o, keep in zip(self.observations, self.estimate.inliers, strict=True) if keep]
        return work_point_error(self.estimate, np.mean(used, axis=0))

    @property
    def budget(self) -> ErrorBudget:
        """What contributes to the error at the work point."""
        try:
            repeatability_m = get_robot(self.result.robot).repeatability_m
        except InputError:
            repeatability_m = None  # an arm of the user's own
        refinement = self.refinement or {}
        motion = None if self.scanner is None else self.scanner.motion
        scale = None if motion is None else float(np.hypot(motion.values[0] - 1.0, motion.sigma[0]))
        return error_budget(
            self.estimate,
            self.observations,
            repeatability_m=repeatability_m,
            scale_error=scale if scale is not None and scale < USUAL_SCALE else None,
            flange_m=get_flange(self.result.flange).outer_m,
            refined=str(refinement["kind"]) if refinement.get("accepted") else "",
        )

    @property
    def interval_rows(self) -> dict[str, str]:
        """Rows for the terminal: the held-out figures, each with its bootstrap interval."""
        return interval_rows("held-out error", 1e3 * self.estimate.held_out.position_m[self.estimate.inliers])

    @property
    def held_out_interval_mm(self) -> tuple[float, float] | None:
        """Interval (mm) that holds the mean error of as many new scans with 95 % probability; None for fewer than four errors."""
        return mean_interval(1e3 * self.estimate.held_out.position_m[self.estimate.inliers])

    def summary(self) -> dict[str, Any]:
        """The JSON object of `calibrate`."""
        interval = self.held_out_interval_mm
        r = self.result
        a = self.algorithm1
        return {
            "state": "done",
            "n_used": int(self.estimate.inliers.sum()),
            "refused": [{"id": i, "reason": t} for i, t in self.refused],
            "X_BC": matrix4(r.X_BC),
            "covariance": r.covariance.tolist(),
            "scanner_correction": r.scanner_correction,
            "held_out_mm": {k: r.held_out_mm[k] for k in ("median", "mean", "p95")},
            "held_out_interval_mm": None if interval is None else list(interval),
            "tilt_deg": r.tilt_deg,
            "outliers": list(self.outliers),
            "warnings": list(r.warnings),
            "unobservable": list(r.unobservable),
            "seconds": self.seconds,
            "k_fold_mm": self.k_fold_mm,
            "axis_turn_deg": None if r.axis_turn_deg is None else list(r.axis_turn_deg),
            "advice": list(self.advice),
            "notes": list(self.notes),
            "work_point": self.work_point.document(),
            "error_budget": self.budget.document(),
            "features": feature_residuals(self.fits, self.patterns),
            **({} if self.refinement is None else {"refinement": self.refinement}),
            "algorithm1": None
            if a is None
            else {
                "verification": a.verification,
                "metric": a.metric,
                "figure_mm": a.figure_mm,
                "true_mm": a.true_mm,
                "at_verification_mm": a.at_verification_mm,
                "unseen": list(a.unseen),
            },
        }


def scanner_pose(result: CalibrationResult) -> ShownPose:
    """The result's pose with its frames in words."""
    return ShownPose(result.symbol, SCANNER[result.symbol], result.X_BC)


def interval_rows(what: str, errors_mm: Array) -> dict[str, str]:
    """Median and 95 % of errors (n,) mm, each beside the interval of as many new ones; {} for fewer than four."""
    rows = {}
    for name, share in (("median", 0.5), ("95 %", 0.95)):
        interval = bootstrap_interval(errors_mm, share)
        if interval is not None:
            reported = float(np.nanquantile(errors_mm, share))
            rows[f"{what}, {name}"] = f"{reported:.3f} mm (bootstrap 95 %: {interval[0]:.3f} to {interval[1]:.3f})"
    return rows


@dataclass(frozen=True)
class PoseError:
    """One scan: distance (mm) between the flange centres by calibration and by robot, angle (deg) between the face normals
    (None where none was seen), and whether the calibration used this scan."""

    id: str
    error_mm: float
    tilt_deg: float | None
    used_before: bool


NONE = "not a verification"


@dataclass(frozen=True)
class Verdict:
    """The verdict of a verification (one of the four above), its limit for the median of the new scans in mm (None: the calibration
    states none) and the reason, a sentence."""

    verdict: str
    limit_mm: float | None
    reason: str

    @property
    def tone(self) -> str:
        """The report's colour."""
        return {USE: "good", DO_NOT: "bad"}.get(self.verdict, "warn")


@dataclass(frozen=True, kw_only=True)
class VerifyReport:
    """The result of a verification. ``observations`` include the scanner correction where the result has one."""

    result: CalibrationResult
    correction: ScannerCorrection | None
    observations: tuple[Observation, ...]
    fits: dict[str, FlangeFit]
    poses: tuple[PoseError, ...]
    refused: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    hashes: dict[str, str]
    out: Path
    verdict: Verdict
    source: str = ""
    dataset: str = "NEW_SCANS"

    @property
    def first(self) -> FirstScreen:
        """The first screen; its verdict is this command's own, on the new scans. What is no verification says so."""
        v, r = self.verdict, self.result
        new = np.array([p.error_mm for p in self.poses if not p.used_before])
        reason = f"This is no verification. {v.reason}" if v.verdict == NONE else v.reason
        settled = (CARE if v.verdict == NONE else v.verdict, reason)
        tolerance = None
        if v.limit_mm is not None and len(new):
            tolerance = Tolerance("the median error of the new scans", float(np.median(new)), v.limit_mm, self.source)
        found = Findings(
            tolerance=tolerance,
            unseen=len(new),
            concerns=self.warnings,
            notes=tuple(filter(None, (correction_note(r, RESULT_FILE),))),
            settled=settled,
        )
        if len(new):
            what = f"{len(new)} new scan{'' if len(new) == 1 else 's'}, which the calibration did not use"
            expected = Expected(
                "error at the flange, 95 %",
                f"{np.percentile(new, 95):.3f} mm",
                f"of {what}; median {np.median(new):.3f} mm",
            )
        else:
            expected = Expected("error at the flange, 95 %", "not known", "every scan here was used in the calibration")
        return FirstScreen(found, expected, self._next(), (scanner_pose(r),))

    def _next(self) -> Next:
        v = self.verdict
        if v.verdict == USE:
            return Next("Use X_BC. Verify again after any knock, and after work at the robot or the scanner.")
        if v.verdict == DO_NOT:
            return Next("See what has changed, then calibrate again.", f"weldcal doctor {self.dataset}")
        if v.verdict == NONE or sum(not p.used_before for p in self.poses) < ENOUGH_UNSEEN:
            return Next("Take four or more new scans across the work space, and verify with them.")
        return Next("Settle what could be wrong, then verify again.", f"weldcal doctor {self.dataset}")

    @property
    def position_error_mm(self) -> dict[str, float]:
        """Median, mean, 95th percentile and largest position error, mm."""
        return error_summary(np.array([p.error_mm for p in self.poses]))

    @property
    def interval_rows(self) -> dict[str, str]:
        """Rows for the terminal: median and 95 % of the errors, each with its bootstrap interval."""
        return interval_rows("error", np.array([p.error_mm for p in self.poses]))

    @property
    def tilt_deg(self) -> dict[str, float | None]:
        """Median and 95th percentile of the tilt, deg; None where no normal was seen."""
        found = error_summary(np.array([p.tilt_deg for p in self.poses], dtype=float))
        return {key: found[key] if np.isfinite(found[key]) else None for key in ("median", "p95")}

    def summary(self) -> dict[str, Any]:
        """The JSON object of `verify`. A refused scan is named in the warnings."""
        return {
            "state": "done",
            "verdict": self.verdict.verdict,
            "limit_mm": self.verdict.limit_mm,
            "reason": self.verdict.reason,
            "position_error_mm": self.position_error_mm,
            "tilt_deg": self.tilt_deg,
            "per_pose": [{"id": p.id, "error_mm": p.error_mm, "tilt_deg": p.tilt_deg} for p in self.poses],
            "warnings": list(self.warnings),
        }


def feature_residuals(
    fits: Mapping[str, FlangeFit], patterns: Mapping[str, HolePattern]
) -> list[dict[str, float | int | str | None]]:
    """One row per scan: rms residual (mm) of plane, outer edge, bore (None where not seen) and of the hole centres from
    their pattern (None where fewer than four show), and one sigma (deg) of the rotation about the flange's axis."""
    rows: list[dict[str, float | int | str | None]] = []
    for id, fit in fits.items():
        holes = patterns.get(id)
        rows.append(
            {
                "id": id,
                "plane_mm": 1e3 * fit.plane_rms_m,
                "outer_mm": 1e3 * fit.outer_rms_m,
                "bore_mm": None if fit.bore_rms_m is None else 1e3 * fit.bore_rms_m,
                "holes": 0 if holes is None else len(holes.holes_C),
                "holes_mm": None if holes is None else 1e3 * holes.rms_m,
                "turn_sigma_deg": None if holes is None else float(np.degrees(holes.turn_sigma)),
            }
        )
    return rows
