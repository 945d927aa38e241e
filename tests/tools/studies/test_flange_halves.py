"""What two parts of a cloud may differ by follows from how sharply its points end at the edges, and the fit comes near it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.flanges import get_flange
from weldcal.tools.studies.flange.halves import center_bound, edge_blur, study_parts

Array = NDArray[np.float64]
STANDARD = get_flange("tool-ring-63")


def _cloud(blur_m: float, seed: int, density: float = 6e6) -> Array:
    """Points strewn at random over the ring, half a metre away, that thin out over ``blur_m`` at both edges."""
    rng = np.random.default_rng(seed)
    side = 0.035
    xy = rng.uniform(-side, side, (int(density * 4.0 * side**2), 2))
    rho = np.hypot(xy[:, 0], xy[:, 1])
    keep = rng.random(len(xy)) < ndtr((STANDARD.face_outer_radius_m - rho) / blur_m) * ndtr(
        (rho - STANDARD.face_inner_radius_m) / blur_m
    )
    xy = xy[keep]
    return np.column_stack([xy, 0.5 + 3e-5 * rng.standard_normal(len(xy))])


@pytest.mark.parametrize("blur_mm", [0.06, 0.15])
def test_the_blur_of_an_edge_is_measured(blur_mm: float) -> None:
    points = _cloud(1e-3 * blur_mm, 0)
    fit = fit_flange(points, STANDARD)
    for outer in (True, False):
        blur, density = edge_blur(points, fit, outer=outer)
        # some 570 points per blur of 0.1 mm at the outer edge, half of it at the bore: a tenth or so each, at three sigma
        assert 1e3 * blur == pytest.approx(blur_mm, rel=0.35)
        assert density == pytest.approx(6e6, rel=0.1)


def test_parts_of_a_cloud_differ_by_little_more_than_they_must() -> None:
    rows = study_parts([_cloud(1e-4, k) for k in range(4)], STANDARD, draws=3)
    for row in rows[:2]:
        # no estimate beats the bound but by chance: chi-square with 24 degrees of freedom, 99.9 % on either side
        assert 0.55 * row.bound_mm < row.apart_mm < 1.46 * 1.3 * row.bound_mm
    assert rows[1].bound_mm == pytest.approx(np.sqrt(2.0) * rows[0].bound_mm, rel=1e-6)


def test_a_softer_edge_says_less_of_the_centre() -> None:
    bounds = []
    for blur in (5e-5, 2e-4):
        points = _cloud(blur, 3)
        bounds.append(center_bound(points, fit_flange(points, STANDARD), 2))
    # the root of the blurs' ratio of four, each known to a tenth or so
    assert bounds[1] / bounds[0] == pytest.approx(2.0, rel=0.25)
