"""weldcal benchmark flange and flange-...: speed, detection, uncertainty and accuracy of the flange fit and calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from weldcal.tools.cli.options import Call, Outcome, command, option, switch

if TYPE_CHECKING:
    from numpy.typing import NDArray

WidthOption = Annotated[int, option("--width", "PX", "Width of the PhoXi M images; 2064 is the full width.", min=200)]
FlangeName = Annotated[str, option("--flange", "NAME", "Flange standard.")]
FLANGE = "iso9409-1-50-4-m6"


@command("benchmark flange")
def speed(
    call: Call,
    loop: Annotated[
        bool, switch("--loop/--no-loop", "Also run the paper's search as a Python loop; takes seconds.")
    ] = True,
) -> Outcome:
    """Time the detection of the flange in a scan and compare with the paper's loop, an Open3D chain and a PCL-style search."""
    from weldcal.tools.studies.flange.speed import run_flange_benchmark

    rows = run_flange_benchmark(call.seed, loop=loop, progress=call.progress)
    reference = {r.name: r for r in rows}["weldcal, " + rows[0].name.removeprefix("weldcal, ")]
    lines = {
        r.name: f"{r.median_ms:.2f} ms (least {r.least_ms:.2f}"
        + (
            f", target {r.target_ms:g}"
            if r.target_ms is not None
            else f", {r.median_ms / reference.median_ms:.0f} x ours"
        )
        + (f"), centre off by {r.error_mm:.3f} mm" if r.error_mm is not None else "), found nothing")
        for r in rows
    }
    return _figures(call, {"state": "done", "rows": [vars(r) for r in rows]}, lines)


@command("benchmark flange-frames")
def frames(
    call: Call,
    count: Annotated[int, option("--frames", "N", "Number of frames with a flange, and without.", min=1)] = 500,
    width: WidthOption = 824,
    flange: FlangeName = FLANGE,
) -> Outcome:
    """Detect the flange in ray-cast frames with and without one: detections, false detections and centre error."""
    from weldcal.models.flanges import get_flange
    from weldcal.models.scanners import get_scanner
    from weldcal.tools.studies.flange.found import study_frames

    found = study_frames(
        get_scanner("phoxi_m", width), get_flange(flange), count, seed=call.seed, progress=call.progress
    )
    summary: dict[str, object] = {
        "state": "done",
        "frames": found.frames,
        "found": found.found,
        "mistaken": found.mistaken,
        "imagined": found.imagined,
        "centre_rms_mm": found.rms_mm,
        "centre_max_mm": float(1e3 * found.errors_m.max(initial=0.0)),
        "missed": [{"frame": k, "reason": why} for k, why in found.missed],
    }
    lines = {
        "found": f"{found.found} of {found.frames} (wrong object detected: {found.mistaken})",
        "false detections": f"{found.imagined} of {found.frames} frames without a flange",
        "centre": f"{found.rms_mm:.3f} mm rms, {summary['centre_max_mm']:.3f} at most",
    }
    return _figures(call, summary, lines)


@command("benchmark flange-hidden")
def hidden(
    call: Call,
    count: Annotated[int, option("--frames", "N", "Number of frames for each kind of occlusion.", min=1)] = 30,
    share: Annotated[float, option("--share", "S", "Hidden share of the flange's width.", min=0.0, max=0.9)] = 0.5,
    width: WidthOption = 824,
    flange: FlangeName = FLANGE,
) -> Outcome:
    """Detect a flange partly hidden by a plate, the image border or missing readings: detections, and errors in units of the
    stated uncertainty."""
    from weldcal.models.flanges import get_flange
    from weldcal.models.scanners import get_scanner
    from weldcal.tools.studies.flange.found import WAYS, study_hidden

    scanner, standard = get_scanner("phoxi_m", width), get_flange(flange)
    rows = [
        study_hidden(w, scanner, standard, count, share=share, seed=call.seed, progress=call.progress) for w in WAYS
    ]
    summary: dict[str, object] = {"state": "done", "rows": [r.summary() for r in rows]}
    lines = {
        r.way: f"{len(r.errors_m)} of {r.frames} found, centre {r.rms_mm:.3f} mm rms; squared error over stated variance "
        f"{r.mean_normalised:.2f}; {100 * r.mean_coverage:.0f} % of the edge seen"
        for r in rows
    }
    return _figures(call, summary, lines)


