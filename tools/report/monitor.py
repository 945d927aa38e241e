"""The result of `weldcal monitor` on a recording and its page: error, offset and drift over time."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes

from weldcal.calibration.data.results import CalibrationResult, matrix4
from weldcal.calibration.motion.drift.sequential import WARM_UP, DriftEvent
from weldcal.models.arrays import Array
from weldcal.tools.report.first_screen import (
    SCANNER,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    typed,
    upper,
)
from weldcal.tools.report.pictures import GREY, OURS, THEIRS, TRUTH, plain, subplots, svg
from weldcal.tools.report.render import fixed, fixed_row, render

if TYPE_CHECKING:
    from weldcal.calibration.motion.drift.watch import DriftHistory

CALM, DRIFTED, WARMED = "no drift found", "the scanner has moved", "the scanner warms up"


@dataclass(frozen=True, kw_only=True, eq=False)
class MonitorReport:
    """What was watched, the calibration, the recalibrated result where it was asked for, and the folder."""

    watched: DriftHistory
    calibration: CalibrationResult
    recalibrated: CalibrationResult | None
    cause: str
    false_alarms_per_hour: float
    warnings: tuple[str, ...]
    seconds: float
    out: Path

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        The tolerance is the test's threshold, which --false-alarms sets; there is no work point in a watch.
        """
        w = self.watched
        largest = float(np.nanmax(w.statistic)) if len(w.statistic) else float("nan")
        source = f"--false-alarms {self.false_alarms_per_hour:g} per hour"
        against = [f"{upper(self.verdict)}: {self.change}"] if self.moves else []
        concerns = [*self.warnings]
        if self.verdict == WARMED:
            concerns = [f"The scanner warms up: {self.change}", *concerns]
        found = Findings(
            against=against,
            tolerance=None if w.events else Tolerance("The largest test statistic", largest, w.threshold, source, ""),
            no_tolerance=f"The test at {source} has found a change.",
            unseen=len(w.ids),
            concerns=concerns,
        )
        errors = 1e3 * np.linalg.norm(w.residuals, axis=1)
        errors = errors[np.isfinite(errors)]
        expected = ExpectedError(
            "error of the tracked flange, 95 %",
            f"{np.percentile(errors, 95):.3f} mm" if len(errors) else "not known",
            f"of {len(w.ids)} frames, which the calibration did not use; rms {1e3 * w.rms_m:.3f} mm",
        )
        return FirstScreen(found, expected, self._next(), (ShownPose("X_BC", self._words, w.X_BC),))

    @property
    def _words(self) -> str:
        if not self.moves:
            return f"{SCANNER['X_BC']}, as calibrated"
        return f"{SCANNER['X_BC']}, after the last change, estimated from the frames since"

    def _next(self) -> Next:
        if self.recalibrated is not None and self.moves:
            folder = self.out / "recalibrated"
            return Next(
                f"Verify the pose after the change before you use it: take new scans, run '{typed('verify', folder)}'"
                " and name their folder."
            )
        if self.moves:
            return Next(
                "Find what moved and fix it, then calibrate again; --recalibrate writes the pose after the change."
            )
        if self.verdict == WARMED:
            return Next("Let the scanner warm up until its scale stands still, then watch again.")
        return Next("Go on; watch again after any knock, and after work at the robot or the scanner.")

    @property
    def change(self) -> str:
        """The last change that was found, in a sentence; empty where there is none."""
        if not self.watched.events:
            return ""
        e = self.watched.events[-1]
        d = drift_document(e)
        if not self.moves:
            return f"from {e.time_s:.1f} s on its scale changed by {1e6 * e.scale:.0f} ppm; the pose is unchanged."
        return (
            f"at {e.time_s:.2f} s (robot clock) by {d['translation_mm']:.3f} mm and {d['rotation_deg']:.4f} degrees, "
            f"found {max(e.found_s - e.time_s, 0.0):.1f} s later. {upper(self.cause)}".rstrip(". ")
            + "."
        )

    @property
    def moves(self) -> tuple[DriftEvent, ...]:
        """Changes of the pose, without warm-ups of the scanner."""
        return tuple(e for e in self.watched.events if e.kind != WARM_UP)

    @property
    def verdict(self) -> str:
        """What was found, in some words."""
        if self.moves:
            return DRIFTED
        return WARMED if self.watched.events else CALM

    def summary(self) -> dict[str, Any]:
        """Return the JSON object of `monitor`; drift and what it is measured by stand last."""
        w = self.watched
        clock = w.clock
        delay = clock.delay_s
        warm = [e for e in w.events if e.kind == WARM_UP]
        return {
            "state": "done",
            "verdict": self.verdict,
            "cause": self.cause,
            "clock": clock.clock.kind,
            "clock_source": clock.source if delay is not None else None,
            "delay_ms": None if delay is None else 1e3 * delay,
            "delay_sigma_ms": None if clock.sigma_s is None else 1e3 * clock.sigma_s,
            "jitter_ms": 1e3 * w.noise.jitter_s,
            "false_alarms_per_hour": self.false_alarms_per_hour,
            "X_BC": matrix4(w.X_BC),
            "covariance": w.covariance.tolist(),
            "since_s": w.since_s,
            "recalibrated": None if self.recalibrated is None else str(self.out / "recalibrated"),
            "warm_up": [{"time_s": e.time_s, "found_s": e.found_s, "scale": e.scale} for e in warm],
            "warnings": list(self.warnings),
            "dropped_for": [
                {"reason": r, "frames": n} for r, n in Counter(_kind(r) for _, r in w.dropped).most_common()
            ],
            "gross": [id for id, g in zip(w.ids, w.gross, strict=True) if g],
            "rms_before_synchronisation_mm": _rms_mm(w.before),
            "rms_after_drift_mm": 1e3 * w.rms_after_m,
            "rms_mm": 1e3 * w.rms_m,
            "frames": len(w.ids),
            "dropped": len(w.dropped),
            "drift": [drift_document(e) for e in self.moves],
        }


