"""Live calibrations with few scans: errors, the Cramer-Rao bound, and repeats with redrawn noise."""

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure
from pydrake.math import RigidTransform

from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, jacobian
from weldcal.models.arrays import Array
from weldcal.systems.cell import build_cell
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.jobs.weld.settings import work_point
from weldcal.systems.runner import Progress, no_progress, run_cell
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.pictures import svg
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.weld import calibration_error
from weldcal.tools.studies.harness import Figures, Row, Study
from weldcal.tools.studies.targets import Target
from weldcal.tools.worlds.perfect_world import perfect


@dataclass(frozen=True, eq=False)
class Station:
    """What made the observations: arm (its joints (n, 6) rad at each of them), how well the flange repeats (m, rms), the true X_BC,
    and the work point (3,) m in B."""

    arm: ArmModel
    joints: Array
    repeatability_m: float
    X_BC: RigidTransform
    p_BWork: Array


@dataclass(frozen=True, eq=False)
class Redrawn:
    """Errors (k,) of a point at the work point (m) and of the rotation (rad): of calibrations whose noise was drawn anew, and of
    as many draws from the Gaussian that the Cramer-Rao bound allows."""

    at_work_m: Array
    rotation_rad: Array
    bound_at_work_m: Array
    bound_rotation_rad: Array

    def within(self, at_work_m: float, rotation_rad: float) -> tuple[float, float]:
        """Share of the calibrations, and of those at the bound, within both."""
        ours = (self.at_work_m <= at_work_m) & (self.rotation_rad <= rotation_rad)
        least = (self.bound_at_work_m <= at_work_m) & (self.bound_rotation_rad <= rotation_rad)
        return float(np.mean(ours)), float(np.mean(least))


def joints_of(observations: tuple[Observation, ...], arm: ArmModel, q_home: Array) -> Array:
    """Joints (n, 6) rad in which a bare flange stands where each observation says: the solution nearest to ``q_home``."""
    out = []
    for o in observations:
        solutions = inverse_kinematics(arm, o.X_BR)
        out.append(min(solutions, key=lambda s: float(np.abs((s - q_home + np.pi) % (2.0 * np.pi) - np.pi).sum())))
    return np.array(out)


def redraw(observations: tuple[Observation, ...], station: Station, count: int, seed: int = 0) -> Redrawn:
    """``count`` calibrations from the poses of these observations, each with noise of its own: joint offsets that displace the flange
    by the repeatability, and fits that err as they state. Deterministic for ``seed``."""
    rng = np.random.default_rng(seed)
    errors = np.empty((2, count))
    for k in range(count):
        drawn = [_redrawn(o, q, station, rng) for o, q in zip(observations, station.joints, strict=True)]
        estimate = estimate_eye_on_base(drawn, SolveConfig(leave_one_out=False))
        e = calibration_error(estimate.X_BC, station.X_BC, station.p_BWork)
        errors[:, k] = e.at_work_m, e.rotation_rad
    drawn_least = rng.multivariate_normal(np.zeros(6), bound_covariance(observations, station), size=count)
    turn, shift = np.linalg.norm(drawn_least[:, :3], axis=1), np.linalg.norm(drawn_least[:, 3:], axis=1)
    return Redrawn(errors[0], errors[1], shift, turn)


