"""A streaming scanner by wire, with a clock of its own: X_BC and clock against the world's truth, and a knock that the
monitor finds."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.worlds.robot.played import Played, played_world
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario
from weldcal.tools.commands.monitor import LiveMonitor, monitor_live
from weldcal.tools.commands.motion_live import MotionOutcome, run_motion_live
from weldcal.tools.emulators.ur.process import CONTROL_PORT, Emulator
from weldcal.tools.report.run import RunOptions

SEED, FRAMES, WATCHED = 3, 60, 80
KNOCK_MM = [0.9, 0.0, -1.2]
PIXELS = "width: 360\n  height: 270\n"


@pytest.fixture(scope="module")
def wired(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Played, str, Path]]:
    """A world with few and small pictures, its address, and the scenario of the cell that it plays."""
    folder = tmp_path_factory.mktemp("world")
    host = f"127.34.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    world = (SCENARIO_FOLDER / "motion.yaml").read_text(encoding="utf-8")
    stand = f"knock_s: 1.0e+5\n  knock_mm: {KNOCK_MM}\n  exposure_samples: 1\n  fps: 10.0\n  {PIXELS}"
    world = re.sub(r"(  preset: .*\n)", rf"\1  {stand}", world)
    cell = (SCENARIO_FOLDER / "wired_motion.yaml").read_text(encoding="utf-8")
    cell = cell.replace("127.30.0.1", host).replace("/tmp/weldcal-cell/frames", str(folder / "frames"))
    cell = re.sub(r"(  preset: .*\n)", rf"\1  {PIXELS}", cell).replace("frames: 400", f"frames: {FRAMES}")
    path = folder / "cell.yaml"
    path.write_text(cell, encoding="utf-8")
    with played_world(folder, world, cell, SEED) as played:
        yield played, host, path


@pytest.fixture(scope="module")
def calibrated(wired: tuple[Played, str, Path], tmp_path_factory: pytest.TempPathFactory) -> MotionOutcome:
    folder = tmp_path_factory.mktemp("calibration") / "run"
    options = RunOptions(scenario="a test's own", out=folder, seed=SEED, recording=False)
    return run_motion_live(load_scenario(str(wired[2])), options, lambda stage, share: None)


def test_pose_and_clock_are_those_of_the_truth_file(wired: tuple[Played, str, Path], calibrated: MotionOutcome) -> None:
    assert calibrated.report is not None, calibrated.run.reason
    truth, e = wired[0].truth(), calibrated.report.estimate
    assert calibrated.run.cell.station.world is None
    X_BC, p = RigidTransform(np.array(truth["X_BC"])), np.array([0.65, 0.0, 0.30])
    assert 1e3 * np.linalg.norm(e.X_BC @ (X_BC.inverse() @ p) - p) < 0.2
    assert e.clock.kind == "device"
    # the scanner's clock counts the world's time; the Diagram's is less by a constant and what it has lost, as device
    # times are here
    clock, ticks, run = truth["scanner_clock"], calibrated.run.clock, calibrated.run
    assert ticks is not None
    assert run.held is False
    device = np.array([f.device for f, _ in calibrated.record.seen], dtype=float)
    world_s = (device - clock["at_0_s"]) / clock["rate"]
    times = world_s + truth["robot_time_at_0_s"]
    true = np.array([ticks.diagram_time(t, np.inf) + ticks.lost_by(t) for t in times])
    found = np.array([e.clock.capture(np.nan, d) for d in device], dtype=float)
    assert 1e3 * np.abs(found - true).max() < 2.0


def test_the_monitor_finds_the_stand_that_the_world_knocks(
    wired: tuple[Played, str, Path], calibrated: MotionOutcome, tmp_path: Path
) -> None:
    played, host, cell = wired
    emulator = Emulator(played.process, host, CONTROL_PORT)

    def watch(_: str, share: float) -> None:
        if share > 0.4 and played.truth()["knocked_at_s"] is None:
            emulator.fault("knock", latch=False)

    options = RunOptions(scenario=str(cell), out=tmp_path / "run", seed=SEED, recording=False)
    try:
        found: LiveMonitor = monitor_live(options, calibrated.folder, watch, frames=WATCHED)
    finally:
        emulator.leave()
    truth, ticks = played.truth(), found.finished.run.clock
    assert found.finished.run.reason is None
    assert ticks is not None
    knocked = ticks.diagram_time(truth["knocked_at_s"] + truth["robot_time_at_0_s"], np.inf)
    live = [event.found_s for event in found.found_live]
    assert len(live) == 1, found.summary()
    # 3 s of the scanner's rate: a busy computer fits fewer frames a second
    frames = found.finished.cell.job.drift(found.finished.run.root).recent[:, 0]
    assert 0 < ((frames > knocked) & (frames <= live[0])).sum() <= 30, (knocked, live, frames)
    assert found.report is not None
    moves = [(event.time_s - knocked, 1e3 * event.translation_m) for event in found.report.moves]
    assert len(moves) == 1, moves
    # 0.3 s of the scanner's rate, in frames for the same reason
    early, late = sorted((knocked, knocked + moves[0][0]))
    assert ((frames > early) & (frames <= late)).sum() <= 3, (moves, frames)
    assert moves[0][1] == pytest.approx(KNOCK_MM, abs=0.3), moves
