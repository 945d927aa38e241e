"""The robot's stream in continuous time: exact motion is recovered between samples, jitter is averaged, gaps are
known."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.worlds.moves import cube_moves
from tests.worlds.streams import Moves, recorded_stream
from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

T = np.random.default_rng(1).uniform(0.5, 5.5, 800)


def moves(seed: int = 3, *, linear: bool = False) -> Moves:
    return cube_moves(np.random.default_rng(seed), linear=linear)[0]


def errors(way: Moves, stream: RobotStream) -> Array:
    """Distances (n,) m of the interpolated positions from the exact ones."""
    return np.asarray(np.linalg.norm((ContinuousMotion(stream).poses(T) - way.at(T))[:, :3, 3], axis=1))


@pytest.mark.parametrize(
    ("rate", "jitter_s", "bound_m"),
    [(500.0, 0.0, 1e-6), (125.0, 0.0, 2e-5), (500.0, 1e-4, 1.2e-5), (250.0, 5e-4, 6e-5)],
)
@pytest.mark.parametrize("joints", [True, False])
def test_between_samples(rate: float, jitter_s: float, bound_m: float, joints: bool) -> None:
    way = moves()
    stream = recorded_stream(way, 6.0, np.random.default_rng(2), rate=rate, jitter_s=jitter_s, joints=joints)
    assert np.sqrt(np.mean(errors(way, stream) ** 2)) < bound_m


def test_velocity_and_turn() -> None:
    way = moves()
    motion = ContinuousMotion(recorded_stream(way, 6.0, np.random.default_rng(2), jitter_s=0.0))
    X_FR = RigidTransform([0.01, 0.02, 0.1])
    at = motion.feature(T, X_FR)
    h = 1e-4
    later, sooner = (way.at(T + s) @ X_FR.GetAsMatrix4() for s in (h, -h))
    assert np.median(np.abs(at.v - (later - sooner)[:, :3, 3] / (2.0 * h))) < 1e-4
    assert np.median(np.abs(at.turn - (later - sooner)[:, :3, 2] / (2.0 * h))) < 1e-4


def test_gaps_and_ends_are_unknown() -> None:
    stream = recorded_stream(moves(), 6.0, np.random.default_rng(2), jitter_s=0.0)
    keep = (stream.time < 2.0) | (stream.time > 2.5)
    motion = ContinuousMotion(RobotStream(stream.time[keep], stream.poses[keep]))
    asked = np.array([-0.1, 1.9, 2.2, 2.6, 6.1])
    assert motion.known(asked).tolist() == [False, True, False, True, False]
    assert np.isnan(motion.poses(asked)[:, 0, 0]).tolist() == [True, False, True, False, True]
    assert len(motion.gaps) == 1


def test_values_read_faster_than_they_change() -> None:
    way = moves()
    stream = recorded_stream(way, 6.0, np.random.default_rng(2), jitter_s=0.0)
    held = stream.poses[4 * (np.arange(len(stream.time)) // 4)]
    assert errors(way, RobotStream(stream.time, held)).max() < 1e-4  # a staircase would be 2 mm behind
