"""The command line: one short function per command, heavy imports inside it, so that help appears at once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console
from weldcal.tools.cli import hand_eye as cli_hand_eye
from weldcal.tools.cli.benchmark.flange import mount as mount_flange
from weldcal.tools.cli.benchmark.profiler import profiler as benchmark_profiler
from weldcal.tools.cli.benchmark.seam_planning import seam_planning
from weldcal.tools.cli.mountings import benchmark_mountings, live
from weldcal.tools.cli.options import (
    BrowserOption,
    CorrectionOption,
    DebugOption,
    DryRunOption,
    JsonOption,
    OutOption,
    PaceOption,
    RealtimeOption,
    RobotOption,
    ScenarioOption,
    SeedOption,
    SpeedFactorOption,
    finish,
    fresh_folder,
)
from weldcal.tools.cli.profiler import profiler
from weldcal.tools.cli.profiler_live import live as profiler_live
from weldcal.tools.cli.reproduce.cell import cell as reproduce_cell
from weldcal.tools.cli.reproduce.group import reproduce
from weldcal.tools.cli.reproduce.tablet import benchmark_tablet
from weldcal.tools.cli.robot import mount as mount_robot
from weldcal.tools.cli.robots import robots
from weldcal.tools.cli.tablet import tablet

app = typer.Typer(
    name="weldcal",
    help="Calibrate a 3D scanner to a robot by its own flange, then feel along a weld seam.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
benchmarks = typer.Typer(help="Speed tables.", no_args_is_help=True)
app.add_typer(benchmarks, name="benchmark")
app.add_typer(reproduce, name="reproduce")
reproduce.command("cell")(reproduce_cell)
app.add_typer(tablet, name="tablet")
benchmarks.command("tablet")(benchmark_tablet)
benchmarks.command("seam-planning")(seam_planning)
mount_flange(benchmarks)
app.add_typer(cli_hand_eye.hand_eye, name="hand-eye")
cli_hand_eye.hand_eye.command("live")(live)
benchmarks.command("hand-eye")(cli_hand_eye.benchmark)
benchmarks.command("mountings")(benchmark_mountings)
app.add_typer(profiler, name="profiler")
benchmarks.command("profiler")(benchmark_profiler)
profiler.command("live")(profiler_live)

DEMO_SCENARIO = "s_groove"


def main() -> None:
    """Entry point of the `weldcal` console script and of `python -m weldcal.tools`."""
    app(prog_name="weldcal")


def version(wanted: bool) -> None:
    """Prints the installed version and ends."""
    if wanted:
        from importlib.metadata import version as installed_version

        typer.echo(f"weldcal {installed_version('weldcal')}")
        raise typer.Exit()


@app.callback()
def weldcal(
    _version: Annotated[
        bool, typer.Option("--version", callback=version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Calibrate a 3D scanner to a robot by its own flange, then feel along a weld seam."""


@app.command(short_help="The whole story in simulation, with a report at the end.")
def demo(
    name: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help="The same as --scenario.", show_default=False)
    ] = None,
    scenario: ScenarioOption = DEMO_SCENARIO,
    out: OutOption = None,
    seed: SeedOption = 0,
    browser: BrowserOption = True,
    realtime: RealtimeOption = False,
    robot: RobotOption = None,
    dry_run: DryRunOption = False,
    pace: PaceOption = None,
    speed_factor: SpeedFactorOption = None,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """The whole story: calibrate, verify, scan the workpiece, plan, weld, retract; with a report at the end."""
    if name is not None:
        if scenario not in (DEMO_SCENARIO, name):
            raise typer.BadParameter("give the scenario once, by itself or with --scenario")
        scenario = name
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.procedures import run_procedure
        from weldcal.tools.outcomes.options import RunOptions

        options = RunOptions(
            scenario=scenario,
            out=out or fresh_folder("demo", scenario, seed),
            seed=seed,
            browser=browser and not json,
            realtime=realtime,
            robot=robot,
            dry_run=dry_run,
            pace=pace,
            speed_factor=speed_factor,
        )
        with console.progress_bar("demo") as progress:
            result = run_procedure(options, progress)
    finish("demo", result.summary(), result.folder, json_wanted=json)


