"""Algorithm 1 as published, and why its own figure flatters it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.calibration.published.costs import axes_cost, translation_and_rotation_cost
from weldcal.calibration.eye_on_base.solve import estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import convergence, k_fold, position_errors
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.algorithm1 import (
    FAILED,
    POOL_SIZE,
    CentreVerification,
    VerificationError,
    algorithm1_start,
    algorithm1_step,
    translation_cost,
)
from weldcal.models.errors import InputError
from weldcal.tools.algorithm1_comparison import algorithm1_curve, run_algorithm1

X_BC = RigidTransform(RollPitchYaw(3.0, 0.2, 0.7), [-0.6, -0.3, 1.1])


def make_observations(n: int, seed: int, sigma: float = 5e-4) -> list[Observation]:
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        p = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.5, 0.9)])
        X_BR = X_BC @ RigidTransform(RollPitchYaw(3.1, 0.1, 0.0), p)
        out.append(Observation(f"p{k}", X_BR, p + sigma * rng.standard_normal(3)))
    return out


def test_the_first_four_fill_the_pool_and_a_step_changes_nothing_before_it() -> None:
    *first, held = make_observations(5, 0)
    empty = algorithm1_start(1e-6, 10)
    state = empty
    for o in first:
        state = algorithm1_step(state, o, CentreVerification(held))
    assert empty.pool == ()
    assert len(state.pool) == POOL_SIZE
    assert state.k == 0
    assert state.cost == pytest.approx(position_errors(state.X_BC, [held])[0])  # type: ignore[arg-type]


def test_the_cost_never_rises_and_the_pool_stays_four_different_pairs() -> None:
    *scans, held = make_observations(25, 1)
    state = algorithm1_start(1e-9, 100)
    costs = []
    for o in scans:
        state = algorithm1_step(state, o, CentreVerification(held))
        assert len({p.id for p in state.pool}) == len(state.pool)
        costs.append(state.cost)
    assert all(b <= a for a, b in itertools.pairwise(costs))
    assert costs[-1] < costs[3]


def test_it_stops_at_the_required_error_or_when_the_scans_are_used_up() -> None:
    *scans, held = make_observations(20, 2)
    generous, short = algorithm1_start(0.1, 100), algorithm1_start(1e-12, 3)
    for o in scans:
        generous = algorithm1_step(generous, o, CentreVerification(held))
        short = algorithm1_step(short, o, CentreVerification(held))
    assert generous.done
    assert generous.k == 0
    assert short.done
    assert short.k == 3


def test_a_failed_registration_costs_infinity_and_the_next_one_replaces_it() -> None:
    *scans, held = make_observations(8, 3)
    calls = iter(range(100))

    def unlucky(X: RigidTransform) -> VerificationError:
        return FAILED if next(calls) < 3 else CentreVerification(held)(X)

    state = algorithm1_start(1e-9, 100)
    for o in scans[:4]:
        state = algorithm1_step(state, o, unlucky)
    assert state.cost == float("inf")
    state = algorithm1_step(state, scans[4], unlucky)
    assert state.cost < 0.01


def test_compensation_makes_its_own_figure_zero() -> None:
    *scans, held = make_observations(10, 4)
    run = run_algorithm1(scans, CentreVerification(held))
    assert run is not None
    assert run.error.X_CpC is not None
    # Eq. (21) moves the seen centre onto the stated one: rounding only
    assert position_errors(run.X_BC @ run.error.X_CpC, [held])[0] < 1e-12


def test_its_own_figure_is_smaller_than_its_true_error_and_all_data_do_better() -> None:
    figure, true, ours = [], [], []
    for seed in range(6):
        *scans, held = make_observations(20, 10 + seed)
        fresh = make_observations(50, 100 + seed, sigma=0.0)
        run = run_algorithm1(scans, CentreVerification(held))
        assert run is not None
        figure.append(run.cost)
        true.append(np.median(position_errors(run.X_BC, fresh)))
        ours.append(np.median(position_errors(estimate_eye_on_base(scans).X_BC, fresh)))
    assert np.mean(figure) < 0.5 * np.mean(true)
    assert np.mean(ours) < np.mean(true)


def test_costs_weigh_what_they_are_told() -> None:
    error = np.array([0.0, 0.0, 0.01, 3e-3, 0.0, 4e-3])
    assert translation_cost(error) == pytest.approx(5e-3)
    assert translation_and_rotation_cost(0.2)(error) == pytest.approx(7e-3)
    assert axes_cost((2, 5), 0.3)(error) == pytest.approx(5e-3)
    with pytest.raises(InputError, match="numbers from 0 to 5"):
        axes_cost((6,), 0.1)


def test_required_error_must_be_positive() -> None:
    with pytest.raises(InputError, match="above zero"):
        algorithm1_start(0.0, 10)


def test_folds_and_convergence_repeat_bit_for_bit_and_judge_every_pose() -> None:
    observations = make_observations(15, 5)
    a, b = (k_fold(observations, folds=5, repeats=2, seed=3) for _ in range(2))
    assert a.shape == (2, 15)
    assert np.isfinite(a).all()
    assert (a == b).all()
    *scans, held = observations
    c, d = (convergence(scans, orders=2, seed=1) for _ in range(2))
    assert np.array_equal(c.held_out, d.held_out, equal_nan=True)
    e, f = (algorithm1_curve(scans, CentreVerification(held), c.counts, orders=2, seed=1) for _ in range(2))
    assert e[1].shape == c.held_out.shape
    assert np.array_equal(e[1], f[1], equal_nan=True)
    with pytest.raises(InputError, match="cannot be divided into 20 folds"):
        k_fold(observations, folds=20)