@command("benchmark flange-parts")
def parts(
    call: Call,
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="A dataset folder with clouds, as for calibrate.")],
) -> Outcome:
    """Compare the flange centres found in two parts of one cloud: their distance, and its lower bound."""
    from weldcal.calibration.data.dataset import load_dataset
    from weldcal.models.errors import InputError
    from weldcal.models.flanges import get_flange
    from weldcal.tools.studies.flange.halves import study_parts

    data = load_dataset(dataset)
    if not data.clouds:
        raise InputError(f"'{dataset}' holds no clouds to divide. Give a dataset with scans.")
    rows = study_parts(
        [data.cloud(id) for id in data.clouds], get_flange(data.header.flange), seed=call.seed, progress=call.progress
    )
    lines = {
        f"{r.points} points each": f"{r.apart_mm:.3f} mm apart (rms; least possible {r.bound_mm:.3f}, stated "
        f"{r.stated_mm:.3f}); of their mean {0.5 * r.apart_mm:.3f}"
        for r in rows
    }
    return _figures(call, {"state": "done", "rows": [vars(r) for r in rows]}, lines)


@command("benchmark flange-honesty")
def honesty(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of calibrations of each size.", min=10)] = 500
) -> Outcome:
    """Measure how often the stated 95 % regions contain the truth, and the ratio of held-out to true errors."""
    from weldcal.tools.report.render import write_atomic
    from weldcal.tools.studies.flange.coverage import coverage_picture, study_corrected, study_coverage

    studies = [study_coverage(n, runs, call.seed, call.progress) for n in (5, 6, 8, 12, 20)]
    studies += [study_corrected(n, runs, call.seed, call.progress) for n in (6, 8, 12, 20)]
    if call.out is not None:
        write_atomic(call.out / "coverage.svg", coverage_picture(studies))
    lines = {
        f"{s.poses} scans{', scanner corrected' if s.corrected else ''}": f"X_BC in its 95 % region {100 * s.pose:.1f} %, the work "
        f"point in its {100 * s.point:.1f} %"
        + ("" if s.corrected else f"; held-out over true error {s.held_out_over_true:.2f}")
        for s in studies
    }
    return _figures(call, {"state": "done", "studies": [vars(s) for s in studies]}, lines)


