"""Tables of the flange benchmarks: from their results to the JSON object and the printed rows."""

from collections.abc import Sequence

import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.studies.flange.coverage import Coverage
from weldcal.tools.studies.flange.found import Found, Hidden
from weldcal.tools.studies.flange.halves import PartRow
from weldcal.tools.studies.flange.held_out import Halves
from weldcal.tools.studies.flange.hole_turn import HoleTurn
from weldcal.tools.studies.flange.imperfect import LightRuns
from weldcal.tools.studies.flange.live import TARGET_M, TARGET_RAD, LiveRow, joined
from weldcal.tools.studies.flange.recorded import Draws, Ingredient
from weldcal.tools.studies.flange.speed import Timing

Table = tuple[dict[str, object], dict[str, str]]
"""The JSON object, and the printed rows by their names."""


def _rows(name: str, rows: Sequence[object]) -> dict[str, object]:
    return {"state": "done", name: [vars(r) for r in rows]}


def speed_table(rows: Sequence[Timing]) -> Table:
    """Times per scan, against the first row."""
    lines = {}
    for r in rows:
        against = f"{r.median_ms / rows[0].median_ms:.0f} x ours" if r.target_ms is None else f"target {r.target_ms:g}"
        off = "found nothing" if r.error_mm is None else f"centre off by {r.error_mm:.3f} mm"
        lines[r.name] = f"{r.median_ms:.2f} ms (least {r.least_ms:.2f}, {against}), {off}"
    return _rows("rows", rows), lines


def frames_table(found: Found) -> Table:
    """Detections with and without a flange, and the error of the centre."""
    largest = float(1e3 * found.errors_m.max(initial=0.0))
    summary: dict[str, object] = {
        "state": "done",
        "frames": found.frames,
        "found": found.found,
        "mistaken": found.mistaken,
        "imagined": found.imagined,
        "centre_rms_mm": found.rms_mm,
        "centre_max_mm": largest,
        "missed": [{"frame": k, "reason": why} for k, why in found.missed],
    }
    return summary, {
        "found": f"{found.found} of {found.frames} (wrong object detected: {found.mistaken})",
        "false detections": f"{found.imagined} of {found.frames} frames without a flange",
        "centre": f"{found.rms_mm:.3f} mm rms, {largest:.3f} at most",
    }


def hidden_table(rows: Sequence[Hidden]) -> Table:
    """Half-hidden flanges, a row per kind of occlusion."""
    lines = {
        r.way: f"{len(r.errors_m)} of {r.frames} found, centre {r.rms_mm:.3f} mm rms; squared error over stated variance "
        f"{r.mean_normalised:.2f}; {100 * r.mean_coverage:.0f} % of the edge seen"
        for r in rows
    }
    return {"state": "done", "rows": [r.summary() for r in rows]}, lines


def hole_turn_table(rows: Sequence[HoleTurn]) -> Table:
    """Rotations of the hole pattern with holes filled, a row per set."""
    lines = {
        f"{r.filled} filled": f"of {r.scans} scans: {r.right} right, {r.wrong} wrong, {r.left_open} left open, "
        f"{r.no_pattern} without a pattern"
        for r in rows
    }
    return _rows("rows", rows), lines


def halves_table(found: Halves) -> Table:
    """What halves of a recording state of themselves, and their errors on the others."""
    lines = {
        "held-out error stated": f"{found.stated_mm:.3f} mm mean, from {found.scans} scans each",
        "error on the other half": f"{found.new_mm:.3f} mm mean",
        "in the stated 95 % interval": f"{found.inside} of {found.draws - found.skipped}",
    }
    return {"state": "done", **vars(found)}, lines


def arm_table(found: dict[str, object]) -> Table:
    """Errors at new scans with and without errors of the arm, and whether what is stated of them holds."""
    lines = {
        "error at new scans, plain": f"{found['plain_mm']:.3f} mm mean",
        "error at new scans, refined": f"{found['refined_mm']:.3f} mm mean (ratio {found['ratio']:.2f})",
        "in the stated 95 % region": f"{found['inside_95_percent']:.1f} %",
        "joint offsets within 3 sigma": f"{found['offsets_within_3_sigma_percent']:.1f} %",
    }
    return found, lines


