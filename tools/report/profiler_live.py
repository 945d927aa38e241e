"""The result of a live profiler run against the ground truth, and the pages of one run and of many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.geometry.robust import chi2_quantile, chi2_share
from weldcal.calibration.profiler.result import ProfilerEstimate
from weldcal.models.arrays import Array
from weldcal.systems.jobs.profiler.estimates import pose_sigmas
from weldcal.systems.jobs.profiler.job import AddedProfilerJob
from weldcal.systems.jobs.profiler.procedure import ProfilerState
from weldcal.systems.runner import Run
from weldcal.tools.report.first_screen import (
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    after_hold,
    point_covariance,
    radius_95,
)
from weldcal.tools.report.pictures import OURS, subplots, svg
from weldcal.tools.report.profiler_file import WORDS
from weldcal.tools.report.render import fixed, render
from weldcal.tools.report.run import RunOptions, robot_timing
from weldcal.welding.record.process import path_error
from weldcal.welding.seam.curve import SeamCurve

WITHIN_MM = 0.3
_NO_KEY = "No scenario key states the error that is allowed: compare it with what your job allows."
RUST, GREY, GREEN = "#c4622d", "#9aa3ab", "#4b7f52"
PARTS = ("turn x", "turn y", "turn z", "shift x", "shift y", "shift z")
_COLOURS = {"edge": OURS, "sphere": RUST}

JOINT_3_SIGMA = chi2_quantile(chi2_share(9.0, 1), 6)  # 20.06


@dataclass(frozen=True, eq=False)
class PoseOutcome:
    """X_FS against the ground truth: error, predicted error, each of six components in its sigma, and e^T C^-1 e."""

    error_mm: float
    error_deg: float
    sigma_mm: float
    sigma_deg: float
    parts: Array
    nees: float

    @property
    def within_3_sigma(self) -> bool:
        """Whether the six-component error is within the bound of 99.73 % probability (3 sigma of one component)."""
        return self.nees <= JOINT_3_SIGMA

    @property
    def largest(self) -> float:
        """The largest of the six components, in sigmas."""
        return float(np.abs(self.parts).max())


@dataclass(frozen=True, eq=False)
class PathOutcome:
    """Deviations along the seam: arc length, lateral and vertical distance (n,) m from the reference line."""

    s: Array
    lateral: Array
    height: Array

    @property
    def distance_mm(self) -> Array:
        """Distance from the line (n,), mm."""
        return np.asarray(1e3 * np.hypot(self.lateral, self.height))


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveOutcome:
    """All results of a run; None for the parts that the scenario does not have."""

    edge: PoseOutcome | None
    sphere: PoseOutcome | None
    tip_mm: float | None
    center_mm: float | None
    points: PathOutcome | None
    curve: PathOutcome | None
    torch: PathOutcome | None


def pose_outcome(estimate: ProfilerEstimate, X_FS: RigidTransform) -> PoseOutcome:
    """Compare an estimate with the true X_FS."""
    R = X_FS.rotation() @ RotationMatrix.ProjectToRotationMatrix(estimate.rotation).inverse()
    error = RigidTransform(R, X_FS.translation() - estimate.translation)
    parts, nees = pose_sigmas(error, estimate.covariance)
    return PoseOutcome(
        error_mm=1e3 * float(np.linalg.norm(error.translation())),
        error_deg=float(np.degrees(abs(R.ToAngleAxis().angle()))),
        sigma_mm=1e3 * float(np.sqrt(np.trace(estimate.covariance[3:, 3:]))),
        sigma_deg=float(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))),
        parts=parts,
        nees=nees,
    )


def true_torch(run: Run[AddedProfilerJob]) -> Array:
    """True torch positions (n, 3) m during its pass along the seam; none where no simulation knows them."""
    if "torch" not in run.cell.logs:
        return np.empty((0, 3))
    state: ProfilerState = run.cell.job.state(run.root)
    log = run.cell.logs["torch"].FindLog(run.root)
    t = log.sample_times()
    return np.array(log.data().T[(t >= state.torch_from_s) & (t <= state.torch_until_s)])


def live_outcome(run: Run[AddedProfilerJob]) -> LiveOutcome:
    """Compare the run with the ground truth of its station; nothing is known of one whose devices are all real."""
    cell, s = run.cell, run.cell.job.state(run.root)
    truth, torch_B = cell.station.truth, true_torch(run)
    profiler = truth.profiler
    if profiler is None:
        return LiveOutcome(edge=None, sphere=None, tip_mm=None, center_mm=None, points=None, curve=None, torch=None)
    touched = s.sphere if s.sphere is not None and s.sphere.estimate.tip is not None else None
    tip = center = None
    if touched is not None and touched.estimate.tip is not None:
        tip = 1e3 * float(np.linalg.norm(touched.estimate.tip - profiler.p_FTip))
        center = 1e3 * float(np.linalg.norm(touched.estimate.center - profiler.center))
    points = curve = torch = None
    job = cell.job.job
    if s.seam is not None and truth.workpiece is not None and truth.X_BP is not None:
        part, X = truth.workpiece, truth.X_BP
        up = X.rotation().matrix()[:, 2].copy()
        true = SeamCurve.from_points(X.multiply(np.asarray(part.seam_P).T).T, up)
        points = _off(s.seam.points_B, true)
        curve = _off(s.seam.curve.position(np.linspace(0.0, s.seam.curve.length, 300)), true)
        if len(torch_B):
            torch = _off(torch_B, true.raised(1e-3 * job.seam.above_root_mm))
    return LiveOutcome(
        edge=None if s.edge is None else pose_outcome(s.edge.estimate, profiler.X_FS),
        sphere=None if touched is None else pose_outcome(touched.estimate, profiler.X_FS),
        tip_mm=tip,
        center_mm=center,
        points=points,
        curve=curve,
        torch=torch,
    )


def _off(p: Array, line: SeamCurve) -> PathOutcome:
    error = path_error(p, line)
    return PathOutcome(error.s, error.lateral, error.height)


@dataclass(frozen=True, eq=False)
class ProfilerLive:
    """The result of one run."""

    options: RunOptions
    run: Run[AddedProfilerJob]
    outcome: LiveOutcome
    robot: str = "simulated"

    @property
    def folder(self) -> Path:
        """The result folder."""
        return self.options.out

    @property
    def state(self) -> ProfilerState:
        """The final state of the job, with all its estimates."""
        found: ProfilerState = self.run.cell.job.state(self.run.root)
        return found

    @property
    def first(self) -> FirstScreen:
        """The first screen: X_FS by edge and by sphere in the middle of the profiles; held-out scans back them."""
        s, held = self.state, self.run.held
        against = [self.run.reason or "The job was held."] if held else []
        poses, errors, unseen, backing = [], [], 0, []
        for name, found, scans in (("edge", s.edge, s.edge_scans), ("sphere", s.sphere, s.sphere_scans)):
            if found is None:
                continue
            e = found.estimate
            X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(e.rotation), e.translation)
            seen = np.vstack([scan.points for scan in scans])
            x, z = np.median(seen[np.isfinite(seen).all(axis=1)], axis=0)
            p_F = np.asarray(X.multiply(np.array([x, 0.0, z])))
            errors.append(1e3 * radius_95(point_covariance(X, e.covariance, p_F)))
            poses.append(ShownPose("X_FS", f"{WORDS}, by the {name}", X))
            unseen += found.held_out_mm.size
            if found.held_out_mm.size:
                backing.append(
                    f"{found.held_out_mm.size} held-out scans of the {name}: at most {found.held_out_mm.max():.3f} mm"
                )
        figure = " and ".join(f"{v:.3f} mm" for v in errors) or "not known"
        said = "; ".join(backing) or "no scan was held out"
        expected = ExpectedError(
            "error in the middle of the profiles, 95 %", figure, f"of the calibration itself, by each target; {said}"
        )
        o, tolerance = self.outcome, None
        if o.torch is not None:
            what = "the torch's largest distance from its line, known in simulation only,"
            tolerance = Tolerance(what, float(o.torch.distance_mm.max()), WITHIN_MM, "the target of this command")
        known = [p for p in (o.edge, o.sphere) if p is not None]
        concerns = (
            ["A pose is farther from the truth than its covariance says (99.7 %)."]
            if any(not p.within_3_sigma for p in known)
            else []
        )
        found_all = Findings(
            against=against, tolerance=tolerance, no_tolerance=_NO_KEY, unseen=unseen, concerns=concerns
        )
        if held:
            after = after_hold(self.run.ended_by_operator)
        else:
            after = Next(
                "Take the same scans with your own profiler, run 'weldcal profiler sphere' and name their file.",
                uses=True,
            )
        more = {} if poses else {"pose": "none was found"}
        return FirstScreen(found_all, expected, after, tuple(poses), more)

    def summary(self) -> dict[str, object]:
        """Return the JSON object of `profiler live`, and of `demo` for such a scenario."""
        s, o = self.state, self.outcome
        done = not self.run.held
        found: dict[str, object] = {"state": "done" if done else "held", "scenario": self.options.scenario}
        found |= {"seed": self.options.seed, "robot": self.robot}
        if not done:
            found["reason"] = self.run.reason
        if s.edge is not None:
            found["edge"] = _pose(o.edge) | {
                "X_FS": _matrix(s.edge.estimate),
                "scans": len(s.edge_scans),
                "without_feature": s.edge.lost,
                "outliers": int((~s.edge.estimate.inliers).sum()),
                "reduced_chi2": s.edge.estimate.reduced_chi2,
                "held_out_mm": float(s.edge.held_out_mm.mean()) if s.edge.held_out_mm.size else None,
            }
        if s.sphere is not None:
            found["sphere"] = _pose(o.sphere) | {
                "X_FS": _matrix(s.sphere.estimate),
                "scans": len(s.sphere_scans),
                "without_feature": s.sphere.lost,
                "touches": len(s.touches),
                "model": s.sphere.model,
                "reduced_chi2": s.sphere.estimate.reduced_chi2,
                "held_out_mm": float(s.sphere.held_out_mm.mean()) if s.sphere.held_out_mm.size else None,
                "tip_error_mm": o.tip_mm,
                "centre_error_mm": o.center_mm,
            }
        if s.seam is not None and o.curve is not None:
            found["seam"] = {"profiles": len(s.seam_scans), "without_groove": s.seam.lost, **_path("curve", o.curve)}
        if o.torch is not None:
            found |= _path("torch", o.torch)
            found["torch_within_mm"] = WITHIN_MM
            found["torch_is_within"] = bool(o.torch.distance_mm.max() <= WITHIN_MM)
        poses = [p for p in (o.edge, o.sphere) if p is not None]
        if poses:
            found["largest_sigmas"] = max(p.largest for p in poses)
            found["poses_within_3_sigma"] = all(p.within_3_sigma for p in poses)
        return found | self.run.timing()


def _matrix(e: ProfilerEstimate) -> list[list[float]]:
    X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(e.rotation), e.translation)
    found: list[list[float]] = X.GetAsMatrix4().tolist()
    return found


def _pose(p: PoseOutcome | None) -> dict[str, object]:
    return (
        {}
        if p is None
        else {
            "error_mm": p.error_mm,
            "error_deg": p.error_deg,
            "sigma_mm": p.sigma_mm,
            "sigma_deg": p.sigma_deg,
            "sigmas": [float(v) for v in p.parts],
            "nees": p.nees,
        }
    )


def _path(name: str, p: PathOutcome) -> dict[str, object]:
    return {f"{name}_mean_mm": float(p.distance_mm.mean()), f"{name}_max_mm": float(p.distance_mm.max())}


def live_report(
    summary: Mapping[str, object],
    outcome: LiveOutcome,
    state: ProfilerState,
    run: Run[Any],
    *,
    first: FirstScreen,
    recording: bool,
) -> str:
    """One run's page as one self-contained HTML text."""
    poses = {name: [p] for name, p in _poses(outcome).items()}
    paths = {n: p for n in ("points", "curve", "torch") if (p := getattr(outcome, n)) is not None}
    shown = {
        name: min(scans, key=lambda scan: _aside(scan.points)).points
        for name, scans in (("edge", state.edge_scans), ("sphere", state.sphere_scans), ("groove", state.seam_scans))
        if scans
    }
    return render(
        "profiler_live.html.j2",
        first=first,
        s=summary,
        rows=[_row(n, p) for n, p in _poses(outcome).items()],
        sigmas=sigmas_picture(poses) if poses else None,
        seam=path_picture(paths, WITHIN_MM) if paths else None,
        profiles=profiles_picture(shown) if shown else None,
        tip_mm=outcome.tip_mm,
        recording=recording,
        **robot_timing(run),
    )


