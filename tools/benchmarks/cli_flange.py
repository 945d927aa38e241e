"""weldcal benchmark flange, flange-frames, flange-hidden, flange-parts and flange-honesty: how fast, sure and honest it is."""

from __future__ import annotations

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
    """Adds the five commands."""
    benchmarks.command("flange")(speed)
    benchmarks.command("flange-frames")(frames)
    benchmarks.command("flange-hidden")(hidden)
    benchmarks.command("flange-parts")(parts)
    benchmarks.command("flange-honesty")(honesty)


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
        from weldcal.tools.benchmarks.flange import run_flange_benchmark

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
        from weldcal.tools.studies.flange_found import study_frames

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
        from weldcal.tools.studies.flange_hidden import WAYS, study_hidden

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
        from weldcal.calibration.dataset import load_dataset
        from weldcal.models.errors import InputError
        from weldcal.models.flanges import get_flange
        from weldcal.tools.studies.flange_halves import study_parts

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
        from weldcal.tools.studies.coverage import study_coverage

        studies = [study_coverage(n, runs, seed, progress) for n in (6, 8, 12, 20)]
    lines = {
        f"{s.poses} scans": f"X_BC in its 95 % region {100 * s.pose:.1f} %, the work point in its {100 * s.point:.1f} %; "
        f"held-out over true error {s.held_out_over_true:.2f}"
        for s in studies
    }
    _finish("benchmark flange-honesty", {"state": "done", "studies": [vars(s) for s in studies]}, lines, out, json)


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