@command("benchmark flange-live")
def live(
    call: Call,
    seeds: Annotated[int, option("--seeds", "N", "Number of calibrations, each in its own world.", min=1)] = 10,
    scans: Annotated[int, option("--scans", "N", "Scans of each calibration.", min=4, max=8)] = 8,
    repeatability: Annotated[
        float, option("--repeatability", "MM", "Repeatability of the arm: rms distance of the flange.", min=0.0)
    ] = 0.05,
    redraws: Annotated[
        int, option("--redraws", "N", "Further calibrations from the poses of each, with new noise.", min=0)
    ] = 50,
) -> Outcome:
    """Measure the error of the live calibration in simulation and compare with the Cramer-Rao bound."""
    import numpy as np

    from weldcal.tools.report.render import write_atomic
    from weldcal.tools.studies.flange.live import TARGET_M, TARGET_RAD, joined, live_picture, study_live

    rows = study_live(
        seeds, first=call.seed, scans=scans, repeatability_mm=repeatability, redraws=redraws, progress=call.progress
    )
    again = joined([r.redrawn for r in rows])
    if call.out is not None and redraws:
        write_atomic(call.out / "live.svg", live_picture(rows))

    def rms(values: NDArray[np.float64]) -> float:
        return float(np.sqrt(np.mean(values**2)))

    work, least, expected = (
        1e3 * np.array([getattr(r, k) for r in rows]) for k in ("at_work_m", "least_m", "expected_m")
    )
    turn, turn_least = (np.degrees([getattr(r, k) for r in rows]) for k in ("rotation_rad", "least_rad"))
    at_work, rotation = ({"mean": v.mean(), "rms": rms(v), "worst": v.max()} for v in (work, turn))
    target_mm, target_deg = 1e3 * TARGET_M, float(np.degrees(TARGET_RAD))
    summary: dict[str, object] = {
        "state": "done",
        "seeds": seeds,
        "scans": scans,
        "repeatability_mm": repeatability,
        "at_work_mm": at_work,
        "rotation_deg": rotation,
        "expected_mm": rms(expected),
        "bound_mm": rms(least),
        "bound_deg": rms(turn_least),
        "target_mm": target_mm,
        "target_deg": target_deg,
        "within": int(np.sum((work <= target_mm) & (turn <= target_deg))),
        "rows": [{k: v for k, v in vars(r).items() if k != "redrawn"} for r in rows],
    }
    shown = "mean {mean:.3f}, rms {rms:.3f}, worst {worst:.3f} mm"
    lines = {
        "at the work point": f"{shown.format(**at_work)} (target {target_mm:.2f}); the estimates expected {rms(expected):.3f} rms",
        "rotation": f"{shown.replace('3f', '4f').replace('mm', 'degrees').format(**rotation)} (target {target_deg:.2f})",
        "both within": f"{summary['within']} of {seeds} calibrations, {scans} scans each, arm repeats to {repeatability:g} mm (rms)",
        "lower bound": f"{rms(least):.3f} mm and {rms(turn_least):.4f} degrees rms (Cramer-Rao, for these poses)",
    }
    if redraws:
        within, within_at_bound = again.within(TARGET_M, TARGET_RAD)
        turns = np.degrees(again.rotation_rad)
        drawn = {
            "calibrations": len(again.at_work_m),
            "rms_mm": rms(1e3 * again.at_work_m),
            "rms_deg": rms(turns),
            "p99_deg": float(np.percentile(turns, 99)),
            "within": within,
            "within_at_bound": within_at_bound,
        }
        summary["redrawn"] = drawn
        lines["new noise"] = (
            "{calibrations} calibrations from the same poses: {rms_mm:.3f} mm and {rms_deg:.4f} degrees rms, 99 % within "
            "{p99_deg:.4f} degrees; both within {within:.1%}, at the bound {within_at_bound:.1%}"
        ).format(**drawn)
    return _figures(call, summary, lines)


@command("benchmark flange-ingredients")
def ingredients(
    call: Call, dataset: Annotated[Path, typer.Argument(help="A dataset folder of at least twelve scans.")]
) -> Outcome:
    """Measure what normals, hole circle, gradient and bends each contribute on recorded scans, and the lower limit."""
    import numpy as np

    from weldcal.tools.studies.flange.recorded import study_ingredients

    found = study_ingredients(dataset, call.seed, call.progress)
    rows: list[dict[str, object]] = []
    lines = {}
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
    return _figures(call, {"state": "done", "rows": rows}, lines)


@command("benchmark flange-few")
def few(
    call: Call,
    dataset: Annotated[Path, typer.Argument(help="A dataset folder of at least eight scans.")],
    draws: Annotated[int, option("--draws", "N", "Number of random draws of each size.", min=2)] = 60,
) -> Outcome:
    """Calibrate from 1, 2, 3, 4, 6, 8 or 12 of the scans and measure the error on the scans that were not used."""
    import numpy as np

    from weldcal.tools.studies.flange.recorded import study_few_scans

    found = study_few_scans(dataset, draws, call.seed, progress=call.progress)
    rows: list[dict[str, object]] = []
    lines = {}
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
    return _figures(call, {"state": "done", "draws": draws, "rows": rows}, lines)


COMMANDS = (speed, frames, hidden, parts, honesty, live, ingredients, few)


def _figures(call: Call, summary: dict[str, object], lines: dict[str, str]) -> Outcome:
    """The outcome, also written to --out as summary.json where it is given."""
    if call.out is not None:
        import json

        from weldcal.tools.console import plain
        from weldcal.tools.report.render import write_atomic

        write_atomic(call.folder("benchmark", "flange") / "summary.json", json.dumps(plain(summary), indent=1))
    return Outcome(summary, values={}, rows=lines)
