"""The simulated world of calibration in motion: exact motion, pixels of their own times, skewed delays, a truth kept
apart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.worlds.motion import MotionOptions, MotionWorld, write_motion_dataset
from weldcal.calibration.data.motion_dataset import load_motion_dataset
from weldcal.calibration.flange.fit import FlangeGuess, fit_flange
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.depth_noise import DepthNoise
from weldcal.models.errors import InputError
from weldcal.models.scanner_streams import ScannerStream, get_stream
from weldcal.models.scanners import depth_to_points, get_scanner

SMALL = MotionOptions(size=(534, 400), noise_mm=0.0, frames=4, surroundings=False)


def found_centre(world: MotionWorld, capture_s: float, X_CR: RigidTransform) -> np.ndarray:
    """The flange's centre (3,) m in the frame captured at that time, searched near X_CR."""
    s = world.scanner
    clean = replace(s, noise=DepthNoise())
    depth = world.scene.frame(world.joints, world.X_BC, capture_s, np.random.default_rng(0), scanner=clean)
    points = depth_to_points(depth, s.fx, s.fy, s.cx, s.cy)
    guess = FlangeGuess(X_CR.translation(), 0.06, X_CR.rotation().matrix()[:, 2])
    return fit_flange(points, world.flange, guess=guess).center_C


def in_camera(world: MotionWorld, t: float) -> RigidTransform:
    """True pose X_CR of the flange at ``t`` s."""
    return world.X_BC.InvertAndCompose(world.pose(t))


@pytest.mark.parametrize("move", ["moveJ", "moveL"])
def test_the_flange_moves_with_trapezoidal_speed_within_its_limits(move: str) -> None:
    world = MotionWorld(replace(SMALL, move=move, speed=0.2, acceleration=0.9))
    dt = 1e-3
    times = np.arange(0.0, world.path.ends_s[-1], dt)
    p = np.array([world.pose(t).translation() for t in times])
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / dt
    assert speed.max() == pytest.approx(0.2, rel=0.02)
    assert np.abs(np.diff(speed)).max() / dt < 0.9 * 1.5  # moveJ bends, so that the flange's own rate is a little above
    corners = [forward_kinematics(world.arm, q).translation() for q in world.path.q]
    reached = [np.linalg.norm(p - c, axis=1).min() for c in corners]
    assert max(reached) < 1e-4
    assert np.linalg.matrix_rank(np.array(corners[1:]) - corners[0], tol=0.05) == 3
    if move == "moveL":
        a, b = corners[:2]
        first = p[times < world.path.ends_s[0]]
        off = np.linalg.norm(np.cross(first - a, (b - a) / np.linalg.norm(b - a)), axis=1)
        assert off.max() < 1e-7


def test_a_frame_shows_the_flange_at_the_middle_of_its_exposure() -> None:
    world = MotionWorld(SMALL)
    along = []
    for t in (0.6, 0.9, 2.2, 2.5, 3.9, 5.3):
        X_CR = in_camera(world, t)
        v = (in_camera(world, t + 0.001).translation() - X_CR.translation()) / 0.001
        assert np.linalg.norm(v) > 0.15
        along.append((found_centre(world, t, X_CR) - X_CR.translation()) @ v / (v @ v))
    assert np.abs(along).max() < 6e-4  # s
    assert abs(np.mean(along)) < 2e-4


def test_rows_of_a_rolling_readout_have_their_own_times() -> None:
    stream = replace(get_stream("motioncam_3d_stream"), readout_s=0.02)
    world = MotionWorld(replace(SMALL, stream=stream))
    t = 2.2
    X_CR = in_camera(world, t)
    p = X_CR.translation()
    row = world.scanner.fy * p[1] / p[2] + world.scanner.cy
    then = t + stream.readout_s * (row / (world.scanner.height - 1) - 0.5)
    assert abs(then - t) > 0.002
    centre = found_centre(world, t, X_CR)
    assert np.linalg.norm(centre - in_camera(world, then).translation()) < 1.5e-4
    assert np.linalg.norm(centre - p) > 4e-4


def test_a_frame_of_a_moving_arm_is_smeared_at_its_edges() -> None:
    world = MotionWorld(replace(SMALL, stream=replace(get_stream("motioncam_3d_stream"), exposure_s=0.03)))
    rng = np.random.default_rng(0)
    sharp = world.scene.frame(world.joints, world.X_BC, 0.6, rng, samples=1)
    smeared = world.scene.frame(world.joints, world.X_BC, 0.6, rng, samples=7)
    both = (sharp > 0.0) & (smeared > 0.0)
    assert np.count_nonzero((np.abs(sharp - smeared) > 0.004) & both) > 50


def test_delays_have_a_floor_a_tail_and_the_stated_mean() -> None:
    stream = ScannerStream()
    rng = np.random.default_rng(2)
    captures = stream.captures(4000, rng)
    late = stream.arrivals(captures, rng) - captures
    assert late.min() >= stream.shortest_delay_s
    assert late.mean() == pytest.approx(0.140, abs=0.001)
    assert late.std() == pytest.approx(0.015, abs=0.001)
    assert np.mean(((late - late.mean()) / late.std()) ** 3) > 1.0  # not Gaussian
    stamps = np.array([stream.device_time(t, rng) for t in captures])
    rate, epoch = np.polyfit(captures, stamps, 1)
    assert rate - 1.0 == pytest.approx(18e-6, abs=2e-7)
    assert epoch == pytest.approx(stream.device_epoch_s, abs=1e-5)
    with pytest.raises(InputError, match="longer than a frame"):
        replace(stream, readout_s=0.045)
    with pytest.raises(InputError, match="does not stream"):
        get_stream("phoxi_m")


def test_the_recording_is_read_back_and_the_truth_lies_outside(tmp_path: Path) -> None:
    preset = get_scanner("motioncam_3d_stream", 267)
    world = MotionWorld(MotionOptions(seed=3, frames=4, size=(preset.width, preset.height), surroundings=False))
    write_motion_dataset(world, tmp_path / "dataset", tmp_path / "truth.json", lambda *_: None)
    read = load_motion_dataset(tmp_path / "dataset")
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert len(world.captures) == len(read.frames) == 4
    assert not read.warnings
    assert not read.refused
    assert not list((tmp_path / "dataset").rglob("*truth*"))
    assert len(json.loads((tmp_path / "truth.json").read_text())["capture_s"]) == 4
    for frame in read.frames:
        assert frame.device is not None
        late = frame.arrival - truth["capture_s"][frame.id]
        assert 0.118 < late < 0.3
        offset = 1e3 * (truth["capture_s"][frame.id] - frame.device)
        assert offset == pytest.approx(truth["device_clock"]["offset_ms_at_middle"], abs=0.2)
    k = len(read.stream.time) // 2
    p = world.pose(read.stream.time[k] - 1000.0).translation()
    assert np.linalg.norm(read.stream.poses[k, :3, 3] - p) < 5e-5
    seen = read.cloud("00000")
    assert seen.shape == (200, 267, 3)
    assert 0.4 < np.nanmedian(seen[..., 2]) < 0.95