def drift_document(e: DriftEvent) -> dict[str, Any]:
    """A change of the scanner's pose as plain values: mm, degrees, axes of the robot's base, seconds of its clock."""
    sigma = np.sqrt(np.diag(e.covariance))
    size, angle = float(np.linalg.norm(e.translation_m)), float(np.linalg.norm(e.rotation_rad))
    return {
        "time_s": e.time_s,
        "translation_mm": 1e3 * size,
        "rotation_deg": float(np.degrees(angle)),
        "time_sigma_s": e.time_sigma_s,
        "found_s": e.found_s,
        "kind": e.kind,
        "significant": e.model,
        "translation_B_mm": (1e3 * e.translation_m).tolist(),
        "translation_sigma_mm": (1e3 * sigma[3:]).tolist(),
        "rotation_B_deg": np.degrees(e.rotation_rad).tolist(),
        "rotation_sigma_deg": np.degrees(sigma[:3]).tolist(),
        "since_start": e.since_start,
        "cause": e.cause,
    }


def _kind(reason: str) -> str:
    """Return a reason without its figures: what comes before a colon, a semicolon or a number."""
    return re.split(r"[:;]|\s-?\d", reason)[0].rstrip(". ") + "."


def _rms_mm(residuals: Array) -> float | None:
    known = residuals[np.isfinite(residuals).all(axis=1)]
    return 1e3 * float(np.sqrt((known**2).sum(axis=1).mean())) if len(known) else None


_AXES = (("x", OURS), ("y", THEIRS), ("z", "#5b7d4e"))
_SMOOTH = 21  # frames of a running median


def monitor_page(report: MonitorReport, *, recording: str) -> str:
    """Return the whole report as one self-contained HTML text."""
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
    figure, axes = subplots(8.2, 2.7)
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
    """Return by how much frames were later than their clock says, by their own residual."""
    w = report.watched
    figure, axes = subplots(8.2, 2.5)
    t = w.rows.times
    axes.plot(t - t[0], 1e3 * w.offsets, ".", color=GREY, markersize=2.5)
    axes.plot(t - t[0], 1e3 * _running(w.offsets[:, None])[:, 0], color=OURS, linewidth=1.2)
    plain(axes, "s after the first frame", "later than nominal, ms")
    return svg(figure, axes)


def _drift(report: MonitorReport) -> bytes:
    """Running median of the error, and the test's statistic against its threshold."""
    w = report.watched
    t = w.rows.times
    figure, (upper, lower) = subplots(8.2, 4.2, 2, 1, sharex=True)
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
