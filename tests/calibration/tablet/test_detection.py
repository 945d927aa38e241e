"""Rings and dots are found in a camera's picture of the page, in the page's order, and what is not there is said."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.calibration.tablet.image import grid, picture, project
from weldcal.calibration.errors import LandmarksNotFound
from weldcal.calibration.tablet.detection import find_landmarks
from weldcal.calibration.tablet.plane_pose import plane_depth, tablet_points, tablet_pose

K = np.array([[617.7, 0.0, 316.5], [0.0, 617.7, 242.3], [0.0, 0.0, 1.0]])
PAGE = grid(3, 3, 0.06, 0.038)
MIDDLE = np.array([0.06, 0.038, 0.0])


def above(roll: float, pitch: float, yaw: float, distance: float, x: float = 0.0, y: float = 0.0) -> RigidTransform:
    """X_CT of a tablet whose middle lies before the camera, turned by degrees."""
    R = RollPitchYaw(*np.radians([roll, pitch, yaw])).ToRotationMatrix()
    return RigidTransform(R, np.array([x, y, distance]) - R.multiply(MIDDLE))


@pytest.mark.parametrize("yaw", [0.0, 35.0, 120.0, 180.0, -100.0])
def test_rings_are_found_in_the_pages_order_however_it_is_turned(yaw: float) -> None:
    X_CT = above(6.0, -8.0, yaw, 0.30)
    found = find_landmarks(picture(X_CT, PAGE, K, seed=int(yaw) + 360), 3, 3)
    # noise 2 of 200 grey levels over some 50 pixels of outline leaves 0.01 px; the centroid's own offset is 0.02 here
    np.testing.assert_allclose(found, project(X_CT, PAGE, K), atol=0.08)


@pytest.mark.parametrize(("tilt", "blur", "noise"), [(0.0, 0.5, 1.0), (30.0, 1.5, 4.0), (-30.0, 1.8, 6.0)])
def test_tilt_blur_and_noise_cost_little(tilt: float, blur: float, noise: float) -> None:
    X_CT = above(0.4 * tilt, tilt, 10.0, 0.32)
    found = find_landmarks(picture(X_CT, PAGE, K, blur_px=blur, noise=noise), 3, 3)
    off = np.linalg.norm(found - project(X_CT, PAGE, K), axis=1)
    assert off.max() < 0.25


def test_single_pixels_are_found() -> None:
    """The paper's target: dots of one pixel, 0.19 mm, from 170 mm."""
    X_CT = above(0.8, -0.6, 2.0, 0.172)
    found = find_landmarks(picture(X_CT, PAGE, K, look="dots", noise=1.5), 3, 3, "dots")
    # a dot covers 0.47 square pixels and darkens 90 grey levels in all: 1.5 of noise over 30 pixels moves it by 0.15
    np.testing.assert_allclose(found, project(X_CT, PAGE, K), atol=0.3)


def test_a_grid_of_four_columns_is_told_from_one_of_three() -> None:
    wide = grid(4, 3, 0.045, 0.038)
    X_CT = above(5.0, 5.0, -20.0, 0.33)
    image = picture(X_CT, wide, K)
    np.testing.assert_allclose(find_landmarks(image, 4, 3), project(X_CT, wide, K), atol=0.08)
    with pytest.raises(LandmarksNotFound):
        find_landmarks(image, 3, 5)


def test_what_is_not_there_is_said() -> None:
    blank = np.full((480, 640), 200, dtype=np.uint8)
    with pytest.raises(LandmarksNotFound, match="0 of 9 landmarks"):
        find_landmarks(blank, 3, 3)
    with pytest.raises(LandmarksNotFound, match="0 of 9 landmarks"):
        find_landmarks(blank, 3, 3, "dots")
    X_CT = above(0.0, 0.0, 0.0, 0.30)
    image = picture(X_CT, PAGE, K)
    u, v = project(X_CT, PAGE, K)[4].astype(int)
    image[v - 15 : v + 15, u - 15 : u + 15] = 200  # one ring hidden
    with pytest.raises(LandmarksNotFound, match="8 of 9"):
        find_landmarks(image, 3, 3)


def test_a_picture_out_of_focus_is_refused_rather_than_guessed() -> None:
    X_CT = above(-14.0, -35.0, 10.0, 0.32)
    with pytest.raises(LandmarksNotFound, match="focus the camera"):
        find_landmarks(picture(X_CT, PAGE, K, blur_px=3.0), 3, 3)


def test_a_ring_of_something_else_is_left_out() -> None:
    X_CT = above(4.0, 3.0, 15.0, 0.30)
    image = picture(X_CT, PAGE, K)
    cv2.circle(image, (60, 430), 8, 10, 3, cv2.LINE_AA)
    np.testing.assert_allclose(find_landmarks(image, 3, 3), project(X_CT, PAGE, K), atol=0.08)


def test_what_was_seen_is_where_it_lies_on_the_tablet() -> None:
    X_CT = above(9.0, -7.0, 25.0, 0.28)
    rays = (find_landmarks(picture(X_CT, PAGE, K), 3, 3) - K[:2, 2]) / 617.7
    found = tablet_pose(rays, PAGE)
    assert 1e3 * np.abs(tablet_points(found, rays) - PAGE).max() < 0.06
    assert np.degrees((found.inverse() @ X_CT).rotation().ToAngleAxis().angle()) < 0.2


def test_the_plane_knows_the_depth_better_than_a_pixel() -> None:
    X_CT = above(3.0, -4.0, 5.0, 0.172)
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:480, :640].astype(float)
    rays = np.c_[(u.ravel() - K[0, 2]) / 617.7, (v.ravel() - K[1, 2]) / 617.7, np.ones(u.size)]
    n = X_CT.rotation().matrix()[:, 2]
    true = ((n @ X_CT.translation()) / (rays @ n)).reshape(480, 640)
    depth = true + rng.normal(0.0, 0.8e-3, true.shape)
    depth[rng.random(true.shape) < 0.3] = 0.0  # glass swallows the pattern
    depth[rng.random(true.shape) < 0.1] += 0.05  # and mirrors it
    uv = project(X_CT, PAGE, K)
    found = plane_depth(depth, uv, np.array([617.7, 617.7]), K[:2, 2])
    p = X_CT.multiply(np.c_[PAGE, np.zeros(9)].T)[2]
    # 0.8 mm over some 50 000 pixels: microns; a pixel alone is 0.8 mm off
    assert np.abs(found - p).max() < 0.03e-3
    with pytest.raises(LandmarksNotFound, match="have a depth"):
        plane_depth(np.zeros((480, 640)), uv, np.array([617.7, 617.7]), K[:2, 2])
