"""weldcal benchmark flange and flange-...: speed, detection, uncertainty and accuracy of the flange fit and calibration."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from weldcal.tools.cli.options import Call, Outcome, command, option, switch

if TYPE_CHECKING:
    from weldcal.tools.studies.flange.tables import Table

WidthOption = Annotated[int, option("--width", "PX", "Width of the PhoXi M images; 2064 is the full width.", min=200)]
FlangeName = Annotated[str, option("--flange", "NAME", "Flange standard.")]
FLANGE = "iso9409-1-50-4-m6"


@command("benchmark flange", short_help="Time the detection of the flange beside other chains.")
def speed(
    call: Call,
    loop: Annotated[
        bool, switch("--loop/--no-loop", "Also run the paper's search as a Python loop; takes seconds.")
    ] = True,
) -> Outcome:
    """Time the detection of the flange in a scan and compare with the paper's loop, an Open3D chain and a PCL-style search."""
    from weldcal.tools.studies.flange.speed import run_flange_benchmark
    from weldcal.tools.studies.flange.tables import speed_table

    return _figures(call, speed_table(run_flange_benchmark(call.seed, loop=loop, progress=call.progress)))


@command("benchmark flange-frames", short_help="Count detections in frames with and without a flange.")
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
    from weldcal.tools.studies.flange.tables import frames_table

    scanner, standard = get_scanner("phoxi_m", width), get_flange(flange)
    return _figures(call, frames_table(study_frames(scanner, standard, count, seed=call.seed, progress=call.progress)))


@command("benchmark flange-hidden", short_help="Detect a flange that is partly hidden.")
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
    from weldcal.tools.studies.flange.found import study_hidden
    from weldcal.tools.studies.flange.tables import hidden_table
    from weldcal.tools.worlds.flange_frames import WAYS

    scanner, standard = get_scanner("phoxi_m", width), get_flange(flange)
    rows = [
        study_hidden(w, scanner, standard, count, share=share, seed=call.seed, progress=call.progress) for w in WAYS
    ]
    return _figures(call, hidden_table(rows))


@command("benchmark flange-parts", short_help="Compare flange centres found in two parts of a cloud.")
def parts(
    call: Call,
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="A dataset folder with clouds, as for calibrate.")],
) -> Outcome:
    """Compare the flange centres found in two parts of one cloud: their distance, and its lower bound."""
    from weldcal.calibration.data.dataset import load_dataset
    from weldcal.models.errors import InputError
    from weldcal.models.flanges import get_flange
    from weldcal.tools.studies.flange.halves import study_parts
    from weldcal.tools.studies.flange.tables import parts_table

    data = load_dataset(dataset)
    if not data.clouds:
        raise InputError(f"'{dataset}' holds no clouds to divide. Give a dataset with scans.")
    rows = study_parts(
        [data.cloud(id) for id in data.clouds], get_flange(data.header.flange), seed=call.seed, progress=call.progress
    )
    return _figures(call, parts_table(rows))


