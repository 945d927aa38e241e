"""Measures frames per second sustained and the time from arrival to estimate, beside an arm's control in real time.

Frames are rendered beforehand and replayed at the scanner's rate on the wall clock. The queue, the estimator and its
process are the cell's own; the arm's control is a simulated arm at 500 Hz in the same Diagram.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from tests.figures.harness import Run, figure
from tests.figures.motion.reproduce import after_picture, history_picture
from tests.worlds.motion import MotionOptions, MotionWorld, write_motion_dataset
from weldcal.calibration.data.motion_dataset import MotionDataset, load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.calibration.data.scanner_correction import ARRIVAL, ScannerClock
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.geometry.se3 import as_transform, rotation_vector
from weldcal.calibration.motion.body import BodyTracker, link_motion, model_from_solids
from weldcal.calibration.motion.drift.watch import DriftHistory, watch
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.recorded_overlay import Overlay, overlay
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.arms.urdf import link_index, link_solids
from weldcal.models.arrays import Array
from weldcal.models.scanners import depth_to_points
from weldcal.systems.background import OwnProcess
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, JobCommand, ScanStream, StreamedScan
from weldcal.systems.motion.buffers import FrameQueue, PoseRecorder
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.commands.monitor_body import track_link
from weldcal.tools.console import Progress
from weldcal.tools.dashboard.scan_overlay import overlay_picture

LINK = "wrist_1_link"
Draw = Callable[[MotionDataset, CalibrationResult, DriftHistory], None]
_SIGMA = 1e-5  # rad and m: the calibration of the study is the truth, so that what is left is tracking


_SHOWN = 4  # newest frames on the port


class FrameReplay(LeafSystem):
    """Outputs clouds in turn, again and again.

    .. pydrake_system::

        name: FrameReplay
        output_ports:
        - stream
        - joints
        - time

    A frame arrives ``delay_s`` after its capture. ``joints`` gives the arm's (6,) rad at a time (s) from the first
    cloud on.
    """

    def __init__(
        self, clouds: Sequence[NDArray[np.float32]], joints: Callable[[float], Array], rate_hz: float, delay_s: float
    ) -> None:
        super().__init__()
        self._clouds, self._motion, self._rate_hz, self._delay_s = clouds, joints, rate_hz, delay_s
        self.DeclareAbstractOutputPort("stream", lambda: AbstractValue.Make(ScanStream()), self._stream)
        self.DeclareVectorOutputPort("joints", 6, self._joints)
        self.DeclareVectorOutputPort("time", 1, self._time)

    def _stream(self, context: Context, output: Any) -> None:
        newest = int((context.get_time() - self._delay_s) * self._rate_hz + 1e-9)
        frames = []
        for n in range(max(1, newest - _SHOWN + 1), newest + 1):
            capture, points = n / self._rate_hz, self._clouds[n % len(self._clouds)]
            frames.append(StreamedScan(n, points_C=points, arrival_time=capture + self._delay_s, device_time=capture))
        output.set_value(ScanStream(tuple(frames)))

    def _joints(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._motion(float(np.mod(context.get_time(), len(self._clouds) / self._rate_hz))))

    def _time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_time())


def track_body(options: MotionOptions, link: str, tell: Progress, draw: Draw | None = None) -> dict[str, DriftHistory]:
    """Render a recording, track flange and link (by its mesh, and by a model fused from the scans).

    The true calibration is used. ``draw`` is called with the recording, the calibration and the link's tracking by its
    mesh, while the recording's folder exists.

    Raises:
        InputError: the arm has no such link; before anything is rendered.
    """
    link_index(load_arm(options.robot), link)
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
        write_motion_dataset(world, data_folder, Path(folder) / "truth.json", tell)
        data, standard = load_motion_dataset(data_folder), world.flange
        motion = ContinuousMotion(data.stream)
        seen = see_frames(data, standard, motion, X_BC=result.X_BC, tell=lambda share: tell("flange", share))
        found["flange"] = watch(result, seen.observed, motion, X_FR=data.X_FR, dropped=seen.refused)
        for name in ("mesh", "fused"):
            frames, body_motion, X_LR, refused = track_link(
                data, result, standard, link, fused=name == "fused", seed=options.seed, tell=lambda f: tell(link, f)
            )
            found[name] = watch(result, frames, body_motion, X_FR=X_LR, dropped=refused)
        if draw is not None:
            draw(data, result, found["mesh"])
    return found


def link_errors(
    data: MotionDataset, result: CalibrationResult, tracked: DriftHistory, link: str
) -> tuple[Array, Array, Array]:
    """Times (N,) s of frames, and the error (N, 6) deg and mm of a link by ICP of its mesh, in the link's axes.

    With the robot's pose at the frame's arrival, and at its capture.
    """
    arm = load_arm(result.robot)
    index = link_index(arm, link)
    model, motion = model_from_solids(link_solids(arm, index)), link_motion(data.stream, arm, index)
    tracker = BodyTracker(model)
    frames = {frame.id: frame for frame in data.frames}
    rows = []
    for id, capture in zip(tracked.ids, tracked.clock.times + tracked.offsets, strict=True):
        poses = [as_transform(X) for X in motion.poses(np.array([frames[id].arrival, capture]))]
        seen = tracker.track(data.cloud(id), result.X_BC.inverse() @ poses[1])
        if seen is not None:
            X_BL = result.X_BC @ seen.X_CL
            off = [X.inverse() @ X_BL for X in poses]
            # of the middle of the body, which ICP shows best
            moved = [1e3 * (X @ model.middle - model.middle) for X in off]
            turned = [np.degrees(rotation_vector(X.rotation())) for X in off]
            rows.append(np.concatenate([[capture], turned[0], moved[0], turned[1], moved[1]]))
    found = np.array(rows)
    return found[:, 0] - found[0, 0], found[:, 1:7], found[:, 7:]


def scan_over_robot(data: MotionDataset, result: CalibrationResult, tracked: DriftHistory) -> Overlay:
    """Compare the scan in the middle with the robot's shape (Fig. 8), at the capture that the tracking has found."""
    k = len(tracked.ids) // 2
    frame = next(frame for frame in data.frames if frame.id == tracked.ids[k])
    late = frame.arrival - float(tracked.clock.times[k] + tracked.offsets[k])
    clock = ScannerClock(kind=ARRIVAL, offset_s=late, sigma_s=None, jitter_s=None, reference_s=frame.arrival)
    with tempfile.TemporaryDirectory() as folder:
        save_result(replace(result, clock=clock), Path(folder))
        return overlay(Path(folder), data.folder, frame.id)


