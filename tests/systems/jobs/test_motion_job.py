"""The motion job: a streaming scanner in the station, its late frames, and X_BC and the clock from a cell in motion."""

from __future__ import annotations

import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource

from tests.systems.cells import Q_HOME, the_arm
from weldcal.calibration.data.motion_dataset import load_motion_dataset
from weldcal.calibration.data.results import load_result
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import NoDevice
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.simulated.streaming_scanner import StreamingScanner
from weldcal.systems.jobs.motion.job import AddedMotion, MotionJob, plan_corners
from weldcal.systems.jobs.motion.procedure import MotionRecorder, posed_stream
from weldcal.systems.jobs.weld.flange_estimator import believed_capture
from weldcal.systems.messages import FlangeEstimate, ScanStream, StreamedScan
from weldcal.systems.runner import Run, no_progress
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import make_station
from weldcal.tools.commands.motion_live import MotionOutcome, follower_delay, run_motion_live
from weldcal.tools.report.run import RunOptions


def scenario(frames: int = 45) -> Scenario:
    found = load_scenario("motion")
    assert isinstance(found.scanner, StreamingScanner)
    found.scanner.width, found.scanner.height, found.scanner.exposure_samples = 480, 360, 1
    job = found.part(MotionJob)
    assert job is not None
    job.frames = frames
    return found


@cache
def an_outcome() -> MotionOutcome:
    """A run by its command, which writes the results too."""
    folder = Path(tempfile.mkdtemp())
    return run_motion_live(scenario(), RunOptions(scenario="motion", out=folder, seed=3, recording=False), no_progress)


def a_run() -> Run[AddedMotion]:
    return an_outcome().run


def test_the_command_writes_the_result_with_its_clock() -> None:
    outcome = an_outcome()
    said, folder = outcome.summary(), outcome.folder
    truth = said["truth"]
    assert isinstance(truth, dict)
    assert (said["state"], said["dropped"], said["clock"]) == ("done", 0, "device")
    assert abs(truth["clock_offset_error_ms"]) < 2.0
    assert truth["error_mm"] < 0.6
    assert json.loads((folder / "run.json").read_text())["n_seen"] == said["n_seen"]
    written = load_result(folder)
    assert outcome.report is not None
    assert written.X_BC.IsNearlyEqualTo(outcome.report.estimate.X_BC, 1e-6)
    assert written.clock is not None
    assert written.clock.offset_s == pytest.approx(outcome.report.estimate.clock.offset_s, abs=1e-6)
    shutil.rmtree(folder)


def test_the_job_finds_the_scanner_and_its_clock() -> None:
    run = a_run()
    assert run.reason is None
    record, found = run.cell.job.record(run.root), run.cell.job.calibration(run.root).estimate
    assert found is not None
    X_BC, p_B = run.cell.station.truth.X_BC, np.array([0.65, 0.0, 0.30])
    assert X_BC is not None
    off = found.X_BC @ (X_BC.inverse() @ p_B) - p_B
    assert np.linalg.norm(off) < 6e-4  # a few dozen frames of a third of the pixels; the full run: docs/motion.md
    log = run.cell.logs["scanner_capture"].FindLog(run.root)
    captures = {int(n): float(t) for n, t in zip(*log.data(), strict=True)}
    offsets = [captures[int(f.id)] - f.device for f, _ in record.seen if f.device is not None]
    assert found.clock.kind == "device"
    assert found.clock.offset_s == pytest.approx(np.mean(offsets), abs=2e-3)
    delays = [f.arrival - captures[int(f.id)] for f, _ in record.seen]
    assert min(delays) > 0.118
    assert np.mean(delays) == pytest.approx(0.14, abs=0.01)


def test_the_drawn_arm_is_where_the_stream_says_and_a_late_one_is_noticed() -> None:
    run = a_run()
    record, log = run.cell.job.record(run.root), run.cell.logs["joints"].FindLog(run.root)
    t, q = log.sample_times() - 0.002, log.data()[:6].T  # at a tick the plant's last step shows
    here = follower_delay(t, q, record)
    assert abs(here) < 3e-4
    assert follower_delay(t + 0.005, q, record) - here == pytest.approx(0.005, abs=2e-4)


def test_no_frame_is_dropped_in_simulation() -> None:
    run = a_run()
    record = run.cell.job.record(run.root)
    taken, dropped = run.cell.job.counts(run.root)
    assert dropped == 0
    assert taken >= len(record.waits_s) >= len(record.seen) >= 45


