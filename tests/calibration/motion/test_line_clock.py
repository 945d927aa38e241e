"""A profiler's clock offset from one straight edge: found while the arm weaves over it, refused where the motion is one
way."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.errors import TooFewPoses, UndeterminedPoses
from weldcal.calibration.geometry.se3 import exp_rotation, pose
from weldcal.calibration.motion.line_clock import offset_from_line
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

X_FP = pose(exp_rotation(np.array([0.1, 0.2, 0.3])), np.array([0.03, 0.01, 0.15]))
EDGE_POINT, EDGE = np.array([0.5, 0.0, 0.1]), np.array([1.0, 0.1, 0.05])
SECONDS = 8.0


def hand_at(t: Array, weave_m: float) -> Array:
    """Along the edge at 20 mm/s, weaving across it with the flange pointing down."""
    p = EDGE_POINT + np.outer(0.02 * (t - 4.0), EDGE) + np.array([-0.05, 0.0, 0.25])
    p = p + np.outer(weave_m * np.sin(3.0 * t), [0.0, 1.0, 0.2])
    w = np.array([np.pi, 0.0, 0.0]) + 5.0 * weave_m * np.outer(np.sin(1.5 * t), [0.0, 1.0, 1.0])
    return pose(exp_rotation(w), p)


def profiles(offset_s: float, weave_m: float, seed: int) -> tuple[Array, Array]:
    """Stamps and crossings of the laser plane (y = 0 of the profiler) with the edge, 20 um of noise in the plane."""
    t = np.arange(1.0, SECONDS - 1.0, 0.02)
    X_BP = hand_at(t, weave_m) @ X_FP
    n, o = X_BP[:, :3, 1], X_BP[:, :3, 3]
    d = EDGE / np.linalg.norm(EDGE)
    s = ((o - EDGE_POINT) * n).sum(axis=1) / (n @ d)
    q = EDGE_POINT + s[:, None] * d
    noise = 2e-5 * np.random.default_rng(seed).standard_normal((len(t), 3)) * [1.0, 0.0, 1.0]
    return t + offset_s, np.einsum("nji,nj->ni", X_BP[:, :3, :3], q - o) + noise


def motion(weave_m: float) -> ContinuousMotion:
    t = np.arange(0.0, SECONDS, 0.004)
    return ContinuousMotion(RobotStream(t, hand_at(t, weave_m)))


def test_offset_is_found_with_an_honest_sigma() -> None:
    at = motion(0.01)
    z = []
    for seed in range(12):
        found = offset_from_line(*profiles(0.0123, 0.01, seed), X_FP, at)
        assert abs(found.offset_s - 0.0123) < 5e-4
        assert found.rms_m < 4e-5 < found.before_m
        assert abs(found.direction @ EDGE) / np.linalg.norm(EDGE) > 1.0 - 1e-6
        z.append((found.offset_s - 0.0123) / found.sigma_s)
    assert 0.2 < float(np.mean(np.square(z))) < 2.5


def test_a_motion_one_way_is_refused() -> None:
    with pytest.raises(UndeterminedPoses, match="to and fro"):
        offset_from_line(*profiles(0.01, 0.0, 0), X_FP, motion(0.0))
    time, points = profiles(0.01, 0.01, 0)
    with pytest.raises(TooFewPoses, match="within the robot's stream"):
        offset_from_line(time + 100.0, points, X_FP, motion(0.01))