def light_runs_table(found: LightRuns) -> Table:
    """Errors of light calibrations in the imperfect world, and their coverage."""
    low, high = found.chance()
    ours, rigid = 1e3 * found.error_m, 1e3 * found.rigid_m
    summary: dict[str, object] = {
        "state": "done",
        "runs": len(ours),
        "scans_mean": float(np.mean(found.scans)),
        "at_work_mm": {"mean": float(ours.mean()), "p95": float(np.percentile(ours, 95)), "worst": float(ours.max())},
        "expected_mm": float(1e3 * np.sqrt(np.mean(found.expected_m**2))),
        "inside_95": found.share_inside,
        "inside_95_chance": [low, high],
        "rigid_at_work_mm": {"mean": float(rigid.mean()), "worst": float(rigid.max())},
    }
    return summary, {
        "error at the work point": f"{ours.mean():.3f} mm mean, {np.percentile(ours, 95):.3f} 95 %, {ours.max():.3f} at most "
        f"({_rms(ours):.3f} rms; {summary['expected_mm']:.3f} expected), from {np.mean(found.scans):.1f} scans",
        "in the stated 95 % region": f"{100 * found.share_inside:.1f} % of {len(ours)} (exact regions: {100 * low:.1f} to "
        f"{100 * high:.1f} %)",
        "without a scanner correction": f"{rigid.mean():.3f} mm mean, {rigid.max():.3f} at most",
    }


def parts_table(rows: Sequence[PartRow]) -> Table:
    """Distance of the centres from two parts of one cloud, and its lower bound."""
    lines = {
        f"{r.points} points each": f"{r.apart_mm:.3f} mm apart (rms; least possible {r.bound_mm:.3f}, stated "
        f"{r.stated_mm:.3f}); of their mean {0.5 * r.apart_mm:.3f}"
        for r in rows
    }
    return _rows("rows", rows), lines


def coverage_table(studies: Sequence[Coverage]) -> Table:
    """How often the stated 95 % regions contain the truth, a row per number of scans."""
    lines = {
        f"{s.poses} scans{_scanner(s)}": f"X_BC in its 95 % region {100 * s.pose:.1f} %, the work "
        f"point in its {100 * s.point:.1f} %"
        + ("" if np.isnan(s.held_out_over_true) else f"; held-out over true error {s.held_out_over_true:.2f}")
        for s in studies
    }
    return _rows("studies", studies), lines