def joined(parts: list[Redrawn]) -> Redrawn:
    """All of them together."""
    names = ("at_work_m", "rotation_rad", "bound_at_work_m", "bound_rotation_rad")
    return Redrawn(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def bound_covariance(observations: tuple[Observation, ...], station: Station) -> Array:
    """Cramer-Rao: the least covariance (6, 6) [rotation rad; displacement of the work point m] that an unbiased calibration from
    these observations of a bare flange can have.

    The arm's error is six independent joint offsets that displace the flange by the repeatability (rms); the scanner's is what
    each fit states of itself. Centre and normal of a pose err together, as one offset of the joints moves both.
    """
    information = np.zeros((6, 6))
    for o, q in zip(observations, station.joints, strict=True):
        J = jacobian(station.arm, q)
        R, z = o.X_BR.rotation().matrix(), o.n_B
        across = R[:, :2].T  # the two directions in which a normal can lean
        H = np.zeros((5, 6))
        H[:3, 3:], H[3:, :3] = np.eye(3), -across @ skew(z)
        noise = _joint_sigma(station, J) ** 2 * H @ J @ J.T @ H.T
        noise[:3, :3] += np.zeros((3, 3)) if o.center_covariance is None else _in_base(o)
        noise[3:, 3:] += (o.normal_sigma or 0.0) ** 2 * np.eye(2)
        A = np.zeros((5, 6))
        A[:3, :3], A[:3, 3:], A[3:, :3] = -skew(o.p_BR - station.p_BWork), np.eye(3), -across @ skew(z)
        information += A.T @ np.linalg.solve(noise, A)
    return np.asarray(np.linalg.inv(information))


def _joint_sigma(station: Station, J: Array) -> float:
    """Standard deviation (rad) of each joint's offset, as the simulated arm draws it."""
    return station.repeatability_m / float(np.linalg.norm(J[3:]))


def _redrawn(o: Observation, q: Array, station: Station, rng: np.random.Generator) -> Observation:
    """The observation with noise of its own; the robot's reported pose stays."""
    offset = _joint_sigma(station, jacobian(station.arm, q)) * rng.standard_normal(6)
    X_CR = station.X_BC.inverse() @ forward_kinematics(station.arm, q + offset)
    z = X_CR.rotation().matrix()[:, 2]
    p, n = np.asarray(X_CR.translation()), z
    if o.center_covariance is not None:
        p = p + rng.multivariate_normal(np.zeros(3), o.center_covariance)
    if o.normal_sigma is not None:
        lean = o.normal_sigma * rng.standard_normal(3)
        n = exp_rotation(lean - z * float(z @ lean)) @ z
    return replace(o, p_CR=p, n_C=None if o.n_C is None else n)


def _in_base(o: Observation) -> Array:
    """The fit's covariance (3, 3) m^2: along the face's normal and across, whatever way the camera is turned."""
    assert o.center_covariance is not None
    n = np.asarray(o.n_C) if o.n_C is not None else np.array([0.0, 0.0, -1.0])
    along = float(n @ o.center_covariance @ n)
    across = 0.5 * (float(np.trace(o.center_covariance)) - along)
    return np.asarray(across * np.eye(3) + (along - across) * np.outer(o.n_B, o.n_B))


SCENARIO = "calibrate_only"
TARGET_M, TARGET_RAD = 6e-5, float(np.radians(0.01))


@dataclass(frozen=True, kw_only=True)
class LiveRow:
    """One seed: scans used, error of a point at the work point (m) and of the rotation (rad), what the estimate expected of the
    former (rms), the least that these poses, arm and scanner allow (rms), and the same calibration with noise redrawn."""

    seed: int
    scans: int
    at_work_m: float
    rotation_rad: float
    expected_m: float
    least_m: float
    least_rad: float
    redrawn: Redrawn


def live_scenario(repeatability_mm: float, scans: int) -> Scenario:
    """The calibration scenario with an arm that repeats no better, a scanner without distortion, and exactly so many scans."""
    scenario = perfect(load_scenario(SCENARIO))
    assert isinstance(scenario.robot, SimulatedUr)
    scenario.robot.repeatability_mm = repeatability_mm
    scenario.calibration.minimum_scans = scenario.calibration.maximum_scans = scans
    check_scenario(scenario)
    return scenario


def study_live(
    seeds: int,
    *,
    first: int = 0,
    scans: int = 8,
    repeatability_mm: float = 0.05,
    redraws: int = 0,
    progress: Progress = no_progress,
) -> list[LiveRow]:
    """Calibrate live, through the whole Diagram, once for each seed, and ``redraws`` times more from the same poses without it.

    Raises InputError for numbers that no cell takes, and RuntimeError where a job was held.
    """
    rows = []
    for k in range(seeds):
        seed = first + k
        progress(f"calibration {k + 1} of {seeds}", k / seeds)
        scenario = live_scenario(repeatability_mm, scans)
        cell = build_cell(scenario, seed)
        with closing(cell.station):
            run = run_cell(cell)
        status, truth = cell.job.calibration_status(run.root), cell.station.truth.X_BC
        if status.estimate is None or truth is None or run.held:
            raise RuntimeError(f"The calibration of seed {seed} did not finish: {run.reason}")
        work = work_point(scenario)
        error = calibration_error(status.estimate.X_BC, truth, work)
        found = status.observations
        joints = joints_of(found, cell.station.arm, np.deg2rad(scenario.home_deg))
        station = Station(cell.station.arm, joints, 1e-3 * repeatability_mm, truth, np.asarray(work))
        least = np.diag(bound_covariance(found, station))
        rows.append(
            LiveRow(
                seed=seed,
                scans=len(found),
                at_work_m=error.at_work_m,
                rotation_rad=error.rotation_rad,
                expected_m=status.predicted_error_m,
                least_m=float(np.sqrt(least[3:].sum())),
                least_rad=float(np.sqrt(least[:3].sum())),
                redrawn=redraw(found, station, redraws, seed),
            )
        )
    return rows


def live_picture(rows: list[LiveRow]) -> bytes:
    """Share of the calibrations whose error is no larger than that: live ones (steps), their noise redrawn, and at the bound."""
    again = joined([r.redrawn for r in rows])
    mm, deg = 1e3, float(np.degrees(1.0))
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    panels = (
        (again.at_work_m, again.bound_at_work_m, [r.at_work_m for r in rows], mm, TARGET_M, "at the work point, mm"),
        (
            again.rotation_rad,
            again.bound_rotation_rad,
            [r.rotation_rad for r in rows],
            deg,
            TARGET_RAD,
            "rotation, degrees",
        ),
    )
    for ax, (drawn, least, live, unit, target, name) in zip(axes, panels, strict=True):
        ax.ecdf(unit * least, color="#777", linewidth=1.2, linestyle="--", label="the least possible (Cramer-Rao)")
        ax.ecdf(unit * drawn, color="#1d5f8a", linewidth=1.6, label=f"noise redrawn, {len(drawn)} times")
        ax.ecdf(unit * np.array(live), color="#b08a2e", linewidth=1.2, label=f"live, {len(live)} worlds")
        ax.axvline(unit * target, color="#444", linewidth=1)
        ax.annotate("target", (unit * target, 0.04), xytext=(-4, 0), textcoords="offset points", ha="right", fontsize=9)
        ax.set_xlim(0.0, 1.25 * unit * target)
        ax.set_xlabel(name)
    axes[0].set_ylabel("share of calibrations within")
    axes[0].legend(
        facecolor="white", edgecolor="none", framealpha=1.0, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.15)
    )
    return svg(figure, *axes)


