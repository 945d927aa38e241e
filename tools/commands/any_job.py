"""Runs a job that has no command of its own, such as one of an installed package: state, timing and recording."""

import json
from dataclasses import dataclass
from pathlib import Path

from weldcal.systems.runner import Progress
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.run import FinishedRun, run_job
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.render import write_atomic


@dataclass(frozen=True, eq=False)
class AnyOutcome:
    """Done or held, and how long it took."""

    options: RunOptions
    finished: FinishedRun

    @property
    def folder(self) -> Path:
        """Where everything was written."""
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
