"""The result of `weldcal calibrate` and its page, with its plots and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from weldcal.calibration.data.results import RESULT_FILE, CalibrationResult, correction_note, export_ros2, matrix4
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance, sigma_at
from weldcal.calibration.eye_on_base.stated_error import USUAL_SCALE, ErrorBudget, error_budget
from weldcal.calibration.eye_on_base.validation import bootstrap_interval, mean_interval, weakest_place
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.recorded_flange import RecordedFlange
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.models.robots import get_robot
from weldcal.tools.report.first_screen import (
    ENOUGH_UNSEEN,
    SCANNER,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    WorkPoint,
    first_sentence,
    limit_tolerance,
    refused_note,
    typed,
    verify_next,
    work_point_error,
    work_point_expected,
)
from weldcal.tools.report.pictures import (
    MOST_SCANS,
    OURS,
    THEIRS,
    TRUTH,
    error_bars,
    error_field,
    scan_pictures,
    subplots,
    svg,
)
from weldcal.tools.report.render import fixed, render, sigma_rows


@dataclass(frozen=True, kw_only=True)
class Algorithm1Outcome:
    """Algorithm 1 on the same data: its figure, its errors at unused poses, and what the figure does not show.

    ``verification``: id of the pose held out for it. ``figure_mm``: reported by Algorithm 1; ``true_mm``: its errors at
    the flange at unused poses; ``unseen``: components of a true error of which less than half appears in the figure.
    ``curve``: what it reports (orders, k) and its true errors (rows, k), m, at the counts of the report's convergence.
    """

    verification: str
    metric: str
    figure_mm: float
    true_mm: dict[str, float]
    at_verification_mm: float
    unseen: tuple[str, ...]
    shares: tuple[float, ...]
    curve: tuple[Array, Array]

    @property
    def sentence(self) -> str:
        """One sentence for the terminal."""
        blind = f" ({self.metric}), insensitive to: {'; '.join(self.unseen)}" if self.unseen else f" ({self.metric})"
        return (
            f"Algorithm 1 reports {self.figure_mm:.3f} mm at its verification pose {self.verification}{blind}. "
            f"Its error at unused poses: {self.true_mm['median']:.3f} mm median."
        )


@dataclass(frozen=True, kw_only=True)
class CalibrationReport(RecordedFlange):
    """The result of `weldcal calibrate`, and its folder. ``limit_mm`` is the error that the job allows, or None."""

    algorithm1: Algorithm1Outcome | None
    seconds: float
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        The error is the larger of two at 95 %: the calibration's own at the work point, and the held-out one.
        """
        r, work = self.result, self.work_point
        said = self._remarks
        # what is not observable and matters to X_BC is among the warnings
        concerns = [text for text in r.warnings if text not in said]
        expected, figure = work_point_expected(work)
        tolerance = limit_tolerance("error at the work point, 95 %", figure, self.limit_mm)
        corrected = correction_note(r, self.out / RESULT_FILE)
        moved = [text for text in self.notes if "in another order" in text]
        notes = [*filter(None, (corrected,)), *moved, *refused_note(self.refused, len(r.poses)), *self._refined]
        found = Findings(tolerance=tolerance, unseen=work.unseen_poses, concerns=concerns, notes=notes)
        return FirstScreen(found, expected, self._next(tolerance, concerns), (scanner_pose(r),), self._used)

    @property
    def _used(self) -> dict[str, str]:
        """Rows: the scans that were used, the scanner's correction, and the files with the forms of robots and ROS."""
        n, left = len(self.result.poses), [name for name, _ in self.refused]
        names = f"; refused: {', '.join(left[:6])}{' ...' if len(left) > 6 else ''}" if left else ""
        if len(left) == 1:
            names += f" ({first_sentence(self.refused[0][1]).rstrip('.')})"
        applied = None if self.scanner is None else self.scanner.accepted
        scale = "" if applied is None else f"; the scanner is corrected by {1e2 * (applied.scale - 1.0):+.2f} %"
        return {
            "scans used": f"{n - len(left)} of {n}{names}{scale or '; the scanner is not corrected'}",
            "UR and ROS 2": "ur_pose.script, static_transform.sh beside the report",
        }

    @property
    def _remarks(self) -> list[str]:
        """Return those of the warnings that report what was done, not what could be wrong."""
        applied = self.scanner is not None and self.scanner.accepted is not None
        return [*([self.scanner.sentence] if applied and self.scanner is not None else []), *self._refined]

    @property
    def _refined(self) -> list[str]:
        """What --refine found and applied."""
        return [] if self.refinement is None else [str(self.refinement["sentence"])]

    def _next(self, tolerance: Tolerance | None, concerns: Sequence[str]) -> Next:
        missed = tolerance is not None and not tolerance.met
        advice = [text for text in self.advice if not text.startswith("Stop")]
        if advice and (missed or self.work_point.unseen_poses < ENOUGH_UNSEEN):
            return Next(f"{' '.join(advice[:2])} Then calibrate again.")
        if missed:
            return Next(self.budget.sentence)
        if concerns:
            return Next(
                "See what disturbs the scans, then verify on scans that the calibration has not seen.",
                typed("doctor", self.out),
            )
        return verify_next(self.out)

    @property
    def work_point(self) -> WorkPoint:
        """The expected error at the middle of the flange centres that were used."""
        used = [o.p_BR for o, keep in zip(self.observations, self.estimate.inliers, strict=True) if keep]
        return work_point_error(self.estimate, np.mean(used, axis=0))

    @cached_property
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
        """Interval (mm) of the mean error of as many new scans, with 95 % probability; None for fewer than four."""
        return mean_interval(1e3 * self.estimate.held_out.position_m[self.estimate.inliers])

    def summary(self) -> dict[str, Any]:
        """Return the JSON object of `calibrate`."""
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
            "features": feature_residuals(self.seen.fits, self.seen.patterns),
            **({} if self.refinement is None else {"refinement": self.refinement}),
            "algorithm1": (
                None
                if a is None
                else {
                    "verification": a.verification,
                    "metric": a.metric,
                    "figure_mm": a.figure_mm,
                    "true_mm": a.true_mm,
                    "at_verification_mm": a.at_verification_mm,
                    "unseen": list(a.unseen),
                }
            ),
        }


