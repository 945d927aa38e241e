"""Write the page of `calibrate` in motion: residuals against time, cost against the clock's offset."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import export_ros2, known, matrix4, target_document
from weldcal.calibration.data.scanner_correction import DEVICE
from weldcal.calibration.recorded_motion import RecordedMotion
from weldcal.tools.report.calibration import scanner_pose
from weldcal.tools.report.first_screen import (
    NO_TOLERANCE,
    Findings,
    FirstScreen,
    Next,
    expected_error,
    limit_tolerance,
    point_covariance,
    radius_95,
    refused_note,
    typed,
)
from weldcal.tools.report.page import Bullets, FactList, Quantity, Section, Shot, TableRows, page_html
from weldcal.tools.report.pictures import GREY, OURS, TRUTH, subplots, svg
from weldcal.tools.report.render import fixed, sigma_rows

COST = (
    "Rms error of a rigid fit of all frames, if every frame was taken so much before its time. The dashed line marks"
    " the start of the joint fit."
)
ALONG = (
    "Distance along the motion between the flange seen and the flange by the robot. Above: frames taken at their"
    " arrival, with the best pose for that. Below: frames taken when the clock says; what is left is the jitter of"
    " single frames."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionReport(RecordedMotion):
    """The result of a calibration in motion, and its folder. ``limit_mm`` is the error that the job allows, or None.

    Of a live run: what speaks ``against`` its result, and why no tolerance is known.
    """

    seconds: float
    out: Path
    limit_mm: float | None = None
    against: tuple[str, ...] = ()
    no_tolerance: str = NO_TOLERANCE

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        The error is the larger of two at 95 %: the pose's own in the middle of the frames, and the held-out one.
        """
        r, p_C, used = self.result, self.frames.p_C, self.estimate.inliers
        held = 1e3 * self.estimate.held_out_m[used]
        held = held[np.isfinite(held)]
        middle = np.asarray(p_C[used].mean(axis=0))
        own = 1e3 * radius_95(point_covariance(r.X_BC, r.covariance, np.asarray(r.X_BC @ middle)))
        p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
        what = f"error {'in the middle of the frames' if r.symbol == 'X_BC' else 'at the target'}, 95 %"
        expected, larger = expected_error(what, own, p95, len(held), "frames")
        tolerance = limit_tolerance(what, larger, self.limit_mm)
        found = Findings(
            against=self.against,
            tolerance=tolerance,
            no_tolerance=self.no_tolerance,
            unseen=len(held),
            concerns=(*r.warnings, *r.unobservable),
            notes=refused_note(self.refused, len(r.poses), "frames"),
        )
        if tolerance is not None and not tolerance.met:
            after = Next("Record a longer motion, with more turns, or scans at rest.")
        elif r.symbol == "X_BC":
            watched = f"run '{typed('monitor --calibration', self.out)}' and name another recording of the flange"
            after = Next(f"Verify with scans at rest that the calibration has not seen; or {watched}.", uses=True)
        else:
            after = Next("Record a second motion and calibrate again: the two poses should agree within their errors.")
        return FirstScreen(found, expected, after, (scanner_pose(r),))

    @property
    def rms_mm(self) -> float:
        """Rms distance of the used frames' centres at their capture times, mm."""
        e = self.estimate
        return 1e3 * float(np.sqrt(np.mean(e.residual_m[e.inliers] ** 2)))

    @property
    def along_rms_mm(self) -> tuple[float, float]:
        """Rms residual along the motion, mm: arrivals taken for captures, and by the clock that was found."""
        e = self.estimate
        used = e.inliers & np.isfinite(e.before_m) & np.isfinite(e.along_m)
        if not used.any():
            return float("nan"), float("nan")
        before, after = (1e3 * float(np.sqrt(np.mean(x[used] ** 2))) for x in (e.before_m, e.along_m))
        return before, after

    def summary(self) -> dict[str, Any]:
        """The JSON object of `calibrate` in motion: the keys of the calibration at rest, and those of the clock."""
        e, r = self.estimate, self.result
        clock = e.clock
        before, after = map(known, self.along_rms_mm)
        return {
            "state": "done",
            "mode": "motion",
            "n_used": int(e.inliers.sum()),
            "refused": [{"id": i, "reason": t} for i, t in self.refused],
            "configuration": r.configuration,
            r.symbol: matrix4(r.X_BC),
            **({} if r.target is None else {"target": target_document(r.target)}),
            "covariance": r.covariance.tolist(),
            "clock_offset_ms": _ms(clock.offset_s),
            "clock_offset_sigma_ms": _ms(clock.sigma_s),
            "clock": clock.kind,
            "clock_reason": clock.reason,
            "clock_jitter_ms": _ms(clock.jitter_s),
            "clock_drift_ppm": None if clock.drift is None else 1e6 * clock.drift,
            "clock_drift_sigma_ppm": None if clock.drift_sigma is None else 1e6 * clock.drift_sigma,
            "clock_reference_s": clock.reference_s,
            "rolling_ms": _ms(clock.rolling_s),
            "late": list(clock.late),
            "scanner_correction": None,
            "held_out_mm": {k: known(r.held_out_mm[k]) for k in ("median", "mean", "p95")},
            "held_out_interval_mm": None,
            "tilt_deg": r.tilt_deg,
            "rms_mm": self.rms_mm,
            "along_motion_rms_mm": {"before": before, "after": after},
            "outliers": list(self.outliers),
            "warnings": list(r.warnings),
            "unobservable": list(r.unobservable),
            "seconds": self.seconds,
            "k_fold_mm": {k: known(v) for k, v in r.held_out_mm.items()},
            "axis_turn_deg": None,
            "advice": [],
            "features": [],
            "algorithm1": None,
        }


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def motion_report(report: MotionReport, title: str, *more: Section, **context: Any) -> str:
    """Return the page; ``more`` sections and ``context`` of a live run, see page_html."""
    r, e, clock = report.result, report.estimate, report.estimate.clock
    n, device, (before, after) = len(report.refused), clock.kind == DEVICE, report.along_rms_mm
    facts = [
        ("clock used", f"{clock.kind}. {clock.reason}"),
        ("offset, ms", f"{_ms_text(clock.offset_s)} ± {_ms_text(clock.sigma_s)} (one sigma)"),
        ("jitter of single frames, ms", _ms_text(clock.jitter_s)),
    ]
    if device and clock.drift is not None and clock.drift_sigma is not None:
        facts += [
            ("drift, ppm", f"{fixed(1e6 * clock.drift, 1)} ± {fixed(1e6 * clock.drift_sigma, 1)}"),
            ("device time of the offset, s", fixed(clock.reference_s, 3)),
        ]
    if clock.rolling_s is not None:
        facts.append(
            ("rolling time per unit of y/z, ms", f"{_ms_text(clock.rolling_s)} ± {_ms_text(clock.rolling_sigma_s)}")
        )
    base = "device times" if device else "arrivals"
    off = Quantity("Clock offset", _ms(clock.offset_s), "ms", f"± {_ms_text(clock.sigma_s)} (one sigma), {base}")
    where = "fixed beside the arm" if r.symbol == "X_BC" else "on the arm, which sees a fixed target"
    cell = ", ".join(filter(None, (r.robot, r.scanner, r.flange and f"flange {r.flange}")))
    pose = FactList([*sigma_rows(r.covariance), ("ROS 2", export_ros2(r.X_BC).strip())])
    formula = f"Capture time = {'device time + offset (+ drift)' if device else 'arrival - offset'}."
    return page_html(
        title,
        f"{cell}; scanner {where}, frames taken while it moves",
        (
            ("Warnings", [Bullets(r.warnings), Bullets(r.unobservable, "not observable: ")]),
            ("Uncertainty of the pose", [pose]),
            ("Clock", [formula, FactList(facts), Shot(_cost(report), COST, "Curve of cost against offset")]),
            ("Residual along the motion", [Shot(_along(report), ALONG, "Two plots of the residual against time")]),
            (
                "Frames not used",
                [TableRows(report.refused, ("frame", "reason"), (0, 1), f"{n} frames, with the reason")],
            ),
            *more,
        ),
        first=report.first,
        cards=(
            off,
            Quantity(
                "Residual along the motion", after, "mm", f"rms; {fixed(before, 2)} without synchronisation", digits=2
            ),
            Quantity("Residual, rms", report.rms_mm, "mm", "at the most probable capture times"),
            Quantity("Frames used", f"{int(e.inliers.sum())} of {len(r.poses)}", "", f"{n or 'none'} refused"),
        ),
        facts=[("time", f"{fixed(report.seconds, 1)} s")],
        **context,
    )


