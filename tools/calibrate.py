"""`weldcal calibrate DATASET`: from a folder of scans to X_BC, its uncertainty, and a report; written whole or not at
all."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.advice import sampling_advice
from weldcal.calibration.dataset import Dataset, load_dataset
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.flange_fit import FlangeFit
from weldcal.calibration.holes import HolePattern
from weldcal.calibration.observability import turn_deg
from weldcal.calibration.observation import Observation
from weldcal.calibration.result import (
    CalibrationResult,
    IcpRecord,
    PoseRecord,
    export_all,
    matrix4,
    save_result,
    software_version,
)
from weldcal.calibration.self_calibration import SelfCalibration, apply_self_calibration, calibrate_corrected
from weldcal.calibration.sightings import see_flanges
from weldcal.calibration.solve import CalibrationEstimate, SolveConfig, estimate_eye_on_base
from weldcal.calibration.validation import (
    Algorithm1Run,
    Convergence,
    convergence,
    k_fold,
    position_errors,
    run_algorithm1,
)
from weldcal.calibration.verification import (
    CentreVerification,
    Sight,
    Verification,
    Verifier,
    icp_error,
    make_verification,
    sight,
)
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.tools.report.features import feature_residuals
from weldcal.tools.report.plots_calibration import calibration_report
from weldcal.tools.report.render import write_atomic

Array = NDArray[np.float64]
_TURN_DEG = 3.0  # orientations closer than this are one orientation to a calibration
Progress = Callable[[str, float], None]
"""Told what is being done and which fraction of the whole is behind us (0 to 1)."""


@dataclass(frozen=True)
class Algorithm1Outcome:
    """Algorithm 1 on the same data: its own figure beside the truth on poses outside its pool, and the figure's blind
    spots.

    ``verification``: id of the pose held out for it. ``figure_mm`` is what Algorithm 1 reports; ``true_mm`` the errors
    at the flange on poses it did not use; ``unseen`` the components of a true error of which less than half enters the
    figure.
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
        blind = f" ({self.metric}); it cannot see: {'; '.join(self.unseen)}" if self.unseen else f" ({self.metric})"
        return (
            f"Algorithm 1 reports {self.figure_mm:.3f} mm at its verification pose {self.verification}{blind}. "
            f"Its true error on poses it did not use: {self.true_mm['median']:.3f} mm median."
        )


@dataclass(frozen=True)
class CalibrationReport:
    """What a run of the job leaves: the estimate, the records written, and where. ``observations`` carry the scanner
    correction where one was accepted."""

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

    def summary(self) -> dict[str, Any]:
        """The JSON object of `--json` (keys of the design's "calibrate" line, and Algorithm 1's figure beside them)."""
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
            "tilt_deg": r.tilt_deg,
            "outliers": list(self.outliers),
            "warnings": list(r.warnings),
            "unobservable": list(r.unobservable),
            "seconds": self.seconds,
            "k_fold_mm": self.k_fold_mm,
            "advice": list(self.advice),
            "features": feature_residuals(self.fits, self.patterns),
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


