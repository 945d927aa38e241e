"""The compiled loops say what the plain mathematics says, and are compiled once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from tests.worlds.flange_frames import facing, flange_frame
from weldcal.calibration.flange.edge_labels import WRONG, border_likelihood
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.holes import find_holes
from weldcal.calibration.flange.track import borders, near_edge, ring_points
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.geometry.primitives import circle_steps, plane_steps
from weldcal.calibration.geometry.robust import middle, solved
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner


@settings(deadline=None)  # the first call compiles
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60))
def test_the_middle_of_any_numbers_is_the_middle_of_their_order(numbers: list[float]) -> None:
    assert middle(np.array(numbers)) == sorted(numbers)[len(numbers) // 2]


def test_a_positive_matrix_is_solved_and_a_flat_one_is_told() -> None:
    rng = np.random.default_rng(0)
    J = rng.normal(size=(3, 9))
    N, g = J @ J.T, rng.normal(size=3)
    ok, x = solved(N, g, 3)
    assert ok
    np.testing.assert_allclose(x, np.linalg.solve(N, g), rtol=1e-9)
    ok, x = solved(N, g, 2)
    assert ok
    np.testing.assert_allclose(x, [*np.linalg.solve(N[:2, :2], g[:2]), 0.0], rtol=1e-9)
    assert not solved(J[:, :2] @ J[:, :2].T, g, 3)[0]


@pytest.mark.parametrize("outer", [True, False])
def test_the_border_is_as_likely_as_the_exact_formula_says(outer: bool) -> None:
    rng = np.random.default_rng(1)
    angle, rho = rng.uniform(0, 2 * np.pi, 700), rng.uniform(0.0296, 0.0304, 700)
    xy = np.array([rho * np.cos(angle), rho * np.sin(angle)], dtype=np.float32)
    on = (rho < 0.03) == outer
    on[:5] ^= True
    theta, width = np.array([2e-5, -1e-5, 0.03003]), 8e-5

    def exact(t: np.ndarray) -> float:
        side = np.where(on, -1.0, 1.0) * (1.0 if outer else -1.0)
        z = side * (np.hypot(xy[0] - t[0], xy[1] - t[1]) - t[2]) / width
        return float(np.log(WRONG + (1.0 - 2.0 * WRONG) * ndtr(z)).sum())

    value, gradient, information = border_likelihood(xy, on, outer, theta, width)
    steps = 1e-7 * np.eye(3)
    slope = np.array([(exact(theta + s) - exact(theta - s)) / 2e-7 for s in steps])
    assert value == pytest.approx(exact(theta), rel=2e-3)
    off = gradient - slope
    assert off @ np.linalg.solve(information, off) < 0.02**2, "a fiftieth of what the pixels leave open"


def test_one_stray_point_in_five_moves_neither_a_circle_nor_a_plane() -> None:
    rng = np.random.default_rng(2)
    angle = rng.uniform(0, 2 * np.pi, 300)
    rho = 0.03 + np.where(np.arange(300) % 5, 1e-5 * rng.normal(size=300), 2e-3)
    ok, circle, *_ = circle_steps(rho * np.cos(angle) - 1e-4, rho * np.sin(angle), 0.0305, 3, 1e-6, 1e-8)
    assert ok
    np.testing.assert_allclose(circle, [-1e-4, 0.0, 0.03], atol=5e-6)
    p = rng.uniform(-0.03, 0.03, (3, 900))
    p[2] = 0.001 + 0.1 * p[0] - 0.05 * p[1] + np.where(np.arange(900) % 5, 0.0, 3e-3)
    ok, plane, *_ = plane_steps(p, 1e-3)
    assert ok
    np.testing.assert_allclose(plane, [0.001, 0.1, -0.05], atol=1e-9)


def test_the_machine_code_is_kept_for_the_next_process() -> None:
    middle(np.array([1.0]))
    kept = Path(middle.stats.cache_path)  # type: ignore[attr-defined]
    assert list(kept.glob("robust.middle-*.nbc"))


def test_what_a_live_calibration_runs_is_compiled_before_it_runs() -> None:
    loops = (circle_steps, ring_points, plane_steps, borders, near_edge, border_likelihood)

    def compiled() -> list[int]:
        return [len(loop.signatures) for loop in loops]  # type: ignore[attr-defined]

    warm_up()
    ready = compiled()
    assert all(n > 0 for n in ready)
    standard = get_flange("iso9409-1-80-6-m8")
    X_CR = facing(np.array([0.0, 0.02, 0.8]), 0.2, 0.0, 0.0)
    scene = flange_frame(get_scanner("phoxi_m", 824), standard, np.random.default_rng(0), X_CR=X_CR).points_C
    found = fit_flange(scene, standard)
    fit_flange(scene, standard, guess=found)
    find_holes(scene, found, standard)
    fit_flange(scene[np.linalg.norm(scene - found.center_C, axis=2) < 0.6 * standard.outer_m], standard)
    assert compiled() == ready
