"""Simulated calibrations without rendering: errors of arms and scanners, and shares of 95 % regions with the truth."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
import typer
from pydrake.math import RigidTransform
from scipy.stats import binom, chi2

from tests.figures.harness import Figures, Results, Row, Study
from tests.worlds import wrong_models
from tests.worlds.light_runs import LightRuns, study_light_runs
from tests.worlds.wrong_models import (
    Found,
    as_measured,
    judged,
    measured_by_a_wrong_scanner,
    simulated_observations,
    station,
    study_station,
)
from weldcal.calibration.calibrate import PLAIN, Steps, calibrate
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, corrected_observation, with_scanner
from weldcal.calibration.eye_on_base.scanner_fit import from_motion
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base, point_error_covariance
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.pictures import subplots, svg
from weldcal.tools.report.render import fixed, statistics, write_atomic

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


def _coverage_rows(f: Figures) -> Iterable[Row]:
    for s in f["studies"]:
        kind = "of another model" if s["warped"] else "corrected" if s["corrected"] else "exact"
        shares = (f"{100 * s[key]:.1f} %" for key in ("pose", "point"))
        yield str(s["poses"]), kind, *shares, fixed(s["held_out_over_true"])


HONESTY = Study(
    name="flange-honesty",
    what="How often stated 95 % regions hold the truth, and the ratio of held-out to true errors.",
    header=("scans", "scanner", "X_BC inside", "work point inside", "held-out over true error"),
    rows=_coverage_rows,
    numbers=3,
)


@command("benchmark flange-honesty", short_help="Measure how often stated 95 % regions hold the truth.", hidden=True)
def honesty(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of calibrations of each size.", min=10)] = 500
) -> Outcome:
    """Measure how often the stated 95 % regions contain the truth, and the ratio of held-out to true errors."""
    folder = HONESTY.folder(call)
    studies = [study_coverage(n, runs, call.seed, call.progress) for n in (5, 6, 8, 12, 20)]
    studies += [study_corrected(n, runs, call.seed, call.progress) for n in (6, 8, 12, 20)]
    studies.append(study_warped(12, max(10, runs // 5), call.progress))
    write_atomic(folder / "coverage.svg", coverage_picture(studies))
    return HONESTY.found({"studies": [vars(s) for s in studies]}, folder)


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Mean error (m) of 60 new scans in each of ``runs`` worlds of one class, and how many times it is stated.

    A class is scans, largest error of the scanner m, rms error of the arm m, with a local field or plain. The ratio
    is of nested held-out errors, both means over the worlds.
    """

    poses: int
    warp_m: float
    arm_m: float
    local: bool
    runs: int
    true_m: float
    stated_over_true: float


def study_stated(poses: int, warp_m: float, arm_m: float, runs: int, *, local: bool) -> Stated:
    """Calibrate ``runs`` devices with an arm each as `weldcal calibrate` does, and measure on new scans."""
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
    ratio = float(np.mean(stated) / np.mean(true))
    return Stated(
        poses=poses,
        warp_m=warp_m,
        arm_m=arm_m,
        local=local,
        runs=runs,
        true_m=float(np.mean(true)),
        stated_over_true=ratio,
    )


def _stated_rows(f: Figures) -> Iterable[Row]:
    for s in f["classes"]:
        yield (
            str(s["poses"]),
            "local" if s["local"] else "plain",
            fixed(1e3 * s["warp_m"], 1),
            fixed(1e3 * s["arm_m"], 2),
            str(s["runs"]),
            fixed(1e3 * s["true_m"]),
            fixed(s["stated_over_true"], 2),
        )
    yield "all", "", "", "", str(sum(s["runs"] for s in f["classes"])), "", fixed(f["mean"], 2)


STATED = Study(
    name="flange-stated",
    what="The stated mean error over the true one, in generated worlds with errors of scanner and arm.",
    header=("scans", "way", "scanner off, mm", "arm off, mm", "worlds", "true mean error, mm", "stated over true"),
    rows=_stated_rows,
    numbers=5,
)


@command("benchmark flange-stated", short_help="Measure stated over true error in generated worlds.", hidden=True)
def stated(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of worlds of each class.", min=2)] = 34
) -> Outcome:
    """Measure how many times the true mean error of new scans is stated, in generated worlds with errors of scanner and
    arm."""
    folder, classes = STATED.folder(call), []
    sizes = [(n, False) for n in (8, 12, 20, 30)] + [(20, True)]
    for k, (poses, local) in enumerate(sizes):
        for warp_m in (2e-4, 8e-4, 1.6e-3):
            call.progress(f"{poses} scans", k / len(sizes))
            classes.append(study_stated(poses, warp_m, _ARM_M, runs, local=local))
    mean = float(np.mean([s.stated_over_true for s in classes]))
    return STATED.found({"classes": [vars(s) for s in classes], "mean": mean}, folder)


