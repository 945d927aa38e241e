"""Replays a recording: today's algorithms on what the cell saw, compared with what it did, bit for bit."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.errors import InputError
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.recording.comparison import Comparison, Difference
from weldcal.systems.recording.player import Playback
from weldcal.systems.recording.port_recorder import LEFT, PERIOD_S
from weldcal.systems.recording.reader import read_recording
from weldcal.systems.recording.scenario_files import unpacked
from weldcal.systems.recording.values import array, decode
from weldcal.systems.runner import Progress, no_progress

IDENTICAL, DIFFERS = "identical", "differs"


@dataclass(frozen=True, eq=False, kw_only=True)
class Replay:
    """A finished replay: seconds of the recording that were replayed, how many values were compared, and what differs by port.

    X_BC (4,4): the calibration that the replay has found, or None. cut_off: the file ends before its run.
    """

    seconds: float
    compared: int
    first: Difference | None
    differences: dict[str, Difference]
    about: dict[str, str]
    phase: str
    X_BC: list[list[float]] | None
    cut_off: bool

    def summary(self) -> dict[str, object]:
        """The JSON object."""
        found: dict[str, object] = {
            "state": IDENTICAL if self.first is None else DIFFERS,
            "seconds": self.seconds,
            "compared": self.compared,
            "cut_off": self.cut_off,
            "phase": self.phase,
            "X_BC": self.X_BC,
            "recorded_with": self.about.get("version"),
            "seed": int(self.about["seed"]),
        }
        if self.first is not None:
            found |= {
                "first": self.first.summary(),
                "differs": {name: d.summary() for name, d in sorted(self.differences.items())},
            }
        return found


def replay(
    path: Path, progress: Progress = no_progress, look: Callable[[Cell[Any], Context], None] | None = None
) -> Replay:
    """Replay a recording; ``look`` is shown the cell and its Context at the end.

    Raises:
        InputError: it is no recording, of another format, or holds too little to replay.
    """
    progress("read the recording", 0.0)
    recording = read_recording(path)
    about = recording.about
    if not recording.entered or recording.end_tick < 1:
        raise InputError(f"'{path}' was cut off before the run began: there is nothing to replay.")
    sizes = json.loads(about["sizes"])
    comparison = Comparison(recording, sizes[LEFT])
    arm = decode(json.loads(about["arm"]), ArmModel)
    robot = PreparedRobot(arm, array(json.loads(about["q_start"])))
    played = Playback(recording.entered, json.loads(about["drives"]), recording.answers)
    with tempfile.TemporaryDirectory() as folder:
        progress("build the cell", 0.02)
        scenario = unpacked(recording.files, Path(folder))
        cell = build_cell(scenario, int(about["seed"]), None, robot, played, lambda station, layout: comparison)
        with closing(cell.station):
            phase, X_BC = _run(cell, recording.end_tick * PERIOD_S, progress, look)
    comparison.finish()
    return Replay(
        seconds=recording.end_tick * PERIOD_S,
        compared=comparison.compared,
        first=comparison.first,
        differences=comparison.differences,
        about=about,
        phase=phase,
        X_BC=X_BC,
        cut_off=recording.end is None,
    )


def _run(
    cell: Cell[Any], end_s: float, progress: Progress, look: Callable[[Cell[Any], Context], None] | None
) -> tuple[str, list[list[float]] | None]:
    """Advance to the end of the recording; the phase there, and the calibration."""
    simulator = Simulator(cell.diagram)
    due = 0.0

    def watch(root: Context) -> EventStatus:
        nonlocal due
        if root.get_time() >= due:
            due = root.get_time() + 1.0
            progress(cell.job.command(root).phase.replace("_", " "), 0.05 + 0.94 * root.get_time() / max(end_s, 1e-9))
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    simulator.Initialize()
    simulator.AdvanceTo(end_s)
    simulator.AdvancePendingEvents()
    simulator.clear_monitor()
    root = simulator.get_context()
    if look is not None:
        look(cell, root)
    status = getattr(cell.job, "calibration_status", None)
    estimate = None if status is None else status(root).estimate
    X_BC = None if estimate is None else estimate.X_BC.GetAsMatrix4().tolist()
    return str(cell.job.command(root).phase), X_BC
