"""The report of a live calibration in any mounting: the station, what was found in which direction, and how sure it is."""

import numpy as np
from matplotlib.figure import Figure

from weldcal.tools.outcomes.mounting import MountingReport
from weldcal.tools.report.hand_eye import unknown_tables
from weldcal.tools.report.pictures import OURS, error_bars, millimetres, svg
from weldcal.tools.report.render import fixed, render
from weldcal.tools.report.run import robot_timing


def mounting_report(report: MountingReport, picture: bytes | None) -> str:
    """The whole report as one self-contained HTML text."""
    status, mounting, result = report.status, report.mounting, report.result
    aside = np.array([1e3 * k.error_m for k in status.held_out])
    off = {
        symbol: f" (off the truth by {fixed(e.mm, 3)} mm and {fixed(e.deg, 4)} deg; simulation)"
        for symbol, e in report.truth_errors().items()
    }
    unknowns = [] if result is None else unknown_tables(result, mounting, off)
    rows = []
    for i, s in enumerate(status.seen):
        used = result is None or bool(result.inliers[i])
        mm = "–" if result is None else fixed(1e3 * float(result.translation[i]), 3)
        deg = "–" if result is None else fixed(float(np.degrees(result.rotation_rad[i])), 4)
        rows.append((s.label, "used" if used else "left out", mm, deg, fixed(100 * s.coverage, 0)))
    rows += [
        (k.label, "held out", fixed(1e3 * k.error_m, 3), fixed(float(np.degrees(k.tilt_rad)), 4), "–")
        for k in status.held_out
    ]
    return render(
        "mounting.html.j2",
        **robot_timing(report.run),
        first=report.first,
        name=mounting.name,
        words=mounting.words,
        equation=mounting.equation,
        source=mounting.source,
        sketch=mounting.sketch,
        given=report.given(),
        description=report.run.cell.scenario.description,
        picture=picture,
        unknowns=unknowns,
        aside_mm=float(np.median(aside)) if len(aside) else None,
        n_aside=len(aside),
        expected_mm=1e3 * status.sigma_work_m,
        work_mm=report.work_error_mm(),
        distance_mm=1e3 * report.job.scene.scanner.optimum_m,
        n_used=len(status.seen),
        n_scans=status.sequence,
        unobservable=() if result is None else result.unobservable,
        warnings=() if result is None else result.warnings,
        refused=status.refused,
        next_best=None if status.next_best is None else status.next_best.sentence(),
        growth=_growth(report) if len(status.history) > 1 else None,
        bars=error_bars([k.label for k in status.held_out], aside, np.ones(len(aside), bool), "error, mm")
        if len(aside)
        else None,
        rows=rows,
        seconds=report.run.seconds,
    )


def _growth(report: MountingReport) -> bytes:
    """Expected error of a point at the work distance after every scan."""
    n, sigma = np.array(report.status.history).T
    required = report.run.cell.scenario.calibration.required_error_mm
    figure = Figure(figsize=(8.2, 2.8), layout="constrained")
    axes = figure.subplots()
    axes.plot(n, 1e3 * sigma, "o-", color=OURS, markersize=5)
    axes.axhline(required, color="#a8402f", linewidth=1, linestyle=":")
    axes.annotate(f"required {required:.2f}", (n[0], required), fontsize=9, va="bottom", color="#a8402f")
    axes.set_yscale("log")
    millimetres(axes)
    axes.set_xticks(n)
    axes.set_xlabel("scans")
    axes.set_ylabel("expected error, mm")
    return svg(figure, axes)
