"""A whole job by wire: the world is another process, its truth is in a file, and a device that is gone ends the job by
name."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import Diagram
from pydrake.systems.primitives import VectorLogSink

from weldcal.models.files import UNFINISHED
from weldcal.systems.cell import build_cell
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.emulators.ur.process import Emulator
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions

SEED = 3
SEAM_MM, SPEED_MM_S = 40.0, 16.0  # twice as fast as usual
X_BC = "{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}"
WELD_ONLY = f"job: {{calibrate: false, X_BC: {X_BC}}}\nwelding: {{seam_length_mm: {SEAM_MM}, speed_mm_s: {SPEED_MM_S}}}"
WORLD = """
description: a straight groove, its scanner where the drawing has it
robot: !SimulatedUr {}
scanner: !RenderedScanner
  preset: ideal
  width: 824
  height: 616
  mounting_translation_mm: 0.0
  mounting_rotation_deg: 0.0
finger_camera: !RenderedFingerCamera {}
workpiece:
  shape: straight
  pose_guess: {xyz_m: [0.65, 0.0, 0.02], rpy_deg: [0.0, 0.0, 90.0]}
  placement_error: {translation_mm: 3.0, rotation_deg: 0.5}
  groove_error: {translation_mm: 1.0, rotation_deg: 0.2}
home_deg: [190.0, -120.0, 135.0, -105.0, -90.0, 90.0]
"""


# What a host's clock shows that somebody sets: each process reads by how much from a file.
SET_CLOCK = """
import time
from pathlib import Path

true_time = time.time
time.time = lambda: true_time() + float(Path({file!r}).read_text())
"""
HOUR_S = 3600.0
ARC_INPUTS = "  arc_fault_input: 1\n"
SET_POINTS = """  wire_feed: {output: 0, unit: V, at_zero: 1.0, at_full: 22.0, value: 8.0}
  arc_voltage: {output: 1, unit: mA, at_zero: 10.0, at_full: 40.0, value: 21.5}
"""


@dataclass
class Played:
    """A world that plays a cell's devices: its process, those of its devices, the cell's scenario and the truth
    file."""

    process: subprocess.Popen[str]
    children: list[int]
    host: str
    cell: Path
    truth: Path
    clock: Path

    def ask(self, **request: Any) -> dict[str, Any]:
        """One request to the controller's control channel."""
        emulator = Emulator(self.process, self.host, 30090)
        try:
            return emulator.ask(**request)
        finally:
            emulator._socket.close()

    def scenario(self, overrides: str = "") -> Scenario:
        """The cell's scenario, which only welds."""
        return load_scenario(str(self.cell), overrides)


def ends(pid: int, within_s: float) -> bool:
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Played]:
    folder = tmp_path_factory.mktemp("world")
    host = f"127.33.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    cell, world, truth = folder / "cell.yaml", folder / "world.yaml", folder / "truth.json"
    text = (SCENARIO_FOLDER / "wired_straight_groove.yaml").read_text()
    text = text.replace("127.30.0.1", host).replace("/tmp/weldcal-cell/scans", str(folder / "scans"))
    assert ARC_INPUTS in text
    text = text.replace(ARC_INPUTS, ARC_INPUTS + SET_POINTS)
    cell.write_text(text.replace("pace: 0.5", "pace: 1.0") + WELD_ONLY + "\n")
    world.write_text(WORLD)
    command = [sys.executable, "-P", "-m", "weldcal.tools", "emulate-cell", "--scenario", str(world)]
    command += ["--cell", str(cell), "--seed", str(SEED), "--truth", str(truth)]
    clock = folder / "clock_is_set_by"
    clock.write_text("0.0")
    (folder / "at_start").mkdir()
    (folder / "at_start" / "sitecustomize.py").write_text(SET_CLOCK.format(file=str(clock)))
    own = {**os.environ, "PYTHONPATH": str(folder / "at_start")}
    with (folder / "log").open("w+") as log:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True, env=own
        )
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("ready"), line + (folder / "log").read_text()
            children = [int(pid) for pid in re.findall(r"process (\d+)", line)]
            assert len(children) == 2
            yield Played(process, children, host, cell, truth, clock)
        finally:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def welded(played: Played, tmp_path_factory: pytest.TempPathFactory) -> tuple[DemoResult, dict[str, Any]]:
    """The job without its calibration, on a short seam, and the truth as it is when the job has ended.

    Somebody sets the computer's clock back by an hour when the workpiece is scanned, and forward by two in the middle
    of the weld.
    """
    options = RunOptions(
        scenario="a test's own", out=tmp_path_factory.mktemp("job") / "run", seed=SEED, recording=False
    )
    unix, stages = time.time, list[str]()

    def set_clock(by_s: float) -> None:
        replaced = played.clock.with_suffix(".new")
        replaced.write_text(str(by_s))
        os.replace(replaced, played.clock)
        patched.setattr(time, "time", lambda: unix() + by_s)

    def watch(phase: str, _: float) -> None:
        stages.append(phase)
        if phase == phase_words("scan_workpiece") and stages.count(phase) == 1:
            set_clock(-HOUR_S)
        if sum(said.startswith(phase_words("weld")) for said in stages) == 3:
            set_clock(HOUR_S)

    with pytest.MonkeyPatch.context() as patched:
        result = run_scenario(played.scenario(), options, watch)
        assert time.time() - unix() == pytest.approx(HOUR_S, abs=1.0), "the clock was set twice"
        set_clock(0.0)
    until = time.monotonic() + 20.0  # the world writes when it has seen the arm at rest
    while (truth := json.loads(played.truth.read_text()))["state"] != "done" and time.monotonic() < until:
        time.sleep(0.1)
    return result, truth