def scanner_pose(result: CalibrationResult) -> ShownPose:
    """Return the result's pose with its frames in words."""
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


def feature_residuals(
    fits: Mapping[str, FlangeFit], patterns: Mapping[str, HolePattern]
) -> list[dict[str, float | int | str | None]]:
    """List rms residuals (mm) of plane, outer edge, bore and holes, and the sigma (deg) of the turn, a row a scan.

    The bore is None where not seen, the holes (from their pattern) where fewer than four show.
    """
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


HEADER = ("pose", "plane, mm", "outer edge, mm", "bore, mm", "holes", "holes, mm", "rotation about the axis, ± deg")


def feature_table(fits: Mapping[str, FlangeFit], patterns: Mapping[str, HolePattern]) -> list[tuple[str, ...]]:
    """Return the rows of ``feature_residuals`` as a report shows them, under ``HEADER``."""
    places = {"plane_mm": 3, "outer_mm": 3, "bore_mm": 3, "holes_mm": 3, "turn_sigma_deg": 2}
    return [
        tuple(str(v) if k not in places else fixed(None if v is None else float(v), places[k]) for k, v in row.items())
        for row in feature_residuals(fits, patterns)
    ]


def fit_cells(fit: FlangeFit | None) -> tuple[str, str]:
    """Return one sigma of the centre (3-D, mm) and the visible share of the edge (%); dashes without a fit."""
    if fit is None:
        return "–", "–"
    return fixed(1e3 * float(np.sqrt(np.trace(fit.center_covariance))), 3), fixed(100 * fit.coverage, 0)


