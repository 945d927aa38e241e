"""Runs the touch job of a scenario: the robot touches places of a scanned part, and the calibration is judged by them."""

from dataclasses import dataclass
from pathlib import Path

from weldcal.calibration.data.results import load_result
from weldcal.calibration.touch.table import touches_text
from weldcal.models.errors import InputError
from weldcal.systems.jobs.touch.config import TouchConfig
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.run import run_job
from weldcal.tools.commands.touch import verify_touches
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.touch import TouchReport

TABLE = "touches.csv"


@dataclass(frozen=True, eq=False)
class LiveTouches:
    """A run of the touch job: what it came to, and the judgement where there were touches."""

    options: RunOptions
    state: str
    reason: str
    report: TouchReport | None
    timing: dict[str, object]

    @property
    def folder(self) -> Path:
        """The result folder."""
        return self.options.out

    def summary(self) -> dict[str, object]:
        """The JSON object of `verify --scenario`."""
        found: dict[str, object] = {} if self.report is None else self.report.summary()
        found |= {"state": self.state, "scenario": self.options.scenario, "seed": self.options.seed}
        if self.state == "held":
            found["reason"] = self.reason
        return found | self.timing


def touching(name: str, result: Path, points: int | None = None) -> Scenario:
    """A scenario of a weld as one whose robot touches the part, to judge ``result``.

    Raises:
        InputError: the scenario has no part to touch, or the result cannot be used.
    """
    scenario = load_scenario(name)
    if not hasattr(scenario, "touch"):
        raise InputError("This installation has no touch job.")
    calibration = load_result(result)
    scenario.job.calibrate = scenario.job.weld = False
    config = TouchConfig(result=str(result))
    if points is not None:
        config.points = points
    scenario.touch = config
    if calibration.kinematics_file:
        folder = result if result.is_dir() else result.parent
        scenario.corrected_kinematics = str(folder / calibration.kinematics_file)
    check_scenario(scenario)
    return scenario


def run_touches(scenario: Scenario, options: RunOptions, progress: Progress) -> LiveTouches:
    """Run the touch job and judge its calibration; write touches.csv, touch.json, touch_errors.csv and the recording.

    Raises:
        InputError, RobotRefused: see run_job; nothing has been written or moved.
    """
    finished = run_job(scenario, options, progress, "touch")
    run, out = finished.run, options.out
    touches = run.cell.job.touches(run.root)
    out.mkdir(parents=True, exist_ok=True)
    finished.write_recording(out)
    report = None
    if touches:
        write_atomic(out / TABLE, touches_text(touches))
        config = scenario.part(TouchConfig)
        assert config is not None
        report = verify_touches(Path(config.result), out / TABLE, out)
    found = LiveTouches(options, "held" if run.held else "done", run.reason or "", report, run.timing())
    write_json(out / "touch.json", found.summary())
    return found
