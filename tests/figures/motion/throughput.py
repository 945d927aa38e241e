"""Measures frames per second sustained and the time from arrival to estimate, beside an arm's control in real time.

Frames are rendered beforehand and replayed at the scanner's rate on the wall clock. The queue, the estimator and its
process are the cell's own; the arm's control is a simulated arm at 500 Hz in the same Diagram.
"""

import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource
from scipy.stats import binom, chi2

from tests.figures.harness import Cases, Figures, Results, Row, Study, Target, all_met, print_targets, whole
from tests.figures.motion.drift import benchmark_drift
from tests.figures.subject import one_of
from tests.worlds.motion import MotionOptions, MotionWorld, write_motion_dataset
from tests.worlds.moves import DELAY_S, cube_moves, observed_frames
from tests.worlds.streams import recorded_stream
from weldcal.calibration.data.motion_dataset import load_motion_dataset
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.geometry.se3 import difference
from weldcal.calibration.motion.drift.watch import DriftHistory, watch
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.arms.urdf import link_index
from weldcal.models.scanners import depth_to_points
from weldcal.systems.background import OwnProcess
from weldcal.systems.drivers.simulated.streaming_scanner import FrameReplay
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, JobCommand
from weldcal.systems.motion.buffers import FrameQueue, PoseRecorder
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.monitor_body import track_link
from weldcal.tools.console import Progress
from weldcal.tools.report.render import write_json

LEVEL, SIGMAS = 0.95, 1.959964
WORK_M = 0.75  # from the scanner to the middle of the cube
CLOCKS = ("arrival", "device")
_DRIFT, _EPOCH_S = 2e-5, 1.0e6  # of a device's clock

Estimator = Callable[..., MotionEstimate]


def one_run(
    clock: str, index: int, duration_s: float, seed: int, estimate: Estimator = estimate_in_motion
) -> Mapping[str, object]:
    """Calibrate one recording of a moveJ (even ``index``) or moveL, with device times or arrivals of 140 +- 15 ms.

    Returns:
        errors (7,) of X_BC's six and the clock's offset (rad, m, s), the same in sigmas, the NEES of X_BC over its six,
        the error of the offset against the mean delay of the recording's own frames (ms), the error of a point in the
        middle of the work (mm), the turn (deg).
    """
    device, linear = clock == "device", index % 2 == 1
    rng = np.random.default_rng([seed, index, int(device)])
    moves, X_BC = cube_moves(rng, linear=linear)
    stream = recorded_stream(moves, duration_s + 1.0, rng, joints=not linear)
    frames, capture = observed_frames(
        moves, X_BC, duration_s + 1.0, rng, device=device, drift=_DRIFT * device, epoch_s=-_EPOCH_S * device
    )
    found = estimate(frames, ContinuousMotion(stream), held_out=False)
    stated = found.clock
    assert stated.offset_s is not None
    assert stated.sigma_s is not None
    if device:
        assert frames.device is not None
        true = own = float(np.interp(stated.reference_s, frames.device, capture - frames.device))
    else:
        true, own = DELAY_S, float(np.mean(frames.arrival - capture))
    # from the estimate to the truth, as the covariance is defined
    error = -difference(found.X_BC.GetAsMatrix4(), X_BC.GetAsMatrix4())
    errors = np.concatenate([error, [stated.offset_s - true]])
    p = np.array([0.0, 0.0, WORK_M])
    return {
        "clock": clock,
        "errors": errors,
        "scaled": errors / np.append(np.sqrt(np.diag(found.covariance)), stated.sigma_s),
        "nees": float(error @ np.linalg.solve(found.covariance, error)) / 6.0,
        "own_ms": 1e3 * (stated.offset_s - own),
        "work_mm": 1e3 * float(np.linalg.norm(np.asarray(found.X_BC @ p) - np.asarray(X_BC @ p))),
        "turn_deg": float(np.degrees(np.linalg.norm(error[:3]))),
        "duration_s": duration_s,
    }


def cases(runs: int, duration_s: float, seed: int) -> Cases:
    """``runs`` recordings with each clock."""
    return {
        f"{clock} {k}": {"clock": clock, "index": k, "duration_s": duration_s, "seed": seed}
        for clock in CLOCKS
        for k in range(runs)
    }


