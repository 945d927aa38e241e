"""Write the page of `calibrate` in motion: residuals against time, cost against the clock's offset."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import (
    CalibrationResult,
    export_ros2,
    known,
    matrix4,
    pose_records,
    software_version,
    statistics,
    target_document,
    tilt_summary,
)
from weldcal.calibration.data.scanner_correction import DEVICE
from weldcal.calibration.motion.estimate import MotionEstimate
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.models.arrays import Array
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
from weldcal.tools.report.pictures import GREY, OURS, TRUTH, subplots, svg
from weldcal.tools.report.render import fixed, render, sigma_rows


def motion_result(
    e: MotionEstimate, ids: Sequence[str], refused: Sequence[tuple[str, str]], **more: Any
) -> CalibrationResult:
    """The estimate as a result folder holds it; ``more``: the names of robot, flange and scanner, and other fields."""
    values = {
        "residual_mm": 1e3 * e.residual_m,
        "held_out_mm": 1e3 * e.held_out_m,
        "tilt_deg": np.degrees(e.tilt_rad),
        "held_out_tilt_deg": np.degrees(e.held_out_tilt_rad),
    }
    return CalibrationResult(
        X_BC=e.X_BC,
        covariance=e.covariance,
        held_out_mm=statistics(1e3 * e.held_out_m[e.inliers]),
        tilt_deg=tilt_summary(e.held_out_tilt_rad[e.inliers]),
        poses=pose_records(ids, e.inliers, values, refused),
        unobservable=e.unobservable,
        sigma_position_mm=1e3 * e.sigma_position_m,
        sigma_normal_deg=float(np.degrees(e.sigma_normal_rad)),
        software=software_version(),
        clock=e.clock,
        clock_covariance=e.joint,
        **more,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionReport:
    """The estimate, the records written, and the folder. ``dropped``: frames of the recording that no estimate used."""

    result: CalibrationResult
    estimate: MotionEstimate
    frames: ObservedFrames
    refused: tuple[tuple[str, str], ...]
    outliers: tuple[str, ...]
    seconds: float
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        The error is the larger of two at 95 %: the pose's own in the middle of the frames, and the held-out one.
        """
        return motion_screen(self.result, self.estimate, self.frames.p_C, self.refused, self.out, self.limit_mm)

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


def motion_screen(
    r: CalibrationResult,
    e: MotionEstimate,
    p_C: Array,
    refused: Sequence[tuple[str, str]],
    out: Path,
    limit_mm: float | None,
    against: Sequence[str] = (),
    no_tolerance: str = NO_TOLERANCE,
) -> FirstScreen:
    """Return the first screen of a calibration in motion; ``p_C`` (n, 3) m are the centres of all its frames."""
    used, held = e.inliers, 1e3 * e.held_out_m[e.inliers]
    held = held[np.isfinite(held)]
    middle = np.asarray(p_C[used].mean(axis=0))
    own = 1e3 * radius_95(point_covariance(r.X_BC, r.covariance, np.asarray(r.X_BC @ middle)))
    p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
    place = "in the middle of the frames" if r.symbol == "X_BC" else "at the target"
    what = f"error {place}, 95 %"
    expected, larger = expected_error(what, own, p95, len(held), "frames")
    tolerance = limit_tolerance(what, larger, limit_mm)
    notes = refused_note(refused, len(p_C) + len(refused), "frames")
    concerns = (*r.warnings, *r.unobservable)
    found = Findings(
        against=against,
        tolerance=tolerance,
        no_tolerance=no_tolerance,
        unseen=len(held),
        concerns=concerns,
        notes=notes,
    )
    if tolerance is not None and not tolerance.met:
        after = Next("Record a longer motion, with more turns, or scans at rest.")
    elif r.symbol == "X_BC":
        watched = f"run '{typed('monitor --calibration', out)}' and name another recording of the flange"
        after = Next(f"Verify with scans at rest that the calibration has not seen; or {watched}.", uses=True)
    else:
        after = Next("Record a second motion and calibrate again: the two poses should agree within their errors.")
    return FirstScreen(found, expected, after, (scanner_pose(r),))


def motion_report(report: MotionReport, *, dataset: str) -> str:
    """Return the whole report as one self-contained HTML text."""
    r, e = report.result, report.estimate
    clock = e.clock
    before, after = report.along_rms_mm
    facts = [
        ("clock used", f"{clock.kind}. {clock.reason}"),
        ("offset, ms", f"{_ms_text(clock.offset_s)} ± {_ms_text(clock.sigma_s)} (one sigma)"),
        ("jitter of single frames, ms", _ms_text(clock.jitter_s)),
    ]
    if clock.kind == DEVICE and clock.drift is not None and clock.drift_sigma is not None:
        facts += [
            ("drift, ppm", f"{fixed(1e6 * clock.drift, 1)} ± {fixed(1e6 * clock.drift_sigma, 1)}"),
            ("device time of the offset, s", fixed(clock.reference_s, 3)),
        ]
    if clock.rolling_s is not None:
        facts.append(
            ("rolling time per unit of y/z, ms", f"{_ms_text(clock.rolling_s)} ± {_ms_text(clock.rolling_sigma_s)}")
        )
    return render(
        "motion_calibration.html.j2",
        dataset=dataset,
        r=r,
        clock=clock,
        device=clock.kind == DEVICE,
        n_used=int(e.inliers.sum()),
        n_total=len(report.frames) + len(report.refused),
        rms_mm=report.rms_mm,
        before_mm=before,
        after_mm=after,
        offset_ms=None if clock.offset_s is None else 1e3 * clock.offset_s,
        offset_sigma_ms=None if clock.sigma_s is None else 1e3 * clock.sigma_s,
        first=report.first,
        pose_facts=[*sigma_rows(r.covariance), ("ROS 2", export_ros2(r.X_BC).strip())],
        clock_facts=facts,
        along=_along(report),
        cost=_cost(report),
        refused=report.refused[:200],
        n_refused=len(report.refused),
        seconds=report.seconds,
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
