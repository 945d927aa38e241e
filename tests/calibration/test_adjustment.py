"""The adjustment gives SciPy's optimum, and states spreads and covariances that hold."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from weldcal.calibration.adjustment import (
    Adjusted,
    Kind,
    Loss,
    Observed,
    Unknowns,
    adjust,
    helmert,
    huber,
    huber_cost,
    likeliest,
    plain,
    scanned,
    soft_l1,
)
from weldcal.models.arrays import Array

X = np.eye(4)
X[:3, :3], X[:3, 3] = Rotation.from_rotvec([0.4, -0.3, 1.1]).as_matrix(), [0.6, -0.2, 0.9]
SCALE = np.array([2e-3])
NEAR = np.array([0.02, -0.01, 0.015, 3e-3, -4e-3, 2e-3])  # rad, m: where an adjustment starts


def world(n: int, rng: np.random.Generator, sigma: float) -> tuple[Array, Array]:
    """Points (n, 3) of a scanner whose lengths are 0.2 % short, and their places with noise."""
    c = rng.uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 0.9], (n, 3))
    return c, (1.0 + SCALE[0]) * c @ X[:3, :3].T + X[:3, 3] + sigma * rng.standard_normal((n, 3))


def solved(c: Array, b: Array, kind: Kind, prior: float = 0.0, width: int = 3) -> Adjusted:
    def rows(at: Unknowns) -> tuple[Observed]:
        q, J_X, J_s = scanned(at.poses[0], c, np.ones((len(c), 1)), at.numbers)
        return (Observed((q - b).reshape(-1, width), np.concatenate([J_X, J_s], axis=2).reshape(-1, width, 7)),)

    start = Unknowns((X,), np.zeros(1)).moved(np.append(NEAR, 0.0))
    return adjust(start, rows, (kind,), prior=np.array([[prior]]))


def residuals(c: Array, b: Array, sigma: float, prior: float) -> Callable[[Array], Array]:
    """Written apart: rotation vector, position and scale."""

    def of(x: Array) -> Array:
        e = (1.0 + x[6]) * Rotation.from_rotvec(x[:3]).apply(c) + x[3:6] - b
        return np.append((e / sigma).ravel(), np.sqrt(prior) * x[6])

    return of


@pytest.mark.parametrize(("loss", "name"), [(plain, "linear"), (soft_l1, "soft_l1"), (huber, "huber")])
def test_the_optimum_is_scipys(loss: Loss, name: str) -> None:
    c, b = world(30, np.random.default_rng(3), 2e-4)
    b[4] += [3e-3, -2e-3, 4e-3]
    kind = Kind(rank=1, loss=loss, sigma=2e-4)
    found = solved(c, b, kind, prior=0.0, width=1)
    start = np.concatenate([Rotation.from_matrix(X[:3, :3]).as_rotvec(), X[:3, 3], [0.0]])
    asked = least_squares(
        residuals(c, b, 2e-4, 0.0), start, loss=name, f_scale=2.0, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac"
    )
    R = Rotation.from_rotvec(asked.x[:3]).as_matrix()
    sigma = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(found.at.poses[0][:3, 3], asked.x[3:6], atol=0.02 * sigma[3:6].min())
    np.testing.assert_allclose(found.at.poses[0][:3, :3], R, atol=0.02 * sigma[:3].min())
    np.testing.assert_allclose(found.at.numbers, asked.x[6:], atol=0.02 * sigma[6])


def test_a_prior_counts_as_one_more_observation() -> None:
    c, b = world(12, np.random.default_rng(5), 2e-4)
    found = solved(c, b, Kind(rank=3, loss=plain, sigma=2e-4), prior=1e-3**-2)
    start = np.concatenate([Rotation.from_matrix(X[:3, :3]).as_rotvec(), X[:3, 3], [0.0]])
    asked = least_squares(residuals(c, b, 2e-4, 1e-3**-2), start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    assert found.at.numbers[0] == pytest.approx(asked.x[6], abs=0.01 * np.sqrt(found.covariance[6, 6]))
    by_scipy = np.linalg.inv(asked.jac.T @ asked.jac)
    assert found.covariance[6, 6] == pytest.approx(by_scipy[6, 6], rel=1e-3)
    np.testing.assert_allclose(found.covariance[3:6, 3:6], by_scipy[3:6, 3:6], rtol=1e-2)


def test_spread_and_covariance_hold_the_truth() -> None:
    """Squared errors over their covariance are 7 on average, and Helmert's variances are right on average."""
    errors, variances, likely = [], [], []
    for seed in range(300):
        c, b = world(12, np.random.default_rng(seed), 2e-4)
        found = solved(c, b, Kind(rank=3, loss=plain, spread=helmert))
        Y = found.at.poses[0]
        turn = Rotation.from_matrix(Y[:3, :3] @ X[:3, :3].T).as_rotvec()
        off = np.concatenate([turn, Y[:3, 3] - X[:3, 3], found.at.numbers - SCALE])
        errors.append(off @ np.linalg.solve(found.covariance * (2e-4 / found.sigmas[0]) ** 2, off))
        variances.append(found.sigmas[0] ** 2)
        assert found.spare[0] == pytest.approx(3 * 12 - 7, abs=1e-6)
        likely.append(solved(c, b, Kind(rank=3, loss=plain, spread=likeliest)).sigmas[0] ** 2)
    assert 6.3 < np.mean(errors) < 7.7
    assert np.mean(variances) == pytest.approx(2e-4**2, rel=0.05)
    assert np.mean(likely) == pytest.approx(2e-4**2 * (36 - 7) / 36, rel=0.05)


