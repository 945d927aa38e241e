"""weldcal benchmark flange and flange-frames, -hidden, -parts, -honesty, -live, -ingredients, -few: how fast, sure, honest and good."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console

SeedOption = Annotated[
    int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="Also write the figures there as summary.json.")
]


def mount(benchmarks: typer.Typer) -> None:
    """Adds the commands."""
    benchmarks.command("flange")(speed)
    benchmarks.command("flange-frames")(frames)
    benchmarks.command("flange-hidden")(hidden)
    benchmarks.command("flange-parts")(parts)
    benchmarks.command("flange-honesty")(honesty)
    benchmarks.command("flange-live")(live)
    benchmarks.command("flange-ingredients")(ingredients)
    benchmarks.command("flange-few")(few)


def speed(
    loop: Annotated[
        bool, typer.Option("--loop/--no-loop", help="Run the paper's search as a Python loop too; it takes seconds.")
    ] = True,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """How fast the flange is found in a scan, beside the paper's loop, an Open3D chain and a PCL-style search."""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange") as progress:
        from weldcal.tools.studies.flange.speed import run_flange_benchmark

        rows = run_flange_benchmark(seed, loop=loop, progress=progress)
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
    _finish("benchmark flange", {"state": "done", "rows": [vars(r) for r in rows]}, lines, out, json)


