"""weldcal benchmark: speed and accuracy of each part but the flange fit, in simulation and on recorded data."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import FARM, Call, Outcome, command, option, switch


@command("benchmark tablet", short_help="Time the tablet calibrations and the published search.")
def tablet(call: Call) -> Mapping[str, object]:
    """Time each tablet calibration and compare it with the published search."""
    from weldcal.tools.studies.tablet.speed import run_tablet_benchmark

    return run_tablet_benchmark(call.folder("benchmark", "tablet"), call.seed, call.progress)


@command("benchmark hand-eye", short_help="Compare the hand-eye solvers with OpenCV's.")
def hand_eye(
    call: Call,
    data: Annotated[Path | None, option("--data", "FOLDER", "A folder of sets, each a folder with pairs.npz.")] = None,
    quick: Annotated[bool, switch("--quick", "Few trials of each kind: seconds instead of minutes.")] = False,
) -> Outcome:
    """Compare the hand-eye solvers with OpenCV's on public data, and test them in simulation: outliers, invariance,
    uncertainty, speed."""
    from weldcal.tools.studies.hand_eye.comparison import run_hand_eye_benchmark, write_table

    folder = call.folder("benchmark", "hand-eye")
    result = run_hand_eye_benchmark(data, quick=quick, seed=call.seed, progress=call.progress)
    return Outcome(result.summary(), text=write_table(result, folder))


@command(
    "benchmark hand-eye-cells", short_help="Compare with OpenCV on cells with a wrong camera or arm.", options=FARM
)
def hand_eye_cells(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of cells of each kind.", min=1)] = 40,
) -> Outcome:
    """Compare held-out errors with OpenCV's best on simulated cells with a wrong camera matrix, a wrong robot, or both."""
    from weldcal.tools.studies.hand_eye.cells_against_opencv import run_cells

    summary, table = run_cells(call.farm(call.folder("benchmark", "hand-eye-cells")), runs, call.seed)
    return Outcome(summary, text=table)


@command("benchmark touch", short_help="Count touched points within the stated 95 % region.", options=FARM)
def touch(
    call: Call,
    runs: Annotated[
        int, option("--runs", "N", "Number of light worlds of six touches, or of whole cells.", min=1)
    ] = 500,
    scenario: Annotated[
        str | None,
        option("--scenario", "NAME", "Whole simulated cells of this scenario: calibrate, then touch the part."),
    ] = None,
    points: Annotated[
        int, option("--points", "N", "With --scenario: places to touch in each cell.", min=3, max=60)
    ] = 8,
) -> Outcome:
    """Measure how often points touched by the robot lie in the 95 % region that their calibration states."""
    from weldcal.tools.studies.touch.coverage import run_touch_cells, run_touch_study

    farm = call.farm(call.folder("benchmark", "touch"))
    if scenario is not None:
        return Outcome(run_touch_cells(farm, scenario, runs, points, call.seed))
    return Outcome(run_touch_study(farm, runs, call.seed))


@command("benchmark mountings", short_help="Calibrate every mounting live over several seeds.", options=FARM)
def mountings(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of seeds of each.", min=1)] = 5,
    names: Annotated[list[str] | None, option("--scenario", "NAME", "Only this scenario; repeat for more.")] = None,
) -> Outcome:
    """Calibrate every mounting live over several seeds: errors against the truth, held-out errors, and errors in units of
    the covariance."""
    from weldcal.tools.studies.hand_eye.mountings import run_mountings

    folder, seeds = call.folder("benchmark", "mountings"), range(call.seed, call.seed + runs)
    summary, table = run_mountings(call.farm(folder), seeds, tuple(names or ()))
    if not call.json:
        typer.echo(table)
    return Outcome(summary)


@command("benchmark profiler", short_help="Time the profiler's calibration by an edge.")
def profiler(
    call: Call,
    data: Annotated[
        Path | None, option("--data", "FOLDER", "The fixed files. Without them, sets generated from the seed.")
    ] = None,
) -> Outcome:
    """Time the profiler's calibration by an edge and compare it with the published method and a grid search."""
    from weldcal.tools.studies.profiler.speed import lines, run_profiler_benchmark

    summary = run_profiler_benchmark(call.folder("benchmark", "profiler"), call.seed, data, call.progress)
    return Outcome(summary, values={}, rows=lines(summary))


@command("benchmark fleet", short_help="Count what weldcal fleet states about made cells.", options=FARM)
def fleet(
    call: Call,
    cells: Annotated[int, option("--cells", "N", "Number of cells.", min=1)] = 25,
    datasets: Annotated[int, option("--datasets", "N", "Datasets of each.", min=1)] = 8,
) -> Mapping[str, object]:
    """Write made cells, some of which move, drift or break, and count what `weldcal fleet` says of them."""
    from weldcal.tools.studies.fleet.study import run_fleet_study

    return run_fleet_study(call.farm(call.folder("benchmark", "fleet")), cells, datasets, call.seed)


@command("benchmark doctor", short_help="Count how often the doctor names the injected cause.", options=FARM)
def doctor(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Sets with each cause.", min=1)] = 20,
    cleans: Annotated[int, option("--clean", "N", "Sets without a cause.", min=0)] = 200,
) -> Outcome:
    """Inject each cause into simulated sets of scans, and count which one `weldcal doctor` names first."""
    from weldcal.tools.studies.doctor.study import STUDY, cases

    found = STUDY.run(call.farm(call.folder("benchmark", "doctor")), cases(runs, cleans, call.seed))
    return Outcome(found.figures, text=found.show, problem=found.problem)


@command("benchmark fuzz-files", short_help="Give every file reader damaged files.")
def fuzz_files(
    call: Call,
    cases: Annotated[int, option("--cases", "N", "Damaged files for each reader.", min=1)] = 1000,
    readers: Annotated[
        list[str] | None, option("--readers", "NAME", "Only this reader; repeat for more.", show_default="all")
    ] = None,
) -> Outcome:
    """Damage files of every format by its own grammar: each reader must accept or refuse them by a sentence, in 10 s and 1 GB."""
    from weldcal.tools.studies.files.fuzz import chosen, fuzz_files

    wanted = chosen(readers or ())
    result = fuzz_files(wanted, cases, call.seed, call.folder("benchmark", "fuzz-files"), call.progress)
    rows = {name: ", ".join(f"{n} {said}" for said, n in count.most_common()) for name, count in result.counts.items()}
    return Outcome(result.summary(), values={}, rows=rows)


@command("benchmark motion-clock", short_help="Measure how well the clock's offset is found in motion.")
def motion_clock(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of calibrations with each clock.", min=2)] = 300,
    seconds: Annotated[float, option("--seconds", "S", "Length of each recording.", min=5.0)] = 20.0,
) -> Outcome:
    """Repeat calibrations in motion with known truth: coverage of the clock's offset, error and NEES of the scanner's pose."""
    from weldcal.tools.studies.motion.clock import clock_table, run_clock_study

    folder = call.folder("benchmark", "motion-clock")
    found = run_clock_study(runs, folder, seed=call.seed, duration_s=seconds, progress=call.progress)
    return Outcome({name: kind.summary() for name, kind in found.items()}, text=clock_table(found))