def calibration_report(report: CalibrationReport, *, dataset: str) -> str:
    """Return the whole report as one self-contained HTML text."""
    r, seen = report.result, report.seen
    used = report.estimate.inliers
    kept = [o for o, keep in zip(report.observations, used, strict=True) if keep]
    p_B = np.array([o.p_BR for o in kept])
    middle, held_out = p_B.mean(axis=0), 1e3 * report.estimate.held_out.position_m
    work_sigma = 1e3 * float(np.sqrt(np.trace(point_error_covariance(report.estimate, middle))))
    budget = report.budget
    return render(
        "calibration.html.j2",
        dataset=dataset,
        interval=report.held_out_interval_mm,
        judged=bool(np.isfinite(r.held_out_mm["median"])),
        fits=bool(seen.fits),
        r=r,
        n_used=int(used.sum()),
        n_total=len(r.poses),
        work_sigma_mm=work_sigma,
        pose_rows=_pose_table(report),
        feature_rows=feature_table(seen.fits, seen.patterns),
        feature_header=HEADER,
        scans=scan_pictures(seen.clouds, seen.fits) if seen.fits and seen.clouds else None,
        n_scans=min(len(seen.fits), MOST_SCANS),
        refused=report.refused,
        first=report.first,
        pose_facts=[
            *sigma_rows(r.covariance),
            ("noise per axis, one sigma", f"{r.sigma_position_mm:.3f} mm"),
            *_axis_turn(r.axis_turn_deg),
            ("ROS 2", export_ros2(r.X_BC).strip()),
        ],
        budget=budget,
        budget_rows=[
            *((c.source, fixed(c.mm, 3), c.basis, c.remedy) for c in budget.rows),
            ("total", fixed(budget.total_mm, 3), "", ""),
        ],
        scanner_sentence=None if report.scanner is None else report.scanner.sentence,
        scanner_rows=_scanner_rows(report),
        algorithm1=report.algorithm1,
        k_fold=report.k_fold_mm,
        convergence=_convergence(report),
        residuals=error_bars([o.id for o in report.observations], held_out, used, "held-out error, mm"),
        field=error_field(report.estimate.X_BC, kept),
        seconds=report.seconds,
        advice=report.advice,
        knowledge=None if len(p_B) < 2 else knowledge_map(report.estimate, p_B),
    )


def _axis_turn(turn: tuple[float, float] | None) -> list[tuple[str, str]]:
    if turn is None:
        return []
    return [
        ("rotation of the holes about the flange axis", f"{turn[0]:.2f} deg (spread {turn[1]:.2f}), for --axis-turn")
    ]


def _pose_table(report: CalibrationReport) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for p in report.result.poses:
        rows.append(
            (
                p.id,
                "used" if p.used else "refused",
                fixed(p.held_out_mm, 3),
                fixed(p.residual_mm, 3),
                fixed(p.held_out_tilt_deg, 3),
                *fit_cells(report.seen.fits.get(p.id)),
                p.reason,
            )
        )
    return rows


def _scanner_rows(report: CalibrationReport) -> list[tuple[str, ...]]:
    """Return the scanner's scale error and gradient by each source, per cent, with one sigma."""
    if report.scanner is None:
        return []
    rows: list[tuple[str, ...]] = []
    for name, e in (("robot motion", report.scanner.motion), ("hole circle", report.scanner.holes)):
        if e is not None:
            per_cent = np.array([1e2, 10.0, 10.0])  # scale in %; gradient in % per 100 mm
            values, sigma = per_cent * (e.values - np.array([1.0, 0.0, 0.0])), per_cent * e.sigma
            rows.append(
                (name, *(f"{fixed(float(v), 3)} ± {fixed(float(q), 3)}" for v, q in zip(values, sigma, strict=True)))
            )
    c = report.scanner.accepted
    if c is not None:
        used = (1e2 * (c.scale - 1.0), *(10.0 * g for g in c.gradient_per_m))
        rows.append(("applied", *(fixed(float(v), 3) for v in used)))
    return rows