@command("benchmark flange-honesty", short_help="Measure how often stated 95 % regions hold the truth.")
def honesty(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of calibrations of each size.", min=10)] = 500
) -> Outcome:
    """Measure how often the stated 95 % regions contain the truth, and the ratio of held-out to true errors."""
    from weldcal.tools.report.render import write_atomic
    from weldcal.tools.studies.flange.coverage import coverage_picture, study_corrected, study_coverage, study_warped
    from weldcal.tools.studies.flange.tables import coverage_table

    studies = [study_coverage(n, runs, call.seed, call.progress) for n in (5, 6, 8, 12, 20)]
    studies += [study_corrected(n, runs, call.seed, call.progress) for n in (6, 8, 12, 20)]
    studies.append(study_warped(12, max(10, runs // 5), call.progress))
    if call.out is not None:
        write_atomic(call.out / "coverage.svg", coverage_picture(studies))
    return _figures(call, coverage_table(studies))


@command("benchmark flange-live", short_help="Compare live calibrations with the Cramer-Rao bound.")
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
    from weldcal.tools.report.render import write_atomic
    from weldcal.tools.studies.flange.live import live_picture, study_live
    from weldcal.tools.studies.flange.tables import live_table

    rows = study_live(
        seeds, first=call.seed, scans=scans, repeatability_mm=repeatability, redraws=redraws, progress=call.progress
    )
    if call.out is not None and redraws:
        write_atomic(call.out / "live.svg", live_picture(rows))
    return _figures(call, live_table(rows, scans, repeatability))


@command("benchmark flange-ingredients", short_help="Measure what each part of the method contributes.")
def ingredients(
    call: Call, dataset: Annotated[Path, typer.Argument(help="A dataset folder of at least twelve scans.")]
) -> Outcome:
    """Measure what normals, hole circle, gradient and bends each contribute on recorded scans, and the lower limit."""
    from weldcal.tools.studies.flange.recorded import study_ingredients
    from weldcal.tools.studies.flange.tables import ingredients_table

    return _figures(call, ingredients_table(study_ingredients(dataset, call.seed, call.progress)))


@command("benchmark flange-few", short_help="Calibrate from 1 to 12 of the scans.")
def few(
    call: Call,
    dataset: Annotated[Path, typer.Argument(help="A dataset folder of at least eight scans.")],
    draws: Annotated[int, option("--draws", "N", "Number of random draws of each size.", min=2)] = 60,
) -> Outcome:
    """Calibrate from 1, 2, 3, 4, 6, 8 or 12 of the scans and measure the error on the scans that were not used."""
    from weldcal.tools.studies.flange.recorded import study_few_scans
    from weldcal.tools.studies.flange.tables import few_table

    return _figures(call, few_table(study_few_scans(dataset, draws, call.seed, progress=call.progress), draws))


@command("benchmark flange-holes", short_help="Fill holes of the flange and count wrong rotations.")
def holes(
    call: Call,
    scans: Annotated[int, option("--scans", "N", "Number of scans for each set of filled holes.", min=1)] = 200,
    width: WidthOption = 1032,
    flange: FlangeName = FLANGE,
) -> Outcome:
    """Fill holes of the flange and count the rotations about its axis that are stated, left open and wrong."""
    from weldcal.models.flanges import get_flange
    from weldcal.models.scanners import get_scanner
    from weldcal.tools.studies.flange.hole_turn import study_hole_turn
    from weldcal.tools.studies.flange.tables import hole_turn_table

    rows = study_hole_turn(
        get_scanner("phoxi_m", width), get_flange(flange), scans, seed=call.seed, progress=call.progress
    )
    return _figures(call, hole_turn_table(rows))


@command("benchmark flange-imperfect", short_help="Calibrate with an imperfect scanner and arm.")
def imperfect(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="[SCENARIO]", help="A scenario with simulated arm and scanner.")
    ] = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of calibrations, each in its own world.", min=10)] = 200,
) -> Outcome:
    """Calibrate with an imperfect scanner and arm, without rendering: errors at the work point, and how often they lie in the
    stated 95 % region."""
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.tools.studies.flange.imperfect import study_light_runs
    from weldcal.tools.studies.flange.tables import light_runs_table

    found = study_light_runs(load_scenario(scenario), runs, seed=call.seed, progress=call.progress)
    return _figures(call, light_runs_table(found))


@command("benchmark flange-halves", short_help="Calibrate from random halves of the scans.")
def held_out(
    call: Call,
    dataset: Annotated[Path, typer.Argument(help="A dataset folder of at least sixteen scans.")],
    draws: Annotated[int, option("--draws", "N", "Number of random halves.", min=1)] = 20,
    local: Annotated[
        bool, switch("--local", "Calibrate from two thirds with --refine local, and judge it on the others.")
    ] = False,
) -> Outcome:
    """Calibrate from random halves of the scans: the stated held-out error and its interval, against the error on the other half."""
    from weldcal.tools.studies.flange.held_out import study_halves
    from weldcal.tools.studies.flange.tables import halves_table

    return _figures(call, halves_table(study_halves(dataset, draws, call.seed, call.progress, local=local)))


@command("benchmark flange-arm", short_help="Calibrate cells with errors of the arm, and refine them.")
def arm(
    call: Call,
    worlds: Annotated[int, option("--worlds", "N", "Number of simulated cells.", min=1)] = 40,
    kind: Annotated[
        str, option("--kind", "KIND", "links: all errors of the arm; joints: zeros of the joints only.")
    ] = "links",
) -> Outcome:
    """Calibrate UR10e cells with factory-size errors of the arm from 20 planned scans, plain and refined, and judge both on new scans."""
    from weldcal.tools.studies.flange.tables import arm_table
    from weldcal.tools.worlds.wrong_arm import run_wrong_arm

    return _figures(call, arm_table(run_wrong_arm(worlds, call.seed, kind, call.progress)))


def _figures(call: Call, table: "Table") -> Outcome:
    """The outcome, also written to --out as summary.json where it is given."""
    summary, lines = table
    if call.out is not None:
        from weldcal.tools.report.files import write_json

        write_json(call.folder("benchmark", "flange") / "summary.json", summary)
    return Outcome(summary, values={}, rows=lines)
