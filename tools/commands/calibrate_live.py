"""`weldcal calibrate --scenario`: runs the mounting job, the motion job, or the calibration alone of the weld job."""

from typing import Annotated

import typer

from weldcal.systems.jobs.job import job_of
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.options import MOTION, Call, Outcome, command, option
from weldcal.tools.commands.motion_live import run_motion_live
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.commands.run import run_options
from weldcal.tools.commands.weld import run_calibration_live


@command(
    "calibrate-live", hidden=True, options=(*MOTION, "record"), short_help="Calibrate a scanner live in a scenario."
)
def calibrate_live(
    call: Call,
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A scenario, by name or path.")],
    robot: Annotated[str | None, option("--robot", "NAME", "simulated, emulated or a controller's address.")] = None,
) -> Outcome:
    """Calibrate a scanner live in a scenario, as `weldcal calibrate --scenario` does."""
    options = run_options(call, "calibrate", scenario, robot=robot)
    loaded = load_scenario(scenario)
    kind = job_of(loaded).key
    if kind == "mounting":
        mounted = run_mounting_live(loaded, options, call.progress)
        return Outcome(mounted.summary(), first=mounted.first)
    if kind == "motion":
        moved = run_motion_live(loaded, options, call.progress)
        return Outcome(moved.summary(), first=moved.first)
    calibrated = run_calibration_live(options, call.progress)
    return Outcome(calibrated.calibration_summary(), first=calibrated.first)
