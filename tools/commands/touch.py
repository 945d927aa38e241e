"""Judge a calibration by points that the tip touched, from a table or by a scenario's touch job; for `verify`."""

from dataclasses import dataclass
from pathlib import Path

from weldcal.calibration.data.results import load_result
from weldcal.calibration.data.scanner_correction import correction_from_document
from weldcal.calibration.touch.judge import judge_touches
from weldcal.calibration.touch.touches import read_touches, touches_text
from weldcal.models.errors import InputError
from weldcal.systems.jobs.touch.planner import TouchConfig
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import Call, Outcome
from weldcal.tools.commands.run import run_job
from weldcal.tools.report.render import check_folder, csv_text, write_atomic, write_json
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.verify import TouchReport, touch_page

TABLE = "touches.csv"


def verify_touches(result: Path, touches: Path, out: Path) -> TouchReport:
    """Judge a calibration by a table of touches; write report.html, touch_errors.csv and touch.json to ``out``.

    Raises:
        InputError: the result, the table or the output folder cannot be used; nothing is written.
    """
    out, result = Path(out), Path(result)
    check_folder(out, "verification")
    calibration = load_result(result)
    read = read_touches(Path(touches), correction_from_document(calibration.scanner_correction))
    folder = result if result.is_dir() else result.parent
    kinematics = folder / calibration.kinematics_file if calibration.kinematics_file else None
    report = TouchReport(judge_touches(calibration, read, kinematics), out, calibration)
    f = report.found
    rows = [
        (
            f.ids[k],
            f.features[k],
            f"{1e3 * f.error_m[k]:.4f}",
            f"{1e3 * f.limit_m[k]:.4f}",
            int(f.inside[k]),
            f"{1e3 * f.relative_m[k]:.4f}",
        )
        for k in range(len(f.ids))
    ]
    write_atomic(
        out / "touch_errors.csv", csv_text(("id", "feature", "error_mm", "limit_mm", "inside", "relative_mm"), rows)
    )
    write_atomic(out / "report.html", touch_page(report, touches.name))
    write_json(out / "touch.json", report.summary())
    return report


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
        """Return the JSON object of `verify --scenario`."""
        found: dict[str, object] = {} if self.report is None else self.report.summary()
        found |= {"state": self.state, "scenario": self.options.scenario, "seed": self.options.seed}
        if self.state == "held":
            found["reason"] = self.reason
        return found | self.timing


def touching(name: str, result: Path) -> Scenario:
    """Return a scenario of a weld as one whose robot touches the part, to judge ``result``.

    Raises:
        InputError: the scenario has no part to touch, or the result cannot be used.
    """
    scenario = load_scenario(name)
    if not hasattr(scenario, "touch"):
        raise InputError("This installation has no touch job.")
    scenario.job.calibrate = scenario.job.weld = False
    scenario.touch = TouchConfig(result=str(result))
    use_kinematics(scenario, result)
    check_scenario(scenario)
    return scenario


def use_kinematics(scenario: Scenario, result: Path) -> None:
    """Let a scenario's arm have the kinematics that belong to a result. Raises InputError for no result."""
    file = load_result(result).kinematics_file
    if file:
        scenario.corrected_kinematics = str((result if result.is_dir() else result.parent) / file)


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


def touches_outcome(call: Call, result: Path, touches: Path) -> Outcome:
    """What `weldcal verify --touch` prints of points in a file."""
    report = verify_touches(result, touches, call.folder("verify", touches.resolve().stem))
    return Outcome(
        report.summary(),
        values={},
        rows={name: text for name, text in report.rows.items() if name != "verdict"},
        first=report.first,
    )


def live_touches_outcome(call: Call, result: Path, scenario: str, robot: str) -> Outcome:
    """What `weldcal verify --scenario` prints of points that its robot touches."""
    options = RunOptions(
        scenario=scenario, out=call.folder("verify", scenario), seed=call.seed, robot=robot, **call.live
    )
    found = run_touches(touching(scenario, result), options, call.progress)
    report = found.report
    return Outcome(
        found.summary(),
        rows={} if report is None else report.rows,
        problem=found.reason if found.state == "held" else "",
        first=None if report is None else report.first,
    )