def live_figures(rows: Sequence[LiveRow], scans: int, repeatability_mm: float) -> dict[str, object]:
    """Errors against their targets and the Cramer-Rao bound, and with redrawn noise where there is some."""
    again = joined([r.redrawn for r in rows])
    work, least, expected = (
        1e3 * np.array([getattr(r, k) for r in rows]) for k in ("at_work_m", "least_m", "expected_m")
    )
    turn, turn_least = (np.degrees([getattr(r, k) for r in rows]) for k in ("rotation_rad", "least_rad"))
    at_work, rotation = ({"mean": v.mean(), "rms": _rms(v), "worst": v.max()} for v in (work, turn))
    target_mm, target_deg = 1e3 * TARGET_M, float(np.degrees(TARGET_RAD))
    figures: dict[str, object] = {
        "seeds": len(rows),
        "scans": scans,
        "repeatability_mm": repeatability_mm,
        "at_work_mm": at_work,
        "rotation_deg": rotation,
        "expected_mm": _rms(expected),
        "bound_mm": _rms(least),
        "bound_deg": _rms(turn_least),
        "target_mm": target_mm,
        "target_deg": target_deg,
        "within": int(np.sum((work <= target_mm) & (turn <= target_deg))),
        "rows": [{k: v for k, v in vars(r).items() if k != "redrawn"} for r in rows],
    }
    if len(again.at_work_m):
        within, within_at_bound = again.within(TARGET_M, TARGET_RAD)
        turns = np.degrees(again.rotation_rad)
        figures["redrawn"] = {
            "calibrations": len(again.at_work_m),
            "rms_mm": _rms(1e3 * again.at_work_m),
            "rms_deg": _rms(turns),
            "p99_deg": float(np.percentile(turns, 99)),
            "within": within,
            "within_at_bound": within_at_bound,
        }
    return figures


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _live_rows(f: Figures) -> Iterable[Row]:
    e, t = f["at_work_mm"], f["rotation_deg"]
    yield "at the work point, mm", *(f"{e[k]:.3f}" for k in ("mean", "rms", "worst")), f"{f['bound_mm']:.3f}"
    yield "rotation, deg", *(f"{t[k]:.4f}" for k in ("mean", "rms", "worst")), f"{f['bound_deg']:.4f}"
    if again := f.get("redrawn"):
        yield "new noise, at the work point, mm", "", f"{again['rms_mm']:.3f}", "", f"{f['bound_mm']:.3f}"
        yield "new noise, rotation, deg", "", f"{again['rms_deg']:.4f}", "", f"{f['bound_deg']:.4f}"
        shares = (f"{100 * again[k]:.1f} %" for k in ("within", "within_at_bound"))
        yield "new noise, both within the targets", "", next(shares), "", next(shares)


LIVE = Study(
    name="flange-live",
    what="The error of the live calibration in simulation, beside the least that its poses, arm and scanner allow.",
    figures=lambda results: results["all"],
    header=("error", "mean", "rms", "worst", "Cramer-Rao, rms"),
    rows=_live_rows,
    targets=lambda f: (
        Target("at the work point", "mm", f["at_work_mm"]["worst"], f["target_mm"], over="worst", decides=False),
        Target("rotation", "deg", f["rotation_deg"]["worst"], f["target_deg"], over="worst", decides=False),
    ),
    numbers=4,
)


@command("benchmark flange-live", short_help="Compare live calibrations with the Cramer-Rao bound.", hidden=True)
def live(
    call: Call,
    seeds: Annotated[int, option("--seeds", "N", "Number of calibrations, each in its own world.", min=1)] = 10,
    scans: Annotated[int, option("--scans", "N", "Scans of each calibration.", min=4, max=8)] = 8,
    repeatability: Annotated[
        float, option("--repeatability", "MM", "Repeatability of the arm: rms distance of the flange.", min=0.0)
    ] = 0.05,
    redraws: Annotated[
        int, option("--redraws", "N", "Further calibrations from the poses of each, with new noise.", min=0)
    ] = 50,
) -> Outcome:
    """Measure the error of the live calibration in simulation and compare with the Cramer-Rao bound."""
    folder = LIVE.folder(call)
    rows = study_live(
        seeds, first=call.seed, scans=scans, repeatability_mm=repeatability, redraws=redraws, progress=call.progress
    )
    if redraws:
        write_atomic(folder / "live.svg", live_picture(rows))
    return LIVE.measured({"all": live_figures(rows, scans, repeatability)}, folder).outcome()
