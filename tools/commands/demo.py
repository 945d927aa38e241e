"""weldcal demo and calibrate --scenario: run the job of a scenario with the command that is made for it."""

import json
from dataclasses import dataclass
from pathlib import Path

from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import Call, Outcome, ScenarioArgument, ScenarioOption, command
from weldcal.tools.commands.run import RECORDED, JobRun, named_once, run_job, run_options
from weldcal.tools.commands.weld import run_calibration_live
from weldcal.tools.procedure import kind_of, run_procedure, runner_of
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
