"""The calibration report: its pictures and the page around them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from weldcal.calibration.result import export_ros2, export_ur_pose
from weldcal.calibration.rigid import rotation_vector
from weldcal.calibration.solve import point_error_covariance
from weldcal.tools.report.render import fixed, render

if TYPE_CHECKING:
    from weldcal.tools.calibrate import CalibrationReport

Array = NDArray[np.float64]

_OURS, _THEIRS, _TRUTH, _REFUSED = "#1d5f8a", "#b08a2e", "#a8402f", "#9aa3ab"


def calibration_report(report: CalibrationReport, *, dataset: str) -> str:
    """The whole report as one self-contained HTML text."""
    r = report.result
    used = report.estimate.inliers
    middle = np.mean([o.p_BR for o, keep in zip(report.observations, used, strict=True) if keep], axis=0)
    work_sigma = 1e3 * float(np.sqrt(np.trace(point_error_covariance(report.estimate, middle))))
    sigma = np.sqrt(np.diag(r.covariance))
    return render(
        "calibration.html.j2",
        dataset=dataset,
        r=r,
        n_used=int(used.sum()),
        n_total=len(report.observations) + len([p for p in r.poses if p.held_out_mm is None]),
        work_sigma_mm=work_sigma,
        pose_rows=_pose_table(report),
        refused=report.refused,
        matrix=[[fixed(float(v), 6) for v in row] for row in r.X_BC.GetAsMatrix4()],
        pose_facts=[
            ("position, mm", "  ".join(fixed(float(1e3 * v), 3) for v in r.X_BC.translation())),
            ("one sigma, mm", "  ".join(fixed(float(1e3 * v), 3) for v in sigma[3:])),
            (
                "rotation vector, deg",
                "  ".join(fixed(float(np.degrees(v)), 4) for v in rotation_vector(r.X_BC.rotation())),
            ),
            ("one sigma, deg", "  ".join(fixed(float(np.degrees(v)), 4) for v in sigma[:3])),
            ("spread of robot and scanner, per axis", f"{r.sigma_position_mm:.3f} mm"),
            ("ROS 2", export_ros2(r.X_BC).strip()),
            ("URScript", export_ur_pose(r.X_BC).strip()),
        ],
        algorithm1=report.algorithm1,
        k_fold=report.k_fold_mm,
        convergence=_convergence(report),
        residuals=_residual_bars(report),
        field=_residual_field(report),
        seconds=report.seconds,
    )


def _pose_table(report: CalibrationReport) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for p in report.result.poses:
        fit = report.fits.get(p.id)
        rows.append(
            (
                p.id,
                "used" if p.used else "refused",
                fixed(p.held_out_mm, 3),
                fixed(p.residual_mm, 3),
                fixed(p.held_out_tilt_deg, 3),
                "–" if fit is None else fixed(1e3 * float(np.sqrt(np.trace(fit.center_covariance))), 3),
                "–" if fit is None else fixed(100 * fit.coverage, 0),
                p.reason,
            )
        )
    return rows


def _convergence(report: CalibrationReport) -> bytes:
    c = report.convergence
    figure = Figure(figsize=(8.2, 3.9), layout="constrained")
    axes = figure.subplots()
    _band(axes, c.counts, 1e3 * c.held_out, _OURS, "this calibration, on scans not used yet")
    _band(axes, c.counts, 1e3 * c.figure_true, _TRUTH, "Algorithm 1, on scans not used yet")
    _band(axes, c.counts, 1e3 * c.figure, _THEIRS, "Algorithm 1's own figure")
    axes.set_xlabel("number of scans")
    axes.set_ylabel("error at the flange, mm")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False, fontsize=9)
    return _svg(figure, axes)


def _band(axes: Axes, x: Array, y: Array, color: str, label: str) -> None:
    good = np.isfinite(y).any(axis=0)
    if not good.any():
        return
    y = np.where(np.isfinite(y), y, np.nan)[:, good]
    axes.plot(x[good], np.nanmedian(y, axis=0), color=color, marker="o", markersize=3.5, linewidth=1.8, label=label)
    axes.fill_between(x[good], *np.nanpercentile(y, (25, 75), axis=0), color=color, alpha=0.13, linewidth=0)


def _residual_bars(report: CalibrationReport) -> bytes:
    e = report.estimate
    error = 1e3 * e.held_out.position_m
    x = np.arange(len(error))
    figure = Figure(figsize=(8.2, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.bar(x, error, color=[_OURS if keep else _REFUSED for keep in e.inliers], width=0.7)
    median = float(np.median(error[e.inliers]))
    axes.axhline(median, color="#444", linewidth=1, linestyle="--")
    axes.annotate(f"median {median:.2f}", (x[-1] + 0.5, median), fontsize=9, va="bottom", ha="right")
    step = max(1, len(x) // 25)
    axes.set_xticks(x[::step], [o.id for o in report.observations][::step], rotation=60, ha="right", fontsize=8)
    # gross outliers would flatten every other bar
    top = 1.25 * float(np.max(error[e.inliers]))
    axes.set_ylim(0.0, top)
    for i in np.nonzero(error > top)[0]:
        axes.annotate(f"{error[i]:.1f}", (float(i), top), fontsize=8, ha="center", va="top", color="#333")
    axes.set_ylabel("held-out error, mm")
    return _svg(figure, axes)


def _residual_field(report: CalibrationReport) -> bytes:
    """Residuals in the camera frame, across the field of view and along the line of sight: a scanner's own error has a
    pattern."""
    e = report.estimate
    R = e.X_BC.rotation().matrix()
    seen = np.array([o.p_CR for o in report.observations])[e.inliers]
    base = np.array([o.p_BR for o in report.observations])[e.inliers]
    error = (seen @ R.T + e.X_BC.translation() - base) @ R
    figure = Figure(figsize=(8.2, 3.7), layout="constrained")
    left, right = figure.subplots(1, 2)
    scale = 0.12 * float(np.ptp(seen[:, :2], axis=0).max()) / max(float(np.median(np.linalg.norm(error, axis=1))), 1e-9)
    for axes, (i, j), names in ((left, (0, 1), ("x", "y")), (right, (0, 2), ("x", "z"))):
        axes.quiver(
            1e3 * seen[:, i],
            1e3 * seen[:, j],
            error[:, i],
            error[:, j],
            angles="xy",
            scale_units="xy",
            scale=1e-3 / scale,
            color=_OURS,
            width=0.004,
        )
        axes.plot(1e3 * seen[:, i], 1e3 * seen[:, j], ".", color="#555", markersize=4)
        axes.set_xlabel(f"camera {names[0]}, mm")
        axes.set_ylabel(f"camera {names[1]}, mm")
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
        axes.margins(0.15)
    left.set_title(f"residuals, {scale:.0f} times enlarged", fontsize=9, loc="left")
    return _svg(figure, left, right)


def _svg(figure: Figure, *all_axes: Axes) -> bytes:
    for axes in all_axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e3e6e9", linewidth=0.8)
        axes.set_axisbelow(True)
    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "weldcal", "svg.fonttype": "path"}):
        figure.savefig(stream, format="svg", metadata={"Date": None}, facecolor="white")
    return stream.getvalue()
