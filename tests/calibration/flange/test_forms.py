"""The same scan as people have it: with its grid, flat, shuffled, cropped or thinned, of a caster that shares nothing
with weldcal."""

from __future__ import annotations

import numpy as np
import pytest

from tests.calibration.flange.raycast import Camera, forms, random_flange, scan
from weldcal.calibration.flange.fit import fit_flange, rebuild_grid
from weldcal.models.flanges import get_flange

STANDARD = get_flange("iso9409-1-50-4-m6")
CAMERA = Camera(640, 480, 800.0)
SCANS = 24


@pytest.fixture(scope="module")
def errors() -> dict[str, np.ndarray]:
    """Of each form (scans, 2): distance of the centre from the truth (m), and its square over the stated covariance,
    per unknown."""
    found: dict[str, list[tuple[float, float]]] = {}
    for k in range(SCANS):
        rng = np.random.default_rng([3, k])
        X_CR = random_flange(rng)
        cloud = scan(X_CR, rng, CAMERA)
        for name, points in forms(cloud, rng, X_CR[:3, 3]).items():
            fit = fit_flange(points, STANDARD)  # none is refused: every scan shows the face
            assert fit.on_grid
            e = fit.center_C - X_CR[:3, 3]
            nees = float(e @ np.linalg.solve(fit.center_covariance, e)) / 3.0
            found.setdefault(name, []).append((float(np.linalg.norm(e)), nees))
    return {name: np.array(v) for name, v in found.items()}


@pytest.mark.parametrize("form", ["zeros", "dropped", "shuffled"])
def test_a_flat_cloud_is_measured_as_its_grid(errors: dict[str, np.ndarray], form: str) -> None:
    assert np.allclose(errors[form], errors["organised"], rtol=1e-6, atol=1e-12)


def test_a_cropped_cloud_is_measured_as_well(errors: dict[str, np.ndarray]) -> None:
    rms = {name: float(np.sqrt(np.mean(e[:, 0] ** 2))) for name, e in errors.items()}
    assert rms["organised"] < 40e-6
    assert rms["cropped"] < 1.15 * rms["organised"]
    assert rms["thinned"] < 3.0 * rms["organised"]


@pytest.mark.parametrize("form", ["organised", "cropped", "thinned"])
def test_the_stated_covariance_is_that_of_the_errors(errors: dict[str, np.ndarray], form: str) -> None:
    # 72 degrees of freedom: a covariance of half or double the sigma is a factor of four
    assert 0.6 < errors[form][:, 1].mean() < 1.6


def test_a_bent_lens_has_a_grid_and_two_views_have_none() -> None:
    rng = np.random.default_rng(5)
    X_CR = random_flange(rng)
    bent = scan(X_CR, rng, Camera(640, 480, 800.0, bend=0.1))
    points = rng.permutation(bent.reshape(-1, 3))
    grid = rebuild_grid(points)
    assert grid is not None
    assert np.array_equal(grid, bent)
    other = scan(X_CR, rng, CAMERA)
    assert rebuild_grid(np.concatenate([points, other.reshape(-1, 3)])) is None
    turned = bent.reshape(-1, 3) @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T + [0.1, 0.2, 1.0]
    assert rebuild_grid(turned) is None


def test_a_fused_cloud_is_measured_without_a_grid() -> None:
    rng = np.random.default_rng(6)
    X_CR = random_flange(rng)
    parts = []
    for _ in range(2):  # the same face from two places: points of both in the first one's frame
        shift = rng.uniform(-0.05, 0.05, 3)
        there = X_CR.copy()
        there[:3, 3] += shift
        parts.append(scan(there, rng, CAMERA).reshape(-1, 3) - shift)
    points = np.concatenate(parts)
    points = points[np.abs(points - X_CR[:3, 3]).max(axis=1) < 0.06]
    assert rebuild_grid(points) is None
    fit = fit_flange(points, STANDARD)
    assert not fit.on_grid
    assert float(np.linalg.norm(fit.center_C - X_CR[:3, 3])) < 4e-4


def test_the_region_without_a_grid_holds_the_pull_of_the_chamfer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("weldcal.calibration.flange.fit.rebuild_grid", lambda cloud: None)
    squares = []
    for k in range(16):
        rng = np.random.default_rng([7, k])
        X_CR = random_flange(rng)
        sigma_m = (5e-5, 2e-4)[k % 2]
        cropped = forms(scan(X_CR, rng, CAMERA, sigma=sigma_m), rng, X_CR[:3, 3])["cropped"]
        fit = fit_flange(cropped, STANDARD)
        e = fit.center_C - X_CR[:3, 3]
        squares.append(float(e @ np.linalg.solve(fit.center_covariance, e)) / 3.0)
    # 48 degrees of freedom, half of them of one bias; without its part the mean is 3 to 4
    assert 0.55 < np.mean(squares) < 1.6
