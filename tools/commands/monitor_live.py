"""`weldcal monitor SCENARIO --calibration RESULT`: watches a calibration live, in any cell whose scanner streams."""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.motion_dataset import FrameTime, MotionDataset, load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, export_all, load_result, save_result
from weldcal.calibration.motion.drift.sequential import DriftConfig, DriftEvent
from weldcal.calibration.motion.drift.watch import Watched, watch
from weldcal.calibration.motion.frames import observed_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.errors import InputError
from weldcal.systems.jobs.motion.calibrator import posed_stream
from weldcal.systems.jobs.motion.config import MotionJob
from weldcal.systems.jobs.motion.job import AddedMotion
from weldcal.systems.jobs.motion.messages import MotionRecord
from weldcal.systems.jobs.weld.settings import feature_standard
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.monitor import causes, rate_checked, recalibrated_result, told_apart
from weldcal.tools.commands.run import JobRun, run_job
from weldcal.tools.outcomes.first_screen import Expected, Findings, FirstScreen, Next
from weldcal.tools.outcomes.monitor import MonitorReport, drift_document
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.monitor import monitor_page
from weldcal.tools.report.render import write_atomic

_LAST = ("rms_mm", "frames", "dropped", "drift")
_LOST = "The frame came while others were waiting for their fit."


@dataclass(frozen=True, eq=False)
class LiveMonitor:
    """A finished watch: the run, and the report of all its frames; None where no frame showed the flange."""

    options: RunOptions
    finished: JobRun
    report: MonitorReport | None

    @property
    def found_live(self) -> tuple[DriftEvent, ...]:
        """What the DriftMonitor in the cell has found."""
        run = self.finished.run
        job: AddedMotion = run.cell.job
        return job.drift(run.root).events

    @property
    def first(self) -> FirstScreen:
        """The first screen; a held run decides against the calibration only where a move was found."""
        run = self.finished.run
        held = [run.reason or "The job was held."] if run.held else []
        if self.report is None:
            found = Findings(against=held or ["No frame showed the flange."], unseen=0)
            after = Next("See that the scanner streams and sees the flange, then watch again.")
            return FirstScreen(
                found, Expected("error of the tracked flange, 95 %", "not known", "no frame showed it"), after
            )
        first = self.report.first
        if not held:
            return first
        return replace(first, found=replace(first.found, against=[*held, *first.found.against]))

    def summary(self) -> dict[str, Any]:
        """The JSON object: the run, then what `monitor` says of a recording, which it ends with."""
        run = self.finished.run
        job: AddedMotion = run.cell.job
        live = job.drift(run.root)
        found: dict[str, Any] = {
            "state": "held" if run.held else "done", "scenario": self.options.scenario, "seed": self.options.seed,
            "robot": self.finished.robot,
            "live": {
                "frames": live.frames, "dropped": live.dropped, "alarmed": live.alarmed, "summary": live.summary,
                "drift": [drift_document(e) for e in live.events],
            },
        }  # fmt: skip
        if run.reason:
            found["reason"] = run.reason
        found |= run.timing()
        said: Mapping[str, Any] = (
            {"rms_mm": None, "frames": 0, "dropped": live.dropped, "drift": []}
            if self.report is None
            else self.report.summary()
        )
        found |= {name: value for name, value in said.items() if name not in (*_LAST, "state")}
        return found | {name: said[name] for name in _LAST}


def monitored_scenario(name: str, calibration: Path, frames: int | None, false_alarms_per_hour: float) -> Scenario:
    """The scenario as it is watched: its motion, or that of the default cube where it has another job.

    Raises:
        InputError: its scanner does not stream, or it cannot be run so.
    """
    rate_checked(false_alarms_per_hour)
    scenario = load_scenario(name)
    scanner = scenario.scanner_config()
    if scanner is None or scanner.stream_delay_s() is None:
        raise InputError(
            f"The scanner of '{name}' does not stream, so that nothing can be watched: write scanner: !StreamingScanner {{}} in the scenario, "
            "or give a recording."
        )
    job = scenario.part(MotionJob) or MotionJob()
    scenario.motion = job  # type: ignore[attr-defined]
    scenario.job.weld, scenario.job.calibrate = False, True
    job.watch, job.false_alarms_per_hour = str(calibration), false_alarms_per_hour
    if frames is not None:
        job.frames = frames
    check_scenario(scenario)
    return scenario