def test_kinds_are_weighed_by_their_own_spread() -> None:
    """Half of the points are ten times worse: they add about a hundredth of what the good half knows."""
    gained = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        halves = [world(10, rng, sigma) for sigma in (1e-4, 1e-3)]

        def rows(at: Unknowns, halves: list[tuple[Array, Array]] = halves) -> list[Observed]:
            out = []
            for c, b in halves:
                q, J_X, J_s = scanned(at.poses[0], c, np.ones((len(c), 1)), at.numbers)
                out.append(Observed(q - b, np.concatenate([J_X, J_s], axis=2)))
            return out

        kind = Kind(rank=3, loss=plain, spread=helmert)
        found = adjust(Unknowns((X,), np.zeros(1)), rows, (kind, kind))
        assert 5.0 < found.sigmas[1] / found.sigmas[0] < 20.0
        assert found.spare[1] > 27.0  # of 30: the bad half pays for little
        alone = solved(*halves[0], kind)
        both, one = (np.trace(f.covariance[3:6, 3:6]) / f.sigmas[0] ** 2 for f in (found, alone))
        gained.append(1.0 - both / one)
    assert 0.002 < np.median(gained) < 0.05


@pytest.mark.parametrize("width", [1, 3])
def test_what_is_known_of_an_observation_lowers_its_weight(width: int) -> None:
    c, b = world(12, np.random.default_rng(7), 1e-4)
    b[3] += 0.05
    own = np.zeros(12)
    own[3] = 1.0
    if width == 3:
        own = own[:, None, None] * np.eye(3)

    def rows(at: Unknowns) -> tuple[Observed]:
        q, J_X, J_s = scanned(at.poses[0], c, np.ones((len(c), 1)), at.numbers)
        return (Observed(q - b, np.concatenate([J_X, J_s], axis=2), own),)

    found = adjust(Unknowns((X,), np.zeros(1)), rows, (Kind(rank=3, loss=plain, sigma=1e-4),))
    np.testing.assert_allclose(found.at.poses[0][:3, 3], X[:3, 3], atol=2e-3)


def test_an_open_direction_does_not_run_away() -> None:
    """Points on one line leave the turn about it open: steps about it stay short."""
    rng = np.random.default_rng(0)
    c = rng.uniform(0.5, 0.9, (9, 1)) * np.array([[0.3, 0.1, 1.0]])
    b = c @ X[:3, :3].T + X[:3, 3]
    found = solved(c, b, Kind(rank=3, loss=plain, sigma=1e-4))
    axis = X[:3, :3] @ np.array([0.3, 0.1, 1.0])
    assert np.isfinite(found.at.poses[0]).all()
    assert np.abs(found.rows[0].e).max() < 1e-9
    assert np.diag(found.covariance).max() < 1.0
    about = Rotation.from_matrix(found.at.poses[0][:3, :3] @ X[:3, :3].T).as_rotvec() @ axis / np.linalg.norm(axis)
    assert about == pytest.approx(NEAR[:3] @ axis / np.linalg.norm(axis), abs=0.05)


def test_the_cost_of_huber_has_his_weights_for_its_slope() -> None:
    for square in (0.5, 11.9, 12.1, 80.0):
        slope = (huber_cost(np.array([square + 1e-5]), 3.0) - huber_cost(np.array([square - 1e-5]), 3.0)) / 2e-5
        assert slope == pytest.approx(huber(np.array([square]), 3.0), rel=1e-4)
