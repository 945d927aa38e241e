"""A registration names the errors that the surface before it could not show."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.calibration.flange.face import face_points
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.algorithm1 import (
    COMPONENTS,
    CentreVerification,
    icp_error,
    information,
    make_verification,
    sigmas,
    surface_normals,
    unobservable_components,
)
from weldcal.models.flanges import flange_mesh, get_flange

STANDARD = get_flange("iso9409-1-50-4-m6")
X_BC = RigidTransform(RollPitchYaw(3.0, 0.2, 0.7), [-0.6, -0.3, 1.1])
X_CR = RigidTransform(RollPitchYaw(3.1, 0.1, 0.4), [0.02, -0.03, 0.6])


def scanned(chamfers: bool) -> np.ndarray:
    """Points in R of the face, with or without what a scanner sees of its chamfers."""
    if not chamfers:
        return np.asarray(face_points(STANDARD, 0.0006))
    points, normals = flange_mesh(STANDARD).sample(40_000, np.random.default_rng(0))
    return np.asarray(points[(normals[:, 2] > 0.2) & (points[:, 2] > -0.001)])


def test_normals_are_those_of_face_and_chamfers() -> None:
    middle = np.array([[0.024, 0.0, 1e-5], [0.031, 0.0, -0.0005], [0.0, 0.01625, -0.0005]])
    normals = surface_normals(middle, STANDARD)
    half = np.sqrt(0.5)
    assert np.allclose(normals, [[0, 0, 1], [half, 0, half], [0, -half, half]], atol=1e-9)


def test_a_face_without_chamfers_hides_its_plane_and_its_turn() -> None:
    points = scanned(False)
    matrix = information(points, surface_normals(points, STANDARD))
    assert unobservable_components(matrix) == COMPONENTS[2:5]
    assert np.isinf(sigmas(matrix, 1e-4)[2:5]).all()
    # along the normal N points of 0.1 mm average to 0.1 mm over the root of N
    assert sigmas(matrix, 1e-4)[5] == pytest.approx(1e-4 / np.sqrt(len(points)), rel=1e-3)


def test_chamfers_show_the_plane_but_never_the_turn() -> None:
    points = scanned(True)
    matrix = information(points, surface_normals(points, STANDARD))
    assert unobservable_components(matrix) == ("rotation about the flange axis",)


@pytest.mark.parametrize("chamfers", [True, False])
def test_the_registration_gives_no_number_for_what_it_cannot_see(chamfers: bool) -> None:
    points = scanned(chamfers)
    noisy = points + 3e-5 * np.random.default_rng(1).standard_normal(points.shape)
    v = make_verification((X_CR @ noisy.T).T, X_BC @ X_CR, STANDARD, method="point_to_plane", seed=1)
    turned = v.X_BR @ RigidTransform(RollPitchYaw(0, 0, 0.05), [0, 0, 4e-4]) @ v.X_BR.inverse() @ X_BC
    error = icp_error(turned, v)
    named = {name: value for name, value, _seen in error.components}
    assert "rotation about the flange axis" in error.unobservable
    assert ("in the flange plane, x" in error.unobservable) is not chamfers
    assert np.isnan(named["rotation about the flange axis"])
    assert error.value[2] == 0.0
    assert named["along the flange normal"] == pytest.approx(4e-4, abs=2e-5)
    assert error.X_CpC is not None
    # Eq. (21) with it moves what was seen and leaves the turn alone, which nothing measured
    again = icp_error(turned @ error.X_CpC, v)
    assert abs(again.value[5]) < 1e-5


def test_a_pair_without_a_cloud_is_blind_to_rotations() -> None:
    error = CentreVerification(Observation("v", X_BC @ X_CR, X_CR.translation()))(X_BC)
    assert error.unobservable == COMPONENTS[:3]
