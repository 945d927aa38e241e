"""Simulated calibrations without rendering: errors of arms and scanners, and shares of 95 % regions with the truth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform
from scipy.stats import binom, chi2

from tests.figures.harness import Run, figure
from tests.worlds import wrong_models
from tests.worlds.light_runs import study_light_runs
from tests.worlds.wrong_models import (
    as_measured,
    judged,
    measured_by_a_wrong_scanner,
    simulated_observations,
    station,
    study_station,
)
from weldcal.calibration.calibrate import PLAIN, Steps, calibrate
from weldcal.calibration.data.results import statistics
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, corrected_observation, with_scanner
from weldcal.calibration.eye_on_base.scanner_fit import from_motion
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base, point_error_covariance
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.report.pictures import subplots, svg
from weldcal.tools.report.render import fixed

LEVEL = 0.95
_ARM_M = 1.5e-4  # per axis, what recorded arms leave of a calibration
WORK_C = np.array([0.02, -0.05, 0.72])
"""The work point (3,) m in the camera."""
Calibrated = tuple[CalibrationEstimate, RigidTransform, Array]
"""An estimate, the true X_BC, and where the estimate puts the work point (3,) m in B."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How often ``runs`` calibrations from ``poses`` observations have the truth in the stated 95 % region.

    Of X_BC (six dimensions) and of a point at the work point (three); held-out over true error at the flange, both
    means over the runs, with the noise of the held-out scan in both (NaN where that was not looked at).
    ``corrected``: with a scanner that is off in scale and gradient, and its correction; ``warped``: with one that
    errs by another model.
    """

    poses: int
    runs: int
    pose: float
    point: float
    held_out_over_true: float
    corrected: bool = False
    warped: bool = False

    def chance(self) -> tuple[float, float]:
        """Shares between which 99 % of such studies fall where the regions are exact."""
        low, high = (binom.ppf(q, self.runs, LEVEL) / self.runs for q in (0.005, 0.995))
        return float(low), float(high)


def study_coverage(poses: int, runs: int, seed: int = 0, progress: Progress = no_progress) -> Coverage:
    """Calibrate ``runs`` times from ``poses`` simulated observations. Deterministic for ``seed``."""
    stated, true = [], []

    def calibrate(k: int) -> Calibrated:
        observations, X_BC = simulated_observations(poses, np.random.default_rng([seed, poses, k]))
        estimate = estimate_eye_on_base(observations, SolveConfig(seed=seed, hypotheses=60))
        # the same noise as an observation of this run has, at a place that it did not use
        other = np.random.default_rng([seed, poses, k, 2])
        place = other.uniform(np.array([-0.18, -0.13, 0.5]), np.array([0.18, 0.13, 0.9]))
        seen = place + 1e-4 * other.standard_normal(3) + 4e-5 * other.standard_normal(3)
        true.append(float(np.linalg.norm(estimate.X_BC @ seen - X_BC @ place)))
        stated.extend(estimate.held_out.position_m.tolist())
        return estimate, X_BC, estimate.X_BC @ WORK_C

    pose, point = _inside(calibrate, f"calibrations from {poses} scans", runs, progress)
    return Coverage(
        poses=poses,
        runs=runs,
        pose=pose,
        point=point,
        held_out_over_true=float(np.mean(stated) / np.mean(true)) if runs else np.nan,
    )


def study_corrected(poses: int, runs: int, seed: int = 0, progress: Progress = no_progress) -> Coverage:
    """As study_coverage, with a scanner that is off and a correction from the same observations.

    Deterministic for ``seed``.
    """

    def calibrate(k: int) -> Calibrated:
        rng = np.random.default_rng([seed, poses, k, 3])
        exact, X_BC = simulated_observations(poses, rng)
        observations, patterns = measured_by_a_wrong_scanner(exact, rng)
        rigid = estimate_eye_on_base(observations, SolveConfig(seed=seed, hypotheses=60, leave_one_out=False))
        found = from_motion(observations, patterns, usual=True, start=rigid.X_BC)
        assert found.X_BC is not None
        estimate = with_scanner(rigid, found.correction, found.X_BC, found.joint, found.redundancy)
        return estimate, X_BC, estimate.X_BC @ found.correction.points(as_measured(WORK_C))

    pose, point = _inside(calibrate, f"corrected calibrations from {poses} scans", runs, progress)
    return Coverage(poses=poses, runs=runs, pose=pose, point=point, held_out_over_true=float("nan"), corrected=True)


def _inside(
    calibrate: Callable[[int], Calibrated], name: str, runs: int, progress: Progress, work_C: Array = WORK_C
) -> tuple[float, float]:
    """Shares of calibrations whose 95 % regions of X_BC and of the work point hold the truth."""
    inside = np.zeros(2)
    for k in range(runs):
        if k % 20 == 0:
            progress(name, k / runs)
        estimate, X_BC, found_BQ = calibrate(k)
        p_BQ = X_BC @ work_C
        turn = rotation_vector(X_BC.rotation() @ estimate.X_BC.rotation().inverse())
        e, d = np.concatenate([turn, X_BC.translation() - estimate.X_BC.translation()]), p_BQ - found_BQ
        inside[0] += float(e @ np.linalg.solve(estimate.covariance, e)) < chi2.ppf(LEVEL, 6)
        inside[1] += float(d @ np.linalg.solve(point_error_covariance(estimate, p_BQ), d)) < chi2.ppf(LEVEL, 3)
    pose, point = inside / max(runs, 1)
    return float(pose), float(point)


def coverage_picture(studies: list[Coverage]) -> bytes:
    """Shares inside their stated 95 % regions against the number of scans, and the band in which exact regions fall."""
    figure, axes = subplots(8.2, 3.6, 1, 2, sharey=True)
    low, high = studies[0].chance()
    for ax, corrected, title in zip(
        axes, (False, True), ("an exact scanner", "a scanner off by 0.2 %, corrected"), strict=True
    ):
        chosen = [s for s in studies if s.corrected == corrected and not s.warped]
        n = [s.poses for s in chosen]
        ax.axhspan(100 * low, 100 * high, color="#1d5f8a", alpha=0.10, linewidth=0)
        ax.axhline(95.0, color="#444", linewidth=1, linestyle="--")
        ax.plot(n, [100 * s.pose for s in chosen], color="#1d5f8a", marker="o", label="X_BC")
        ax.plot(n, [100 * s.point for s in chosen], color="#b08a2e", marker="s", label="the work point")
        ax.set(xticks=n, xlabel="number of scans")
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_ylim(88.0, 100.0)
    axes[0].set_ylabel("inside the stated 95 % region, %")
    axes[0].legend(frameon=False, fontsize=9, loc="lower right")
    return svg(figure, *axes)


def study_warped(poses: int, runs: int, progress: Progress = no_progress) -> Coverage:
    """Calibrate ``runs`` devices, each with a warp of its own, from ``poses`` scans each."""
    stated, true = [], []

    def calibrate(device: int) -> Calibrated:
        _, estimate = wrong_models.calibrate_warped(device, poses)
        seen = wrong_models.warped_point(wrong_models.WORK_C, device)
        stated.append(float(np.mean(estimate.held_out.position_m)))
        true.append(float(np.mean(wrong_models.new_errors(device, estimate))))
        found = seen if estimate.correction is None else estimate.correction.points(seen)
        return estimate, wrong_models.X_BC, estimate.X_BC @ found

    name = f"calibrations of {poses} scans by a warped scanner"
    pose, point = _inside(calibrate, name, runs, progress, wrong_models.WORK_C)
    return Coverage(
        poses=poses,
        runs=runs,
        pose=pose,
        point=point,
        held_out_over_true=float(np.mean(stated) / np.mean(true)),
        corrected=True,
        warped=True,
    )


@figure("flange-honesty", "how often stated 95 % regions hold the truth, and held-out over true errors")
def honesty(run: Run) -> None:
    """Calibrate many times from few to many scans, with an exact, a corrected and a warped scanner."""
    runs = run.size(10, 500)
    studies = [study_coverage(n, runs, run.seed, run.progress) for n in (5, 6, 8, 12, 20)]
    studies += [study_corrected(n, runs, run.seed, run.progress) for n in (6, 8, 12, 20)]
    studies.append(study_warped(12, max(10, runs // 5), run.progress))
    run.write("coverage.svg", coverage_picture(studies))
    kinds = ("of another model" if s.warped else "corrected" if s.corrected else "exact" for s in studies)
    rows = (
        (str(s.poses), kind, f"{100 * s.pose:.1f} %", f"{100 * s.point:.1f} %", fixed(s.held_out_over_true))
        for s, kind in zip(studies, kinds, strict=True)
    )
    run.table("", ("scans", "scanner", "X_BC inside", "work point inside", "held-out over true error"), rows)


def study_stated(poses: int, warp_m: float, arm_m: float, runs: int, *, local: bool) -> tuple[float, float]:
    """Calibrate ``runs`` devices with an arm each as `weldcal calibrate` does, and measure on 60 new scans.

    Returns:
        mean error of the new scans (m), and how many times it is stated by the nested held-out errors.
    """
    stated, true = [], []
    for device in range(runs):
        observations, patterns = wrong_models.warped_observations(device, poses, 0, warp_m, arm_m)
        new, _ = wrong_models.warped_observations(device, 60, 1, warp_m, arm_m)
        found = calibrate(observations, Steps(patterns=patterns, refine="local" if local else PLAIN))
        correction, refined = found.correction, found.refined
        seen = new if correction is None else [corrected_observation(correction, o) for o in new]
        if refined is not None and refined.field is not None:
            seen = refined.field.applied(found.estimate.X_BC, seen)
        true.append(float(np.mean(position_errors(found.estimate.X_BC, seen))))
        stated.append(float(np.nanmean(found.estimate.held_out.position_m[found.estimate.inliers])))
    return float(np.mean(true)), float(np.mean(stated) / np.mean(true))


@figure("flange-stated", "the stated mean error over the true one, with errors of scanner and arm")
def stated(run: Run) -> None:
    """Measure how many times the true mean error of new scans is stated, in worlds of fifteen classes."""
    rows, ratios, runs = [], [], run.size(2, 34)
    for poses, local in (*((n, False) for n in (8, 12, 20, 30)), (20, True)):
        for warp_m in (2e-4, 8e-4, 1.6e-3):
            run.progress(f"{poses} scans", 0.0)
            true_m, ratio = study_stated(poses, warp_m, _ARM_M, runs, local=local)
            ratios.append(ratio)
            way = "local" if local else "plain"
            rows.append((str(poses), way, fixed(1e3 * warp_m, 1), fixed(1e3 * true_m), fixed(ratio, 2)))
    rows.append(("all", "", "", "", fixed(float(np.mean(ratios)), 2)))
    for poses in (10, 14, 20):
        true_m, ratio = study_stated(poses, 0.0, 3e-4 / np.sqrt(3.0), runs, local=False)
        rows.append((str(poses), "plain, arm of 0.3 mm", "0.0", fixed(1e3 * true_m), fixed(ratio, 2)))
    run.table("", ("scans", "way", "scanner off, mm", "true mean error, mm", "stated over true"), rows)


@figure("flange-arm", "cells with factory-size errors of the arm, calibrated from 20 planned scans, plain and refined")
def arm(run: Run) -> None:
    """Calibrate UR10e cells, and judge both ways on new scans."""
    f = judged([study_station(station(seed, links=True), "links") for seed in run.seeds(2, 40)])
    rows = (
        ("error at new scans, plain", f"{f['plain_mm']:.3f} mm mean"),
        ("error at new scans, refined", f"{f['refined_mm']:.3f} mm mean (ratio {f['ratio']:.2f})"),
        ("in the stated 95 % region", f"{f['inside_95_percent']:.1f} %"),
        ("joint offsets within 3 sigma", f"{f['offsets_within_3_sigma_percent']:.1f} %"),
    )
    run.table("", ("", "found"), rows)


@figure("flange-imperfect", "live calibrations with an imperfect scanner and arm, without rendering")
def imperfect(run: Run) -> None:
    """Measure errors at the work point, and how often they lie in the stated 95 % region."""
    found = study_light_runs(load_scenario("s_groove"), run.size(10, 200), seed=run.seed, progress=run.progress)
    ours, rigid = (statistics(1e3 * v, "mean", "rms", "p95", "max") for v in (found.error_m, found.rigid_m))
    low, high = found.chance()
    expected = 1e3 * np.sqrt(np.mean(found.expected_m**2))
    error = (
        f"{ours['mean']:.3f} mm mean, {ours['p95']:.3f} 95 %, {ours['max']:.3f} at most ({ours['rms']:.3f} rms; "
        f"{expected:.3f} expected), from {np.mean(found.scans):.1f} scans"
    )
    inside = f"{100 * found.share_inside:.1f} % of {len(found.error_m)}"
    rows = (
        ("error at the work point", error),
        ("in the stated 95 % region", f"{inside} (exact regions: {100 * low:.1f} to {100 * high:.1f} %)"),
        ("without a scanner correction", f"{rigid['mean']:.3f} mm mean, {rigid['max']:.3f} at most"),
    )
    run.table("", ("", "found"), rows)
