"""Track the flange through a recording in motion and test for drift: `weldcal monitor`."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.checks import read_header
from weldcal.calibration.data.motion_dataset import FrameTime, MotionDataset, load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, export_all, load_result, save_result, software_version
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.motion.drift.sequential import MOVED, DriftConfig, DriftEvent
from weldcal.calibration.motion.drift.watch import DriftHistory, background_move, watch
from weldcal.calibration.motion.frames import observed_frames, see_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.systems.jobs.motion.job import AddedMotion, MotionJob
from weldcal.systems.jobs.motion.procedure import MotionRecord, posed_stream
from weldcal.systems.jobs.weld.settings import feature_standard
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LIVE, Call, FlangeOption, Outcome, command, option, switch
from weldcal.tools.commands.monitor_body import track_link
from weldcal.tools.commands.run import JobRun, run_job, run_options
from weldcal.tools.console import Progress
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, Next
from weldcal.tools.report.monitor import MonitorReport, drift_document, monitor_page
from weldcal.tools.report.render import check_folder, write_atomic
from weldcal.tools.report.run import RunOptions

_STILLS = 15  # frames before and after a change that show what stands still
_APART_S = 0.3  # from a change and the frames that are compared
_FEW = 40  # frames: fewer leave the noise, and so small changes, open


@command("monitor", options=LIVE, short_help="Watch a calibration while the arm moves.", defaults={"browser": False})
def monitor(
    call: Call,
    recording: Annotated[
        str,
        typer.Argument(
            metavar="FOLDER",
            help=(
                "A recording in motion: dataset.yaml (mode: motion), stream.csv, frames.csv, clouds/. Or a scenario"
                " whose scanner "
                "streams, by name or YAML file: it is watched live."
            ),
        ),
    ],
    calibration: Annotated[
        Path, option("--calibration", "RESULT", "The calibration: its folder, or its calibration.yaml.")
    ],
    flange: FlangeOption = None,
    body: Annotated[
        str | None,
        option(
            "--body", "LINK", "Track a link instead of the flange, such as wrist_1_link.", show_default="the flange"
        ),
    ] = None,
    fused: Annotated[bool, switch("--fused", "With --body: fuse its surface from the scans, without a mesh.")] = False,
    false_alarms: Annotated[float, option("--false-alarms", "N", "False alarms per hour that are accepted.")] = 1e-3,
    recalibrate: Annotated[
        bool, switch("--recalibrate", "Write the scanner's pose after the last change to recalibrated/.")
    ] = False,
    frames: Annotated[
        int | None,
        option("--frames", "N", "Live: frames with the flange to watch.", min=40, show_default="the scenario's"),
    ] = None,
    record: Annotated[bool, switch("--record", "Live: also write what streams as a recording.")] = False,
) -> Outcome:
    """Track the flange in a recording, or live, and test whether, when and how far the scanner has moved.

    Times are on the robot's clock. Translation and rotation are those of the scanner about its own origin, in the
    robot's base.
    """

    if _is_scenario(recording):
        if body is not None:
            raise typer.BadParameter("--body is for a recording; live, the flange is tracked")
        live = monitor_live(
            run_options(call, "monitor", recording),
            calibration,
            call.progress,
            frames=frames,
            false_alarms_per_hour=false_alarms,
            recalibrate=recalibrate,
            record=record,
        )
        return _outcome(live.summary(), () if live.report is None else live.report.moves, live.first)
    if frames is not None or record:
        raise typer.BadParameter("--frames and --record are for a scenario; omit them with a recording")
    folder = Path(recording)
    report = monitor_recording(
        folder,
        calibration,
        call.folder("monitor", folder.resolve().name),
        flange=flange,
        false_alarms_per_hour=false_alarms,
        recalibrate=recalibrate,
        body=body,
        fused=fused,
        seed=call.seed,
        progress=call.progress,
    )
    return _outcome(report.summary(), report.moves, report.first)


def _is_scenario(name: str) -> bool:
    """Return whether a name is that of a scenario and not of a recording's folder."""
    return not Path(name).is_dir() and (name.endswith((".yaml", ".yml")) or name in scenario_names())


def _outcome(summary: dict[str, Any], moves: Sequence[Any], first: FirstScreen) -> Outcome:
    """What is printed of a watch."""
    shown = ("verdict", "cause", "rms_mm", "rms_before_synchronisation_mm", "frames", "dropped", "delay_ms")
    values = {key: summary[key] for key in shown if key in summary}
    rows = {
        f"{e.kind} at {e.time_s:.2f} s": (
            f"{d['translation_mm']:.3f} mm, {d['rotation_deg']:.4f} deg, found at {e.found_s:.2f} s"
        )
        for e, d in zip(moves, summary["drift"], strict=True)
    }
    return Outcome(summary, values=values, rows=rows, first=first)


