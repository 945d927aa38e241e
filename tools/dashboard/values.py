"""Write what the page shows as words and numbers of JSON: state, steps, plots, last and next scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from weldcal.systems.jobs.weld.iterative_calibrator import PoseRequest
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, PlannedSeam
from weldcal.systems.viewer.cameras import CAMERAS, FOLLOW, Views
from weldcal.systems.viewer.live import ACTIVE, Moment, ScanRow, WeldRow
from weldcal.systems.viewer.scene import RESIDUAL_MM, WELDING_PHASES, LegendKey, legend, uncertainty_at
from weldcal.tools.dashboard.facts import SCAN, Facts
from weldcal.tools.dashboard.panels import stage_of

STARTING, RUNNING, STOPPING, HELD, DONE, ENDED = "STARTING", "RUNNING", "STOPPING", "HELD", "DONE", "ENDED"
LEAST_SHARE = 0.1
"""Share of a run from which on the time left can be told by the time so far."""
LOW_MARGIN = 0.5
"""Share of the steering margin below which the page shows it."""


def mm(metres: float, digits: int = 3) -> float | None:
    """Millimetres for JSON; None for a number that is not finite."""
    return number(1e3 * metres, digits)


def number(value: float, digits: int = 3) -> float | None:
    """Return a number for JSON, rounded; None for one that is not finite."""
    return round(value, digits) if math.isfinite(value) else None


def steps(facts: Facts, phase: str) -> list[dict[str, str]]:
    """Return the job's steps, each "done", "now" or "next"; none for a job that states no steps."""
    at = next((k for k, (_, phases) in enumerate(facts.steps) if phase in phases), None)
    if phase == "done":
        at = len(facts.steps)
    if at is None:
        return []
    return [
        {"name": name, "is": "done" if k < at else "now" if k == at else "next"}
        for k, (name, _) in enumerate(facts.steps)
    ]


def weld_values(facts: Facts, moment: Moment, newest: Sequence[WeldRow]) -> dict[str, Any] | None:
    """Return the weld's present values; None while the tip does not follow a seam."""
    report, planned = moment.shown.get("servo_report"), moment.shown.get("planned_seam")
    if not isinstance(report, ServoReport) or not isinstance(planned, PlannedSeam) or planned.seam is None:
        return None
    if report.phase not in ACTIVE or report.command is None:
        return None
    length, now = planned.seam.length, report.command.diagnostics
    row = newest[-1] if newest else None
    left_s = max(length - now.s_torch, 0.0) * 1e3 / facts.weld_speed_mm_s
    share = (moment.sigma_min - facts.sigma_stop) / (2.0 * (facts.sigma_slow - facts.sigma_stop))
    margin = round(100.0 * max(share, 0.0)) if math.isfinite(share) and share < LOW_MARGIN else None
    return {
        "phase": report.phase,
        "at_mm": mm(min(max(now.s_torch, 0.0), length), 1),
        "length_mm": mm(length, 1),
        "left_s": number(left_s, 0),
        "beside_mm": mm(now.e_t),
        "offset_mm": None if row is None else mm(row.offset),
        "deflection_mm": None if row is None else mm(row.deflection),
        "speed_mm_s": None if row is None else mm(row.speed, 2),
        "torch_on": report.torch_on,
        "margin_percent": margin,
        "back_mm": mm(report.way_back_m, 1) if report.way_back_m > 0.0 else None,
    }


def left_s(facts: Facts, moment: Moment, share: float = 0.0) -> float | None:
    """Seconds of the job that are left, about, of which this share is done; None while that is not known."""
    at = [k for k, step in enumerate(steps(facts, stage_of(moment))) if step["is"] == "now"]
    if not at or moment.time <= 0.0:
        return None
    if not facts.seconds:
        return round(moment.time * (1.0 - share) / share) if share > LEAST_SHARE else None
    name, after = facts.steps[at[0]][0], [name for name, _ in facts.steps[at[0] + 1 :]]
    now, weld = facts.seconds.get(name, 0.0), weld_values(facts, moment, ())
    status = moment.shown.get("calibration_status")
    if weld is not None and weld["left_s"] is not None:
        now = weld["left_s"]
    elif name == "Calibrate" and isinstance(status, CalibrationStatus):
        scans = status.calibration_scans
        each = moment.time / scans if scans > 1 else facts.seconds.get(SCAN, 0.0)
        now = each * max(facts.minimum_scans - scans, 1)
    return round(now + sum(facts.seconds.get(n, 0.0) for n in after))