def frames(
    count: Annotated[
        int, typer.Option("--frames", metavar="N", min=1, help="Frames with a flange, and without.")
    ] = 500,
    width: Annotated[
        int, typer.Option("--width", metavar="PX", min=200, help="Of a PhoXi M frame; 2064 is all.")
    ] = 824,
    flange: Annotated[str, typer.Option("--flange", metavar="NAME", help="Flange standard.")] = "iso9409-1-50-4-m6",
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Found in every ray-cast frame that shows it, in none that does not? And how far the centre is off."""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange-frames") as progress:
        from weldcal.models.flanges import get_flange
        from weldcal.models.scanners import get_scanner
        from weldcal.tools.studies.flange.found import study_frames

        found = study_frames(get_scanner("phoxi_m", width), get_flange(flange), count, seed=seed, progress=progress)
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
        "found": f"{found.found} of {found.frames} (mistaken for something else: {found.mistaken})",
        "imagined": f"{found.imagined} of {found.frames} frames without a flange",
        "centre": f"{found.rms_mm:.3f} mm rms, {summary['centre_max_mm']:.3f} at most",
    }
    _finish("benchmark flange-frames", summary, lines, out, json)


def hidden(
    count: Annotated[int, typer.Option("--frames", metavar="N", min=1, help="Frames for each way of hiding.")] = 30,
    share: Annotated[
        float, typer.Option("--share", metavar="S", min=0.0, max=0.9, help="Hidden part of the flange's width.")
    ] = 0.5,
    width: Annotated[
        int, typer.Option("--width", metavar="PX", min=200, help="Of a PhoXi M frame; 2064 is all.")
    ] = 824,
    flange: Annotated[str, typer.Option("--flange", metavar="NAME", help="Flange standard.")] = "iso9409-1-50-4-m6",
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """A flange half hidden by a plate, the image's border or missing readings: found, and how honestly?"""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange-hidden") as progress:
        from weldcal.models.flanges import get_flange
        from weldcal.models.scanners import get_scanner
        from weldcal.tools.studies.flange.found import WAYS, study_hidden

        scanner, standard = get_scanner("phoxi_m", width), get_flange(flange)
        rows = [study_hidden(w, scanner, standard, count, share=share, seed=seed, progress=progress) for w in WAYS]
    summary: dict[str, object] = {"state": "done", "rows": [r.summary() for r in rows]}
    lines = {
        r.way: f"{len(r.errors_m)} of {r.frames} found, centre {r.rms_mm:.3f} mm rms; squared error over the stated one "
        f"{r.mean_normalised:.2f}; {100 * r.mean_coverage:.0f} % of the edge seen"
        for r in rows
    }
    _finish("benchmark flange-hidden", summary, lines, out, json)


def parts(
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder with clouds, as calibrate takes it.")],
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """How far do two parts of one cloud disagree about the flange's centre, and how far must they?"""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange-parts") as progress:
        from weldcal.calibration.data.dataset import load_dataset
        from weldcal.models.errors import InputError
        from weldcal.models.flanges import get_flange
        from weldcal.tools.studies.flange.halves import study_parts

        data = load_dataset(dataset)
        if not data.clouds:
            raise InputError(f"'{dataset}' holds no clouds to divide: give a dataset with scans.")
        rows = study_parts(
            [data.cloud(id) for id in data.clouds], get_flange(data.header.flange), seed=seed, progress=progress
        )
    lines = {
        f"{r.points} points each": f"{r.apart_mm:.3f} mm apart (rms; least possible {r.bound_mm:.3f}, stated "
        f"{r.stated_mm:.3f}); of the two together {0.5 * r.apart_mm:.3f}"
        for r in rows
    }
    _finish("benchmark flange-parts", {"state": "done", "rows": [vars(r) for r in rows]}, lines, out, json)


def honesty(
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=10, help="Calibrations of each size.")] = 500,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Do stated 95 % regions hold the truth 95 times in 100, and held-out errors agree with true ones?"""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange-honesty") as progress:
        from weldcal.tools.report.render import write_atomic
        from weldcal.tools.studies.flange.coverage import coverage_picture, study_corrected, study_coverage

        studies = [study_coverage(n, runs, seed, progress) for n in (5, 6, 8, 12, 20)]
        studies += [study_corrected(n, runs, seed, progress) for n in (6, 8, 12, 20)]
        if out is not None:
            write_atomic(out / "coverage.svg", coverage_picture(studies))
    lines = {
        f"{s.poses} scans{', scanner corrected' if s.corrected else ''}": f"X_BC in its 95 % region {100 * s.pose:.1f} %, the work "
        f"point in its {100 * s.point:.1f} %"
        + ("" if s.corrected else f"; held-out over true error {s.held_out_over_true:.2f}")
        for s in studies
    }
    _finish("benchmark flange-honesty", plain_studies(studies), lines, out, json)


def plain_studies(studies: Sequence[object]) -> dict[str, object]:
    """For JSON: what was not looked at as null."""
    rows = [{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in vars(s).items()} for s in studies]
    return {"state": "done", "studies": rows}


def live(
    seeds: Annotated[
        int, typer.Option("--seeds", metavar="N", min=1, help="Calibrations, each in a world of its own.")
    ] = 10,
    scans: Annotated[int, typer.Option("--scans", metavar="N", min=4, max=8, help="Scans of each.")] = 8,
    repeatability: Annotated[
        float, typer.Option("--repeatability", metavar="MM", min=0.0, help="Of the arm: rms distance of the flange.")
    ] = 0.05,
    redraws: Annotated[
        int,
        typer.Option(
            "--redraws", metavar="N", min=0, help="Calibrations more from each one's poses, noise drawn anew."
        ),
    ] = 50,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """How near the live calibration of the simulated station comes to the truth, beside the least that any could."""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange-live") as progress:
        import numpy as np

        from weldcal.tools.report.render import write_atomic
        from weldcal.tools.studies.flange.live import TARGET_M, TARGET_RAD, joined, live_picture, study_live

        rows = study_live(
            seeds, first=seed, scans=scans, repeatability_mm=repeatability, redraws=redraws, progress=progress
        )
        again = joined([r.redrawn for r in rows])
        if out is not None and redraws:
            write_atomic(out / "live.svg", live_picture(rows))
        work = 1e3 * np.array([r.at_work_m for r in rows])
        turn, turn_least = (np.degrees([getattr(r, k) for r in rows]) for k in ("rotation_rad", "least_rad"))
        least, expected = (1e3 * np.array([getattr(r, k) for r in rows]) for k in ("least_m", "expected_m"))
    rms, rms_deg = float(np.sqrt(np.mean(work**2))), float(np.sqrt(np.mean(turn**2)))
    summary: dict[str, object] = {
        "state": "done",
        "seeds": seeds,
        "scans": scans,
        "repeatability_mm": repeatability,
        "at_work_mm": {"mean": float(work.mean()), "rms": rms, "worst": float(work.max())},
        "rotation_deg": {"mean": float(turn.mean()), "rms": rms_deg, "worst": float(turn.max())},
        "expected_mm": float(np.sqrt(np.mean(expected**2))),
        "bound_mm": float(np.sqrt(np.mean(least**2))),
        "bound_deg": float(np.sqrt(np.mean(turn_least**2))),
        "target_mm": 1e3 * TARGET_M,
        "target_deg": float(np.degrees(TARGET_RAD)),
        "within": int(np.sum((work <= 1e3 * TARGET_M) & (turn <= np.degrees(TARGET_RAD)))),
        "rows": [{k: v for k, v in vars(r).items() if k != "redrawn"} for r in rows],
    }
    lines = {
        "at the work point": f"mean {work.mean():.3f}, rms {rms:.3f}, worst {work.max():.3f} mm (target {1e3 * TARGET_M:.2f}); "
        f"the estimates expected {summary['expected_mm']:.3f} rms",
        "rotation": f"mean {turn.mean():.4f}, rms {rms_deg:.4f}, worst {turn.max():.4f} degrees (target {summary['target_deg']:.2f})",
        "both within": f"{summary['within']} of {seeds} calibrations, {scans} scans each, arm repeats to {repeatability:g} mm (rms)",
        "no method below": f"{summary['bound_mm']:.3f} mm and {summary['bound_deg']:.4f} degrees rms (Cramer-Rao, these poses)",
    }
    if redraws:
        drawn = {
            "calibrations": len(again.at_work_m),
            "rms_mm": float(1e3 * np.sqrt(np.mean(again.at_work_m**2))),
            "rms_deg": float(np.degrees(np.sqrt(np.mean(again.rotation_rad**2)))),
            "p99_deg": float(np.degrees(np.percentile(again.rotation_rad, 99))),
            "within": again.within(TARGET_M, TARGET_RAD)[0],
            "within_at_bound": again.within(TARGET_M, TARGET_RAD)[1],
        }
        summary["redrawn"] = drawn
        lines["noise drawn anew"] = (
            f"{drawn['calibrations']} calibrations from the same poses: {drawn['rms_mm']:.3f} mm and {drawn['rms_deg']:.4f} degrees rms, "
            f"99 % within {drawn['p99_deg']:.4f} degrees; both within {100 * drawn['within']:.1f} %, at the bound "
            f"{100 * drawn['within_at_bound']:.1f} %"
        )
    _finish("benchmark flange-live", summary, lines, out, json)


def ingredients(
    dataset: Annotated[Path, typer.Argument(help="A folder of twelve scans and more.")],
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """What normals, hole circle, gradient and bends are each worth on recorded scans, and the floor under it."""
    with (
        console.boundary(json_wanted=json, debug=debug),
        console.progress_bar("benchmark flange-ingredients") as progress,
    ):
        import numpy as np

        from weldcal.tools.studies.flange.recorded import study_ingredients

        found = study_ingredients(dataset, seed, progress)
        rows: list[dict[str, object]] = []
        for r in found:
            e, t = 1e3 * r.position_m, np.degrees(r.tilt_rad)
            rows.append(
                {
                    "name": r.name,
                    "position_mm": {
                        "median": float(np.median(e)),
                        "mean": float(e.mean()),
                        "p95": float(np.percentile(e, 95)),
                    },
                    "median_sigma_mm": 1e3 * r.median_sigma_m(),
                    "tilt_deg": {"median": float(np.nanmedian(t)), "p95": float(np.nanpercentile(t, 95))},
                    "floor_mm": 1e3 * r.floor_m,
                }
            )
    lines = {
        r.name: f"{np.median(1e3 * r.position_m):.3f} +- {1e3 * r.median_sigma_m():.3f} / {1e3 * r.position_m.mean():.3f} / "
        f"{np.percentile(1e3 * r.position_m, 95):.3f} mm, tilt {np.nanmedian(np.degrees(r.tilt_rad)):.3f} / "
        f"{np.nanpercentile(np.degrees(r.tilt_rad), 95):.3f} degrees; spread alone {1e3 * r.floor_m:.3f} mm"
        for r in found
    }
    _finish("benchmark flange-ingredients", {"state": "done", "rows": rows}, lines, out, json)


def few(
    dataset: Annotated[Path, typer.Argument(help="A folder of eight scans and more.")],
    draws: Annotated[int, typer.Option("--draws", metavar="N", min=2, help="Random draws of each size.")] = 60,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """How good is a calibration from 1, 2, 3, 4, 6, 8 or 12 of the scans on those that it did not use?"""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark flange-few") as progress:
        import numpy as np

        from weldcal.tools.studies.flange.recorded import study_few_scans

        found = study_few_scans(dataset, draws, seed, progress=progress)
        rows: list[dict[str, object]] = []
        lines = {}
        for r in found:
            if len(r.position_m) < 2:
                lines[f"{r.scans} scans"] = f"{r.refused} of {draws} draws refused"
                continue
            median, tilt = 1e3 * float(np.median(r.position_m)), float(np.degrees(np.median(r.tilt_rad)))
            p95, sigma = 1e3 * float(np.percentile(r.position_m, 95)), 1e3 * r.median_sigma_m()
            rows.append(
                {
                    "scans": r.scans,
                    "median_mm": median,
                    "median_sigma_mm": sigma,
                    "p95_mm": p95,
                    "tilt_deg": tilt if np.isfinite(tilt) else None,
                    "corrected": r.corrected,
                    "refused": r.refused,
                }
            )
            lines[f"{r.scans} scan{'s' * (r.scans > 1)}"] = (
                f"{median:.3f} +- {sigma:.3f} mm, 95 % {p95:.3f}"
                + (f", tilt {tilt:.3f} degrees" if np.isfinite(tilt) else "")
                + f"; scanner corrected in {100 * r.corrected:.0f} %"
                + (f"; {r.refused} refused" if r.refused else "")
            )
    _finish("benchmark flange-few", {"state": "done", "draws": draws, "rows": rows}, lines, out, json)


def _finish(command: str, summary: dict[str, object], lines: dict[str, str], out: Path | None, json: bool) -> None:
    if out is not None:
        import json as text

        from weldcal.tools.report.render import write_atomic

        write_atomic(out / "summary.json", text.dumps(summary, indent=1))
    if json:
        console.emit_json(summary)
    else:
        width = max(len(name) for name in lines)
        for name, line in lines.items():
            typer.echo(f"{name:<{width}}  {line}")
