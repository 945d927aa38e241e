"""Which procedure a scenario is, and who runs it: the job of calibration and weld, or one of the others by its own field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from weldcal.systems.scenario.schema import Scenario, load_scenario
from weldcal.tools.commands.demo import DemoOptions, run_calibration_live, run_scenario
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.commands.profiler.live import run_profiler_live
from weldcal.tools.commands.tablet.demo import run_tablet_demo
from weldcal.tools.console import Progress


class Outcome(Protocol):
    """What every run leaves: a folder, and the JSON object of what it came to."""

    @property
    def folder(self) -> Path:
        """Where everything was written."""

    def summary(self) -> dict[str, object]:
        """The JSON object."""


Runner = Callable[[Scenario, DemoOptions, Progress], Outcome]
JOB = "job"
PROCEDURES: dict[str, tuple[Callable[[Scenario], bool], Runner]] = {
    "tablet": (lambda scenario: scenario.tablet is not None, run_tablet_demo),
    "mounting": (lambda scenario: scenario.mounting is not None, run_mounting_live),
    "profiler": (lambda scenario: scenario.profiler_job is not None, run_profiler_live),
}


def kind_of(scenario: Scenario) -> str:
    """Which of PROCEDURES a scenario is; without the field of any of them it is the main job."""
    return next((kind for kind, (belongs, _) in PROCEDURES.items() if belongs(scenario)), JOB)


def runner_of(scenario: Scenario) -> Runner:
    """Who runs this scenario."""
    kind = kind_of(scenario)
    return run_scenario if kind == JOB else PROCEDURES[kind][1]


def run_procedure(options: DemoOptions, progress: Progress) -> Outcome:
    """The whole story of a scenario, whichever procedure it is.

    Raises:
        InputError, UnreachableScanner, RobotRefused: the scenario or the options cannot be done; nothing has been written.
    """
    scenario = load_scenario(options.scenario)
    return runner_of(scenario)(scenario, options, progress)


def calibrate_live(options: DemoOptions, progress: Progress) -> dict[str, object]:
    """The JSON object of `calibrate --scenario`: a mounting by its own procedure, else the calibration of the job alone."""
    scenario = load_scenario(options.scenario)
    if kind_of(scenario) == "mounting":
        return run_mounting_live(scenario, options, progress).summary()
    return run_calibration_live(options, progress).calibration_summary()
