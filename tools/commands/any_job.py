"""Runs a job without a command of its own, such as one of an installed package; writes state, timing and recording."""

import json
from dataclasses import dataclass
from pathlib import Path

from weldcal.systems.runner import Progress
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.run import JobRun, run_job
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions


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
        """The JSON object of `demo` for such a job."""
        run = self.finished.run
        found: dict[str, object] = {
            "state": "held" if run.held else "done",
            "scenario": self.options.scenario,
            "seed": self.options.seed,
            "robot": self.finished.robot,
        }
        if run.reason:
            found["reason"] = run.reason
        return found | run.timing()


def run_any(scenario: Scenario, options: RunOptions, progress: Progress) -> AnyOutcome:
    """Run the job; write run.json and the recording. Raises as run_job."""
    outcome = AnyOutcome(options, run_job(scenario, options, progress))
    options.out.mkdir(parents=True, exist_ok=True)
    write_atomic(options.out / "run.json", json.dumps(outcome.summary(), indent=1) + "\n")
    outcome.finished.write_recording(options.out)
    return outcome