def scan_values(facts: Facts, moment: Moment) -> dict[str, Any] | None:
    """Return the calibration's present values; None where the job does not calibrate."""
    status, pose = moment.shown.get("calibration_status"), moment.shown.get("next_pose")
    if not isinstance(status, CalibrationStatus) or not math.isfinite(facts.required_mm):
        return None
    found: dict[str, Any] = {
        "scans": status.calibration_scans,
        "maximum": facts.maximum_scans,
        "error_mm": mm(status.predicted_error_m),
        "required_mm": facts.required_mm,
        "last": _last_scan(status),
        "next": None,
        "verified": [{"label": v.label, "error_mm": mm(v.error_m)} for v in status.verifications],
    }
    if not status.done and isinstance(pose, PoseRequest) and pose.q is not None:
        found["next"] = _next_pose(facts, status, pose)
    return found


def _last_scan(status: CalibrationStatus) -> str | None:
    """Return the newest scan: used with its residual, or why it was refused."""
    if status.verifications:
        last = status.verifications[-1]
        return f"{last.label}, held out: the calibration is {1e3 * last.error_m:.2f} mm off there"
    if status.refused and (
        not status.observations or (status.calibration_scans > len(status.observations) and status.message)
    ):
        label, reason = status.refused[-1]
        return f"{label}: not used, {reason}"
    if not status.observations:
        return None
    label, estimate = status.observations[-1].id, status.estimate
    if estimate is None or len(estimate.position_residuals_m) != len(status.observations):
        return f"{label}: the flange was found"
    residual = 1e3 * float(estimate.position_residuals_m[-1])
    return f"{label}: the flange was found, {residual:.2f} mm from where the calibration puts it"


def _next_pose(facts: Facts, status: CalibrationStatus, pose: PoseRequest) -> str:
    """The next pose, and why it is the next."""
    then = math.nan if facts.gain is None else facts.gain(status, pose.index)
    if math.isfinite(then) and math.isfinite(status.predicted_error_m):
        now = 1e3 * status.predicted_error_m
        return f"{pose.label}, which adds most of the planned poses: {now:.2f} to about {1e3 * then:.2f} mm expected"
    return f"{pose.label}, which adds most of the planned poses"


def weld_rows(rows: Sequence[WeldRow]) -> list[list[float | None]]:
    """Rows of the weld's plots: time s, mm of seam of torch and tip, mm beside the plan, mm of deflection, mm/s."""
    return [
        [number(r.time, 2), mm(r.s_torch, 2), mm(r.s_tip, 2), mm(r.offset), mm(r.deflection), mm(r.speed, 2)]
        for r in rows
    ]


def scan_rows(rows: Sequence[ScanRow]) -> list[list[float | None]]:
    """Rows of the calibration's plot: scans, expected error mm, held-out median mm."""
    return [[r.scans, mm(r.predicted), mm(r.held_out)] for r in rows]


def scene_values(facts: Facts, moment: Moment, views: Views) -> dict[str, Any]:
    """What lies over the 3D view: the cameras, and the legend of what is drawn now."""
    status = moment.shown.get("calibration_status")
    keys: list[LegendKey] = []
    estimate, scale = None, None
    if isinstance(status, CalibrationStatus):
        estimate = status.estimate if math.isfinite(facts.required_mm) else None
        phase = moment.command.phase
        times = None
        if estimate is not None and facts.work_B is not None:
            times = uncertainty_at(estimate, facts.work_B).magnification
        if math.isfinite(facts.required_mm) or phase in WELDING_PHASES:
            keys = legend(phase, times)
        if estimate is not None and phase not in (*WELDING_PHASES, "scan_workpiece", "park", "home", "done", "held"):
            scale = RESIDUAL_MM
    return {
        "cameras": (
            [{"key": name, "name": CAMERAS[name]} for name in (FOLLOW, *views.known)] if len(views.known) > 1 else []
        ),
        "wanted": views.wanted,
        "showing": views.showing,
        "legend": [key._asdict() for key in keys],
        "scale_mm": scale,
    }