def calibrate_dataset(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    centres: bool = False,
    correct_scanner: bool = True,
) -> CalibrationReport:
    """Calibrate from a dataset folder and write ``calibration.yaml``, exports and ``report.html`` to ``out``.

    ``robot`` and ``flange`` override dataset.yaml. ``progress`` is told (stage, fraction). ``centres`` also writes
    centres.csv (camera frame, metres, uncorrected). Without ``correct_scanner`` the scanner is taken as it is. Nothing
    is written unless the calibration succeeded. Raises InputError (one sentence) for bad data; a cloud that cannot be
    used is refused by name and reported, as long as enough remain.
    """
    started = time.monotonic()
    tell: Progress = progress or (lambda stage, fraction: None)
    if Path(out).exists() and not Path(out).is_dir():
        raise InputError(f"'{out}' is a file; give a folder for the result.")
    data = load_dataset(Path(folder))
    standard = get_flange(flange or data.header.flange)
    seen = see_flanges(data, standard, seed=seed, tell=lambda fraction: tell("fitting flanges", 0.7 * fraction))
    observations, fits, clouds, refused = list(seen.observations), seen.fits, seen.clouds, list(seen.refused)
    _enough(observations, refused, data)
    tell("solving", 0.7)
    estimate = estimate_eye_on_base(observations, SolveConfig(seed=seed))
    tell("judging the scanner", 0.72)
    scanner, corrected, estimate = apply_self_calibration(
        observations, estimate, seen.patterns, seed=seed, wanted=correct_scanner
    )
    outliers = tuple(o.id for o, keep in zip(observations, estimate.inliers, strict=True) if not keep)
    errors = dict(zip((o.id for o in observations), estimate.position_residuals_m, strict=True))
    refused += [
        (i, f"Its centre disagrees by {1e3 * errors[i]:.1f} mm with the other poses; it was left out.")
        for i in outliers
    ]
    inliers = [o for o, keep in zip(observations, estimate.inliers, strict=True) if keep]
    tell("cross-validating", 0.75)
    folds = (
        k_fold(
            inliers,
            folds=min(5, len(inliers)),
            repeats=5,
            seed=seed,
            solve=None
            if scanner is None or scanner.accepted is None
            else lambda poses: calibrate_corrected(poses, seen.patterns, seed=seed),
        )
        if len(inliers) >= 6
        else np.full((1, 1), np.nan)
    )
    tell("Algorithm 1 for comparison", 0.8)
    algorithm1, verifier, icp = _algorithm1(observations, inliers, clouds, fits, standard, seed)
    curve = convergence(inliers, verifier, orders=8, seed=seed)
    warnings = list(estimate.warnings)
    if turn_deg([o.X_BR for o in inliers]) < _TURN_DEG:
        warnings.append(
            "The poses hardly differ in orientation: a constant error of the flange centre would not show in these "
            "figures."
        )
    if scanner is not None and scanner.worth_saying:
        warnings.append(scanner.sentence)
    correction = None if scanner is None or scanner.accepted is None else scanner.accepted.document()
    result = CalibrationResult(
        X_BC=estimate.X_BC,
        covariance=estimate.covariance,
        held_out_mm=_summary(1e3 * estimate.held_out.position_m[estimate.inliers]),
        tilt_deg=_tilts(estimate),
        poses=_pose_records(observations, estimate, refused),
        icp=icp,
        unobservable=estimate.unobservable,
        warnings=tuple(warnings),
        robot=robot or data.header.robot,
        flange=standard.designation,
        scanner=data.header.scanner,
        sigma_position_mm=1e3 * estimate.sigma_position_m,
        sigma_normal_deg=float(np.degrees(estimate.sigma_normal_rad)) if fits else 0.0,
        seed=seed,
        data_hashes=data.hashes,
        scanner_correction=correction,
        software=software_version(),
    )
    report = CalibrationReport(
        result,
        estimate,
        tuple(corrected),
        scanner,
        fits,
        tuple(refused),
        outliers,
        algorithm1,
        curve,
        _summary(1e3 * folds[np.isfinite(folds)]),
        time.monotonic() - started,
        Path(out),
        sampling_advice(estimate, corrected),
        seen.patterns,
    )
    tell("writing the report", 0.95)
    html = calibration_report(report, dataset=Path(folder).name)
    write_atomic(Path(out) / "report.html", html)
    export_all(result, Path(out))
    if centres:
        write_atomic(Path(out) / "centres.csv", _centres_csv(observations))
    # last, so that its presence means that everything else is there
    save_result(result, Path(out))
    report = replace(report, seconds=time.monotonic() - started)
    tell("done", 1.0)
    return report


def _enough(observations: list[Observation], refused: list[tuple[str, str]], data: Dataset) -> None:
    if observations and len(observations) >= 4:
        return
    n = len(observations)
    if n == 0:
        same = len({r for _, r in refused}) == 1 and len(refused) > 1
        which = "every cloud" if same else f"the first, {refused[0][0]}"
        raise InputError(f"None of the {len(refused)} clouds can be used; for {which}: {refused[0][1]}")
    if refused:
        names = "; ".join(f"{i}: {t}" for i, t in refused[:3])
        raise TooFewPoses(
            f"Only {n} usable poses remain of {n + len(refused)}, at least 4 are needed; refused were {names}"
        )
    raise TooFewPoses(
        f"The dataset has {n} poses; a calibration needs at least 4 whose flange centres do not lie in one plane."
    )