def body_row(w: DriftHistory) -> dict[str, float]:
    """Count the frames, and measure rms, mean and spread (mm) of the tracking error."""
    e = w.residuals[~w.gross]
    mean, spread = np.linalg.norm(e.mean(axis=0)), np.sqrt(e.var(axis=0).sum())
    mm = {"rms_mm": 1e3 * w.rms_m, "mean_mm": 1e3 * float(mean), "spread_mm": 1e3 * float(spread)}
    return {"frames": len(w.ids), "dropped": len(w.dropped), **mm}


@figure("whole-body", "tracking by the flange and by a wrist link, by its mesh and by a model fused from the scans")
def whole_body(run: Run) -> None:
    """Compare the tracking errors; pictures of them and of a scan over the robot (Fig. 7 and 8 of the paper on motion)."""
    frames, width = run.size((12, 400), (200, 1068))
    options = MotionOptions(frames=frames, size=(width, round(0.749 * width)), seed=run.seed, surroundings=False)

    def draw(data: MotionDataset, result: CalibrationResult, tracked: DriftHistory) -> None:
        errors = link_errors(data, result, tracked, LINK)
        run.write("wrist.svg", history_picture(*errors, ("poses at arrival", "poses at the capture found")))
        run.write("wrist_after.svg", after_picture(errors[0], errors[2]))
        run.write("overlay.png", overlay_picture(scan_over_robot(data, result, tracked)))

    rows = {name: body_row(w) for name, w in track_body(options, LINK, run.progress, draw).items()}
    lines = ((name, *(f"{v:.3g}" for v in row.values())) for name, row in rows.items())
    run.table(LINK, ("tracked", "frames", "dropped", "rms mm", "mean mm", "spread mm"), lines)


_POLL_S = 0.004
_STEP_S = 0.004
_FPS = 20.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Throughput:
    """Frames offered, estimated, without a fit and dropped in ``seconds``, and times in ms.

    Times from arrival to estimate, and how late the arm's 500 Hz loop ran.
    """

    pixels: int
    seconds: float
    offered: int
    estimated: int
    refused: int
    dropped: int
    wait_ms: tuple[float, ...]
    behind_ms: tuple[float, ...]


@figure("motion-speed", "half-megapixel frames at 20 per second beside an arm's control: estimates, and their delay")
def speed(run: Run) -> None:
    """Replay rendered frames in real time."""
    found = run_throughput(run.size(2.0, 30.0), run.seed, run.progress, rendered=run.size(8, 40))
    p = np.percentile(found.wait_ms, [50, 95, 100])
    rows = (
        ("pixels", str(found.pixels)),
        ("estimates per second", f"{found.estimated / found.seconds:.2f}"),
        (
            "offered, estimated, refused, dropped",
            f"{found.offered}, {found.estimated}, {found.refused}, {found.dropped}",
        ),
        ("arrival to estimate, ms: median, 95 %, worst", ", ".join(f"{v:.1f}" for v in p)),
        ("500 Hz loop behind, ms: median, worst", f"{np.median(found.behind_ms):.2f}, {max(found.behind_ms):.2f}"),
    )
    run.table("", ("streamed scans", ""), rows)