def _scanner(study: Coverage) -> str:
    if study.warped:
        return ", scanner of another model"
    return ", scanner corrected" if study.corrected else ""


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def live_table(rows: Sequence[LiveRow], scans: int, repeatability_mm: float) -> Table:
    """Errors of live calibrations against their targets and the Cramer-Rao bound, and with redrawn noise where there is some."""
    again = joined([r.redrawn for r in rows])
    work, least, expected = (
        1e3 * np.array([getattr(r, k) for r in rows]) for k in ("at_work_m", "least_m", "expected_m")
    )
    turn, turn_least = (np.degrees([getattr(r, k) for r in rows]) for k in ("rotation_rad", "least_rad"))
    at_work, rotation = ({"mean": v.mean(), "rms": _rms(v), "worst": v.max()} for v in (work, turn))
    target_mm, target_deg = 1e3 * TARGET_M, float(np.degrees(TARGET_RAD))
    summary: dict[str, object] = {
        "state": "done",
        "seeds": len(rows),
        "scans": scans,
        "repeatability_mm": repeatability_mm,
        "at_work_mm": at_work,
        "rotation_deg": rotation,
        "expected_mm": _rms(expected),
        "bound_mm": _rms(least),
        "bound_deg": _rms(turn_least),
        "target_mm": target_mm,
        "target_deg": target_deg,
        "within": int(np.sum((work <= target_mm) & (turn <= target_deg))),
        "rows": [{k: v for k, v in vars(r).items() if k != "redrawn"} for r in rows],
    }
    shown = "mean {mean:.3f}, rms {rms:.3f}, worst {worst:.3f} mm"
    lines = {
        "at the work point": f"{shown.format(**at_work)} (target {target_mm:.2f}); the estimates expected {_rms(expected):.3f} rms",
        "rotation": f"{shown.replace('3f', '4f').replace('mm', 'degrees').format(**rotation)} (target {target_deg:.2f})",
        "both within": f"{summary['within']} of {len(rows)} calibrations, {scans} scans each, arm repeats to {repeatability_mm:g} mm (rms)",
        "lower bound": f"{_rms(least):.3f} mm and {_rms(turn_least):.4f} degrees rms (Cramer-Rao, for these poses)",
    }
    if len(again.at_work_m):
        within, within_at_bound = again.within(TARGET_M, TARGET_RAD)
        turns = np.degrees(again.rotation_rad)
        summary["redrawn"] = drawn = {
            "calibrations": len(again.at_work_m),
            "rms_mm": _rms(1e3 * again.at_work_m),
            "rms_deg": _rms(turns),
            "p99_deg": float(np.percentile(turns, 99)),
            "within": within,
            "within_at_bound": within_at_bound,
        }
        lines["new noise"] = (
            "{calibrations} calibrations from the same poses: {rms_mm:.3f} mm and {rms_deg:.4f} degrees rms, 99 % within "
            "{p99_deg:.4f} degrees; both within {within:.1%}, at the bound {within_at_bound:.1%}"
        ).format(**drawn)
    return summary, lines


def ingredients_table(found: Sequence[Ingredient]) -> Table:
    """Held-out errors by each ingredient of the calibration, and what the spread alone leaves."""
    rows, lines = [], {}
    for r in found:
        e, tilt, sigma = 1e3 * r.position_m, np.degrees(r.tilt_rad), 1e3 * r.median_sigma_m()
        position = {"median": np.median(e), "mean": e.mean(), "p95": np.percentile(e, 95)}
        turn = {"median": np.nanmedian(tilt), "p95": np.nanpercentile(tilt, 95)}
        floor = 1e3 * r.floor_m
        rows.append(
            {"name": r.name, "position_mm": position, "median_sigma_mm": sigma, "tilt_deg": turn, "floor_mm": floor}
        )
        lines[r.name] = (
            f"{position['median']:.3f} +- {sigma:.3f} / {position['mean']:.3f} / {position['p95']:.3f} mm, "
            f"tilt {turn['median']:.3f} / {turn['p95']:.3f} degrees; spread alone {floor:.3f} mm"
        )
    return {"state": "done", "rows": rows}, lines


def few_table(found: Sequence[Draws], draws: int) -> Table:
    """Errors of calibrations from few scans, on the scans that were not used."""
    rows, lines = [], {}
    for r in found:
        if len(r.position_m) < 2:
            lines[f"{r.scans} scans"] = f"{r.refused} of {draws} draws refused"
            continue
        median, tilt = 1e3 * float(np.median(r.position_m)), float(np.degrees(np.median(r.tilt_rad)))
        p95, sigma = 1e3 * float(np.percentile(r.position_m, 95)), 1e3 * r.median_sigma_m()
        row = {"scans": r.scans, "median_mm": median, "median_sigma_mm": sigma, "p95_mm": p95, "tilt_deg": tilt}
        rows.append({**row, "corrected": r.corrected, "refused": r.refused})
        lines[f"{r.scans} scan{'s' * (r.scans > 1)}"] = (
            f"{median:.3f} +- {sigma:.3f} mm, 95 % {p95:.3f}"
            + (f", tilt {tilt:.3f} degrees" if np.isfinite(tilt) else "")
            + f"; scanner corrected in {100 * r.corrected:.0f} %"
            + (f"; {r.refused} refused" if r.refused else "")
        )
    return {"state": "done", "draws": draws, "rows": rows}, lines
