"""What a planned motion is expected to tell: as the joint fit then states it, and more where the motion comes back."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worlds.moves import cube_moves, observed_frames
from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.motion.estimate import estimate_in_motion
from weldcal.calibration.motion.expected import Moves, expected_of_motion, recorded_stream
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.errors import InputError

NOISE = {"centre_sigma_m": 4.2e-5, "normal_sigma": 5e-4}


def cut(stream: RobotStream, begin: float, end: float) -> ContinuousMotion:
    keep = (stream.time >= begin) & (stream.time <= end)
    return ContinuousMotion(RobotStream(stream.time[keep], stream.poses[keep]))


def test_the_fit_states_what_was_expected() -> None:
    rng = np.random.default_rng(2)
    moves, X_BC = cube_moves(rng)
    motion = ContinuousMotion(recorded_stream(moves, 13.0, rng))
    frames, _ = observed_frames(moves, X_BC, 13.0, rng, device=False)
    found = estimate_in_motion(frames, motion, held_out=False)
    told = expected_of_motion(motion, X_BC, **NOISE)
    assert told.offset_s == pytest.approx(found.clock.sigma_s, rel=0.25)
    stated = float(np.linalg.norm(np.sqrt(np.diag(found.covariance)[:3])))
    assert told.turn_rad == pytest.approx(stated, rel=0.35)
    assert told.work_m < 3e-5


def test_coming_back_tells_clock_from_pose() -> None:
    rng = np.random.default_rng(3)
    moves, X_BC = cube_moves(rng)
    poses = moves.poses[:2].copy()
    poses[1, :3, :3] = poses[0, :3, :3]
    line = Moves(moves.q[:2], poses, np.full(2, float(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]))), True)
    stream = recorded_stream(line, 6.0, rng)
    way, round_trip = cut(stream, 0.25, 1.05), cut(stream, 0.0, 2.9)
    one, two = (expected_of_motion(m, X_BC, **NOISE) for m in (way, round_trip))
    assert one.shared > 0.99
    assert two.shared < 0.3
    assert one.offset_s > 20.0 * two.offset_s
    with pytest.raises(InputError, match="frames"):
        expected_of_motion(cut(stream, 0.0, 0.1), X_BC)
