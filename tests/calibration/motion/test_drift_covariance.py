"""The pose after a move and its covariance: as far off as stated, in worlds of NumPy with the errors that the filter
expects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from weldcal.calibration.motion.drift.residuals import FrameNoise, Rows, rows_of
from weldcal.calibration.motion.drift.sequential import MOVED, DriftConfig, DriftEvent, DriftTest

Array = NDArray[np.float64]
Moved = list[tuple[DriftTest, DriftEvent, Array, Array, Rotation, Array]]

FRAME_S, FRAMES, AT = 0.05, 320, 160
PIVOT = np.array([-0.6, -0.2, 0.4])
R_BC = Rotation.from_euler("xyz", [3.0, 0.2, 0.7])
P_BC = PIVOT - R_BC.apply([0.0, 0.0, 0.65])
CENTRE_M, TILT_RAD = 3.5e-5, 6e-4
KNOWN_RAD, KNOWN_M = 1.2e-4, 5e-5
FIELD_M, FIELD_RAD, LENGTH_M, LENGTH_RAD = 1.5e-4, 8e-4, 0.15, 0.5


def _pose(turn: Rotation, p: Array) -> RigidTransform:
    return RigidTransform(RotationMatrix(turn.as_matrix()), p)


def _field(rng: np.random.Generator, centers: Array, normals: Array) -> Array:
    """Systematic errors (n, 5) m and rad of scanner and arm: smooth over where the flange is and how it is turned."""
    x = np.column_stack([centers / LENGTH_M, normals / LENGTH_RAD])
    k = np.exp(-0.5 * ((x[:, None] - x[None]) ** 2).sum(axis=2))
    values, vectors = np.linalg.eigh(k)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(root @ rng.normal(size=(len(x), 5)) * np.repeat([FIELD_M, FIELD_RAD], [3, 2]))


def _world(seed: int, turn: Array, shift: Array, noise: float = 1.0) -> tuple[DriftTest, Rows, Rotation, Array]:
    """A calibration with an error of the size that it states, its frames, and the scanner's pose after it moved at half
    time."""
    rng = np.random.default_rng([5, seed])
    t = FRAME_S * np.arange(FRAMES)
    phase, size = rng.uniform(0.0, 2.0 * np.pi, 6), np.array([0.08, 0.08, 0.06, 0.25, 0.25, 0.25])
    swing = size * np.sin(2.0 * np.pi * t[:, None] * np.array([0.17, 0.13, 0.11, 0.19, 0.14, 0.16]) + phase)
    p_B, facing = PIVOT + swing[:, :3], Rotation.from_rotvec(swing[:, 3:])
    n_B = facing.apply(R_BC.apply([0.0, 0.0, -1.0]))
    R_after, p_after = Rotation.from_rotvec(turn) * R_BC, P_BC + shift
    late = (np.arange(FRAMES) >= AT)[:, None]
    p_C = np.where(late, R_after.inv().apply(p_B - p_after), R_BC.inv().apply(p_B - P_BC))
    n_C = np.where(late, R_after.inv().apply(n_B), R_BC.inv().apply(n_B))
    p_C = p_C + CENTRE_M * rng.normal(size=p_C.shape)
    n_C = Rotation.from_rotvec(TILT_RAD * rng.normal(size=p_C.shape)).apply(n_C)
    a, b = KNOWN_RAD * rng.normal(size=3), KNOWN_M * rng.normal(size=3)  # about the camera's origin
    R_hat, p_hat = Rotation.from_rotvec(a) * R_BC, P_BC + b
    covariance = np.diag(np.repeat([KNOWN_RAD**2, KNOWN_M**2], 3))
    rows = rows_of(
        _pose(R_hat, p_hat), PIVOT, t, p_B, n_B, np.gradient(p_B, FRAME_S, axis=0), np.gradient(n_B, FRAME_S, axis=0),
        p_C, n_C, np.tile(CENTRE_M**2 * np.eye(3), (FRAMES, 1, 1)), np.full(FRAMES, TILT_RAD),
    )  # fmt: skip
    rows = replace(rows, residuals=rows.residuals + _field(rng, rows.centers, rows.normals))
    test = DriftTest(_pose(R_hat, p_hat), covariance, PIVOT, noise=FrameNoise(noise, noise))
    return test, rows, R_after, p_after


def _error(X: RigidTransform, R: Rotation, p: Array) -> Array:
    """[rotation; translation] from the truth to a pose."""
    turn = Rotation.from_matrix(X.rotation().matrix()) * R.inv()
    return np.concatenate([turn.as_rotvec(), X.translation() - p])


def _moved(cells: int, noise: float = 1.0) -> Moved:
    """Cells whose scanner turns by a milliradian and shifts by half a millimetre; ``noise`` is the share of it that is
    stated."""
    found = []
    for seed in range(cells):
        rng = np.random.default_rng([6, seed])
        turn, shift = (s * v / np.linalg.norm(v) for s, v in zip((1e-3, 5e-4), rng.normal(size=(2, 3)), strict=True))
        test, rows, R, p = _world(seed, turn, shift, noise)
        for k in range(0, FRAMES, 10):
            test.update(rows.part(slice(k, k + 10)))
        test.finish()
        assert [e.kind for e in test.events] == [MOVED]
        found.append((test, test.events[0], turn, shift, R, p))
    return found


def _squares(moved: Moved) -> list[float]:
    """Normalised squared errors of the moves; a simpler move has no covariance of the part that it leaves out."""
    square = []
    for _, event, turn, shift, _, _ in moved:
        e = np.concatenate([event.rotation_rad - turn, event.translation_m - shift])
        if event.model == "both":
            square.append(float(e @ np.linalg.solve(event.covariance, e)) / 6.0)
    return square


@pytest.fixture(scope="module")
def moved() -> Moved:
    return _moved(14)


def test_the_pose_after_a_move_is_as_far_off_as_stated(moved: Moved) -> None:
    square = []
    for test, _, _, _, R, p in moved:
        X, covariance = test.current()
        e = _error(X, R, p)
        square.append(float(e @ np.linalg.solve(covariance, e)) / 6.0)
    # 84 degrees of freedom: 15 %
    assert 0.55 < np.mean(square) < 1.6


def test_the_move_is_as_far_off_as_stated(moved: Moved) -> None:
    square = _squares(moved)
    assert len(square) > 7
    assert 0.4 < np.mean(square) < 1.7


def test_a_noise_that_is_understated_widens_the_move() -> None:
    """Frames four times as noisy as their fits state: the innovations say so."""
    square = _squares(_moved(8, 0.25))
    assert len(square) > 3
    assert np.mean(square) < 2.5


def test_a_turn_about_the_scanner_shifts_it_nowhere() -> None:
    test, rows, _, _ = _world(0, np.array([8e-4, -6e-4, 0.0]), np.zeros(3))
    test.update(rows)
    test.finish()
    (event,) = test.events
    assert np.linalg.norm(event.translation_m) < 1.5e-4
    assert np.linalg.norm(event.rotation_rad - [8e-4, -6e-4, 0.0]) < 5e-4  # about the line of sight a turn shows least


def test_a_quiet_hour_has_the_stated_chance_of_a_false_alarm() -> None:
    """Of all tests in an hour, 20 frames a second times the hypotheses, each a chi-square with the unknowns of a
    move."""
    config = DriftConfig()
    test = DriftTest(_pose(R_BC, P_BC), 1e-8 * np.eye(6), PIVOT, config, frame_rate_hz=20.0)
    tests = 3600.0 * 20.0 * len(test.filter.kind)
    for threshold, unknowns in ((test.threshold, 6), (test.threshold_alone, 3)):
        # four kinds of move are tested: each takes its part
        assert 0.1 < tests * chi2.sf(threshold, unknowns) / config.false_alarms_per_hour < 1.0