def run_throughput(seconds: float, seed: int, progress: Progress, *, rendered: int = 40) -> Throughput:
    """Render, and replay for ``seconds`` in real time."""
    world = MotionWorld(MotionOptions(scanner="motioncam_3d_stream_half", frames=1, surroundings=True, seed=seed))
    s = world.scanner
    clouds = []
    for k in range(rendered):
        progress("rendering frames", 0.6 * k / rendered)
        depth = world.scene.frame(world.joints, world.X_BC, k / _FPS, np.random.default_rng([seed, k]))
        clouds.append(depth_to_points(depth, s.fx, s.fy, s.cx, s.cy).astype(np.float32))
    scenario = load_scenario("eye_on_base")
    station = make_station(scenario, seed)
    background = OwnProcess()
    with closing(station), closing(background):
        return _replayed(world, clouds, station, background, seconds, progress)


def _replayed(
    world: MotionWorld,
    clouds: list[np.ndarray],
    station: Any,
    background: OwnProcess,
    seconds: float,
    progress: Progress,
) -> Throughput:
    builder = DiagramBuilder()
    builder.AddSystem(station.diagram)
    for name, values in (("arm.velocity_command", np.zeros(6)), ("scanner.trigger", np.zeros(1))):
        still = builder.AddSystem(ConstantVectorSource(values))
        builder.Connect(still.get_output_port(), station.diagram.GetInputPort(name))
    delay_s = 0.14
    replay = builder.AddSystem(FrameReplay(clouds, world.joints, _FPS, delay_s))
    recorder, queue = builder.AddSystem(PoseRecorder()), builder.AddSystem(FrameQueue(2, _POLL_S))
    estimator = builder.AddSystem(
        FlangeEstimator(
            arm=world.arm,
            X_FR=RigidTransform(),
            standard=world.flange,
            X_BC_guess=world.X_BC_nominal,
            guess_radius_m=0.06,
            background=background,
            period_s=_POLL_S,
            delay_s=delay_s,
        )
    )
    job = builder.AddSystem(ConstantValueSource(AbstractValue.Make(JobCommand())))
    status = builder.AddSystem(ConstantValueSource(AbstractValue.Make(CalibrationStatus())))
    estimate = estimator.GetOutputPort("flange_estimate")
    for source, system, port in (
        (replay.GetOutputPort("joints"), recorder, "position_measured"),
        (replay.GetOutputPort("time"), recorder, "sample_time"),
        (replay.GetOutputPort("stream"), queue, "stream"),
        (estimate, queue, "flange_estimate"),
        (queue.GetOutputPort("scan"), estimator, "scan"),
        (job.get_output_port(), estimator, "job"),
        (status.get_output_port(), estimator, "calibration_status"),
        (recorder.GetOutputPort("history"), estimator, "history"),
    ):
        builder.Connect(source, system.GetInputPort(port))
    simulator = Simulator(builder.Build())
    background.prepare(warm_up)
    background.settle()
    root = simulator.get_context()
    waits, behind, refused, newest = [], [], 0, 0
    simulator.AdvanceTo(0.1)
    start = time.monotonic() - 0.1
    for step in range(1, int(seconds / _STEP_S) + 1):
        now = 0.1 + step * _STEP_S
        ahead = start + now - time.monotonic()
        if ahead > 0.0:
            time.sleep(ahead)
        behind.append(1e3 * max(-ahead, 0.0))
        simulator.AdvanceTo(now)
        found: FlangeEstimate = estimate.Eval(estimator.GetMyContextFromRoot(root))
        if found.sequence > newest:
            newest = found.sequence
            waits.append(1e3 * (time.monotonic() - start - found.arrival_time))
            refused += found.fit is None
        if step % 250 == 0:
            progress("replaying", 0.6 + 0.4 * now / seconds)
    dropped = int(queue.GetOutputPort("counts").Eval(queue.GetMyContextFromRoot(root))[1])
    spent = time.monotonic() - start
    offered = int((0.1 + seconds - delay_s) * _FPS)
    pixels = world.scanner.width * world.scanner.height
    return Throughput(
        pixels=pixels,
        seconds=spent,
        offered=offered,
        estimated=len(waits),
        refused=refused,
        dropped=dropped,
        wait_ms=tuple(waits),
        behind_ms=tuple(behind),
    )
