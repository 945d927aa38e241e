"""The commands that run a scenario: demo, weld, tablet demo, hand-eye live and profiler live."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldcal.tools.cli.options import (
    LIVE,
    Call,
    Outcome,
    RecordOption,
    ScenarioArgument,
    ScenarioOption,
    command,
    option,
)

if TYPE_CHECKING:
    from weldcal.tools.report.run import RunOptions

DEMO_SCENARIO = "s_groove"
RECORDED = (*LIVE, "record")
PROFILER_SCENARIO = "profiler_seam"


@command("demo", options=RECORDED, short_help="Run the complete job in simulation and write a report.")
def demo(call: Call, name: ScenarioArgument = None, scenario: ScenarioOption = DEMO_SCENARIO) -> Outcome:
    """Run the complete job: calibrate, verify, scan the workpiece, plan, weld, retract. A report is written at the end."""
    from weldcal.tools.commands.procedures import run_procedure

    options = run_options(call, "demo", _named_once(name, scenario, DEMO_SCENARIO))
    found = run_procedure(options, call.progress)
    return Outcome(found.summary(), first=getattr(found, "first", None))


@command("weld", options=RECORDED, short_help="Weld a seam in a scenario, without calibrating.")
def weld(call: Call, scenario: ScenarioOption = "straight_groove") -> Outcome:
    """Weld a seam in a scenario, with the scanner's pose taken from the scenario."""
    from weldcal.tools.commands.demo import run_weld

    found = run_weld(run_options(call, "weld", scenario), call.progress)
    return Outcome(found.summary(), first=found.first)


@command(
    "tablet demo", short_help="Run the tablet calibration in a scenario.", options=LIVE, defaults={"browser": False}
)
def tablet_demo(call: Call, scenario: ScenarioOption = "tablet", record: RecordOption = False) -> Outcome:
    """Run the tablet calibration: look, touch each landmark, calibrate, compare with the truth."""
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.tools.commands.tablet.demo import run_tablet_demo

    options = run_options(call, "tablet", scenario, recording=record)
    found = run_tablet_demo(load_scenario(scenario), options, call.progress)
    return Outcome(found.summary(), first=found.first)


@command(
    "hand-eye live", short_help="Calibrate a scanner live in any mounting.", options=LIVE, defaults={"browser": False}
)
def hand_eye_live(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A scenario with a mounting section, by name or path.")
    ] = "eye_in_hand",
    record: RecordOption = False,
) -> Outcome:
    """Calibrate a scanner live in any mounting: it scans the robot's flange, its foot, or a second arm's flange."""
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.tools.commands.mounting_live import run_mounting_live

    options = run_options(call, "hand-eye", scenario, recording=record)
    result = run_mounting_live(load_scenario(scenario), options, call.progress)
    return Outcome(result.summary(), text=result.text(), first=result.first)


@command(
    "profiler live",
    short_help="Calibrate a profiler on the arm and follow a seam.",
    options=LIVE,
    defaults={"browser": False},
)
def profiler_live(
    call: Call,
    name: ScenarioArgument = None,
    scenario: Annotated[
        str, option("--scenario", "NAME", "profiler_edge, profiler_sphere, profiler_seam or a YAML file.")
    ] = PROFILER_SCENARIO,
    runs: Annotated[int, option("--runs", "N", "Number of seeds, from --seed on.", min=1)] = 1,
    record: RecordOption = False,
) -> Outcome:
    """Calibrate a profiler on the arm by an edge and a touched sphere, then scan and follow a seam."""
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.tools.commands.profiler.live import run_profiler_live, run_profiler_seeds

    chosen = _named_once(name, scenario, PROFILER_SCENARIO)
    options = run_options(call, "profiler-live", chosen, recording=record)
    loaded = load_scenario(chosen)
    if runs > 1:
        return Outcome(run_profiler_seeds(loaded, options, runs, call.progress))
    found = run_profiler_live(loaded, options, call.progress)
    return Outcome(found.summary(), first=found.first)


def run_options(call: Call, command: str, scenario: str, **more: Any) -> RunOptions:
    """The options of a run; its folder is named after the command and the scenario."""
    from weldcal.tools.report.run import RunOptions

    return RunOptions(scenario=scenario, out=call.folder(command, scenario), seed=call.seed, **{**call.live, **more})


def _named_once(name: str | None, scenario: str, preset: str) -> str:
    """The scenario, given as an argument or with --scenario.

    Raises:
        typer.BadParameter: both are given, and differ.
    """
    if name is not None and scenario not in (preset, name):
        raise typer.BadParameter("give the scenario once, as an argument or with --scenario")
    return name or scenario
