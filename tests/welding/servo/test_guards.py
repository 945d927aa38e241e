"""Whatever is asked, the motion is finite, within its limits and able to stop."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from weldcal.welding.numerics import box_least_squares
from weldcal.welding.servo.guards import (
    ArmGuardConfig,
    GuardError,
    SlewLimits,
    guarded_joint_velocity,
    seam_conditioning,
    slew_limit,
)

DT = 0.002
LIMITS = SlewLimits(speed=1.0, acceleration=4.0, jerk=80.0)


def jacobian(sigma_min: float, seed: int = 0) -> np.ndarray:
    """A Jacobian whose length-scaled least singular value is `sigma_min`."""
    rng = np.random.default_rng(seed)
    U, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    W, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    length = ArmGuardConfig().characteristic_length_m
    return np.diag([1.0, 1.0, 1.0, length, length, length]) @ U @ np.diag([1.5, 1.2, 1.0, 0.8, 0.6, sigma_min]) @ W.T


def test_away_from_singularities_the_arm_does_what_it_is_told() -> None:
    J, V = jacobian(0.3), np.array([0.02, -0.01, 0.1, 0.005, -0.003, 0.001])
    answer = guarded_joint_velocity(J, V, 2.0)
    np.testing.assert_allclose(J @ answer.q_dot, V, atol=1e-12)
    assert answer.scale == 1.0
    assert answer.reason is None
    assert answer.sigma_min == pytest.approx(0.3)


def test_near_one_it_slows_but_keeps_its_direction() -> None:
    V = np.array([0.0, 0.0, 0.05, 0.008, 0.0, 0.0])
    scales = []
    for sigma in (0.079, 0.06, 0.045, 0.035):
        answer = guarded_joint_velocity(jacobian(sigma), V, 10.0)
        J = jacobian(sigma)
        got = J @ answer.q_dot
        np.testing.assert_allclose(got, answer.scale * V, atol=1e-12)
        scales.append(answer.scale)
        assert answer.reason is not None
    assert all(a > b for a, b in pairwise(scales))


def test_at_one_it_stops() -> None:
    for sigma in (0.03 * (1.0 - 1e-12), 0.01, 0.0):
        answer = guarded_joint_velocity(jacobian(sigma), np.ones(6), 2.0)
        assert answer.stopped
        assert not answer.q_dot.any()
        assert answer.reason is not None


def test_on_the_threshold_rounding_chooses_the_side_and_the_arm_stands_on_both() -> None:
    sides = set()
    for seed in range(20):
        answer = guarded_joint_velocity(jacobian(0.03, seed), np.ones(6), 2.0)
        assert np.abs(answer.q_dot).max() < 1e-12
        sides.add(answer.stopped)
    assert sides == {True, False}


def test_joint_speeds_are_held_by_slowing_everything_alike() -> None:
    J, V = jacobian(0.3), np.array([1.0, 2.0, -1.0, 1.0, 0.5, -2.0])
    limit = np.array([2.0, 2.0, 3.0, 3.0, 3.0, 0.5])
    answer = guarded_joint_velocity(J, V, limit)
    assert np.all(np.abs(answer.q_dot) <= limit + 1e-12)
    np.testing.assert_allclose(J @ answer.q_dot, answer.scale * V, atol=1e-9)
    assert 0.0 < answer.scale < 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_command_that_is_no_number_stops_the_arm(bad: float) -> None:
    V = np.zeros(6)
    V[2] = bad
    answer = guarded_joint_velocity(jacobian(0.3), V, 2.0)
    assert answer.stopped
    assert np.isfinite(answer.q_dot).all()
    assert not guarded_joint_velocity(jacobian(0.3) * bad, np.ones(6), 2.0).q_dot.any()


def test_thresholds_that_make_no_sense_are_refused() -> None:
    with pytest.raises(GuardError):
        ArmGuardConfig(sigma_slow=0.02, sigma_stop=0.03)
    with pytest.raises(GuardError):
        SlewLimits(jerk=0.0)
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(GuardError):
            ArmGuardConfig(sigma_slow=bad)
        with pytest.raises(GuardError):
            ArmGuardConfig(characteristic_length_m=bad)


def run_slew(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities and accelerations for commands (N, n)."""
    v, a = np.zeros(commands.shape[1]), np.zeros(commands.shape[1])
    vs, accs = [v], [a]
    for command in commands:
        v, a = slew_limit(command, v, a, LIMITS, DT)
        vs.append(v)
        accs.append(a)
    return np.array(vs), np.array(accs)


@pytest.mark.parametrize("seed", range(4))
def test_no_command_breaks_a_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Every kind: steps held long and short, beyond the limits, and ones that are no number.
    commands = np.repeat(rng.uniform(-5.0, 5.0, (200, 6)), rng.integers(1, 60, 200), axis=0)
    commands[rng.random(len(commands)) < 0.02] = np.nan
    v, a = run_slew(commands)
    assert np.isfinite(v).all()
    assert np.abs(v).max() <= 1.0 + 1e-9
    assert np.abs(a).max() <= 4.0 + 1e-9
    assert np.abs(np.diff(a, axis=0)).max() <= 80.0 * DT + 1e-9


def test_a_step_is_reached_without_overshoot_and_kept() -> None:
    for target in (0.7, -0.3, 1.0, 0.001):
        v, a = run_slew(np.full((1000, 1), target))
        assert np.max(v * np.sign(target)) <= abs(target) + 1e-12
        assert v[-1, 0] == pytest.approx(target, abs=1e-9)
        assert a[-1, 0] == pytest.approx(0.0, abs=1e-6)


def test_from_any_motion_it_comes_to_rest_without_reversing_far() -> None:
    rng = np.random.default_rng(9)
    v, a = np.zeros(6), np.zeros(6)
    for _ in range(300):
        v, a = slew_limit(rng.uniform(-2.0, 2.0, 6), v, a, LIMITS, DT)
    for _ in range(1000):
        v, a = slew_limit(np.full(6, np.nan), v, a, LIMITS, DT)
    np.testing.assert_allclose(v, 0.0, atol=1e-9)


def test_the_seams_conditioning_is_that_of_the_chord() -> None:
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    corner = seam_conditioning(x, x, y)
    assert corner.cos_torch == 0.0
    assert corner.value == pytest.approx(1.0)


def test_least_squares_in_a_box_is_the_best_of_a_fine_grid() -> None:
    rng = np.random.default_rng(4)
    for _ in range(40):
        rows = tuple(tuple(r) for r in np.column_stack([rng.uniform(0.1, 5.0, 3), rng.normal(size=(3, 3))]).tolist())
        low, high = np.sort(rng.normal(size=(2, 2)), axis=0)
        x, y = box_least_squares(rows, (low[0], high[0]), (low[1], high[1]))  # type: ignore[arg-type]

        def cost(x: np.ndarray | float, y: np.ndarray | float, rows: tuple = rows) -> np.ndarray | float:
            return sum(w * (a * x + b * y - c) ** 2 for w, a, b, c in rows)

        assert low[0] <= x <= high[0]
        assert low[1] <= y <= high[1]
        grid = np.meshgrid(np.linspace(low[0], high[0], 60), np.linspace(low[1], high[1], 60))
        assert cost(x, y) <= np.min(cost(*grid)) + 1e-9