def _figures(results: Results) -> Figures:
    return {clock: _summary([r for r in whole(results).values() if r["clock"] == clock]) for clock in CLOCKS}


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the runs with one clock."""
    of = {
        key: np.array([r[key] for r in runs]) for key in ("errors", "scaled", "nees", "own_ms", "work_mm", "turn_deg")
    }
    offset = 1e3 * of["errors"][:, 6]
    low, high = (binom.ppf(q, len(offset), LEVEL) / len(offset) for q in (0.005, 0.995))
    return {
        "runs": len(offset),
        "duration_s": runs[0]["duration_s"],
        "offset_coverage": float((np.abs(of["scaled"][:, 6]) < SIGMAS).mean()),
        "offset_coverage_chance": [float(low), float(high)],
        "offset_rms_ms": float(np.sqrt(np.mean(offset**2))),
        "offset_worst_ms": float(np.abs(offset).max()),
        "offset_own_mean_rms_ms": float(np.sqrt(np.mean(of["own_ms"] ** 2))),
        "offset_own_mean_worst_ms": float(np.abs(of["own_ms"]).max()),
        "nees": float(of["nees"].mean()),
        "nees_per_unknown": [float(v) for v in (of["scaled"] ** 2).mean(axis=0)],
        "nees_per_unknown_chance": [float(chi2.ppf(q, len(offset)) / len(offset)) for q in (0.005, 0.995)],
        "work_p95_mm": float(np.percentile(of["work_mm"], 95)),
        "work_worst_mm": float(of["work_mm"].max()),
        "turn_worst_deg": float(of["turn_deg"].max()),
    }


def _rows(figures: Figures) -> Iterable[Row]:
    for key in figures[CLOCKS[0]]:
        yield key, *(_cell(figures[clock][key]) for clock in CLOCKS)


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(f"{v:.3g}" for v in value)
    return "" if value is None else f"{value:.4g}"


STUDY = Study(
    name="motion-clock",
    what=(
        "Calibrations in motion with known truth: coverage of the clock's offset, error and NEES of the scanner's pose."
    ),
    case=one_run,
    figures=_figures,
    header=("figure", *CLOCKS),
    rows=_rows,
)


@command(
    "benchmark motion-clock",
    short_help="Measure how well the clock's offset is found in motion.",
    options=FARM,
    hidden=True,
)
def benchmark_clock(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of calibrations with each clock.", min=2)] = 300,
    seconds: Annotated[float, option("--seconds", "S", "Length of each recording.", min=5.0)] = 20.0,
) -> Outcome:
    """Repeat calibrations in motion with known truth: coverage of the clock's offset, error and NEES of the scanner's
    pose."""
    return STUDY.outcome(call, cases(runs, seconds, call.seed))


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
    }


_POLL_S = 0.004
_STEP_S = 0.004
_FPS, _MEDIAN_MS = 20.0, 50.0


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

    @property
    def fps(self) -> float:
        """Estimates per second."""
        return self.estimated / self.seconds

    @property
    def targets(self) -> tuple[Target, ...]:
        """The issue's figures; wall-clock times do not decide an exit code."""
        share = 100.0 * self.estimated / max(self.offered, 1)
        return (
            Target("frames with an estimate, of those at 20 per second", "%", share, 99.0, "≥", decides=False),
            Target("arrival to estimate, median", "ms", float(np.median(self.wait_ms)), _MEDIAN_MS, decides=False),
        )

    def summary(self) -> dict[str, object]:
        """Return the JSON object."""
        p = np.percentile(self.wait_ms, [50, 95, 100])
        return {
            "state": "done",
            "pixels": self.pixels,
            "seconds": self.seconds,
            "frames_per_second": self.fps,
            "offered": self.offered,
            "estimated": self.estimated,
            "refused": self.refused,
            "dropped": self.dropped,
            "arrival_to_estimate_ms": {"median": float(p[0]), "p95": float(p[1]), "worst": float(p[2])},
            "loop_behind_ms": {"median": float(np.median(self.behind_ms)), "worst": float(max(self.behind_ms))},
            "targets": [{"what": t.what, "reached": t.value, "wanted": t.wanted, "met": t.met} for t in self.targets],
        }


@command("benchmark motion-speed", short_help="Measure frames per second beside an arm's control.", hidden=True)
def benchmark_speed(
    call: Call, seconds: Annotated[float, option("--seconds", "S", "Length of the stream.", min=2.0)] = 30.0
) -> Outcome:
    """Fit half-megapixel frames at 20 per second beside an arm's control: frames per second, and arrival to
    estimate."""
    found = run_throughput(call.folder("benchmark", "motion"), seconds, call.seed, call.progress)
    return Outcome(found.summary(), text=partial(print_targets, "streamed scans", found.targets))


def run_throughput(folder: Path, seconds: float, seed: int, progress: Progress, *, rendered: int = 40) -> Throughput:
    """Render, replay for ``seconds`` in real time, and write benchmark.json."""
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
        result = _replayed(world, clouds, station, background, seconds, progress)
    write_json(folder / "benchmark.json", result.summary())
    return result


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


@command("benchmark motion", short_help="Measure calibration in motion: speed, clock, drift.", options=FARM)
@one_of("speed", speed=benchmark_speed, clock=benchmark_clock, drift=benchmark_drift, whole_body=benchmark_whole_body)
def benchmark_motion(call: Call) -> None:
    """Measure calibration in motion: the speed of fits beside an arm's control, the stated clock and pose, the drift
    test, or tracking by a link."""
