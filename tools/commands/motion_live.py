"""Run the motion job: calibrate a streaming scanner and its clock live, and compare with the truth."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from weldcal.models.arrays import Array
from weldcal.systems.jobs.motion.job import AddedMotion, MotionJob
from weldcal.systems.jobs.motion.procedure import MotionRecord, posed_stream
from weldcal.systems.runner import Progress, Run
from weldcal.systems.scenario.loading import scenario_text
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.run import JobRun, run_job
from weldcal.tools.console import rows as console_rows
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, after_hold
from weldcal.tools.report.motion_calibration import MotionReport, motion_report
from weldcal.tools.report.page import TableRows, page_html
from weldcal.tools.report.render import save_all, write_atomic
from weldcal.tools.report.run import RunOptions, robot_timing, run_document

_NO_KEY = "No scenario key states the error that is allowed: compare it with what your job allows."
_SHARED = ("X_BC", "covariance", "clock", "clock_offset_ms", "clock_offset_sigma_ms", "rms_mm")
"""Keys of the JSON object as `calibrate` has them."""


@dataclass(frozen=True, eq=False)
class MotionOutcome:
    """The run of a motion job, its calibration (None: there is none) and what was collected."""

    options: RunOptions
    finished: JobRun
    record: MotionRecord
    report: MotionReport | None

    @property
    def run(self) -> Run[AddedMotion]:
        """The run of the cell."""
        return self.finished.run

    @property
    def folder(self) -> Path:
        """The result folder."""
        return self.options.out

    def true_captures(self) -> dict[int, float]:
        """List true capture times (s) by frame number, on the stream's clock; empty where no simulation knows them.

        A drawn arm that follows an emulated controller is behind it: a frame then shows where that arm was before.
        """
        logs, root = self.run.cell.logs, self.run.root
        if "scanner_capture" not in logs:
            return {}
        numbers, times = logs["scanner_capture"].FindLog(root).data()
        behind = 0.0
        world = self.run.cell.station.world
        if "joints" in logs and self.record.blocks and world is not None:
            log = logs["joints"].FindLog(root)
            # as in a picture, at a tick the plant's last step shows
            stepped = log.sample_times() - world.plant.time_step()
            behind = follower_delay(stepped, log.data()[:6].T, self.record)
        return {int(n): float(t) - behind for n, t in zip(numbers, times, strict=True) if n}

    @property
    def against(self) -> tuple[str, ...]:
        """Why the job was held."""
        return (self.run.reason or "The job was held.",) if self.run.held else ()

    @property
    def first(self) -> FirstScreen:
        """The first screen: of the calibration as `calibrate` gives it on the same recording."""
        if self.report is not None:
            return self.report.first
        expected = ExpectedError("error in the middle of the frames, 95 %", "not known", "there is no calibration")
        found = Findings(against=self.against or ("There is no calibration.",), unseen=0)
        return FirstScreen(found, expected, after_hold(self.run.ended_by_operator), more={"pose": "none was found"})

    def truth(self) -> dict[str, object]:
        """Errors against the simulation: X_BC at the cube's centre, and the clock's offset (mean over the frames)."""
        X_BC, captures, job = (
            self.run.cell.station.truth.X_BC,
            self.true_captures(),
            self.run.cell.scenario.part(MotionJob),
        )
        if X_BC is None or self.report is None or job is None:
            return {}
        e = self.report.estimate
        p_C = X_BC.inverse() @ np.array(job.centre_m)
        turn = (X_BC.inverse() @ e.X_BC).rotation().ToAngleAxis().angle()
        found: dict[str, object] = {
            "error_mm": 1e3 * float(np.linalg.norm(e.X_BC @ p_C - X_BC @ p_C)),
            "error_deg": float(np.degrees(turn)),
        }
        seen = [(f, captures[int(f.id)]) for f, _ in self.record.seen if int(f.id) in captures]
        if seen and e.clock.offset_s is not None:
            device = e.clock.kind == "device"
            base = np.array([f.device if device else f.arrival for f, _ in seen], dtype=float)
            true = np.array([t for _, t in seen])
            true_offset = float(np.mean(true - base if device else base - true))
            found |= {
                "clock_offset_ms": 1e3 * true_offset,
                "clock_offset_error_ms": 1e3 * (e.clock.offset_s - true_offset),
            }
        return found

    def summary(self) -> dict[str, object]:
        """Return the JSON object."""
        run = self.run
        taken, dropped = run.cell.job.counts(run.root)
        found = run_document(run, self.options, self.finished.robot) | {
            "mode": "motion",
            "frames": taken,
            "dropped": dropped,
            "n_seen": len(self.record.seen),
            "refused": [{"id": i, "reason": t} for i, t in self.record.refused],
            "wait_ms": {"median": _ms(self.record.waits_s, 50), "p95": _ms(self.record.waits_s, 95)},
        }
        if self.report is not None:
            said = self.report.summary()
            found |= {key: said[key] for key in _SHARED} | {"held_out_mm": said["k_fold_mm"], "truth": self.truth()}
        return found | run.timing()


def _ms(values: tuple[float, ...], percentile: float) -> float | None:
    return 1e3 * float(np.percentile(values, percentile)) if values else None


def follower_delay(t: Array, joints: Array, record: MotionRecord) -> float:
    """Estimate how long (s) after the robot's stream an arm (n, 6) rad at times (n,) s is where that says."""
    stream = record.stream("")
    assert stream.joints is not None
    inside = (t > stream.time[0]) & (t < stream.time[-1])
    reported = np.column_stack([np.interp(t[inside], stream.time, q) for q in stream.joints.T])
    rate = np.gradient(reported, t[inside], axis=0)
    return -float(((joints[inside] - reported) * rate).sum() / (rate**2).sum())


def run_motion_live(scenario: Scenario, options: RunOptions, progress: Progress) -> MotionOutcome:
    """Run the job; write calibration.yaml with its exports, report.html, run.json and the recordings.

    Raises as run_job.
    """
    job = scenario.part(MotionJob)
    if job is not None and job.record:
        job.recording_folder = str(options.out / "recording")
    finished = run_job(scenario, options, progress, "motion")
    run, added = finished.run, finished.cell.job
    record, calibration = added.record(run.root), added.calibration(run.root)
    options.out.mkdir(parents=True, exist_ok=True)
    write_atomic(options.out / "scenario.yaml", scenario_text(scenario))
    outcome = MotionOutcome(options, finished, record, None)
    title, context = f"Calibration in motion, live, in “{options.scenario}”", robot_timing(run)
    context["recording"] = finished.meshcat is not None
    if (found := calibration.found) is not None:
        result = replace(found.result, seed=options.seed)
        known = vars(found) | {"result": result, "against": outcome.against, "no_tolerance": _NO_KEY}
        outcome = replace(outcome, report=MotionReport(**known, seconds=run.wall_seconds, out=options.out))
        save_all(result, options.out)
    if added.recorder is not None:
        added.recorder.finish(posed_stream(record, finished.cell.station.arm), added.header)
    rows = [(k, str(v)) for k, v in console_rows(outcome.summary()).items() if v]
    figures = ("Figures", [TableRows(rows, text=(0, 1))])
    page = (
        page_html(title, scenario.description, [figures], first=outcome.first, **context)
        if outcome.report is None
        else motion_report(outcome.report, title, figures, **context)
    )
    write_atomic(options.out / "report.html", page)
    write_atomic(options.out / "run.json", json.dumps(outcome.summary(), indent=1) + "\n")
    finished.write_recording(options.out)
    return outcome