def _algorithm1(
    observations: list[Observation],
    inliers: list[Observation],
    clouds: dict[str, Array],
    fits: dict[str, FlangeFit],
    standard: FlangeStandard,
    seed: int,
) -> tuple[Algorithm1Outcome | None, Verifier | None, tuple[IcpRecord, ...]]:
    """Algorithm 1 with one pose held out for verification: the one nearest the middle, where the arm will
    mostly work."""
    if len(inliers) < 6:
        return None, None, ()
    middle = np.median([o.p_BR for o in inliers], axis=0)
    held = min(inliers, key=lambda o: (float(np.linalg.norm(o.p_BR - middle)), o.id))
    pool = [o for o in observations if o.id != held.id]
    good = [o for o in inliers if o.id != held.id]
    ours = estimate_eye_on_base(good, SolveConfig(seed=seed, leave_one_out=False)).X_BC
    icp: list[IcpRecord] = []
    shares: Sight | None = None
    verifier: Verifier
    if clouds:
        as_published = make_verification(clouds[held.id], held.X_BR, standard, max_points=1500, seed=seed)
        verifier = as_published
        metric = "point-to-point ICP of the verification cloud against the flange's model"
        shares = sight(ours, as_published)
        for v in (as_published, replace(as_published, method="point_to_plane")):
            icp.append(_icp_record(held, ours, v))
        unseen = shares.unseen
    else:
        verifier = CentreVerification(held)
        metric = "distance of the verification pair's centre, in place of the ICP, as there are no clouds"
        unseen = ("every rotation (one centre has none)", "the error at any other pose")
    run = run_algorithm1(pool, verifier)
    if run is None:
        return None, verifier, tuple(icp)
    true = run.true_errors[[o.id in {g.id for g in good} for o in pool if o.id not in run.pool]]
    outcome = Algorithm1Outcome(
        held.id,
        metric,
        1e3 * run.cost,
        _summary(1e3 * true),
        1e3 * float(position_errors(run.X_BC, [held])[0]),
        unseen,
        tuple(float(s) for s in shares.share) if shares is not None else (),
        run,
    )
    return outcome, verifier, tuple(icp)


def _icp_record(held: Observation, X_BC: RigidTransform, verification: Verification) -> IcpRecord:
    """The published figure for our own calibration, made without the verification pose."""
    error = icp_error(X_BC, verification)
    return IcpRecord(
        id=held.id,
        method=verification.method,
        rotation_deg=tuple(float(v) for v in np.degrees(error.value[:3])),
        translation_mm=tuple(float(v) for v in 1e3 * error.value[3:]),
        translation_norm_mm=float(1e3 * np.linalg.norm(error.value[3:])),
        unseen=sight(X_BC, verification).unseen,
        true_error_mm=float(1e3 * position_errors(X_BC, [held])[0]),
    )


def _summary(values: Array) -> dict[str, float]:
    v = np.asarray(values, dtype=float)
    v = v[np.isfinite(v)]
    if len(v) == 0:
        return {"median": float("nan"), "mean": float("nan"), "p95": float("nan"), "max": float("nan")}
    return {
        "median": float(np.median(v)),
        "mean": float(v.mean()),
        "p95": float(np.percentile(v, 95)),
        "max": float(v.max()),
    }


def _tilts(estimate: CalibrationEstimate) -> dict[str, float | None]:
    s = _summary(np.degrees(estimate.held_out.tilt_rad[estimate.inliers]))
    return {k: s[k] if np.isfinite(s[k]) else None for k in ("median", "p95")}


def _pose_records(
    observations: list[Observation], estimate: CalibrationEstimate, refused: list[tuple[str, str]]
) -> tuple[PoseRecord, ...]:
    reasons = dict(refused)
    records = []
    for k, o in enumerate(observations):
        tilt, held_tilt = (float(np.degrees(t[k])) for t in (estimate.tilt_residuals_rad, estimate.held_out.tilt_rad))
        records.append(
            PoseRecord(
                o.id,
                bool(estimate.inliers[k]),
                reasons.pop(o.id, ""),
                float(1e3 * estimate.position_residuals_m[k]),
                float(1e3 * estimate.held_out.position_m[k]),
                tilt if np.isfinite(tilt) else None,
                held_tilt if np.isfinite(held_tilt) else None,
            )
        )
    return (*records, *(PoseRecord(i, False, t) for i, t in reasons.items()))


def _centres_csv(observations: list[Observation]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["id", "centre_x", "centre_y", "centre_z", "normal_x", "normal_y", "normal_z"])
    for o in observations:
        normal = ["", "", ""] if o.n_C is None else [f"{v:.9f}" for v in o.n_C]
        writer.writerow([o.id, *(f"{v:.9f}" for v in o.p_CR), *normal])
    return stream.getvalue()


__all__ = ["Algorithm1Outcome", "CalibrationReport", "calibrate_dataset"]