@app.command(short_help="Where is the scanner? From a dataset, or live.")
def calibrate(
    dataset: Annotated[Path | None, typer.Argument(help="A folder with dataset.yaml, poses.csv and clouds/.")] = None,
    scenario: Annotated[
        str | None, typer.Option("--scenario", metavar="NAME", help="Calibrate live in this scenario instead.")
    ] = None,
    out: OutOption = None,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            metavar="NAME",
            help="Of a dataset: the arm, where it does not say it. Live: simulated, emulated or a controller's address.",
        ),
    ] = None,
    flange: Annotated[
        str | None,
        typer.Option(
            "--flange", metavar="NAME", help="Flange standard, such as iso9409-1-50-4-m6, where it is not said."
        ),
    ] = None,
    centres: Annotated[
        bool,
        typer.Option("--centres", help="Also write centres.csv: the flange centre found in each scan of a dataset."),
    ] = False,
    scanner_correction: CorrectionOption = True,
    axis_turn: Annotated[
        float | None,
        typer.Option(
            "--axis-turn",
            metavar="DEG",
            help="How far the flange's holes are turned about its axis: one to three scans are enough then.",
        ),
    ] = None,
    dry_run: DryRunOption = False,
    pace: PaceOption = None,
    speed_factor: SpeedFactorOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Where is the scanner? From a folder of flange scans and robot poses, or live in a scenario."""
    if (dataset is None) == (scenario is None):
        raise typer.BadParameter("give either a dataset folder or --scenario NAME")
    rows: dict[str, str] = {}
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("calibrate") as progress:
        if dataset is not None:
            from weldcal.tools.commands.calibrate import calibrate_dataset

            folder = out or fresh_folder("calibrate", dataset.resolve().name, seed)
            report = calibrate_dataset(
                dataset,
                folder,
                robot=robot,
                flange=flange,
                seed=seed,
                progress=progress,
                centres=centres,
                correct_scanner=scanner_correction,
                axis_turn_deg=axis_turn,
            )
            summary = report.summary()
            if report.algorithm1 is not None:
                rows["Algorithm 1"] = report.algorithm1.sentence
        else:
            from weldcal.tools.commands.procedures import calibrate_live
            from weldcal.tools.outcomes.options import RunOptions

            assert scenario is not None
            folder = out or fresh_folder("calibrate", scenario, seed)
            options = RunOptions(
                scenario=scenario,
                out=folder,
                seed=seed,
                robot=robot,
                dry_run=dry_run,
                pace=pace,
                speed_factor=speed_factor,
            )
            summary = calibrate_live(options, progress)
    finish("calibrate", summary, folder, json_wanted=json, rows=rows)


@app.command(short_help="How good is a calibration on scans it never saw?")
def verify(
    result: Annotated[Path, typer.Argument(help="A result folder, or its calibration.yaml.")],
    dataset: Annotated[Path, typer.Argument(help="A folder with dataset.yaml, poses.csv and clouds/, or pairs.csv.")],
    out: OutOption = None,
    flange: Annotated[
        str | None, typer.Option("--flange", metavar="NAME", help="Flange standard, where the dataset does not say it.")
    ] = None,
    scanner_correction: CorrectionOption = True,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """How good is a calibration on scans it never saw? Position error and tilt per pose, at the flange."""
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("verify") as progress:
        from weldcal.tools.commands.verify import verify_dataset

        folder = out or fresh_folder("verify", dataset.resolve().name, seed)
        report = verify_dataset(
            result, dataset, folder, flange=flange, seed=seed, progress=progress, correct_scanner=scanner_correction
        )
    finish("verify", report.summary(), folder, json_wanted=json)


@app.command(short_help="Follow a seam in a scenario.")
def weld(
    scenario: ScenarioOption = "straight_groove",
    out: OutOption = None,
    seed: SeedOption = 0,
    browser: BrowserOption = True,
    realtime: RealtimeOption = False,
    robot: RobotOption = None,
    dry_run: DryRunOption = False,
    pace: PaceOption = None,
    speed_factor: SpeedFactorOption = None,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Follow a seam in a scenario, with the scanner's pose taken as the scenario's mounting says."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.demo import run_weld
        from weldcal.tools.outcomes.options import RunOptions

        folder = out or fresh_folder("weld", scenario, seed)
        options = RunOptions(
            scenario=scenario,
            out=folder,
            seed=seed,
            browser=browser and not json,
            realtime=realtime,
            robot=robot,
            dry_run=dry_run,
            pace=pace,
            speed_factor=speed_factor,
        )
        with console.progress_bar("weld") as progress:
            result = run_weld(options, progress)
    finish("weld", result.summary(), result.folder, json_wanted=json)


@benchmarks.command("cell")
def benchmark_cell(
    out: OutOption = None, seed: SeedOption = 0, json: JsonOption = False, debug: DebugOption = False
) -> None:
    """How fast the whole cell runs: real-time factor of the welding phase, finger camera included."""
    folder = out or fresh_folder("benchmark", "cell", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark cell") as progress:
        from weldcal.tools.studies.cell.speed import run_cell_benchmark

        summary = run_cell_benchmark(folder, seed, progress)
    finish("benchmark cell", summary, folder, json_wanted=json)


@benchmarks.command("seeds")
def benchmark_seeds(
    scenario: ScenarioOption = "s_groove",
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=1, help="How many seeds.")] = 11,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """The demo over many seeds: does every run end done, and how far off are calibration and torch at worst."""
    folder = out or fresh_folder("benchmark", f"seeds-{scenario}", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark seeds") as progress:
        from weldcal.tools.studies.cell.seeds import run_seeds

        summary = run_seeds(scenario, folder, range(seed, seed + runs), progress)
    finish("benchmark seeds", summary, folder, json_wanted=json)


@app.command(short_help="Show a finished run again.")
def view(
    result: Annotated[Path, typer.Argument(help="A result folder, or one recording.html or report.html.")],
    browser: Annotated[
        bool,
        typer.Option("--browser/--no-browser", help="Open it, or only print where it is.", show_default="open it"),
    ] = True,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Show a finished run again: its 3D recording and its report."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.view import find_pages, open_pages

        pages = find_pages(result)
        opened = browser and open_pages(pages)
        if browser and not opened:
            console.emit_warning("No web browser could be opened here; open these files on a machine that has one.")
        if json:
            console.emit_json({"state": "done", "pages": pages, "opened": opened})
        else:
            for page in pages:
                typer.echo(str(page))


app.command("robots")(robots)
mount_robot(app, benchmarks)