def wrong_arm(seed: int, kind: str) -> Mapping[str, object]:
    """One world, plain and refined."""
    return {"kind": kind, **asdict(study_station(station(seed, links=kind == "links"), kind))}


def _arm_figures(results: Results) -> Figures:
    kinds = [r["kind"] for r in results.values()]
    found = [Found(**{k: np.array(v) for k, v in r.items() if k != "kind"}) for r in results.values()]
    return {"worlds": len(found), "kind": kinds[0], **judged(found)}


def _arm_rows(f: Figures) -> Iterable[Row]:
    yield "error at new scans, plain", f"{f['plain_mm']:.3f} mm mean"
    yield "error at new scans, refined", f"{f['refined_mm']:.3f} mm mean (ratio {f['ratio']:.2f})"
    yield "in the stated 95 % region", f"{f['inside_95_percent']:.1f} %"
    yield "joint offsets within 3 sigma", f"{f['offsets_within_3_sigma_percent']:.1f} %"


ARM = Study(
    name="flange-arm",
    what="UR10e cells with factory-size errors of the arm, calibrated from 20 planned scans, plain and refined.",
    case=wrong_arm,
    figures=_arm_figures,
    header=("", "found"),
    rows=_arm_rows,
)


@command("benchmark flange-arm", short_help="Calibrate cells with errors of the arm, and refine them.", hidden=True)
def arm(
    call: Call,
    worlds: Annotated[int, option("--worlds", "N", "Number of simulated cells.", min=1)] = 40,
    kind: Annotated[
        str, option("--kind", "KIND", "links: all errors of the arm; joints: zeros of the joints only.")
    ] = "links",
) -> Outcome:
    """Calibrate UR10e cells with factory-size errors of the arm from 20 planned scans, plain and refined, and judge
    both on new scans."""
    seeds = range(call.seed, call.seed + worlds)
    return ARM.outcome(call, {f"world {s}": {"seed": s, "kind": kind} for s in seeds})


def _imperfect(found: LightRuns) -> dict[str, object]:
    ours, rigid = (statistics(1e3 * v, "mean", "rms", "p95", "max") for v in (found.error_m, found.rigid_m))
    return {
        "runs": len(found.error_m),
        "scans_mean": float(np.mean(found.scans)),
        "at_work_mm": {"mean": ours["mean"], "p95": ours["p95"], "worst": ours["max"]},
        "rms_at_work_mm": ours["rms"],
        "expected_mm": float(1e3 * np.sqrt(np.mean(found.expected_m**2))),
        "inside_95": found.share_inside,
        "inside_95_chance": list(found.chance()),
        "rigid_at_work_mm": {"mean": rigid["mean"], "worst": rigid["max"]},
    }


def _imperfect_rows(f: Figures) -> Iterable[Row]:
    e, (low, high) = f["at_work_mm"], f["inside_95_chance"]
    yield (
        "error at the work point",
        (
            f"{e['mean']:.3f} mm mean, {e['p95']:.3f} 95 %, {e['worst']:.3f} at most ({f['rms_at_work_mm']:.3f} rms; "
            f"{f['expected_mm']:.3f} expected), from {f['scans_mean']:.1f} scans"
        ),
    )
    yield (
        "in the stated 95 % region",
        f"{100 * f['inside_95']:.1f} % of {f['runs']} (exact regions: {100 * low:.1f} to {100 * high:.1f} %)",
    )
    yield "without a scanner correction", "{mean:.3f} mm mean, {worst:.3f} at most".format(**f["rigid_at_work_mm"])


IMPERFECT = Study(
    name="flange-imperfect",
    what=(
        "Live calibrations with an imperfect scanner and arm, without rendering: errors, and how often they lie in the"
        " region."
    ),
    header=("", "found"),
    rows=_imperfect_rows,
)


@command("benchmark flange-imperfect", short_help="Calibrate with an imperfect scanner and arm.", hidden=True)
def imperfect(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="[SCENARIO]", help="A scenario with simulated arm and scanner.")
    ] = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of calibrations, each in its own world.", min=10)] = 200,
) -> Outcome:
    """Calibrate with an imperfect scanner and arm, without rendering: errors at the work point, and how often they lie
    in the stated 95 % region."""
    folder = IMPERFECT.folder(call)
    found = study_light_runs(load_scenario(scenario), runs, seed=call.seed, progress=call.progress)
    return IMPERFECT.found(_imperfect(found), folder)
