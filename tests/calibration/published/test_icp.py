"""What Algorithm 1's registration sees of a known error, and that a failure is never a success."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.calibration.flange.face import face_points
from weldcal.calibration.flange.fit import face_cloud
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.published.algorithm1 import (
    CentreVerification,
    Verification,
    icp_error,
    make_verification,
    sight,
)
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange

STANDARD = get_flange("iso9409-1-50-4-m6")
X_BC = RigidTransform(RollPitchYaw(3.0, 0.2, 0.7), [-0.6, -0.3, 1.1])
X_CR = RigidTransform(RollPitchYaw(3.1, 0.1, 0.4), [0.02, -0.03, 0.6])
X_BR = X_BC @ X_CR


@pytest.fixture(scope="module")
def verification() -> Verification:
    rng = np.random.default_rng(0)
    face = face_points(STANDARD, 0.0008)
    face = face + np.column_stack([0.0 * face[:, :2], 5e-5 * rng.standard_normal(len(face))])
    return make_verification((X_CR @ face.T).T, X_BR, STANDARD, seed=1)


def displaced(component: int, size: float) -> RigidTransform:
    d = np.zeros(6)
    d[component] = size
    return X_BR @ RigidTransform(RotationMatrix(exp_rotation(d[:3])), d[3:]) @ X_BR.inverse() @ X_BC


def test_a_true_calibration_has_a_figure_near_zero(verification: Verification) -> None:
    error = icp_error(X_BC, verification)
    assert error.found
    # face points against a surface that also has chamfers: the figure is biased by less than 0.1 mm
    assert np.linalg.norm(error.value[3:]) < 1e-4


def test_an_error_along_the_normal_is_seen_in_full_with_its_sign(verification: Verification) -> None:
    base = icp_error(X_BC, verification).value[5]
    seen = icp_error(displaced(5, 5e-4), verification).value[5] - base
    assert seen == pytest.approx(5e-4, rel=0.1)


def test_rotation_about_the_flange_axis_and_shifts_in_its_plane_are_hardly_seen(verification: Verification) -> None:
    share = sight(X_BC, verification)
    assert abs(share.share[2]) < 0.3
    assert abs(share.share[5] - 1.0) < 0.1
    assert (share.share[:2] > 0.6).all()
    assert "rotation about the flange axis" in share.unseen
    assert "along the flange normal" not in share.unseen


def test_no_match_is_infinite_and_never_the_identity(verification: Verification) -> None:
    error = icp_error(displaced(5, 0.3), verification)
    assert not error.found
    assert np.isinf(error.value).all()
    assert error.X_CpC is None


def test_correcting_by_the_error_removes_it(verification: Verification) -> None:
    wrong = displaced(5, 4e-4)
    error = icp_error(wrong, verification)
    assert error.X_CpC is not None
    again = icp_error(wrong @ error.X_CpC, verification)
    assert abs(again.value[5]) < 0.1 * 4e-4


def test_point_to_plane_sees_the_normal_too(verification: Verification) -> None:
    plane = replace(verification, method="point_to_plane")
    seen = icp_error(displaced(5, 5e-4), plane).value[5] - icp_error(X_BC, plane).value[5]
    assert seen == pytest.approx(5e-4, rel=0.05)


def test_a_pair_without_a_cloud_gives_its_centre_error_only() -> None:
    o = Observation("v", X_BR, X_CR.translation() + X_CR.rotation().matrix()[:, 2] * 2e-4)
    error = CentreVerification(o)(X_BC)
    assert np.allclose(error.value, [0, 0, 0, 0, 0, 2e-4], atol=1e-12)


def test_an_empty_verification_cloud_is_refused() -> None:
    with pytest.raises(InputError, match="at least 100 valid points"):
        make_verification(np.full((500, 3), np.nan), X_BR, STANDARD)


def test_the_face_is_what_lies_within_its_rim_and_chamfers() -> None:
    """Each point alone, by its height over the face and its distance from the axis; missing points are no face."""
    rng = np.random.default_rng(4)
    standard = get_flange("iso9409-1-50-4-m6")
    X = RigidTransform(RollPitchYaw(2.9, 0.2, 0.4), [0.05, -0.02, 0.6])
    local = rng.uniform(-1.0, 1.0, (20_000, 3)) * [0.05, 0.05, 0.006]
    inside = np.hypot(local[:, 0], local[:, 1]) < 0.5 * standard.outer_m + 0.001
    inside &= (local[:, 2] < 0.001) & (local[:, 2] > -2.0 * standard.chamfer_m)
    cloud = (local @ X.rotation().matrix().T + X.translation()).reshape(100, 200, 3)
    cloud[::9] = np.nan
    inside = inside.reshape(100, 200) & np.isfinite(cloud[..., 0])
    fit = SimpleNamespace(center_C=X.translation(), normal_C=X.rotation().matrix()[:, 2])
    assert np.array_equal(face_cloud(cloud, fit, standard), cloud[inside])  # type: ignore[arg-type]
