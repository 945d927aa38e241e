"""The command line: one short function per command, heavy imports inside it, so that help appears at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import cli_hand_eye, console
from weldcal.tools.benchmarks.cli_flange import mount as mount_flange
from weldcal.tools.benchmarks.cli_profiler import profiler as benchmark_profiler
from weldcal.tools.benchmarks.cli_seam_planning import seam_planning
from weldcal.tools.cli_mounting import benchmark_mountings, live
from weldcal.tools.cli_profiler import profiler
from weldcal.tools.cli_profiler_live import live as profiler_live
from weldcal.tools.cli_robots import robots
from weldcal.tools.cli_tablet import tablet
from weldcal.tools.studies.cli_cell import cell as reproduce_cell
from weldcal.tools.studies.cli_reproduce import reproduce
from weldcal.tools.studies.cli_tablet import benchmark_tablet

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
app.command("robots")(robots)
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

OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
]
SeedOption = Annotated[
    int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")]
BrowserOption = Annotated[
    bool,
    typer.Option(
        "--browser/--no-browser", help="Open the live 3D view in the web browser, or not.", show_default="open it"
    ),
]
RobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar="ROBOT",
        help="simulated, emulated (a controller on loopback), or the address of a controller.",
        show_default="the scenario's",
    ),
]
DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run", help="Only look at the robot, then run on a simulated arm like it: nothing is sent to it."
    ),
]
PaceOption = Annotated[
    float | None,
    typer.Option(
        "--pace", metavar="P", help="Emulated controller only: its seconds per second of the clock, 0.05 to 1."
    ),
]
SpeedFactorOption = Annotated[
    float | None,
    typer.Option(
        "--speed-factor", metavar="X", help="Make the arm's moves slower: 0.05 to 1. The weld keeps its speed."
    ),
]
AddressOption = Annotated[
    str, typer.Option("--address", metavar="ADDRESS", help="Loopback address 127.x.y.z of the emulated controller.")
]
CorrectionOption = Annotated[
    bool,
    typer.Option(
        "--scanner-correction/--no-scanner-correction",
        help="Of a dataset: look for the scanner's own scale error, or take its scans as they are.",
    ),
]
RealtimeOption = Annotated[bool, typer.Option("--realtime", help="Never run faster than the real robot would.")]
DEMO_SCENARIO = "s_groove"
ScenarioOption = Annotated[
    str, typer.Option("--scenario", metavar="NAME", help="A scenario's name, or the path of a scenario YAML file.")
]


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
        from weldcal.tools.demo import DemoOptions
        from weldcal.tools.procedures import run_procedure

        options = DemoOptions(
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
            from weldcal.tools.calibrate import calibrate_dataset

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
            from weldcal.tools.demo import DemoOptions
            from weldcal.tools.procedures import calibrate_live

            assert scenario is not None
            folder = out or fresh_folder("calibrate", scenario, seed)
            options = DemoOptions(
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
        from weldcal.tools.verify import verify_dataset

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
        from weldcal.tools.demo import DemoOptions, run_weld

        folder = out or fresh_folder("weld", scenario, seed)
        options = DemoOptions(
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
        from weldcal.tools.benchmarks.cell import run_cell_benchmark

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
        from weldcal.tools.benchmarks.seeds import run_seeds

        summary = run_seeds(scenario, folder, range(seed, seed + runs), progress)
    finish("benchmark seeds", summary, folder, json_wanted=json)


@benchmarks.command("robot-faults")
def benchmark_robot_faults(
    sequences: Annotated[int, typer.Option("--sequences", metavar="N", min=0, help="Random fault sequences.")] = 20,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=1.0, help="Length of each.")] = 60.0,
    address: AddressOption = "127.0.0.1",
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Every fault of the robot link at 0.05 m/s on an emulated controller: does the arm stop, stay, and say why."""
    folder = out or fresh_folder("benchmark", "robot-faults", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark robot-faults") as progress:
        from weldcal.tools.benchmarks.robot_faults import run_fault_benchmark

        report = run_fault_benchmark(
            folder, address=address, sequences=sequences, seconds=seconds, seed=seed, progress=progress
        )
    rows = {outcome.name: outcome.line for outcome in report.outcomes}
    finish("benchmark robot-faults", report.summary(), folder, json_wanted=json, rows=rows)


@benchmarks.command("robot")
def benchmark_robot(
    minutes: Annotated[float, typer.Option("--minutes", metavar="M", min=0.05, help="Length of the stream.")] = 10.0,
    address: AddressOption = "127.0.0.1",
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """A 125 Hz command stream to an emulated controller: periods, latencies, and every deadline missed by 20 ms."""
    folder = out or fresh_folder("benchmark", "robot", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark robot") as progress:
        from weldcal.tools.benchmarks.robot import run_robot_benchmark

        report = run_robot_benchmark(folder, address=address, minutes=minutes, seed=seed, progress=progress)
    finish("benchmark robot", report.summary(), folder, json_wanted=json)


@app.command("emulate-ur", short_help="A UR controller on loopback.")
def emulate_ur(
    polyscope: Annotated[
        str, typer.Option("--polyscope", metavar="VERSION", help="Controller version: 5.12, 5.21, 10.7 ...")
    ] = "5.21",
    kinematics: Annotated[
        Path | None, typer.Option("--kinematics", metavar="FILE", help="A robot's factory calibration.")
    ] = None,
    host: Annotated[str, typer.Option("--host", metavar="ADDRESS", help="Loopback address 127.x.y.z.")] = "127.0.0.1",
    control_port: Annotated[
        int, typer.Option("--control-port", metavar="PORT", help="Where faults are injected, as JSON lines.")
    ] = 30090,
    pace: Annotated[
        float, typer.Option("--pace", metavar="P", help="Controller seconds per host second, 0.05 to 1.")
    ] = 1.0,
    seed: SeedOption = 0,
    debug: DebugOption = False,
) -> None:
    """A UR controller on loopback that executes the URScript it is sent; runs until it is interrupted."""
    with console.boundary(json_wanted=False, debug=debug):
        from weldcal.tools.ur_emulator.main import run_emulator

        run_emulator(
            host=host,
            control_port=control_port,
            polyscope=polyscope,
            kinematics=kinematics,
            pace=pace,
            seed=seed,
            ready=typer.echo,
        )


@app.command("check-robot", short_help="Is this robot ready? Looks, moves nothing.")
def check_robot(
    host: Annotated[str, typer.Argument(metavar="HOST", help="Name or address of the robot's controller.")],
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Is this robot ready? A table of what is right and what to change; nothing moves and nothing is written."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.systems.drivers.ur.preflight import preflight
        from weldcal.tools.check_robot import as_json, emit_table

        report = preflight(host)
        if json:
            console.emit_json(as_json(report))
        else:
            emit_table(report)
    if report.first_problem is not None:
        console.emit_warning(report.first_problem.remedy)
        raise typer.Exit(1)


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
        from weldcal.tools.view import find_pages, open_pages

        pages = find_pages(result)
        opened = browser and open_pages(pages)
        if browser and not opened:
            console.emit_warning("No web browser could be opened here; open these files on a machine that has one.")
        if json:
            console.emit_json({"state": "done", "pages": pages, "opened": opened})
        else:
            for page in pages:
                typer.echo(str(page))


def fresh_folder(command: str, name: str, seed: int) -> Path:
    """The first unused weldcal-out/<command>-<name>-seed<N>[-2, -3 ...]: an earlier result is never written over."""
    first = Path("weldcal-out") / f"{command}-{Path(name).stem}-seed{seed}"
    folder, number = first, 1
    while folder.exists():
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder


def finish(
    command: str,
    summary: Mapping[str, object],
    folder: Path,
    *,
    json_wanted: bool,
    rows: Mapping[str, str] | None = None,
) -> None:
    """Reports the outcome (with --json as JSON, else in rows) and ends with exit code 1 unless its `state` is done."""
    state = str(summary.get("state", "done"))
    if json_wanted:
        console.emit_json(summary)
    else:
        console.emit_summary(
            f"{command}: {state}", {**console.rows(summary), **(rows or {}), "written to": str(folder)}
        )
    if state != "done":
        console.emit_warning(str(summary.get("reason") or f"The {command} ended {state}; the report says why."))
        raise typer.Exit(1)
