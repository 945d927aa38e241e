"""The report page of `weldcal calibrate`, with its plots and tables."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from weldcal.calibration.data.results import export_ros2
from weldcal.calibration.eye_on_base.solve import point_error_covariance
from weldcal.models.arrays import Array
from weldcal.tools.outcomes.calibration import CalibrationReport
from weldcal.tools.report.calibration_map import knowledge_map
from weldcal.tools.report.flange_features import HEADER, feature_table, fit_cells
from weldcal.tools.report.pictures import OURS, THEIRS, TRUTH, error_bars, error_field, svg
from weldcal.tools.report.render import fixed, fixed_row, render


def calibration_report(report: CalibrationReport, *, dataset: str) -> str:
    """The whole report as one self-contained HTML text."""
    r = report.result
    used = report.estimate.inliers
    kept = [o for o, keep in zip(report.observations, used, strict=True) if keep]
    p_B = np.array([o.p_BR for o in kept])
    middle, held_out = p_B.mean(axis=0), 1e3 * report.estimate.held_out.position_m
    work_sigma = 1e3 * float(np.sqrt(np.trace(point_error_covariance(report.estimate, middle))))
    sigma = np.sqrt(np.diag(r.covariance))
    budget = report.budget
    return render(
        "calibration.html.j2",
        dataset=dataset,
        interval=report.held_out_interval_mm,
        judged=bool(np.isfinite(r.held_out_mm["median"])),
        fits=bool(report.fits),
        r=r,
        n_used=int(used.sum()),
        n_total=len(report.observations) + len([p for p in r.poses if p.held_out_mm is None]),
        work_sigma_mm=work_sigma,
        pose_rows=_pose_table(report),
        feature_rows=feature_table(report.fits, report.patterns),
        feature_header=HEADER,
        refused=report.refused,
        first=report.first,
        pose_facts=[
            ("one sigma of the position, mm", fixed_row(1e3 * sigma[3:], 3)),
            ("one sigma of the rotation, deg", fixed_row(np.degrees(sigma[:3]), 4)),
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
                *fit_cells(report.fits.get(p.id)),
                p.reason,
            )
        )
    return rows


def _scanner_rows(report: CalibrationReport) -> list[tuple[str, ...]]:
    """The scanner's scale error and gradient by each source, per cent, with one sigma."""
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
    figure = Figure(figsize=(8.2, 3.9), layout="constrained")
    axes = figure.subplots()
    _band(axes, c.counts, 1e3 * c.held_out, OURS, "this calibration, on unused scans")
    _band(axes, c.counts, 1e3 * c.figure_true, TRUTH, "Algorithm 1, on unused scans")
    _band(axes, c.counts, 1e3 * c.figure, THEIRS, "figure reported by Algorithm 1")
    axes.set_xlabel("number of scans")
    axes.set_ylabel("error at the flange, mm")
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