def _poses(o: LiveOutcome) -> dict[str, PoseOutcome]:
    return {n: p for n in ("edge", "sphere") if (p := getattr(o, n)) is not None}


def _aside(points: Array) -> float:
    """How far from the middle the nearest face lies in a profile (n, 2) m."""
    p = points[np.isfinite(points).all(axis=1)]
    if not len(p):
        return np.inf
    near = p[:, 1] < np.percentile(p[:, 1], 5.0) + 0.012
    return abs(float(np.mean(p[near, 0])))


def _row(name: str, p: PoseOutcome) -> tuple[str, ...]:
    return (
        name,
        fixed(p.error_mm, 3),
        fixed(p.sigma_mm, 3),
        fixed(p.error_deg, 3),
        fixed(p.sigma_deg, 3),
        fixed(p.largest, 2),
        fixed(p.nees, 1),
    )


def sigmas_picture(poses: Mapping[str, Sequence[PoseOutcome]]) -> bytes:
    """Each of six parts of the error of X_FS in sigmas of its own prediction, a dot a run; the band is 3 sigma."""
    figure, axes = subplots(8.2, 3.0)
    axes.axhspan(-3.0, 3.0, color="#e8eef2", zorder=0)
    axes.axhline(0.0, color="#444", linewidth=0.8)
    for k, (name, found) in enumerate(poses.items()):
        shift = 0.24 * (k - 0.5 * (len(poses) - 1))
        for j, pose in enumerate(found):
            spread = 0.0 if len(found) == 1 else 0.16 * (j / (len(found) - 1) - 0.5)
            at, size = np.arange(6) + shift + spread, 5.0 if len(found) == 1 else 3.5
            axes.plot(at, pose.parts, "o", color=_COLOURS[name], markersize=size, label=name if j == 0 else None)
    axes.set_xticks(range(6), PARTS)
    largest = max(float(np.abs(p.parts).max()) for found in poses.values() for p in found)
    axes.set(ylim=(-max(4.0, 1.1 * largest), max(4.0, 1.1 * largest)), ylabel="error / predicted sigma")
    axes.legend(frameon=False, ncols=2, loc="upper right")
    return svg(figure, axes)