def streamed() -> tuple[dict[int, float], dict[int, float], dict[int, StreamedScan]]:
    """When each frame was on the port, when it was captured, and the frame, of a quarter of a second of a turning
    arm."""
    found = scenario()
    found.scanner = StreamingScanner(width=480, height=360, exposure_samples=3, jitter_ms=0.0, delay_ms=100.0)
    station = make_station(found, 0)
    builder = DiagramBuilder()
    diagram = builder.AddSystem(station.diagram)
    simulator = Simulator(builder.Build())
    context = diagram.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    diagram.GetInputPort("scanner.streaming").FixValue(context, [1.0])
    diagram.GetInputPort("arm.velocity_command").FixValue(context, np.full(6, 0.3))
    seen: dict[int, float] = {}
    captures: dict[int, float] = {}
    frames: dict[int, StreamedScan] = {}
    for step in range(1, 126):
        simulator.AdvanceTo(0.002 * step)
        stream: ScanStream = diagram.GetOutputPort("scanner.stream").Eval(context)
        number, capture = diagram.GetOutputPort("cheat.scanner_capture").Eval(context)
        captures.setdefault(int(number), float(capture))
        for frame in stream.frames:
            seen.setdefault(frame.sequence, 0.002 * step)
            frames[frame.sequence] = frame
    station.close()
    return seen, captures, frames


def test_a_frame_is_on_the_port_after_its_delay_and_the_same_in_every_run() -> None:
    seen, captures, frames = streamed()
    assert not any(np.isfinite(frame.capture_time) for frame in frames.values())  # nobody is told
    assert sorted(seen) == [1, 2, 3]
    for number, at in seen.items():
        assert at - captures[number] == pytest.approx(0.1, abs=0.0021)
    assert captures[2] - captures[1] == pytest.approx(0.05)
    again = streamed()[2]
    assert all(np.array_equal(frames[n].points_C, again[n].points_C, equal_nan=True) for n in frames)
    assert all(frames[n].device_time == again[n].device_time for n in frames)


def test_capture_is_believed_by_the_device_once_a_frame_is_known() -> None:
    first = StreamedScan(1, arrival_time=10.15, device_time=500.0)
    assert believed_capture(first, FlangeEstimate(), 0.14) == pytest.approx(10.01)
    before = FlangeEstimate(sequence=1, capture_time=10.01, device_time=500.0)
    late = StreamedScan(2, arrival_time=10.25, device_time=500.05)
    assert believed_capture(late, before, 0.14) == pytest.approx(10.06)
    early = StreamedScan(2, arrival_time=10.18, device_time=500.05)  # less late than thought: the clock is corrected
    assert believed_capture(early, before, 0.14) == pytest.approx(10.04)
    jumped = StreamedScan(2, arrival_time=10.20, device_time=900.0)
    assert believed_capture(jumped, before, 0.14) == pytest.approx(10.06)
    bare = StreamedScan(2, arrival_time=10.20)
    assert believed_capture(bare, before, 0.14) == pytest.approx(10.06)


def test_corners_span_a_cube_and_unreachable_ones_are_refused() -> None:
    found = scenario()
    station = make_station(found, 0)
    job = found.part(MotionJob)
    assert job is not None
    corners = plan_corners(found, station, job, Q_HOME, np.random.default_rng(0))
    p = np.array([forward_kinematics(the_arm(), q).translation() for q in corners])
    assert np.ptp(p, axis=0) == pytest.approx([0.2, 0.2, 0.2], abs=1e-6)
    job.centre_m = [1.4, 0.0, 0.3]
    with pytest.raises(InputError, match=r"move motion\.centre_m"):
        plan_corners(found, station, job, Q_HOME, np.random.default_rng(0))
    station.close()


def test_the_wrong_scanner_is_refused_by_name() -> None:
    found = scenario()
    found.scanner = RenderedScanner()
    with pytest.raises(InputError, match="needs a scanner that streams"):
        check_scenario(found)
    other = load_scenario("eye_on_base")
    other.scanner = StreamingScanner()
    with pytest.raises(InputError, match="belongs to a motion job"):
        check_scenario(other)
    assert isinstance(other.finger_camera, NoDevice)


def test_what_streams_is_recorded(tmp_path: Path) -> None:
    run, builder = a_run(), DiagramBuilder()
    points = np.full((12, 16, 3), [0.0, 0.0, 0.6], dtype=np.float32)
    points[..., 0] += np.arange(16, dtype=np.float32) * 0.001
    start = run.cell.job.record(run.root).seen[0][0].arrival
    stream = ScanStream((StreamedScan(4, points_C=points, arrival_time=start, device_time=7.0),))
    recorder = builder.AddSystem(MotionRecorder(tmp_path / "recording"))
    source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(stream)))
    builder.Connect(source.get_output_port(), recorder.GetInputPort("stream"))
    Simulator(builder.Build()).AdvanceTo(0.1)
    joints = posed_stream(run.cell.job.record(run.root), the_arm())
    assert recorder.finish(joints, run.cell.job.header) == 1
    read = load_motion_dataset(tmp_path / "recording")
    assert [(f.id, f.device) for f in read.frames] == [("00004", 7.0)]
    assert np.allclose(read.cloud("00004"), points, atol=1e-6)
    assert np.allclose(read.stream.poses, joints.poses, atol=1e-9)