def _ms_text(seconds: float | None) -> str:
    return fixed(None if seconds is None else 1e3 * seconds, 3)


def _along(report: MotionReport) -> bytes:
    """Residual along the motion against time, before and after synchronisation."""
    e = report.estimate
    figure, (upper, lower) = subplots(8.2, 5.4, 2, 1, sharex=True)
    t = e.capture - e.capture[0]
    for axes, values, color, name in (
        (upper, e.before_m, TRUTH, "arrivals taken for captures"),
        (lower, e.along_m, OURS, "by the clock that was found"),
    ):
        axes.plot(t[e.inliers], 1e3 * values[e.inliers], ".", color=color, markersize=3.5)
        if (~e.inliers).any():
            axes.plot(t[~e.inliers], 1e3 * values[~e.inliers], ".", color=GREY, markersize=3.0)
            shown = values[e.inliers & np.isfinite(values)]
            if len(shown):
                axes.set_ylim(
                    *(1e3 * v for v in (1.2 * min(shown.min(), 0.0) - 1e-5, 1.2 * max(shown.max(), 0.0) + 1e-5))
                )
        axes.axhline(0.0, color="#888", linewidth=0.8)
        axes.set_title(name, fontsize=10, loc="left")
        axes.set_ylabel("along the motion, mm")
    lower.set_xlabel("time, s")
    return svg(figure, upper, lower)


def _cost(report: MotionReport) -> bytes:
    """Rms of the rigid fit against the delay of the frames' times."""
    start, clock = report.estimate.start, report.estimate.clock
    figure, axes = subplots(8.2, 3.4)
    good = np.isfinite(start.rms_m)
    axes.plot(1e3 * start.delays[good], 1e3 * start.rms_m[good], color=OURS, linewidth=1.6)
    axes.axvline(1e3 * start.delay_s, color=TRUTH, linewidth=1, linestyle="--")
    axes.set(
        xlabel="offset of the arrivals, ms"
        if clock.kind != DEVICE
        else "device time behind the median arrival less capture, ms",
        ylabel="rms of the rigid fit, mm",
    )
    axes.set_ylim(bottom=0.0)
    return svg(figure, axes)
