"""weldcal benchmark: speed and accuracy of each part but the flange fit, in simulation and on recorded data."""

from collections.abc import Mapping
from typing import Annotated

from weldcal.tools.cli.options import FARM, Call, Outcome, ScenarioOption, command, option, switch


@command("benchmark seam-planning", short_help="Measure the error of a seam planned from one scan.")
def seam_planning(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Random poses of each part.", min=1)] = 2,
    preset: Annotated[
        list[str] | None, option("--preset", "NAME", "A scanner; repeat for more.", show_default="all")
    ] = None,
    full: Annotated[
        bool, switch("--full-resolution", "Images of the scanner's full width, not 824 pixels at most.")
    ] = False,
    troubles: Annotated[
        bool, switch("--troubles/--no-troubles", "Also test occlusion, clutter and wrong workpieces.")
    ] = True,
) -> Outcome:
    """Measure the error of a seam planned from one scan, with and without a drawing, for each scanner."""
    from weldcal.models.scanners import get_scanner
    from weldcal.tools.studies.seam_planning.benchmark import run_seam_planning_benchmark

    folder = call.folder("benchmark", "seam-planning")
    names = [get_scanner(name).name for name in preset] if preset else None
    summary, rows = run_seam_planning_benchmark(
        folder, runs, call.seed, names, call.progress, full=full, troubles=troubles
    )
    return Outcome(summary, rows=rows)


@command("benchmark part-welds", short_help="Weld twelve parts in four joints from STEP files.")
def part_welds(
    call: Call,
    part: Annotated[list[str] | None, option("--part", "NAME", "A part; repeat for more.", show_default="all")] = None,
    runs: Annotated[int, option("--runs", "N", "Welds of each part, seeds from --seed on.", min=1)] = 1,
    located_by: Annotated[
        str, option("--located-by", "WORD", "Where the part's pose is from: scan or drawing.")
    ] = "scan",
    seam_mm: Annotated[
        float | None, option("--seam-mm", "MM", "Weld only so much of each seam.", show_default="all of it")
    ] = None,
    refine: Annotated[
        str,
        option("--refine", "KIND", "Calibrate each cell first and refine it: none (not calibrated), joints or links."),
    ] = "none",
    arm_mm: Annotated[
        float, option("--arm-mm", "MM", "How far the true flange is from the reported one (rms).", min=0.0, max=5.0)
    ] = 0.4,
) -> Outcome:
    """Weld twelve parts in four joints in the simulated cell, each from its STEP file, and measure the torch's error."""
    from weldcal.tools.studies.part_welds.study import Trial, run_part_welds

    trial = Trial.of(located_by, seam_mm, refine, arm_mm)
    folder = call.folder("benchmark", "part-welds")
    summary = run_part_welds(folder, part, range(call.seed, call.seed + runs), trial, call.progress)
    return Outcome(summary)


@command("benchmark part-registration", short_help="Register twelve parts from STEP files in their scans.")
def part_registration(
    call: Call,
    part: Annotated[list[str] | None, option("--part", "NAME", "A part; repeat for more.", show_default="all")] = None,
    scenes: Annotated[int, option("--scenes", "N", "Scenes with clutter, without a guess.", min=0)] = 40,
    plans: Annotated[int, option("--plans", "N", "Plans of each part's seam, seeds from --seed on.", min=0)] = 3,
    refusals: Annotated[int, option("--refusals", "N", "Scenes of each subject that must be refused.", min=0)] = 3,
) -> Outcome:
    """Register twelve parts from STEP files in simulated scans, plan their seams, and compare both with the truth."""
    from weldcal.tools.studies.parts.study import run_registration_study

    folder = call.folder("benchmark", "part-registration")
    first, second, third = (range(call.seed, call.seed + count) for count in (scenes, plans, refusals))
    return Outcome(run_registration_study(folder, first, second, third, part, call.progress))


@command("benchmark cell", short_help="Measure the real-time factor of the cell while welding.")
def cell(call: Call) -> Mapping[str, object]:
    """Measure the real-time factor of the whole cell while welding, finger camera included."""
    from weldcal.tools.studies.cell.speed import run_cell_benchmark

    return run_cell_benchmark(call.folder("benchmark", "cell"), call.seed, call.progress)


@command("benchmark seeds", short_help="Run the demo over many seeds.", options=FARM)
def seeds(
    call: Call,
    scenario: ScenarioOption = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of seeds.", min=1)] = 11,
) -> Mapping[str, object]:
    """Run the demo over many seeds: completed runs, and the largest errors of calibration and torch."""
    from weldcal.tools.studies.cell.seeds import run_seeds

    folder = call.folder("benchmark", f"seeds-{scenario}")
    return run_seeds(scenario, call.farm(folder), range(call.seed, call.seed + runs))


