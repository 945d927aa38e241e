"""The tag behind the tip gives the tip's displacement, or says why it cannot."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.welding.finger.deformation import TagError, TagLimits, TagModel, deflection_from_tag, detect_tag, tag_cells

TAG = TagModel("4X4_50", 7, 0.010)
K = np.array([[450.0, 0.0, 319.5], [0.0, 450.0, 239.5], [0.0, 0.0, 1.0]])
_OVER = 4  # supersampling of the synthetic image
_CELL = 24  # pixels a cell in the drawn print


def picture(X_KM: RigidTransform, tag: TagModel = TAG) -> np.ndarray:
    """A (480, 640) grey image of the tag on white, drawn from its cells alone."""
    cells = tag_cells(tag)
    n = len(cells)
    sheet = np.full((n + 4, n + 4), 255, dtype=np.uint8)
    sheet[2:-2, 2:-2] = np.where(cells, 255, 0)
    sheet = np.kron(sheet, np.ones((_CELL, _CELL), dtype=np.uint8))
    side = tag.size_m / n
    # Print pixel (u, v), centre of the first at (0, 0), to metres in M.
    a = side / _CELL
    h = 0.5 * (n + 4) * _CELL - 0.5
    to_plane = np.array([[a, 0.0, -a * h], [0.0, -a, a * h], [0.0, 0.0, 1.0]])
    R, p = X_KM.rotation().matrix(), X_KM.translation()
    fine = np.array([[_OVER, 0.0, 0.5 * (_OVER - 1)], [0.0, _OVER, 0.5 * (_OVER - 1)], [0.0, 0.0, 1.0]])
    H = fine @ K @ np.column_stack([R[:, 0], R[:, 1], p]) @ to_plane
    big = cv2.warpPerspective(sheet, H, (640 * _OVER, 480 * _OVER), flags=cv2.INTER_AREA, borderValue=255)
    return cv2.resize(big, (640, 480), interpolation=cv2.INTER_AREA)


def facing(x: float, y: float, z: float, roll: float = 0.1, pitch: float = -0.08, yaw: float = 0.2) -> RigidTransform:
    """A tag that looks at the camera, nearly."""
    turn = RotationMatrix(RollPitchYaw(np.pi, 0.0, 0.0)) @ RotationMatrix(RollPitchYaw(roll, pitch, yaw))
    return RigidTransform(turn, [x, y, z])


def test_the_print_is_a_black_frame_about_the_dictionarys_bits() -> None:
    cells = tag_cells(TAG)
    assert cells.shape == (6, 6)
    assert not cells[[0, -1]].any()
    assert not cells[:, [0, -1]].any()
    assert 0 < cells.sum() < 16
    assert any(not np.array_equal(cells, tag_cells(TagModel("4X4_50", i))) for i in range(6))


def test_displacement_is_seen_to_hundredths_of_a_millimetre() -> None:
    rest = facing(0.0, 0.0, 0.040)
    seen_rest = detect_tag(picture(rest), K, TAG)
    assert seen_rest.valid
    assert seen_rest.X_KM is not None
    errors = []
    for dx, dy, dz in ((2e-3, 0.0, 0.0), (0.0, -2e-3, 0.0), (1e-3, 1.5e-3, -3e-3), (-2.3e-3, 0.7e-3, 1e-3)):
        seen = detect_tag(picture(facing(dx, dy, 0.040 + dz)), K, TAG)
        assert seen.valid
        assert seen.X_KM is not None
        errors.append(deflection_from_tag(seen.X_KM, seen_rest.X_KM, RotationMatrix()) - [dx, dy, dz])
    # Sides are found to a hundredth or two of a pixel: 2 um across at 450 px and 40 mm, and 40/10 times that in depth.
    assert np.abs(np.array(errors)[:, :2]).max() < 0.003e-3
    assert np.abs(np.array(errors)[:, 2]).max() < 0.015e-3


def test_the_pose_is_that_of_the_print_and_not_of_its_mirror() -> None:
    X_KM = facing(1e-3, -2e-3, 0.040, 0.35, -0.3, 0.6)
    seen = detect_tag(picture(X_KM), K, TAG)
    assert seen.X_KM is not None
    turn = (seen.X_KM.rotation().inverse() @ X_KM.rotation()).ToAngleAxis().angle()
    assert np.degrees(turn) < 2.0


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_images_say_the_same_as_grey_ones(channels: int) -> None:
    grey = picture(facing(0.0, 0.0, 0.040))
    colour = np.repeat(grey[:, :, None], channels, axis=2)
    a, b = detect_tag(grey, K, TAG), detect_tag(colour, K, TAG)
    assert a.X_KM is not None
    assert b.X_KM is not None
    np.testing.assert_allclose(a.X_KM.translation(), b.X_KM.translation(), atol=1e-6)


def test_a_tag_that_is_not_there_is_not_seen() -> None:
    blank = np.full((480, 640), 200, dtype=np.uint8)
    assert not detect_tag(blank, K, TAG).valid
    other = picture(facing(0.0, 0.0, 0.040), TagModel("4X4_50", 3))
    seen = detect_tag(other, K, TAG)
    assert not seen.valid
    assert "not visible" in seen.reason


def test_the_same_tag_twice_is_ambiguous() -> None:
    one = picture(facing(-0.012, 0.0, 0.050))
    two = picture(facing(0.012, 0.0, 0.050))
    seen = detect_tag(np.minimum(one, two), K, TAG)
    assert not seen.valid
    assert "unique" in seen.reason


def test_a_pose_out_of_range_or_far_from_the_corners_is_refused() -> None:
    image = picture(facing(0.0, 0.0, 0.040))
    assert "range" in detect_tag(image, K, TAG, TagLimits(far_m=0.030)).reason
    skewed = np.array([[450.0, 0.0, 319.5], [0.0, 900.0, 239.5], [0.0, 0.0, 1.0]])
    seen = detect_tag(image, skewed, TAG)
    assert not seen.valid
    assert seen.reprojection_px > 1.0


def test_deflection_is_turned_into_the_tip_frame() -> None:
    rest, now = RigidTransform([0.0, 0.0, 0.04]), RigidTransform([0.001, 0.002, 0.043])
    R_TK = RotationMatrix(RollPitchYaw(np.pi, 0.0, 0.0))  # the camera looks down from above the tip
    np.testing.assert_allclose(deflection_from_tag(now, rest, R_TK), [0.001, -0.002, -0.003], atol=1e-12)


def test_what_is_no_tag_image_or_camera_is_named() -> None:
    with pytest.raises(TagError, match="dictionary"):
        TagModel("QR", 0, 0.01)
    with pytest.raises(TagError, match="id"):
        TagModel("4X4_50", 50, 0.01)
    with pytest.raises(TagError, match="positive"):
        TagModel("4X4_50", 0, 0.0)
    with pytest.raises(TagError, match="image"):
        detect_tag(np.zeros((4, 4)), K, TAG)  # type: ignore[arg-type]
    with pytest.raises(TagError, match="camera matrix"):
        detect_tag(np.zeros((48, 64), dtype=np.uint8), np.eye(2), TAG)
