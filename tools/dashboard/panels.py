"""Show the jobs besides the weld: steps, live plots and lines of text, from the job's newest messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from weldcal.models.arrays import Array
from weldcal.systems.viewer.live import Moment
from weldcal.tools.dashboard.facts import Facts

if TYPE_CHECKING:
    from weldcal.systems.jobs.mounting.procedure import MountingStatus
    from weldcal.systems.jobs.profiler.procedure import ProfilerState
    from weldcal.systems.jobs.tablet.procedure import TabletState
    from weldcal.systems.jobs.touch.procedure import TouchState
    from weldcal.systems.motion.drift_monitor import DriftStatus

ROWS = 240  # of a curve that is sent
X, Y, Z, PLAIN = "x", "y", "z", "line"  # the page's colours of curves
_NEWEST_FRAMES = 200


def stage_of(moment: Moment) -> str:
    """The key of the present step in the facts' steps: the command's phase, or what the state of another job says."""
    state: Any = moment.shown.get("state")
    if moment.command.finished:
        return moment.command.phase
    match type(state).__name__:  # by its name: the modules of the jobs that do not run are not imported
        case "MountingState" if state.label:
            return str(state.purpose)
        case "MountingState":
            return "start" if state.visit < 0 else "verify" if state.purpose == "calibrate" else "home"
        case "ProfilerState":
            return str(state.step) or "start"
        case "TabletState" | "TouchState" | "MotionState":
            return str(state.phase)
    return moment.command.phase


def panel(facts: Facts, moment: Moment) -> dict[str, Any] | None:
    """Heading, note, plots and lines of a job besides the weld; None where it has nothing to show."""
    state: Any = moment.shown.get("state")
    match type(state).__name__:
        case "MountingState" if (status := moment.shown.get("status")) is not None:
            return _mounting(facts, status)
        case "MotionState":
            drift = moment.shown.get("drift")
            return _motion(facts, moment) if drift is None else _drift(drift)
        case "TabletState":
            return _tablet(facts, state)
        case "TouchState":
            return _touch(facts, state)
        case "ProfilerState":
            return _profiler(state)
    return None


def _mounting(facts: Facts, status: MountingStatus) -> dict[str, Any]:
    points = [(float(n), 1e3 * sigma) for n, sigma in status.history]
    high = _high([2.0 * facts.required_mm, *(min(y, 20.0 * facts.required_mm) for _, y in points if math.isfinite(y))])
    last = "none yet"
    if status.held_out:
        found = status.held_out[-1]
        last = f"{found.label}, held out: the calibration is {1e3 * found.error_m:.2f} mm off there"
    elif status.refused and (not status.seen or status.sequence > len(status.seen) + len(status.refused) - 1):
        last = f"{status.refused[-1][0]}: not used, {status.refused[-1][1]}"
    if status.seen and not status.held_out and last == "none yet":
        circle = status.seen[-1]
        last = f"{circle.label}: the circle was found, {100.0 * circle.coverage:.0f} % of its edge was seen"
    lines = [("Last scan", last)]
    if status.next_best is not None:
        lines.append(("Would help most", status.next_best.sentence()))
    return {
        "heading": "Calibration",
        "note": _count(len(status.seen), "scan"),
        "plots": [
            _plot(
                "Expected error of a scanned point",
                "mm",
                [("expected", PLAIN, points)],
                (0.0, max(float(facts.maximum_scans), 1.0)),
                (0.0, high),
                "scans",
                (facts.required_mm, f"required {facts.required_mm:.2f} mm"),
                dots=True,
            )
        ],
        "lines": lines,
    }


def _motion(facts: Facts, moment: Moment) -> dict[str, Any]:
    from weldcal.systems.jobs.motion.procedure import MotionCalibration, MotionRecord

    record, found = moment.shown.get("record"), moment.shown.get("calibration")
    record = record if isinstance(record, MotionRecord) else MotionRecord()
    waits = 1e3 * np.array(record.waits_s[-_NEWEST_FRAMES:])
    k = np.arange(float(len(waits))) + len(record.waits_s) - len(waits)
    distance = np.array([np.linalg.norm(fit.center_C) for _, fit in record.seen[-_NEWEST_FRAMES:]])
    n = np.arange(float(len(distance))) + len(record.seen) - len(distance)
    lines = [("Flange found", f"in {len(record.seen)} of {len(record.seen) + len(record.refused)} frames")]
    if record.refused:
        lines.append(("Last refused", f"{record.refused[-1][0]}: {record.refused[-1][1]}"))
    if isinstance(found, MotionCalibration) and found.estimate is not None:
        held = 1e3 * float(np.nanmedian(found.estimate.held_out_m))
        lines.append(("Calibration", f"{held:.2f} mm median on frames that it did not use"))
    return {
        "heading": "Frames",
        "note": f"{len(record.seen)} of {facts.maximum_scans}",
        "plots": [
            _time_plot(
                "Distance of the flange", "mm", [("distance", PLAIN, n, 1e3 * distance)], "frames", middle=False
            ),
            _time_plot("From arrival to the estimate", "ms", [("wait", PLAIN, k, waits)], "frames", middle=False),
        ],
        "lines": lines,
    }


def _drift(status: DriftStatus) -> dict[str, Any]:
    rows = status.recent
    t = rows[:, 0] - rows[-1, 0] if len(rows) else np.empty(0)
    errors = [(name, name, t, 1e3 * rows[:, 1 + axis]) for axis, name in enumerate((X, Y, Z))]
    limit = status.threshold if math.isfinite(status.threshold) else None
    statistic = _time_plot("Drift test", "", [("statistic", PLAIN, t, rows[:, 5])], "s", middle=False)
    if limit is not None:
        statistic["limit"], statistic["limit_name"] = limit, "alarm"
        statistic["y"] = [0.0, max(1.25 * limit, statistic["y"][1])]
    return {
        "heading": "Watch",
        "note": _count(status.frames, "frame"),
        "warning": status.summary if status.moved else "",
        "plots": [
            _time_plot("Error of the calibration", "mm", errors, "s"),
            _time_plot("Offset of the scanner's clock", "ms", [("offset", PLAIN, t, 1e3 * rows[:, 4])], "s"),
            statistic,
        ],
        "lines": [("Verdict", status.summary or "no drift"), ("Frames dropped", str(status.dropped))],
    }


def _tablet(facts: Facts, state: TabletState) -> dict[str, Any]:
    points = [(float(t.position_px[0]), float(t.position_px[1])) for t in state.touches]
    reach = max([100.0, *(abs(v) for p in points for v in p)])
    y = [p[1] for p in points] or [0.0]
    span = (min(*y, 0.0) - 0.08 * reach, max(*y, 0.0) + 0.08 * reach)
    lines = [("Last touch", "none yet")]
    if state.touches:
        last = state.touches[-1]
        at = f"{last.position_px[0]:.1f}, {last.position_px[1]:.1f} px"
        lines = [("Last touch", f"landmark {last.landmark + 1} at {at} from the first landmark")]
    if state.phase in ("to_above", "descend", "lift"):
        lines.append(("Next", f"landmark {state.landmark + 1}"))
    plot = _plot(
        "Touches on the tablet", "px", [("touch", PLAIN, points)], (-0.08 * reach, 1.08 * reach), span, "px", dots=True
    )
    plot["now"] = f"{len(points)} of {facts.maximum_scans}"
    plot["line"] = False
    return {"heading": "Touches", "note": plot["now"], "plots": [plot], "lines": lines}


def _touch(facts: Facts, state: TouchState) -> dict[str, Any]:
    heights = [] if facts.height is None else [1e3 * facts.height(felt) for felt in state.felt]
    points = [(float(k + 1), y) for k, y in enumerate(heights)]
    reach = _high([0.1, *(abs(y) for y in heights)])
    across = (0.0, facts.maximum_scans + 1.0)
    plots = [
        _plot(
            "Touched face above the scanned one",
            "mm",
            [("touch", PLAIN, points)],
            across,
            (-reach, reach),
            "touches",
            dots=True,
        )
    ]
    plots[0]["line"] = False
    if state.zero is not None and state.frames and state.phase in ("descend", "press"):
        given = 1e3 * np.array([frame[2] - state.zero[2] for frame in state.frames[-_NEWEST_FRAMES:]])
        n = np.arange(float(len(given)))
        high = max(1.5 * facts.press_mm, float(given.max()))
        plots.append(
            _plot(
                f"Tip gives way at place {state.index + 1}",
                "mm",
                [("tip", PLAIN, [(float(a), float(b)) for a, b in np.column_stack([n, given])])],
                (0.0, max(float(len(given)), 1.0)),
                (min(-0.1, float(given.min())), high),
                "frames",
                (facts.press_mm, "touched"),
            )
        )
    last = "none yet"
    if heights:
        side = "above" if heights[-1] >= 0.0 else "below"
        last = f"place {len(heights)}: the face is {abs(heights[-1]):.3f} mm {side} the scanned one"
    lines = [("Last touch", last)]
    if state.places and state.phase in ("to_above", "zero", "descend"):
        lines.append(("Next", f"place {state.index + 1} of {len(state.places)}"))
    return {
        "heading": "Touches",
        "note": f"{len(state.felt)} of {facts.maximum_scans}",
        "warning": state.reason,
        "plots": plots,
        "lines": lines,
    }


def _profiler(state: ProfilerState) -> dict[str, Any]:
    lines, plots = [("Profiles", f"{len(state.taken)} in this step")], []
    scans = state.taken or state.seam_scans or state.sphere_scans or state.edge_scans
    if scans:
        p = 1e3 * np.asarray(scans[-1].points)
        p = p[np.isfinite(p).all(axis=1)]
        if len(p) > 1:
            low, high = float(p[:, 1].min()), float(p[:, 1].max())
            margin = max(0.1 * (high - low), 1.0)
            plots.append(
                _plot(
                    "Last profile: z over x",
                    "mm",
                    [("profile", PLAIN, [(float(x), float(z)) for x, z in _thinned(p)])],
                    (float(p[:, 0].min()), float(p[:, 0].max())),
                    (low - margin, high + margin),
                    "mm",
                )
            )
            plots[-1]["now"] = f"{len(p)} points"
    held = [
        (name, found.held_out_mm)
        for name, found in (("edge", state.edge), ("sphere", state.sphere))
        if found is not None
    ]
    for name, errors in held:
        known = np.asarray(errors)[np.isfinite(errors)]
        if len(known):
            curve = [(float(k + 1), abs(float(v))) for k, v in enumerate(known)]
            title = f"Held-out profiles of the {name}"
            high = _high([v for _, v in curve])
            plots.append(
                _plot(
                    title, "mm", [("error", PLAIN, curve)], (0.0, len(curve) + 1.0), (0.0, high), "profiles", dots=True
                )
            )
            plots[-1]["now"] = f"median {float(np.median(np.abs(known))):.2f} mm"
            plots[-1]["line"] = False
    if state.touches:
        lines.append(("Touches", str(len(state.touches))))
    if state.seam is not None:
        lines.append(("Seam", f"measured over {1e3 * state.seam.curve.length:.0f} mm"))
    return {"heading": "Profiles", "note": "", "plots": plots, "lines": lines}


def _time_plot(
    title: str, unit: str, curves: Sequence[tuple[str, str, Array, Array]], x_unit: str, *, middle: bool = True
) -> dict[str, Any]:
    """Return a plot over time or frames; `middle`: about zero, else from the least value to the largest."""
    values = np.concatenate([y[np.isfinite(y)] for *_, y in curves]) if curves else np.empty(0)
    x = curves[0][2] if curves else np.empty(0)
    if middle:
        reach = _high([0.1, *(np.percentile(np.abs(values), [99.0]) if len(values) else [])])
        span = (-reach, reach)
    elif len(values):
        low, high = float(values.min()), float(values.max())
        span = (min(low, 0.9 * low), max(1.05 * high, low + 1e-3))
    else:
        span = (0.0, 1.0)
    along = (float(x[0]), float(x[-1])) if len(x) > 1 else (0.0, 1.0)
    sent = [
        (name, colour, [(float(a), float(b)) for a, b in _thinned(np.column_stack([t, y]))])
        for name, colour, t, y in curves
    ]
    return _plot(title, unit, sent, along, span, x_unit)


def _plot(
    title: str,
    unit: str,
    curves: Sequence[tuple[str, str, Sequence[tuple[float, float]]]],
    x: tuple[float, float],
    y: tuple[float, float],
    x_unit: str,
    limit: tuple[float, str] | None = None,
    *,
    dots: bool = False,
) -> dict[str, Any]:
    """Return a plot for the page: curves of (name, colour, points), ranges, and a dashed line with its name."""
    last = [[p for p in points if math.isfinite(p[1])][-1:] for *_, points in curves]
    places = 0 if y[1] - y[0] > 20.0 else 1 if y[1] - y[0] > 2.0 else 2
    now = ", ".join(f"{p[0][1]:z.{max(places, 1)}f}" for p in last if p)
    return {
        "title": title,
        "now": f"{now} {unit}".strip() if now else "",
        "x": list(x),
        "y": list(y),
        "unit": x_unit,
        "places": places,
        "dots": dots,
        "line": True,
        "limit": None if limit is None else limit[0],
        "limit_name": "" if limit is None else limit[1],
        "curves": [
            {
                "name": name,
                "colour": colour,
                "points": [[round(a, 3), round(b, 4) if math.isfinite(b) else None] for a, b in points],
            }
            for name, colour, points in curves
        ],
    }


def _thinned(rows: Array) -> Array:
    return rows[:: max(1, len(rows) // ROWS)]


def _high(values: Sequence[float]) -> float:
    """Return the next of 1, 2, 5, 10 ... at or above the largest value."""
    largest = max([1e-3, *(v for v in values if math.isfinite(v))])
    power = 10.0 ** math.floor(math.log10(largest))
    return float(next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= largest * (1.0 - 1e-9)))


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"
