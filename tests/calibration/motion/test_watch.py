"""A calibration is watched over a recording: frames synchronised in spite of a knock, the pose after it, what is
dropped."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.worlds.moves import cube_moves, observed_frames
from tests.worlds.streams import recorded_stream
from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ARRIVAL, ScannerClock
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.motion.drift.watch import watch
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.motion.synchronise import synchronise
from weldcal.models.errors import InputError

DELAY_S = 0.140


def recording(
    seed: int, *, device: bool, knock: RigidTransform | None = None, at: float = 10.0, duration: float = 16.0
) -> tuple[CalibrationResult, ObservedFrames, ContinuousMotion]:
    """A calibration, frames of a scanner that jumps by ``knock`` about its own origin in the base, and the robot's
    motion."""
    rng = np.random.default_rng(seed)
    moves, X_BC = cube_moves(rng)
    motion = ContinuousMotion(recorded_stream(moves, duration, rng))
    frames, capture = observed_frames(moves, X_BC, duration, rng, device=device, epoch_s=500.0, drift=2e-5)
    if knock is not None:
        after = RigidTransform(knock.rotation() @ X_BC.rotation(), X_BC.translation() + knock.translation())
        X = after.inverse() @ X_BC
        late = capture > at
        p_C, n_C = frames.p_C.copy(), frames.n_C.copy()
        p_C[late] = (X @ p_C[late].T).T
        n_C[late] = n_C[late] @ X.rotation().matrix().T
        frames = replace(frames, p_C=p_C, n_C=n_C)
    result = CalibrationResult(
        X_BC=X_BC, covariance=np.diag([1e-9] * 3 + [1e-9] * 3), held_out_mm={}, tilt_deg={}, poses=()
    )
    return result, frames, motion


@pytest.mark.parametrize("device", [True, False])
def test_a_quiet_recording_is_synchronised_and_calm(device: bool) -> None:
    result, frames, motion = recording(1, device=device)
    w = watch(result, frames, motion)
    assert w.events == ()
    assert w.clock.clock.kind == ("device" if device else "arrival")
    assert w.clock.delay_s is not None
    assert w.clock.sigma_s is not None
    if not device:  # of the mean over frames; a device's delay is that behind its median arrival
        assert abs(w.clock.delay_s - DELAY_S) < 4.0 * w.clock.sigma_s + 1e-3
    assert w.rms_m < 0.15e-3
    assert float(np.sqrt((w.before**2).sum(axis=1).mean())) > 10e-3
    assert w.rms_after_m == w.rms_m


@pytest.mark.parametrize(("shift_mm", "turn_deg"), [(0.4, 0.0), (6.0, 0.8)])
@pytest.mark.parametrize("device", [True, False])
def test_a_knock_within_the_recording_is_found_with_the_pose_after_it(
    shift_mm: float, turn_deg: float, device: bool
) -> None:
    shift = 1e-3 * shift_mm * np.array([0.6, 0.0, 0.8])
    turn = np.radians(turn_deg) * np.array([0.0, 0.8, 0.6])
    knock = RigidTransform(RotationMatrix(exp_rotation(turn)), shift)
    result, frames, motion = recording(2, device=device, knock=knock)
    w = watch(result, frames, motion)
    assert [e.since_start for e in w.events] == [False]
    e = w.events[0]
    assert abs(e.time_s - 10.0) < 0.25
    assert e.found_s - 10.0 < 2.0
    sigma = np.sqrt(np.diag(e.covariance))
    assert np.all(np.abs(e.translation_m - shift) < 5.0 * sigma[3:] + 2e-5)
    assert np.all(np.abs(e.rotation_rad - turn) < 5.0 * sigma[:3] + 2e-5)
    assert w.rms_after_m < 0.15e-3 < w.rms_m


def test_a_calibrations_clock_serves_where_the_arm_rests() -> None:
    result, frames, motion = recording(3, device=False)
    # the arm stood: all frames see the flange at one place
    still = replace(frames, p_C=np.tile(frames.p_C[0], (len(frames), 1)))
    resting = ContinuousMotion(_rest(motion))
    found = synchronise(still, resting, result.X_BC)
    assert found.delay_s is None
    clock = ScannerClock(kind=ARRIVAL, offset_s=0.141, sigma_s=1e-3, jitter_s=0.015, reference_s=0.0)
    found = synchronise(still, resting, result.X_BC, known=clock)
    assert found.source == "calibration"
    assert found.times == pytest.approx(frames.arrival - 0.141)


def test_frames_outside_the_stream_are_dropped_by_name() -> None:
    result, frames, motion = recording(4, device=False)
    begin = motion.span[1] - 5.0
    short = ContinuousMotion(_cut(motion, begin))
    w = watch(result, frames, short, dropped=[("x", "no flange")])
    outside = [id for id, reason in w.dropped if "stream has no data" in reason]
    assert len(w.ids) + len(w.dropped) == len(frames) + 1
    assert 0.6 * len(frames) < len(outside) < 0.8 * len(frames)
    with pytest.raises(InputError, match="robot's clock"):
        watch(result, replace(frames, arrival=frames.arrival + 1e4), motion)


def _rest(motion: ContinuousMotion) -> RobotStream:
    t = np.linspace(*motion.span, 2000)
    return RobotStream(t, np.tile(motion.poses(t[1000:1001]), (2000, 1, 1)) + 0.0)


def _cut(motion: ContinuousMotion, begin: float) -> RobotStream:
    t = np.arange(begin, motion.span[1] - 0.01, 0.002)
    return RobotStream(t, motion.poses(t))


def test_a_handful_of_frames_gives_finite_figures_and_no_alarm() -> None:
    result, frames, motion = recording(5, device=False)
    few = frames.pick(np.arange(len(frames)) < 6)
    w = watch(result, few, motion)
    assert len(w.ids) == 6
    assert w.events == ()
    assert 0.0 < w.rms_m < 1e-3