def monitor_recording(
    folder: Path,
    calibration: Path,
    out: Path,
    *,
    flange: str | None = None,
    false_alarms_per_hour: float = DriftConfig.false_alarms_per_hour,
    recalibrate: bool = False,
    body: str | None = None,
    fused: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> MonitorReport:
    """Watch a calibration (its folder or file) over a recording in motion; write report.html and monitor.json.

    The clock's offset is estimated from the recording itself; the calibration's is used where the recording does not
    show it. ``flange`` overrides dataset.yaml. ``body`` is a link that is tracked instead of the flange, by its mesh
    or, with ``fused``, by a model made from the first scans. With ``recalibrate`` the pose that the frames since the
    last change show is written to ``out``/recalibrated. Raises InputError: the result or the recording cannot be used;
    TooFewPoses: no frames show the flange.
    """
    started = time.monotonic()
    tell: Progress = progress or (lambda stage, fraction: None)
    rate_checked(false_alarms_per_hour)
    if fused and body is None:
        raise InputError("A fused model is one of a link: name it with --body.")
    check_folder(Path(out))
    result = load_result(Path(calibration))
    data = load_motion_dataset(Path(folder), robot=read_header(Path(folder) / "dataset.yaml").robot or result.robot)
    if data.in_hand:
        raise InputError(f"'{folder}' has scans of a scanner on the flange. Give scans of a scanner beside the robot.")
    standard = get_flange(flange or data.header.flange or result.flange)
    motion = ContinuousMotion(data.stream)
    X_FR = data.X_FR
    if body is None:
        seen = see_frames(
            data,
            standard,
            motion,
            X_BC=result.X_BC,
            seed=seed,
            tell=lambda fraction: tell("tracking the flange", 0.85 * fraction),
        )
        frames, refused = seen.observed, seen.refused
    else:
        frames, motion, X_FR, refused = track_link(
            data,
            result,
            standard,
            body,
            fused=fused,
            seed=seed,
            tell=lambda fraction: tell(f"tracking the {body}", 0.85 * fraction),
        )
    tell("testing for drift", 0.85)
    config = DriftConfig(false_alarms_per_hour=false_alarms_per_hour)
    watched = watch(result, frames, motion, X_FR=X_FR, dropped=refused, config=config)
    watched = replace(watched, events=tuple(classified(e, watched, data, result) for e in watched.events))
    recalibrated = (
        recalibrated_result(result, watched, data.hashes, standard.designation, seed) if recalibrate else None
    )
    report = MonitorReport(
        watched=watched,
        calibration=result,
        recalibrated=recalibrated,
        cause=causes(watched),
        false_alarms_per_hour=false_alarms_per_hour,
        warnings=(*data.warnings, *_warnings(result, data, watched, len(refused), standard.designation)),
        seconds=time.monotonic() - started,
        out=Path(out),
    )
    tell("writing the report", 0.95)
    write_atomic(Path(out) / "report.html", monitor_page(report, recording=Path(folder).resolve().name))
    if recalibrated is not None:
        export_all(recalibrated, Path(out) / "recalibrated")
        save_result(recalibrated, Path(out) / "recalibrated")
    # last, so that its presence means that everything else is there
    write_atomic(Path(out) / "monitor.json", json.dumps(report.summary(), indent=2, allow_nan=False) + "\n")
    tell("done", 1.0)
    return report


def rate_checked(false_alarms_per_hour: float) -> None:
    """Check the accepted rate. Raises InputError."""
    if not 0.0 < false_alarms_per_hour <= 3600.0:
        raise InputError(
            f"The rate of false alarms must be positive and at most 3600 per hour, not {false_alarms_per_hour:g}."
        )


def recalibrated_result(
    result: CalibrationResult, watched: DriftHistory, hashes: dict[str, str], flange: str, seed: int
) -> CalibrationResult:
    """Calibrate at the end of a watch, from all frames since the last change and the calibration before it."""
    held = 1e3 * np.linalg.norm(watched.after[~watched.gross & (watched.rows.times >= watched.since_s)], axis=1)
    errors = {"median": float(np.median(held)), "mean": float(held.mean()), "p95": float(np.percentile(held, 95.0))}
    return replace(
        result,
        X_BC=watched.X_BC,
        covariance=watched.covariance,
        held_out_mm=errors if len(held) else result.held_out_mm,
        poses=(),
        icp=(),
        warnings=(*result.warnings, f"Recalibrated in motion from frames since {watched.since_s:.3f} s (robot clock)."),
        seed=seed,
        flange=flange,
        data_hashes=hashes,
        joint_covariance=None,
        clock_covariance=None,
        software=software_version(),
    )


def classified(e: DriftEvent, watched: DriftHistory, data: MotionDataset, result: CalibrationResult) -> DriftEvent:
    """Return the event with its cause, where the static surroundings in the scans before and after show it."""
    if e.kind != MOVED or e.since_start:
        return e
    t = watched.rows.times
    others = [o.time_s for o in watched.events if o is not e]
    low = max((o for o in others if o < e.time_s), default=-np.inf)
    high = min((o for o in others if o > e.time_s), default=np.inf)
    parts: list[list[Array]] = []
    for near in ((t > low + _APART_S) & (t < e.time_s - _APART_S), (t > e.time_s + _APART_S) & (t < high - _APART_S)):
        index = np.flatnonzero(near)
        chosen = index[np.unique(np.linspace(0, len(index) - 1, min(len(index), _STILLS)).astype(int))]
        parts.append([data.cloud(watched.ids[k]) for k in chosen])
    # what the flange says of the move: from the pose before it to the pose after
    turn = RotationMatrix(exp_rotation(e.rotation_rad))
    R = result.X_BC.rotation()
    moved = RigidTransform(turn @ R, result.X_BC.translation() + e.translation_m)
    found = background_move(parts[0], parts[1], moved.InvertAndCompose(result.X_BC))
    return e if found is None or found.cause is None else replace(e, cause=found.cause)


def causes(watched: DriftHistory) -> str:
    """Return what the data show of the cause, over all events."""
    return "; ".join(dict.fromkeys(e.cause for e in watched.events))


def _warnings(
    result: CalibrationResult, data: MotionDataset, watched: DriftHistory, refused: int, flange: str
) -> list[str]:
    h, out = data.header, []
    for what, was, now in (
        ("robot", result.robot, h.robot),
        ("flange", result.flange, flange),
        ("scanner", result.scanner, h.scanner),
    ):
        if was and now and was != now:
            out.append(f"The calibration was made with the {what} '{was}', this recording with '{now}'.")
    if len(watched.ids) < _FEW:
        out.append(f"Only {len(watched.ids)} frames show it; small changes cannot be found in so few.")
    clock = watched.clock
    if clock.delay_s is None:
        out.append("The motion does not show when the frames were taken: their arrivals are used as they are.")
    elif clock.source == "calibration":
        out.append("The motion does not show when the frames were taken: the calibration's clock is used.")
    if refused > len(watched.ids):
        out.append(f"{refused} of {len(data.frames)} frames do not show it well enough.")
    return out


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
                found, ExpectedError("error of the tracked flange, 95 %", "not known", "no frame showed it"), after
            )
        first = self.report.first
        if not held:
            return first
        return replace(first, found=replace(first.found, against=[*held, *first.found.against]))

    def summary(self) -> dict[str, Any]:
        """Return the JSON object: the run, then what `monitor` says of a recording, which it ends with."""
        run = self.finished.run
        job: AddedMotion = run.cell.job
        live = job.drift(run.root)
        found: dict[str, Any] = {
            "state": "held" if run.held else "done",
            "scenario": self.options.scenario,
            "seed": self.options.seed,
            "robot": self.finished.robot,
            "live": {
                "frames": live.frames,
                "dropped": live.dropped,
                "alarmed": live.alarmed,
                "summary": live.summary,
                "drift": [drift_document(e) for e in live.events],
            },
        }
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
    """Return the scenario as it is watched: its motion, or that of the default cube where it has another job.

    Raises:
        InputError: its scanner does not stream, or it cannot be run so.
    """
    rate_checked(false_alarms_per_hour)
    scenario = load_scenario(name)
    scanner = scenario.scanner_config()
    if scanner is None or scanner.stream_delay_s() is None:
        raise InputError(
            f"The scanner of '{name}' does not stream, so that nothing can be watched: write scanner: !StreamingScanner"
            " {} in the scenario, or give a recording."
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
    """Watch a calibration while the arm moves in the scenario's cube; write report.html, monitor.json and recordings.

    The DriftMonitor in the cell tests every frame as it comes. At the end all frames are tested again with the clock
    that they show together, as on a recording. ``record`` also writes what streamed as a recording, by whose still
    background a moved base is told from a moved scanner. Raises as run_job and load_result; nothing has moved.
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
        header = replace(added.header, flange=feature_standard(scenario).designation)
        added.recorder.finish(posed_stream(collected, arm), header)
        data = load_motion_dataset(options.out / "recording")
    report = None
    if collected.seen:
        watched = watched_record(result, collected, finished, DriftConfig(false_alarms_per_hour=false_alarms_per_hour))
        if data is not None:
            events = tuple(classified(e, watched, data, result) for e in watched.events)
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


def watched_record(
    result: CalibrationResult, record: MotionRecord, finished: JobRun, config: DriftConfig
) -> DriftHistory:
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