def _convergence(report: CalibrationReport) -> bytes:
    c = report.convergence
    figure, axes = subplots(8.2, 3.9)
    _band(axes, c.counts, 1e3 * c.held_out, OURS, "this calibration, on unused scans")
    if report.algorithm1 is not None:
        figure_m, true_m = report.algorithm1.curve
        _band(axes, c.counts, 1e3 * true_m, TRUTH, "Algorithm 1, on unused scans")
        _band(axes, c.counts, 1e3 * figure_m, THEIRS, "figure reported by Algorithm 1")
    axes.set(xlabel="number of scans", ylabel="error at the flange, mm")
    axes.set_ylim(bottom=0.0)
    if axes.lines:
        axes.legend(frameon=False, fontsize=9)
    else:
        axes.text(0.5, 0.5, "too few scans for a curve", transform=axes.transAxes, ha="center", color="#555")
    return svg(figure, axes)


def _band(axes: Axes, x: Array, y: Array, color: str, label: str) -> None:
    good = np.isfinite(y).any(axis=0)
    if not good.any():
        return
    y = np.where(np.isfinite(y), y, np.nan)[:, good]
    axes.plot(x[good], np.nanmedian(y, axis=0), color=color, marker="o", markersize=3.5, linewidth=1.8, label=label)
    axes.fill_between(x[good], *np.nanpercentile(y, (25, 75), axis=0), color=color, alpha=0.13, linewidth=0)


_STEPS = 25
_MARGIN = 0.35  # of the widest extent of the poses: so far around them the map reaches
_WIDEST = 3.0  # of the error in the middle: beyond, the map says "more"
_SHADES = LinearSegmentedColormap.from_list("known", ["#eef4f8", "#9dc0d8", "#1d5f8a", "#10324a"])


def knowledge_map(estimate: CalibrationEstimate, p_B: Array) -> bytes:
    """Draw the sigma (3-D) of a scanned point through the middle of poses (n >= 2, 3) m, from above and aside."""
    middle, extent = p_B.mean(axis=0), float(np.ptp(p_B, axis=0).max())
    weak, least = weakest_place(estimate, p_B), 1e3 * sigma_at(estimate, middle)
    figure = Figure(figsize=(8.2, 4.0), layout="constrained")
    levels = least * np.linspace(0.95, _WIDEST, 9)
    all_axes = figure.subplots(1, 2)
    for axes, (i, j), title in zip(all_axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        reach = 0.5 * extent * (1.0 + 2.0 * _MARGIN)
        u, v = (np.linspace(-reach, reach, _STEPS) + middle[k] for k in (i, j))
        p = np.tile(middle, (_STEPS, _STEPS, 1))
        p[..., i], p[..., j] = u, v[:, None]
        sigma = 1e3 * np.sqrt(np.trace(point_error_covariance(estimate, p), axis1=-2, axis2=-1))
        drawn = axes.contourf(1e3 * u, 1e3 * v, sigma, levels=levels, cmap=_SHADES, extend="both")
        for at, mark, size, colour, label in (
            (p_B, "o", 5, "white", "poses taken"),
            (weak[None], "*", 15, "#e0872f", "best next pose"),
        ):
            x, y = 1e3 * at[:, i], 1e3 * at[:, j]
            axes.plot(x, y, mark, color=colour, markeredgecolor="#222", markersize=size, label=label)
        axes.set(xlabel=f"base {'xyz'[i]}, mm", ylabel=f"base {'xyz'[j]}, mm")
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_aspect("equal")
    bar = figure.colorbar(drawn, ax=all_axes, shrink=0.85, format="%.3g")
    bar.set_label("one sigma of a scanned point, mm")
    all_axes[0].legend(fontsize=8, loc="lower left", framealpha=0.9)
    return svg(figure, *all_axes)
