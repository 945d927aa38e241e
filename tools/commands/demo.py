"""weldcal demo and calibrate --scenario: run the job of a scenario with the command that is made for it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from weldcal.systems.jobs.job import job_of
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import Call, Outcome, ScenarioArgument, ScenarioOption, command
from weldcal.tools.commands.run import RECORDED, JobRun, named_once, run_job, run_options
from weldcal.tools.commands.weld import run_calibration_live, run_scenario
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions, run_document


def calibrate_live(call: Call, scenario: str, robot: str | None) -> Outcome:
    """Calibrate a scanner live in a scenario, as `weldcal calibrate --scenario` does."""
    options = run_options(call, "calibrate", scenario, robot=robot)
    loaded = load_scenario(scenario)
    if (kind := kind_of(loaded)) in ("mounting", "motion"):
        found = runner_of(kind)(loaded, options, call.progress)
        return Outcome(found.summary(), first=getattr(found, "first", None))
    calibrated = run_calibration_live(options, call.progress)
    return Outcome(calibrated.calibration_summary(), first=calibrated.first)


DEMO_SCENARIO = "s_groove"


@command("demo", options=RECORDED, short_help="Run the complete job in simulation and write a report.")
def demo(call: Call, name: ScenarioArgument = None, scenario: ScenarioOption = DEMO_SCENARIO) -> Outcome:
    """Run the complete job: calibrate, verify, scan the workpiece, plan, weld, retract. A report is written at the
    end."""
    options = run_options(call, "demo", named_once(name, scenario, DEMO_SCENARIO))
    found = run_procedure(options, call.progress)
    return Outcome(found.summary(), first=getattr(found, "first", None))


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
    runner: Runner = run_any
    match key:
        case "":
            runner = run_scenario
        case "motion":
            from weldcal.tools.commands.motion_live import run_motion_live as runner
        case "mounting":
            from weldcal.tools.commands.mounting_live import run_mounting_live as runner
        case "profiler_job":
            from weldcal.tools.commands.profiler.live import run_profiler_live as runner
        case "tablet":
            from weldcal.tools.commands.tablet.demo import run_tablet_demo as runner
        case "touch":
            from weldcal.tools.commands.touch import run_touches as runner
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


@dataclass(frozen=True, eq=False)
class AnyOutcome:
    """The state of the run, and its timing."""

    options: RunOptions
    finished: JobRun

    @property
    def folder(self) -> Path:
        """The result folder."""
        return self.options.out

    def summary(self) -> dict[str, object]:
        """Return the JSON object of `demo` for such a job."""
        run = self.finished.run
        return run_document(run, self.options, self.finished.robot) | run.timing()


def run_any(scenario: Scenario, options: RunOptions, progress: Progress) -> AnyOutcome:
    """Run the job; write run.json and the recording. Raises as run_job."""
    outcome = AnyOutcome(options, run_job(scenario, options, progress))
    options.out.mkdir(parents=True, exist_ok=True)
    write_atomic(options.out / "run.json", json.dumps(outcome.summary(), indent=1) + "\n")
    outcome.finished.write_recording(options.out)
    return outcome