@command("benchmark replay", short_help="Record runs of every kind and replay each bit for bit.", options=FARM)
def replays(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of runs, over all kinds in turn.", min=1)] = 20,
) -> Outcome:
    """Record runs of every kind (simulated, on an emulated controller, by wire, with faults), and replay each bit for bit."""
    from weldcal.tools.studies.replay.study import run_replays

    summary, table = run_replays(call.farm(call.folder("benchmark", "replay")), runs, call.seed)
    return Outcome(summary, text=table)


@command("benchmark recording", short_help="Measure the computing time that a recording costs.")
def recording(
    call: Call,
    pairs: Annotated[int, option("--pairs", "N", "Pairs of runs.", min=6)] = 11,
) -> Outcome:
    """Run a short demo with and without --record in turn, and compare the computing time."""
    from weldcal.tools.studies.replay.overhead import run_overhead

    summary, table = run_overhead(call.folder("benchmark", "recording"), pairs, call.seed, call.progress)
    return Outcome(summary, text=table)


@command("benchmark arms", short_help="Run the demo on six UR arms, scaled to their reach.", options=FARM)
def arms(
    call: Call,
    names: Annotated[list[str] | None, option("--arm", "NAME", "Only this arm; repeat for more.")] = None,
    seam: Annotated[float, option("--seam", "MM", "How much of the seam is welded.", min=20.0)] = 80.0,
    robot: Annotated[
        str | None, option("--robot", "WHERE", "simulated, or emulated: a controller on this computer.")
    ] = None,
) -> Outcome:
    """Run the demo, scaled to the reach, on UR3e, UR5e, UR10e, UR16e, UR20 and UR30; the scenarios are written too."""
    from weldcal.models.robots import get_robot
    from weldcal.tools.studies.arms.demo import ARMS, arms_table, run_arms

    chosen = [get_robot(name).name for name in names] if names else list(ARMS)
    summary, rows = run_arms(call.farm(call.folder("benchmark", "arms")), chosen, call.seed, seam, robot)
    return Outcome(summary, text=arms_table(rows))


@command(
    "benchmark robot-faults", short_help="Inject every fault of the robot link while moving.", options=("address",)
)
def robot_faults(
    call: Call,
    sequences: Annotated[int, option("--sequences", "N", "Number of random fault sequences.", min=0)] = 20,
    seconds: Annotated[float, option("--seconds", "S", "Length of each.", min=1.0)] = 60.0,
) -> Outcome:
    """Inject every fault of the robot link at 0.05 m/s on an emulated controller: the arm must stop, stay, and say why."""
    from weldcal.tools.studies.robot.faults import run_fault_benchmark

    result = run_fault_benchmark(
        call.folder("benchmark", "robot-faults"),
        address=call.given["address"],
        sequences=sequences,
        seconds=seconds,
        seed=call.seed,
        progress=call.progress,
    )
    return Outcome(result.summary(), rows={outcome.name: outcome.line for outcome in result.outcomes})


@command("benchmark robot", short_help="Measure the periods of commands streamed at 125 Hz.", options=("address",))
def robot(
    call: Call, minutes: Annotated[float, option("--minutes", "M", "Length of the stream.", min=0.05)] = 10.0
) -> Mapping[str, object]:
    """Stream commands at 125 Hz to an emulated controller: periods, latencies, and deadlines missed by 20 ms or more."""
    from weldcal.tools.studies.robot.stream import run_robot_benchmark

    folder = call.folder("benchmark", "robot")
    return run_robot_benchmark(
        folder, address=call.given["address"], minutes=minutes, seed=call.seed, progress=call.progress
    ).summary()


@command("benchmark robot-jobs", short_help="Measure how late velocities are in whole jobs.")
def robot_jobs(
    call: Call,
    scenario: ScenarioOption = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of jobs.", min=1)] = 10,
    load: Annotated[int, option("--load", "N", "Busy programs beside the jobs.", min=0)] = 0,
    seam_mm: Annotated[
        float | None, option("--seam-mm", "MM", "Length of the seam.", min=10.0, show_default="the scenario's")
    ] = None,
) -> Outcome:
    """Run whole jobs on an emulated controller in real time: how late the velocities are, alone or beside busy programs."""
    from weldcal.tools.studies.robot.jobs import run_jobs

    folder = call.folder("benchmark", f"robot-jobs-{scenario}")
    result = run_jobs(scenario, folder, runs, seed=call.seed, load=load, seam_mm=seam_mm, progress=call.progress)
    rows = {f"seed {job.seed}": job.line for job in result.jobs} | {"this computer": result.host.line}
    return Outcome(result.summary(), rows=rows)