def path_picture(paths: Mapping[str, PathOutcome], limit_mm: float) -> bytes:
    """Distance from the true line along it: raw points as dots, the seam and the torch as lines."""
    figure, axes = subplots(8.2, 3.2)
    styles = {
        "points": (".", GREY, "each profile's root"),
        "curve": ("-", OURS, "seam as found"),
        "torch": ("-", RUST, "torch"),
    }
    for name, path in paths.items():
        style, colour, label = styles[name]
        axes.plot(1e3 * path.s, path.distance_mm, style, color=colour, label=label, markersize=3, linewidth=1.6)
    axes.axhline(limit_mm, color="#a8402f", linewidth=1, linestyle=":")
    axes.annotate(f"{limit_mm:g} mm", (axes.get_xlim()[0], limit_mm), fontsize=9, va="bottom", color="#a8402f")
    axes.set(ylim=(0.0, None), xlabel="along the seam, mm", ylabel="off the true line, mm")
    axes.legend(frameon=False, ncols=3, loc="upper right")
    return svg(figure, axes)


def profiles_picture(profiles: Mapping[str, Array]) -> bytes:
    """One raw profile (n, 2) m of each kind, as the sensor returned it, z downwards."""
    figure = Figure(figsize=(8.2, 2.7), layout="constrained")
    for k, (name, p) in enumerate(profiles.items()):
        axes = figure.add_subplot(1, len(profiles), k + 1)
        near = p[np.isfinite(p).all(axis=1)]
        if len(near):
            top = float(np.percentile(near[:, 1], 3.0))
            near = near[near[:, 1] < top + 0.045]
        axes.plot(1e3 * near[:, 0], 1e3 * near[:, 1], ".", color=OURS, markersize=2.5)
        axes.invert_yaxis()
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("x, mm")
        if k == 0:
            axes.set_ylabel("z, mm")
        axes.spines[["top", "right"]].set_visible(False)
    return svg(figure, figure.axes[0])
