"""X_BC and the scanner's clock from frames in motion: right, honest, and silent about what the motion does not show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.worlds.moves import cube_moves, observed_frames
from tests.worlds.streams import Moves, recorded_stream
from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.errors import UndeterminedPoses
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.observed import ObservedFrames, choose_clock
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

SECONDS = 13.0
WORK = np.array([0.0, 0.0, 0.75])


@cache
def world() -> tuple[Moves, RigidTransform, RobotStream, ContinuousMotion]:
    moves, X_BC = cube_moves(np.random.default_rng(5))
    stream = recorded_stream(moves, SECONDS, np.random.default_rng(6))
    return moves, X_BC, stream, ContinuousMotion(stream)


def frames(**options: float | bool) -> tuple[ObservedFrames, Array]:
    moves, X_BC, _, _ = world()
    return observed_frames(moves, X_BC, SECONDS, np.random.default_rng(7), **{"device": False} | options)  # type: ignore[arg-type]


def at_work_mm(found: MotionEstimate) -> float:
    return 1e3 * float(np.linalg.norm(np.asarray(found.X_BC @ WORK) - np.asarray(world()[1] @ WORK)))


def check_offset(found: MotionEstimate, true_s: float, sigmas: float = 3.5) -> None:
    assert found.clock.offset_s is not None
    assert found.clock.sigma_s is not None
    assert abs(found.clock.offset_s - true_s) < sigmas * found.clock.sigma_s


def test_arrivals_with_jitter() -> None:
    f, _ = frames()
    found = estimate_in_motion(f, world()[3])
    check_offset(found, 0.140)
    assert found.clock.kind == "arrival"
    assert found.clock.sigma_s == pytest.approx(0.015 / np.sqrt(len(f)), rel=0.25)
    assert found.clock.jitter_s == pytest.approx(0.015, rel=0.25)
    assert at_work_mm(found) < 0.05
    assert 1e3 * np.nanmedian(found.held_out_m) < 0.08
    rms = [np.sqrt(np.nanmean(x**2)) for x in (found.before_m, found.along_m)]
    assert rms[0] > 0.015
    assert rms[1] < 0.005


def test_device_clock_of_another_epoch_with_drift() -> None:
    f, capture = frames(device=True, epoch_s=-1.7e9, drift=5e-5)
    found = estimate_in_motion(f, world()[3], held_out=False)
    clock = found.clock
    assert clock.kind == "device"
    assert f.device is not None
    check_offset(
        found, float(np.interp(clock.reference_s, f.device, capture - f.device)), 5.0
    )  # 0.24 microseconds of a double
    assert clock.sigma_s is not None
    assert clock.sigma_s < 5e-5
    assert clock.drift == pytest.approx(5e-5, abs=1e-5)
    said = clock.capture(0.0, float(f.device[100]))
    assert said == pytest.approx(capture[100], abs=2e-4)
    assert at_work_mm(found) < 0.03


def test_rolling_time_within_a_frame() -> None:
    f, _ = frames(device=True, rolling_s=0.02)
    found = estimate_in_motion(f, world()[3], held_out=False)
    assert found.clock.rolling_s == pytest.approx(0.02, abs=1e-3)
    assert at_work_mm(found) < 0.03
    plain, _ = frames(device=True)
    assert estimate_in_motion(plain, world()[3], held_out=False).clock.rolling_s is None


def test_wrong_fits_and_late_frames() -> None:
    f, _ = frames()
    rng = np.random.default_rng(8)
    p, arrival = f.p_C.copy(), f.arrival.copy()
    bad = rng.random(len(f)) < 0.2
    p[bad] += rng.normal(0.0, 0.02, (int(bad.sum()), 3))
    arrival[10::60] += 0.4
    found = estimate_in_motion(replace(f, p_C=p, arrival=arrival), world()[3], held_out=False)
    check_offset(found, 0.140)
    assert at_work_mm(found) < 0.06
    assert not (found.inliers & bad & (np.linalg.norm(p - f.p_C, axis=1) > 0.01)).any()
    assert 0 < len(found.clock.late) <= len(arrival[10::60])


def test_frames_outside_the_stream_are_left_out() -> None:
    f, _ = frames()
    stream = world()[2]
    keep = (stream.time > 3.0) & (stream.time < 10.0)
    found = estimate_in_motion(f, ContinuousMotion(RobotStream(stream.time[keep], stream.poses[keep])), held_out=False)
    check_offset(found, 0.140)
    assert 100 < found.inliers.sum() < 145
    assert "outside the robot's stream" in found.warnings[0]


def test_errors_that_depend_on_the_place_are_stated() -> None:
    f, _ = frames(device=True)
    wave = 1e-4 * np.sin(
        f.p_C @ np.array([[30.0, 0.0, 28.0], [0.0, 25.0, 0.0], [0.0, 0.0, 20.0]]) + np.array([1.0, 2.0, 0.0])
    )
    plain = estimate_in_motion(f, world()[3], held_out=False)
    found = estimate_in_motion(replace(f, p_C=f.p_C + wave), world()[3], held_out=False)
    assert not plain.places.found
    assert found.places.found
    assert 3e-5 < found.places.sigma_m < 1.2e-4
    grown = np.sqrt(np.diag(found.covariance)[3:] / np.diag(plain.covariance)[3:])
    assert (grown > 2.0).all()
    assert at_work_mm(found) < 0.15


def test_edges_found_below_a_rough_face_are_estimated() -> None:
    f, _ = frames(device=True)
    view = f.p_C / np.linalg.norm(f.p_C, axis=1)[:, None]
    along = (view * f.n_C).sum(axis=1)[:, None]
    slide = 5e-4 * (view - along * f.n_C) / np.abs(along)
    low = replace(f, p_C=f.p_C - 2.5 * slide)
    plain = estimate_in_motion(low, world()[3], held_out=False)
    found = estimate_in_motion(replace(low, slide=slide), world()[3], held_out=False)
    assert found.fit.edge == pytest.approx(2.5, abs=0.2)
    assert at_work_mm(found) < 0.04
    assert at_work_mm(plain) > 2.0 * at_work_mm(found)
    assert found.joint.shape == (8, 8)


def test_an_arm_at_rest_leaves_the_pose_open() -> None:
    f, _ = frames()
    stream = world()[2]
    rest = RobotStream(stream.time, np.repeat(stream.poses[3000:3001], len(stream.time), axis=0))
    noise = np.random.default_rng(9).normal(0.0, 5e-5, (len(f), 3))
    one = replace(f, p_C=f.p_C[100] + noise, n_C=np.repeat(f.n_C[100:101], len(f), axis=0))
    with pytest.raises(UndeterminedPoses, match="rotation"):
        estimate_in_motion(one, ContinuousMotion(rest))


def test_offset_is_not_invented_from_frames_at_rest() -> None:
    _, X_BC, stream, _ = world()
    f, _ = frames()
    # the arm stands at each corner for seconds and jumps between them where the stream has a gap
    corners = world()[0].poses
    which = np.minimum((4.0 * (stream.time - stream.time[0]) / SECONDS).astype(int), 3)
    keep = np.ones(len(which), dtype=bool)
    for k in range(1, 4):
        keep &= np.abs(stream.time - stream.time[0] - 0.25 * k * SECONDS) > 0.3
    rest = RobotStream(stream.time[keep], corners[which][keep])
    true = ContinuousMotion(rest).poses(f.arrival - 0.14)
    seen = np.isfinite(true[:, 0, 0])
    X_CF = X_BC.inverse().GetAsMatrix4() @ true[seen]
    noise = np.random.default_rng(9).normal(0.0, 5e-5, (int(seen.sum()), 3))
    part = replace(f.pick(np.flatnonzero(seen)), p_C=X_CF[:, :3, 3] + noise, n_C=X_CF[:, :3, 2])
    found = estimate_in_motion(part, ContinuousMotion(rest), held_out=False)
    assert found.clock.offset_s is None
    assert found.clock.sigma_s is None
    assert "does not show the clock's offset" in found.unobservable[0]
    assert at_work_mm(found) < 0.05


def test_line_to_and_fro_shows_clock_and_pose() -> None:
    moves, X_BC, _, _ = world()
    poses = moves.poses[:2].copy()
    poses[1, :3, :3] = poses[0, :3, :3]
    length = float(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]))
    line = Moves(moves.q[:2], poses, np.full(2, length), True)
    rng = np.random.default_rng(10)
    stream = recorded_stream(line, SECONDS, rng)
    f, _ = observed_frames(line, X_BC, SECONDS, rng, device=False)
    found = estimate_in_motion(f, ContinuousMotion(stream), held_out=False)
    check_offset(found, 0.140)
    assert at_work_mm(found) < 0.1


def test_clocks_that_cannot_be_used() -> None:
    f, capture = frames(device=True)
    assert f.device is not None
    n = len(f)
    assert choose_clock(f).kind == "device"
    assert choose_clock(replace(f, device=np.full(n, 3.0))).kind == "arrival"
    assert "not in seconds" in choose_clock(replace(f, device=1e3 * f.device)).reason
    reset = np.where(np.arange(n) > n // 3, f.device - 50.0, f.device)
    assert "set anew" in choose_clock(replace(f, device=reset)).reason
    some = np.where(np.arange(n) % 2 == 0, np.nan, f.device)
    assert "have a device time" in choose_clock(replace(f, device=some)).reason
    noisy = f.device + np.random.default_rng(11).normal(0.0, 0.04, n)
    found = estimate_in_motion(replace(f, device=noisy), world()[3], held_out=False)
    assert found.clock.kind == "arrival"
    assert len(capture) == n
