"""Pictures of a board captured one by one, in both mountings, by a renderer that shares no code with the session."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform

import tests.calibration.hand_eye.rendering as draw
from tests.calibration.hand_eye.test_pictures import BOARDS
from weldcal.calibration.capture.session import ArmPose, CaptureSession
from weldcal.calibration.capture.tasks import BoardTask
from weldcal.calibration.recorded_hand_eye import HandEyeOptions, calibrate_recorded

TEXT = "chessboard:9x6:20"


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_on_base"])
def test_the_camera_s_pose_and_what_to_do_next_after_each_picture(tmp_path: Path, mounting: str) -> None:
    drawing, rng = BOARDS[TEXT], np.random.default_rng(8)
    truth = draw.world(drawing, 8, 11, eye_in_hand=mounting == "eye_in_hand")
    one = CaptureSession(tmp_path / "s", BoardTask(TEXT, mounting))
    seen = []
    for C, M in list(zip(truth.camera, truth.robot, strict=True))[:9]:
        cv2.imwrite(str(tmp_path / "shot.png"), draw.render(drawing, C, rng, sub=2))
        X = RigidTransform(M)
        assert not one.take(tmp_path / "shot.png", ArmPose(X_BF=X)).refused
        seen.append(one.verdict())
    assert all(v.X is None and v.said for v in seen[:2])
    last = seen[-1]
    assert last.X is not None, last.said
    assert last.symbol == ("X_FC" if mounting == "eye_in_hand" else "X_BC")
    assert last.error_95_m is not None
    assert last.advice is not None
    assert last.advice.sigma_after_m < last.advice.sigma_before_m
    assert np.linalg.norm(last.X.translation() - truth.X[:3, 3]) < 2e-3
    asked = HandEyeOptions(board=TEXT, mounting=mounting, corners=None)
    again = calibrate_recorded(one.folder, asked).result.X
    assert again.IsNearlyEqualTo(last.X, 1e-12), "as hand-eye gives it; OpenCV's threads add in another order"
    one.task.save(one.folder)
    for C, M in list(zip(truth.camera, truth.robot, strict=True))[9:]:
        cv2.imwrite(str(tmp_path / "shot.png"), draw.render(drawing, C, rng, sub=2))
        checked, error = one.check(tmp_path / "shot.png", ArmPose(X_BF=RigidTransform(M)))
        assert not checked.refused
        assert error < 1.5e-3
    resumed = CaptureSession(one.folder, BoardTask(TEXT, mounting))
    assert len(resumed.captures) == 9
    X_again = resumed.verdict().X
    assert X_again is not None
    assert X_again.IsNearlyEqualTo(last.X, 1e-12)
