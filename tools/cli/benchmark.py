"""weldcal benchmark: speed and accuracy of each part but the flange fit, in simulation and on recorded data."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from weldcal.tools.cli.options import Call, Outcome, command, option


@command("benchmark tablet", short_help="Time the tablet calibrations and the published search.")
def tablet(call: Call) -> Mapping[str, object]:
    """Time each tablet calibration and compare it with the published search."""
    from weldcal.tools.studies.tablet.speed import run_tablet_benchmark

    return run_tablet_benchmark(call.folder("benchmark", "tablet"), call.seed, call.progress)


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
