"""Which procedure a scenario is, and who runs it: the job of calibration and weld, or one of the others by its own field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from weldcal.systems.scenario import Scenario, load_scenario
from weldcal.tools.console import Progress
from weldcal.tools.demo import DemoOptions, run_scenario
from weldcal.tools.tablet_demo import run_tablet_demo


class Outcome(Protocol):
    """What every run leaves: a folder, and the JSON object of what it came to."""

    @property
    def folder(self) -> Path:
        """Where everything was written."""

    def summary(self) -> dict[str, object]:
        """The JSON object."""


Runner = Callable[[Scenario, DemoOptions, Progress], Outcome]
RUNNERS: dict[str, Runner] = {
    "job": run_scenario,
    "tablet": run_tablet_demo,
}


def kind_of(scenario: Scenario) -> str:
    """The key of RUNNERS that a scenario belongs to; without a field of another procedure it is the main job."""
    return "job" if scenario.tablet is None else "tablet"


def runner_of(scenario: Scenario) -> Runner:
    """Who runs this scenario."""
    return RUNNERS[kind_of(scenario)]


def run_procedure(options: DemoOptions, progress: Progress) -> Outcome:
    """The whole story of a scenario, whichever procedure it is.

    Raises:
        InputError, UnreachableScanner, RobotRefused: the scenario or the options cannot be done; nothing has been written.
    """
    scenario = load_scenario(options.scenario)
    return runner_of(scenario)(scenario, options, progress)
