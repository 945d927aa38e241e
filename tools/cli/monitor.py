"""weldcal monitor: watches a calibration while the arm moves."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, FlangeOption, Outcome, command, option, switch


@command("monitor", short_help="Watch a calibration while the arm moves.")
def monitor(
    call: Call,
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="A recording in motion: dataset.yaml (mode: motion), stream.csv, frames.csv, clouds/.",
        ),
    ],
    calibration: Annotated[
        Path, option("--calibration", "RESULT", "The calibration: its folder, or its calibration.yaml.")
    ],
    flange: FlangeOption = None,
    false_alarms: Annotated[float, option("--false-alarms", "N", "False alarms per hour that are accepted.")] = 1e-3,
    recalibrate: Annotated[
        bool, switch("--recalibrate", "Write the scanner's pose after the last change to recalibrated/.")
    ] = False,
) -> Outcome:
    """Track the flange through a recording and test the calibration: has the scanner moved, when, by how much, which way.

    Times are on the robot's clock. Translation and rotation are those of the scanner about its own origin, in the robot's base.
    """
    from weldcal.tools.commands.monitor import monitor_recording

    report = monitor_recording(
        recording,
        calibration,
        call.folder("monitor", recording.resolve().name),
        flange=flange,
        false_alarms_per_hour=false_alarms,
        recalibrate=recalibrate,
        seed=call.seed,
        progress=call.progress,
    )
    summary = report.summary()
    values = {
        key: summary[key]
        for key in ("verdict", "cause", "rms_mm", "rms_before_synchronisation_mm", "frames", "dropped", "delay_ms")
    }
    rows = {
        f"{e.kind} at {e.time_s:.2f} s": f"{d['translation_mm']:.3f} mm, {d['rotation_deg']:.4f} deg, found at {e.found_s:.2f} s"
        for e, d in zip(report.moves, summary["drift"], strict=True)
    }
    return Outcome(summary, values=values, rows=rows)
