"""`weldcal monitor FOLDER --calibration RESULT`: tracks the flange through a recording in motion and tests for drift."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.checks import read_header
from weldcal.calibration.data.motion_dataset import MotionDataset, load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, export_all, load_result, save_result, software_version
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.motion.drift.background import background_move
from weldcal.calibration.motion.drift.sequential import MOVED, DriftConfig, DriftEvent
from weldcal.calibration.motion.drift.watch import Watched, watch
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.tools.commands.monitor_body import see_link
from weldcal.tools.console import Progress
from weldcal.tools.outcomes.monitor import MonitorReport
from weldcal.tools.report.monitor import monitor_page
from weldcal.tools.report.render import write_atomic

_STILLS = 15  # frames before and after a change that show what stands still
_APART_S = 0.3  # from a change and the frames that are compared
_FEW = 40  # frames: fewer leave the noise, and so small changes, open


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
    """Watch a calibration (its folder or calibration.yaml) over a recording in motion; write report.html and monitor.json.

    The clock's offset is estimated from the recording itself; the calibration's is used where the recording does not show it.
    ``flange`` overrides dataset.yaml. ``body`` is a link that is tracked instead of the flange, by its mesh or, with ``fused``, by a
    model made from the first scans. With ``recalibrate`` the pose that the frames since the last change show is written to
    ``out``/recalibrated. Raises InputError: the result or the recording cannot be used; TooFewPoses: no frames show the flange.
    """
    started = time.monotonic()
    tell: Progress = progress or (lambda stage, fraction: None)
    rate_checked(false_alarms_per_hour)
    if fused and body is None:
        raise InputError("A fused model is one of a link: name it with --body.")
    if Path(out).exists() and not Path(out).is_dir():
        raise InputError(f"'{out}' is a file. Give a folder for the result.")
    result = load_result(Path(calibration))
    data = load_motion_dataset(Path(folder), robot=read_header(Path(folder) / "dataset.yaml").robot or result.robot)
    if data.in_hand:
        raise InputError(f"'{folder}' is of a scanner on the flange; monitor watches one that stands beside the robot.")
    standard = get_flange(flange or data.header.flange or result.flange)
    motion = ContinuousMotion(data.stream)
    X_FR = data.X_FR
    if body is None:
        seen = see_frames(
            data, standard, motion, X_BC=result.X_BC, seed=seed,
            tell=lambda fraction: tell("tracking the flange", 0.85 * fraction),
        )  # fmt: skip
        frames, refused = seen.observed, seen.refused
    else:
        frames, motion, X_FR, refused = see_link(
            data, result, standard, body, fused=fused, seed=seed,
            tell=lambda fraction: tell(f"tracking the {body}", 0.85 * fraction),
        )  # fmt: skip
    tell("testing for drift", 0.85)
    config = DriftConfig(false_alarms_per_hour=false_alarms_per_hour)
    watched = watch(result, frames, motion, X_FR=X_FR, dropped=refused, config=config)
    watched = replace(watched, events=tuple(told_apart(e, watched, data, result) for e in watched.events))
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
    result: CalibrationResult, watched: Watched, hashes: dict[str, str], flange: str, seed: int
) -> CalibrationResult:
    """The calibration as it is at the end of a watch, from all frames since the last change and the calibration before it."""
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


def told_apart(e: DriftEvent, watched: Watched, data: MotionDataset, result: CalibrationResult) -> DriftEvent:
    """The event with its cause, where what stands still in the scans before and after it tells."""
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


def causes(watched: Watched) -> str:
    """What the data tell of the cause, over all events."""
    return "; ".join(dict.fromkeys(e.cause for e in watched.events))


def _warnings(result: CalibrationResult, data: MotionDataset, watched: Watched, refused: int, flange: str) -> list[str]:
    h, out = data.header, []
    for what, was, now in (
        ("robot", result.robot, h.robot), ("flange", result.flange, flange), ("scanner", result.scanner, h.scanner),
    ):  # fmt: skip
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