def test_the_job_is_done_though_the_clock_is_set_and_the_truth_file_says_how_well(
    welded: tuple[DemoResult, dict[str, Any]],
) -> None:
    result, truth = welded
    assert result.state == "done", result.run.reason
    assert (truth["state"], truth["collisions"]) == ("done", 0)
    assert truth["torch_mean_mm"] <= 0.10
    assert truth["torch_max_mm"] <= 0.35
    # it begins at the seam's start, and ends where it was said to: the groove goes on there
    assert SEAM_MM - 0.5 <= truth["welded_mm"] <= SEAM_MM + 0.5
    assert truth["arc_on_s"] == pytest.approx(truth["welded_mm"] / SPEED_MM_S, abs=0.25)
    assert np.array(truth["X_BC"])[:3, 3] == pytest.approx([0.65, 0.0, 0.95])
    files = {file.name for file in result.folder.iterdir()}
    assert {"report.html", "weld.csv", "weld.json", "summary.json"} <= files
    assert UNFINISHED not in files
    # what the power source made of the analog outputs while its arc burned: without them there is no arc
    assert truth["set_points"] == pytest.approx({"wire_feed": 8.0, "arc_voltage": 21.5})


def test_the_cell_knows_nothing_of_the_truth(welded: tuple[DemoResult, dict[str, Any]]) -> None:
    result, _ = welded
    station, summary = result.run.cell.station, result.summary()
    assert station.world is None
    assert (station.truth.X_BC, station.truth.workpiece, station.truth.X_BP) == (None, None, None)
    ports = [station.diagram.get_output_port(k).get_name() for k in range(station.diagram.num_output_ports())]
    assert [name for name in ports if name.startswith("cheat")] == []
    assert not any(isinstance(value, SimulatedWorld) for value in vars(station).values())
    assert not {"torch_mean_mm", "X_BC_error_mm", "plan_mean_mm"} & set(summary)
    assert (result.folder / "report.html").exists()
    assert (result.folder / "weld.csv").exists()


def test_the_weld_waits_for_the_arc_on_the_seams_start(welded: tuple[DemoResult, dict[str, Any]]) -> None:
    log = welded[0].weld.log  # type: ignore[union-attr]
    lit = np.flatnonzero(log.torch_on)[0]
    speed = np.linalg.norm(np.diff(log.p_BRobot, axis=0), axis=1) / np.diff(log.time)
    # the tool rests before the torch is asked for, and until the arc is there, 0.12 s later
    assert speed[lit - 80 : lit - 40].mean() > 5e-3
    assert np.median(speed[lit - 6 : lit + 12]) < 1e-3
    assert speed[lit + 60 : lit + 120].mean() > 5e-3


def test_the_record_has_the_arc_that_the_world_had(welded: tuple[DemoResult, dict[str, Any]]) -> None:
    result, truth = welded
    (seam,) = result.record.seams  # type: ignore[union-attr]
    assert seam.arc_s == pytest.approx(truth["arc_on_s"], abs=0.1)
    assert seam.welded_mm == pytest.approx(truth["welded_mm"], abs=0.5)
    (piece,) = result.record.pieces  # type: ignore[union-attr]
    assert (piece.name, piece.run, piece.ended) == ("1", 1, "done")
    assert piece.to_mm - piece.from_mm == pytest.approx(truth["welded_mm"], abs=0.5)
    assert datetime.fromisoformat(piece.start) < datetime.fromisoformat(piece.end), "of the wall's clock"
    document = json.loads((result.folder / "record.json").read_text())
    assert [one["arc_mm"] for one in document["seams"]] == [[[piece.from_mm, piece.to_mm]]]
    assert {file.name for file in result.folder.glob("record.*")} == {"record.html", "record.json", "record.csv"}