def monitor_live(
    options: RunOptions,
    calibration: Path,
    progress: Progress,
    *,
    frames: int | None = None,
    false_alarms_per_hour: float = DriftConfig.false_alarms_per_hour,
    recalibrate: bool = False,
    record: bool = False,
) -> LiveMonitor:
    """Watch a calibration while the arm moves through the scenario's cube; write report.html, monitor.json and the 3D recording.

    The DriftMonitor in the cell tests every frame as it comes. At the end all frames are tested again with the clock that they
    show together, as on a recording. ``record`` also writes what streamed as a recording, by whose still background a moved
    base is told from a moved scanner. Raises as run_job and load_result; nothing has moved.
    """
    started = time.monotonic()
    result = load_result(calibration)
    scenario = monitored_scenario(options.scenario, calibration, frames, false_alarms_per_hour)
    job = scenario.part(MotionJob)
    assert job is not None
    if record or job.record:
        job.record, job.recording_folder = True, str(options.out / "recording")
    finished = run_job(scenario, options, progress, "motion")
    added: AddedMotion = finished.cell.job
    options.out.mkdir(parents=True, exist_ok=True)
    collected, arm = added.record(finished.run.root), finished.cell.station.arm
    data: MotionDataset | None = None
    if added.recorder is not None and collected.seen:
        added.recorder.finish(posed_stream(collected, arm), scenario.arm, feature_standard(scenario).designation, scenario.scanner.scanner())  # type: ignore[attr-defined]  # fmt: skip
        data = load_motion_dataset(options.out / "recording")
    report = None
    if collected.seen:
        watched = watched_record(result, collected, finished, DriftConfig(false_alarms_per_hour=false_alarms_per_hour))
        if data is not None:
            events = tuple(told_apart(e, watched, data, result) for e in watched.events)
            watched = replace(watched, events=events)
        feature = feature_standard(scenario).designation
        again = recalibrated_result(result, watched, {}, feature, options.seed) if recalibrate else None
        report = MonitorReport(
            watched=watched,
            calibration=result,
            recalibrated=again,
            cause=causes(watched),
            false_alarms_per_hour=false_alarms_per_hour,
            warnings=(),
            seconds=time.monotonic() - started,
            out=options.out,
        )
        write_atomic(options.out / "report.html", monitor_page(report, recording=options.scenario))
        if again is not None:
            export_all(again, options.out / "recalibrated")
            save_result(again, options.out / "recalibrated")
    finished.write_recording(options.out)
    outcome = LiveMonitor(options, finished, report)
    write_atomic(options.out / "monitor.json", json.dumps(outcome.summary(), indent=2, allow_nan=False) + "\n")
    return outcome


def watched_record(result: CalibrationResult, record: MotionRecord, finished: JobRun, config: DriftConfig) -> Watched:
    """What all frames of a run say together."""
    cell, root = finished.cell, finished.run.root
    added: AddedMotion = cell.job
    frames: list[FrameTime] = [f for f, _ in record.seen]
    observed = observed_frames(frames, {f.id: fit for f, fit in record.seen})
    _, dropped = added.counts(root)
    lost = [(f"queue {k + 1}", _LOST) for k in range(dropped)]
    motion = ContinuousMotion(posed_stream(record, cell.station.arm))
    X_FR = None if np.allclose(added.X_FR.GetAsMatrix4(), np.eye(4)) else added.X_FR
    return watch(result, observed, motion, X_FR=X_FR, dropped=[*record.refused, *lost], config=config)
