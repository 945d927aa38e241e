"""A square's corners by its whole sides: unbiased under blur, deaf to specks, and silent where a side cannot be
seen."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from weldcal.welding.finger.sides import sides_of_square

TRUE = np.array([[140.3, 92.8], [251.1, 101.4], [242.7, 213.9], [131.6, 204.2]])
CELLS, OVER = 6, 6


@lru_cache(maxsize=8)
def picture(blur_px: float) -> np.ndarray:
    """A black square with true corners on white, (300, 400) uint8, drawn fine and gathered by each pixel's area."""
    v, u = np.mgrid[0 : 300 * OVER, 0 : 400 * OVER]
    x, y = (u + 0.5) / OVER - 0.5, (v + 0.5) / OVER - 0.5  # pixel corners, not centres, are scaled
    inside = np.ones(x.shape, dtype=bool)
    for a, b in zip(TRUE, np.roll(TRUE, -1, axis=0), strict=True):
        inside &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0
    fine = np.where(inside, 20.0, 220.0).astype(np.float32)
    small = cv2.GaussianBlur(cv2.resize(fine, (400, 300), interpolation=cv2.INTER_AREA), (0, 0), blur_px)
    return np.asarray(np.round(small), dtype=np.uint8)


ROUGH = np.array([[1.0, -0.8], [-0.5, 0.9], [0.7, 0.6], [-1.0, -0.4]])


@pytest.mark.parametrize("blur_px", [0.4, 0.8, 1.2])
def test_blur_does_not_move_the_corners(blur_px: float) -> None:
    found = sides_of_square(picture(blur_px), TRUE + ROUGH, CELLS)
    assert found is not None
    # An edge sharper than a pixel says less about where in the pixel it lies.
    assert np.abs(found.corners - TRUE).max() < (0.025 if blur_px < 0.5 else 0.01)


def test_noise_is_averaged_over_the_sides() -> None:
    clean, rng = picture(0.7), np.random.default_rng(0)
    errors = []
    for _ in range(20):
        noisy = np.clip(np.round(clean + 2.0 * rng.standard_normal(clean.shape)), 0, 255).astype(np.uint8)
        found = sides_of_square(noisy, TRUE, CELLS)
        assert found is not None
        errors.append(found.corners - TRUE)
    # Two grey levels of 200 in a dozen samples of each of a hundred pixels along a side.
    assert np.std(errors, axis=0).max() < 0.02


def test_a_speck_on_a_side_does_not_count() -> None:
    clean = picture(0.7)
    dirty = clean.copy()
    cv2.circle(dirty, (195, 94), 4, 20, -1)
    found, wanted = sides_of_square(dirty, TRUE, CELLS), sides_of_square(clean, TRUE, CELLS)
    assert found is not None
    assert wanted is not None
    assert np.abs(found.corners - wanted.corners).max() < 0.06


@pytest.mark.parametrize("what", ["no contrast", "out of the picture", "collapsed"])
def test_where_a_side_cannot_be_seen_it_says_nothing(what: str) -> None:
    image, corners = picture(0.7), TRUE
    if what == "no contrast":
        image = image.copy()
        image[:150] = 128
    elif what == "out of the picture":
        corners = TRUE - np.array([130.0, 0.0])
    else:
        corners = np.repeat(TRUE[:1], 4, axis=0)
    assert sides_of_square(image, corners, CELLS) is None
