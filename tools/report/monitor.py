"""The report page of `weldcal monitor`: error, offset and drift over time."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from weldcal.calibration.motion.drift.sequential import DriftEvent
from weldcal.models.arrays import Array
from weldcal.tools.outcomes.monitor import MonitorReport
from weldcal.tools.report.pictures import GREY, OURS, THEIRS, TRUTH, plain, svg
from weldcal.tools.report.render import fixed, fixed_row, render

_AXES = (("x", OURS), ("y", THEIRS), ("z", "#5b7d4e"))
_SMOOTH = 21  # frames of a running median


def monitor_page(report: MonitorReport, *, recording: str) -> str:
    """The whole report as one self-contained HTML text."""
    w, summary = report.watched, report.summary()
    t = w.rows.times
    return render(
        "monitor.html.j2",
        recording=recording,
        r=report.calibration,
        m=summary,
        first=report.first,
        event_rows=[_row(e) for e in w.events],
        before=_errors(t, w.before, "error, mm", w.events),
        after=_errors(t, w.residuals, "error, mm", w.events),
        tilts=_errors(
            t, w.tilts, "tilt, deg", w.events, scale=float(np.degrees(1.0)), names=("about one tangent", "the other")
        ),
        offset=_offset(report),
        drift=_drift(report),
        warnings=report.warnings,
        dropped=[(d["reason"], d["frames"]) for d in summary["dropped_for"]],
        threshold=w.threshold,
        seconds=report.seconds,
    )


def _row(e: DriftEvent) -> tuple[str, ...]:
    sigma = np.sqrt(np.diag(e.covariance))
    return (
        e.kind + (", before the recording" if e.since_start else ""),
        f"{fixed(e.time_s, 2)} ± {fixed(e.time_sigma_s, 2)}",
        fixed(e.found_s, 2),
        fixed_row(1e3 * e.translation_m, 3),
        fixed_row(1e3 * sigma[3:], 3),
        fixed_row(np.degrees(e.rotation_rad), 4),
        fixed_row(np.degrees(sigma[:3]), 4),
        e.model,
    )


def _errors(
    t: Array, e: Array, label: str, events: tuple[DriftEvent, ...], *, scale: float = 1e3, names: tuple[str, ...] = ()
) -> bytes:
    """Components of an error (N, k) against time (N,) s."""
    figure = Figure(figsize=(8.2, 2.7), layout="constrained")
    axes = figure.subplots()
    for k in range(e.shape[1]):
        name, color = _AXES[k]
        axes.plot(t - t[0], scale * e[:, k], ".", color=color, markersize=2.5, label=names[k] if names else name)
    known = np.abs(scale * e[np.isfinite(e)])
    if known.size:
        top = 1.3 * float(np.percentile(known, 99.0)) + 1e-6
        axes.set_ylim(-top, top)
    _mark(axes, t, events)
    axes.legend(loc="upper right", fontsize=8, ncols=3, markerscale=3.0)
    plain(axes, "s after the first frame", label)
    return svg(figure, axes)


def _offset(report: MonitorReport) -> bytes:
    """By how much frames were later than their clock says, as their own residual tells it."""
    w = report.watched
    figure = Figure(figsize=(8.2, 2.5), layout="constrained")
    axes = figure.subplots()
    t = w.rows.times
    axes.plot(t - t[0], 1e3 * w.offsets, ".", color=GREY, markersize=2.5)
    axes.plot(t - t[0], 1e3 * _running(w.offsets[:, None])[:, 0], color=OURS, linewidth=1.2)
    plain(axes, "s after the first frame", "later than nominal, ms")
    return svg(figure, axes)


def _drift(report: MonitorReport) -> bytes:
    """Running median of the error, and the test's statistic against its threshold."""
    w = report.watched
    t = w.rows.times
    figure = Figure(figsize=(8.2, 4.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    smooth = _running(w.residuals)
    for k, (name, color) in enumerate(_AXES):
        upper.plot(t - t[0], 1e3 * smooth[:, k], color=color, linewidth=1.2, label=name)
    upper.legend(loc="upper right", fontsize=8, ncols=3)
    plain(upper, "", "running median, mm")
    lower.semilogy(t - t[0], np.maximum(w.statistic, 0.1), color=OURS, linewidth=1.0)
    lower.axhline(w.threshold, color=TRUTH, linewidth=1.0, linestyle=":")
    lower.annotate("alarm", (0.0, w.threshold), fontsize=8, va="bottom", color=TRUTH)
    plain(lower, "s after the first frame", "test statistic")
    for axes in (upper, lower):
        _mark(axes, t, w.events)
    return svg(figure, upper, lower)


def _mark(axes: Axes, t: Array, events: tuple[DriftEvent, ...]) -> None:
    for e in events:
        axes.axvline(e.time_s - t[0], color=TRUTH, linewidth=1.0, linestyle="--")


def _running(values: Array) -> Array:
    """Running median (N, k) of values (N, k)."""
    half = _SMOOTH // 2
    return np.array([np.median(values[max(0, i - half) : i + half + 1], axis=0) for i in range(len(values))])
