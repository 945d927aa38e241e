"""weldcal monitor: watches a calibration while the arm moves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldcal.tools.cli.options import LIVE, Call, FlangeOption, Outcome, command, option, switch
from weldcal.tools.cli.runs import run_options

if TYPE_CHECKING:
    from weldcal.tools.outcomes.first_screen import FirstScreen


@command("monitor", options=LIVE, short_help="Watch a calibration while the arm moves.", defaults={"browser": False})
def monitor(
    call: Call,
    recording: Annotated[
        str,
        typer.Argument(
            metavar="FOLDER",
            help="A recording in motion: dataset.yaml (mode: motion), stream.csv, frames.csv, clouds/. Or a scenario whose scanner "
            "streams, by name or YAML file: it is watched live.",
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
    """Track the flange through a recording, or live, and test the calibration: has the scanner moved, when, by how much, which way.

    Times are on the robot's clock. Translation and rotation are those of the scanner about its own origin, in the robot's base.
    """
    from weldcal.tools.commands.monitor import monitor_recording

    if _is_scenario(recording):
        return _live(call, recording, calibration, frames, false_alarms, recalibrate, record, body)
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
    """Whether a name is that of a scenario and not of a recording's folder."""
    from weldcal.systems.scenario.loading import scenario_names

    return not Path(name).is_dir() and (name.endswith((".yaml", ".yml")) or name in scenario_names())


def _live(
    call: Call, name: str, calibration: Path, frames: int | None, false_alarms: float, recalibrate: bool, record: bool,
    body: str | None,
) -> Outcome:  # fmt: skip
    if body is not None:
        raise typer.BadParameter("--body is for a recording; live, the flange is tracked")
    from weldcal.tools.commands.monitor_live import monitor_live

    options = run_options(call, "monitor", name)
    live = monitor_live(
        options, calibration, call.progress, frames=frames, false_alarms_per_hour=false_alarms, recalibrate=recalibrate,
        record=record,
    )  # fmt: skip
    return _outcome(live.summary(), () if live.report is None else live.report.moves, live.first)


def _outcome(summary: dict[str, Any], moves: Sequence[Any], first: FirstScreen) -> Outcome:
    """What is printed of a watch."""
    shown = ("verdict", "cause", "rms_mm", "rms_before_synchronisation_mm", "frames", "dropped", "delay_ms")
    values = {key: summary[key] for key in shown if key in summary}
    rows = {
        f"{e.kind} at {e.time_s:.2f} s": f"{d['translation_mm']:.3f} mm, {d['rotation_deg']:.4f} deg, found at {e.found_s:.2f} s"
        for e, d in zip(moves, summary["drift"], strict=True)
    }
    return Outcome(summary, values=values, rows=rows, first=first)
