"""Maps the key of a scenario's job to the command that runs it."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from weldcal.systems.jobs.discovery import job_of
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.any_job import run_any
from weldcal.tools.commands.demo import run_calibration_live, run_scenario
from weldcal.tools.commands.motion_live import run_motion_live
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.commands.profiler.live import run_profiler_live
from weldcal.tools.commands.tablet.demo import run_tablet_demo
from weldcal.tools.commands.touch_live import run_touches
from weldcal.tools.outcomes.first_screen import FirstScreen
from weldcal.tools.report.run import RunOptions


class Outcome(Protocol):
    """The result of every run: a folder and a JSON object."""

    @property
    def folder(self) -> Path:
        """The result folder."""

    def summary(self) -> dict[str, object]:
        """The JSON object."""


Runner = Callable[[Scenario, RunOptions, Progress], Outcome]
RUNNERS: dict[str, Runner] = {
    "": run_scenario,
    "tablet": run_tablet_demo,
    "mounting": run_mounting_live,
    "motion": run_motion_live,
    "profiler_job": run_profiler_live,
    "touch": run_touches,
}


def kind_of(scenario: Scenario) -> str:
    """The key of the scenario's job; empty for the weld job."""
    return job_of(scenario).key


def run_procedure(options: RunOptions, progress: Progress) -> Outcome:
    """Run a scenario's job; for a job without a command, only its state and a recording are written.

    Raises:
        InputError, UnreachableScanner, RobotRefused: the scenario or the options cannot be run; nothing has been written.
    """
    scenario = load_scenario(options.scenario)
    return RUNNERS.get(kind_of(scenario), run_any)(scenario, options, progress)


def calibrate_live(options: RunOptions, progress: Progress) -> tuple[dict[str, object], FirstScreen]:
    """Run `calibrate --scenario`: the mounting or motion job, or only the calibration of the weld job; JSON object and first screen."""
    scenario = load_scenario(options.scenario)
    if kind_of(scenario) == "mounting":
        mounted = run_mounting_live(scenario, options, progress)
        return mounted.summary(), mounted.first
    if kind_of(scenario) == "motion":
        moved = run_motion_live(scenario, options, progress)
        return moved.summary(), moved.first
    found = run_calibration_live(options, progress)
    return found.calibration_summary(), found.first