def structure(diagram: Diagram, without: set[str]) -> tuple[set[str], set[tuple[str, str, str, str]]]:
    """The names of a cell's systems and its connections by the names of systems and ports."""
    names = {system.get_name() for system in diagram.GetSystems() if not isinstance(system, VectorLogSink)}
    found = set()
    for (system, k), (source, port) in diagram.connection_map().items():
        if isinstance(system, VectorLogSink):  # without a name; what is logged is the truth's or as here
            continue
        wire = (
            source.get_name(),
            source.get_output_port(port).get_name(),
            system.get_name(),
            system.get_input_port(k).get_name(),
        )
        if not {wire[1], wire[3]} & without:
            found.add(wire)
    return names, found


def test_the_wired_cell_is_the_simulated_one_but_for_the_stations_inside(
    welded: tuple[DemoResult, dict[str, Any]],
) -> None:
    simulated = build_cell(load_scenario("straight_groove", WELD_ONLY), 0)
    try:
        names = ("process_on", "arc_established", "set_values")  # wired to a real one only
        torch = {*names, *(f"arm.{name}" for name in names)}
        wired, rendered = (structure(cell.diagram, torch) for cell in (welded[0].run.cell, simulated))
        assert rendered == wired
        assert len(wired[0]) > 10
        assert len(wired[1]) > 40
    finally:
        simulated.station.close()


def held_by(played: Played, folder: Path, stage: str, happens: Callable[[], object], overrides: str) -> str:
    """The reason with which a job is held when something happens at the begin of a phase."""
    seen: list[str] = []

    def watch(phase: str, _: float) -> None:
        if phase == phase_words(stage) and not seen:
            seen.append(phase)
            happens()

    options = RunOptions(scenario="a test's own", out=folder, seed=SEED, recording=False)
    result = run_scenario(played.scenario(overrides), options, watch)
    assert seen, "the phase has come"
    assert result.state == "held"
    return str(result.run.reason)


def test_pictures_that_stop_end_the_job_by_name(
    played: Played, welded: tuple[DemoResult, dict[str, Any]], tmp_path: Path
) -> None:
    finger = played.children[-1]
    source = f"source: http://{played.host}:8081/stream, stamps: host"
    try:
        reason = held_by(
            played,
            tmp_path / "run",
            "start",
            lambda: os.kill(finger, signal.SIGSTOP),
            f"finger_camera: !VideoFingerCamera {{{source}, silent_s: 2.0, frozen_s: 10.0, late_s: 10.0}}",
        )
    finally:
        os.kill(finger, signal.SIGCONT)
    assert "finger camera" in reason
    state = played.ask(ask="state")
    stops_by = state["timestamp"] + 0.3  # by the controller's clock, which a busy computer slows
    while (state["program"] or np.abs(state["qd"]).max() >= 1e-3) and state["timestamp"] < stops_by:
        time.sleep(0.02)
        state = played.ask(ask="state")
    assert np.abs(state["qd"]).max() < 1e-3
    assert (state["digital_outputs"], state["program"]) == (0, None)


def test_a_scanner_that_does_not_answer_ends_the_job_by_name(
    played: Played, welded: tuple[DemoResult, dict[str, Any]], tmp_path: Path
) -> None:
    scanner = played.children[0]
    folder = played.cell.parent / "scans"
    wires = f"folder: {folder}, trigger: 'tcp://{played.host}:5020', preset: phoxi_m, width: 824, height: 616"
    try:
        reason = held_by(
            played,
            tmp_path / "run",
            "park",  # not in the midst of a scan, for which the world would wait
            lambda: os.kill(scanner, signal.SIGSTOP),
            f"scanner: !FolderScanner {{{wires}, scan_timeout_s: 2.0}}",
        )
    finally:
        os.kill(scanner, signal.SIGCONT)
    assert "scanner" in reason
    assert "2 s" in reason
    state = played.ask(ask="state")
    assert (state["digital_outputs"], state["program"]) == (0, None)


def test_a_world_that_ends_takes_its_devices_with_it_and_the_job_is_held(
    played: Played, welded: tuple[DemoResult, dict[str, Any]], tmp_path: Path
) -> None:
    reason = held_by(played, tmp_path / "run", "park", lambda: played.process.send_signal(signal.SIGTERM), "")
    assert "LINK" in reason
    assert played.process.wait(20.0) == 0
    assert all(ends(pid, 10.0) for pid in played.children)
    assert json.loads(played.truth.read_text())["X_BC"]
