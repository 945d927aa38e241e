"""Compare tracking errors of the flange and of a wrist link, by its mesh and by a fused model."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np

from weldcal.calibration.data.motion_dataset import load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.motion.drift.watch import DriftHistory, watch
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.arms.urdf import link_index
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.monitor_body import track_link
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.studies.harness import Target, all_met, print_targets
from weldcal.tools.worlds.motion import MotionOptions, MotionWorld, write_motion_dataset

LINK = "wrist_1_link"
WITHIN = 2.0
_SIGMA = 1e-5  # rad and m: the calibration of the study is the truth, so that what is left is tracking


@command("benchmark whole-body", short_help="Compare tracking by the flange with tracking by a link.", hidden=True)
def benchmark_whole_body(
    call: Call,
    frames: Annotated[int, option("--frames", "N", "Frames of the recording.", min=12)] = 200,
    width: Annotated[int, option("--width", "PX", "Width of the scanner's image.", min=64)] = 1068,
    noise_mm: Annotated[
        float | None, option("--noise-mm", "MM", "Noise of one pixel.", show_default="the scanner's")
    ] = None,
    body: Annotated[str, option("--body", "LINK", "The link that is tracked.")] = LINK,
) -> Outcome:
    """Compare the tracking error of the flange with that of a link, by its mesh and by a model fused from the scans."""
    options = MotionOptions(
        frames=frames, size=(width, round(0.749 * width)), noise_mm=noise_mm, seed=call.seed, surroundings=False
    )
    summary, targets = run_whole_body(call.folder("benchmark", "whole-body"), options, body, call.progress)
    return Outcome(summary, text=lambda: print_targets("Whole body", targets))


def run_whole_body(
    out: Path | None, options: MotionOptions, link: str = LINK, progress: Progress | None = None
) -> tuple[dict[str, object], list[Target]]:
    """Render a recording, track flange and link with the true calibration; rms and spread of the error (mm) of each.

    Raises:
        InputError: the arm has no such link; before anything is rendered.
    """
    link_index(load_arm(options.robot), link)
    tell: Progress = progress or (lambda stage, fraction: None)
    world = MotionWorld(options)
    result = CalibrationResult(
        X_BC=world.X_BC,
        covariance=_SIGMA**2 * np.eye(6),
        held_out_mm={},
        tilt_deg={},
        poses=(),
        robot=options.robot,
        flange=world.flange.designation,
    )
    found: dict[str, DriftHistory] = {}
    with tempfile.TemporaryDirectory() as folder:
        data_folder = Path(folder) / "recording"
        write_motion_dataset(world, data_folder, Path(folder) / "truth.json", lambda s, f: tell(s, 0.5 * f))
        data = load_motion_dataset(data_folder)
        standard = world.flange
        motion = ContinuousMotion(data.stream)
        seen = see_frames(data, standard, motion, X_BC=result.X_BC, tell=lambda f: tell("flange", 0.5 + 0.15 * f))
        found["flange"] = watch(result, seen.observed, motion, X_FR=data.X_FR, dropped=seen.refused)
        known = replace(result, clock=None)
        for name, fused in (("mesh", False), ("fused", True)):
            frames, body_motion, X_LR, refused = track_link(
                data,
                known,
                standard,
                link,
                fused=fused,
                seed=options.seed,
                tell=lambda f, name=name, at=0.82 if fused else 0.65: tell(  # type: ignore[misc]
                    f"{link}, {name}", at + 0.17 * f
                ),
            )
            found[name] = watch(known, frames, body_motion, X_FR=X_LR, dropped=refused)
    rows = {name: _row(w) for name, w in found.items()}
    limit = WITHIN * rows["flange"]["rms_mm"]
    targets = [Target(f"{link} by {name}, rms", "mm", rows[name]["rms_mm"], limit) for name in ("mesh", "fused")]
    summary: dict[str, object] = {
        "state": "done" if all_met(targets) else "failed",
        "link": link,
        **rows,
        "targets": [{**t._asdict(), "met": t.met} for t in targets],
    }
    if out is not None:
        write_json(out / "result.json", summary)
    return summary, targets


def _row(w: DriftHistory) -> dict[str, float]:
    used = ~w.gross
    e = w.residuals[used]
    return {
        "frames": float(len(w.ids)),
        "dropped": float(len(w.dropped)),
        "rms_mm": 1e3 * w.rms_m,
        "mean_mm": 1e3 * float(np.linalg.norm(e.mean(axis=0))),
        "spread_mm": 1e3 * float(np.sqrt(e.var(axis=0).sum())),
        "tilt_spread_deg": float(np.degrees(np.sqrt(w.tilts[used].var(axis=0).mean()))),
    }
