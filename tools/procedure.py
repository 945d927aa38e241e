"""Run the job of a scenario by what is made for it: found by the job's key, and imported when it runs."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from weldcal.systems.jobs.job import job_of
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.report.run import RunOptions

RUNNERS = {
    "": "weld:run_scenario",
    "motion": "motion_live:run_motion_live",
    "mounting": "mounting_live:run_mounting_live",
    "profiler_job": "profiler.live:run_profiler_live",
    "tablet": "tablet.demo:run_tablet_demo",
    "touch": "touch:run_touches",
}
"""Module below tools/commands and function, by the key of the job; empty for the weld job."""


class RunResult(Protocol):
    """The result of every run: a folder and a JSON object."""

    @property
    def folder(self) -> Path:
        """The result folder."""

    def summary(self) -> dict[str, object]:
        """Return the JSON object."""


Runner = Callable[[Scenario, RunOptions, Progress], RunResult]


def runner_of(key: str) -> Runner:
    """Return what runs the job with this key; imports it."""
    module, _, name = RUNNERS.get(key, "demo:run_any").partition(":")
    runner: Runner = getattr(importlib.import_module(f"weldcal.tools.commands.{module}"), name)
    return runner


def kind_of(scenario: Scenario) -> str:
    """Return the key of the scenario's job; empty for the weld job."""
    return job_of(scenario).key


def run_procedure(options: RunOptions, progress: Progress) -> RunResult:
    """Run a scenario's job; for a job without a command, only its state and a recording are written.

    Raises:
        InputError, UnreachableScanner, RobotRefused: the scenario or the options cannot be run; nothing has been
            written.
    """
    scenario = load_scenario(options.scenario)
    return runner_of(kind_of(scenario))(scenario, options, progress)
