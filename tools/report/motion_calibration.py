"""The report page of a calibration in motion, with residuals against time and the cost against the clock's offset."""

import numpy as np
from matplotlib.figure import Figure

from weldcal.calibration.data.results import export_ros2
from weldcal.calibration.data.scanner_clock import DEVICE
from weldcal.tools.outcomes.motion import MotionReport
from weldcal.tools.report.pictures import GREY, OURS, TRUTH, svg
from weldcal.tools.report.render import fixed, fixed_row, render


def motion_report(report: MotionReport, *, dataset: str) -> str:
    """The whole report as one self-contained HTML text."""
    r, e = report.result, report.estimate
    clock = e.clock
    sigma = np.sqrt(np.diag(r.covariance))
    before, after = report.along_rms_mm
    facts = [
        ("clock used", f"{clock.kind}. {clock.reason}"),
        ("offset, ms", f"{_ms(clock.offset_s)} ± {_ms(clock.sigma_s)} (one sigma)"),
        ("jitter of single frames, ms", _ms(clock.jitter_s)),
    ]
    if clock.kind == DEVICE and clock.drift is not None and clock.drift_sigma is not None:
        facts += [
            ("drift, ppm", f"{fixed(1e6 * clock.drift, 1)} ± {fixed(1e6 * clock.drift_sigma, 1)}"),
            ("device time of the offset, s", fixed(clock.reference_s, 3)),
        ]
    if clock.rolling_s is not None:
        facts.append(("rolling time per unit of y/z, ms", f"{_ms(clock.rolling_s)} ± {_ms(clock.rolling_sigma_s)}"))
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
        pose_facts=[
            ("one sigma of the position, mm", fixed_row(1e3 * sigma[3:], 3)),
            ("one sigma of the rotation, deg", fixed_row(np.degrees(sigma[:3]), 4)),
            ("ROS 2", export_ros2(r.X_BC).strip()),
        ],
        clock_facts=facts,
        along=_along(report),
        cost=_cost(report),
        refused=report.refused[:200],
        n_refused=len(report.refused),
        seconds=report.seconds,
    )


def _ms(seconds: float | None) -> str:
    return fixed(None if seconds is None else 1e3 * seconds, 3)


def _along(report: MotionReport) -> bytes:
    """Residual along the motion against time, before and after synchronisation."""
    e = report.estimate
    figure = Figure(figsize=(8.2, 5.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
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
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    axes = figure.subplots()
    good = np.isfinite(start.rms_m)
    axes.plot(1e3 * start.delays[good], 1e3 * start.rms_m[good], color=OURS, linewidth=1.6)
    axes.axvline(1e3 * start.delay_s, color=TRUTH, linewidth=1, linestyle="--")
    axes.set_xlabel(
        "offset of the arrivals, ms"
        if clock.kind != DEVICE
        else "device time behind the median arrival less capture, ms"
    )
    axes.set_ylabel("rms of the rigid fit, mm")
    axes.set_ylim(bottom=0.0)
    return svg(figure, axes)
