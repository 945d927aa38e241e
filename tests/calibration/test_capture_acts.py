"""Wrong acts at a capture, as the issues of other capture tools report them: each is named where it happens.

Scans are cast at the drawn arm; pictures come from a renderer that shares no code with the session.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

import tests.calibration.hand_eye.rendering as draw
from tests.calibration.hand_eye.test_pictures import BOARDS
from weldcal.calibration.capture.session import ArmPose, CaptureSession, CaptureVerdict
from weldcal.calibration.capture.tasks import BoardTask, FlangeTask
from weldcal.calibration.data.clouds import read_cloud, save_cloud
from weldcal.tools.dashboard.capture_demo import ROBOT, DemoCell

FLANGE, TEXT = "ISO 9409-1-50-4-M6", "chessboard:9x6:20"
SCANS = {
    "the flange is out of view": "nothing was measured",
    "half of the flange is beyond the edge of the picture": "whole",
    "a hand before the flange": "whole|edge of the face",
    "another thing before the scanner": "edge of the face|no flange|whole",
    "the sensor sends its last scan again": "the same data as for 003",
    "the arm was not moved": "where it was in 003",
    "the arm still moves": "moved by 2.0 mm",
    "the pose is that of the last capture": "where it was in 003",
    "the scan is that of the last pose, measured again": "an older one",
    "the pose is in millimetres": "in its unit",
    "a TCP of 150 mm is set": "a TCP is set at the robot",
    "the pose is that of the base in the flange": "at the robot",
}
"""Act -> what the sentence must name; reported for tf that lags, controllers in mm, TCPs, frozen and cropped clouds."""
PICTURES = {
    "no board": "not in the picture",
    "the board is cut off": "not in the picture",
    "the camera is out of focus": "blurred|not in the picture",
    "the board is far": "px apart|not in the picture",
    "the lamp is off": "dark",
    "the exposure is too long": "overexposed",
    "another board": "corners of a chessboard were found, not 9x6",
    "the resolution was changed": "pixels, those before",
    "the camera sends an old picture": "an older one",
}


def turned(X: RigidTransform, *rpy_deg: float) -> RigidTransform:
    return X @ RigidTransform(RollPitchYaw(np.radians(rpy_deg)), [0.0, 0.0, 0.0])


@pytest.mark.parametrize("act", SCANS)
def test_an_act_with_a_scanner(tmp_path: Path, act: str) -> None:
    cell, one = DemoCell(7), CaptureSession(tmp_path / "s", FlangeTask(ROBOT, FLANGE))
    for move in ("+x", "+ry", "+y"):
        last, old = cell.pose(), cell.take(tmp_path).rename(tmp_path / "old.npz")
        assert not one.take(old, last).refused
        cell.jog(move, None)
    cell.jog("-rx", None)
    now, after = cell.pose(), None
    assert now.X_BF is not None
    X, scan = now.X_BF, cell.take(tmp_path)
    points = read_cloud(scan)
    face = points[..., 2] < np.nanmin(points[..., 2]) + 0.04
    columns, rows = np.nonzero(face)[1], np.nonzero(face)[0]
    if act == "the flange is out of view":
        points[...] = np.nan
    elif act.startswith("half"):
        points = points[:, int(np.median(columns)) :]
    elif act.startswith("a hand"):
        points[int(np.percentile(rows, 35.0)) :, :, 2] = np.nanmin(points[..., 2]) - 0.1
    elif act.startswith("another thing"):
        points[np.isfinite(points[..., 2]), 2] = np.nanmedian(points[..., 2])
    elif act.startswith("the sensor"):
        scan = one.captures[-1].file
        points = read_cloud(scan)
    elif act.startswith(("the arm was", "the pose is that of the last")):
        now = last
    elif act.startswith("the arm still"):
        after = ArmPose(X_BF=X @ RigidTransform([0.0, 0.002, 0.0]))
    elif act.startswith("the scan is"):
        points = read_cloud(old) + np.random.default_rng(1).normal(0.0, 5e-5, points.shape)
    elif "millimetres" in act:
        now = ArmPose(X_BF=RigidTransform(X.rotation(), 1e3 * X.translation()), q=now.q)
    elif "TCP" in act:
        now = ArmPose(X_BF=X @ RigidTransform([0.06, 0.0, 0.15]), q=now.q)
    else:
        now = ArmPose(X_BF=X.inverse(), q=now.q)
    if not act.startswith("the sensor"):
        save_cloud(scan, points)
    refused = one.take(scan, now, after).refused
    assert re.search(SCANS[act], refused), refused
    assert len(one.captures) == 3


def with_board(tmp_path: Path, captures: int, seed: int = 8) -> tuple[CaptureSession, draw.World, np.random.Generator]:
    """A session with a camera in the hand, with so many good captures."""
    drawing, rng = BOARDS[TEXT], np.random.default_rng(seed)
    truth = draw.world(drawing, seed, 12)
    one = CaptureSession(tmp_path / "s", BoardTask(TEXT, "eye_in_hand"))
    for k in range(captures):
        cv2.imwrite(str(tmp_path / "shot.png"), draw.render(drawing, truth.camera[k], rng, sub=2))
        assert not one.take(tmp_path / "shot.png", ArmPose(X_BF=RigidTransform(truth.robot[k]))).refused
    return one, truth, rng


@pytest.mark.parametrize("act", PICTURES)
def test_an_act_with_a_camera(tmp_path: Path, act: str) -> None:
    one, truth, rng = with_board(tmp_path, 2)
    shown = draw.render(BOARDS[TEXT], truth.camera[2], rng, sub=2)
    if act == "no board":
        shown[...] = 120
    elif "cut off" in act:
        shown = np.roll(shown, shown.shape[1] // 2, axis=1)
    elif "focus" in act:
        shown = cv2.GaussianBlur(shown, (0, 0), 6.0)
    elif "far" in act:
        shown = np.pad(cv2.resize(shown, (80, 60), interpolation=cv2.INTER_AREA), ((210, 210), (280, 280)), mode="edge")
    elif "lamp" in act:
        shown = rng.poisson(2.0, shown.shape).astype(np.uint8)
    elif "exposure" in act:
        shown = np.clip(8.0 * shown + 220.0, 0, 255).astype(np.uint8)
    elif act == "another board":
        shown = draw.render(draw.draw_chessboard(7, 5, 20.0), truth.camera[2], rng, sub=2)
    elif "resolution" in act:
        shown = cv2.resize(shown, None, fx=1.5, fy=1.5)
    else:
        shown = draw.render(BOARDS[TEXT], truth.camera[0], rng, sub=2)
    cv2.imwrite(str(tmp_path / "shot.png"), shown)
    refused = one.take(tmp_path / "shot.png", ArmPose(X_BF=RigidTransform(truth.robot[2]))).refused
    assert re.search(PICTURES[act], refused), refused


def test_a_board_that_slips_is_named_at_the_capture(tmp_path: Path) -> None:
    """By 8 mm after eight captures: that capture, and no other, is the odd one out."""
    one, truth, rng = with_board(tmp_path, 8)
    before = one.verdict()
    assert not before.odd
    slipped = truth.camera[8] @ draw.se3([0.0, 0.0, 0.0], [0.008, 0.0, 0.0])
    cv2.imwrite(str(tmp_path / "shot.png"), draw.render(BOARDS[TEXT], slipped, rng, sub=2))
    one.take(tmp_path / "shot.png", ArmPose(X_BF=RigidTransform(truth.robot[8])))
    assert [id for id, _ in one.verdict().odd] == ["009"]


def test_a_scanner_that_is_knocked_is_named_at_the_capture(tmp_path: Path) -> None:
    cell, one = DemoCell(5), CaptureSession(tmp_path / "s", FlangeTask(ROBOT, FLANGE))
    for move in ("+x", "+ry", "+y", "-rx", "-z", "-ry"):
        assert not one.take(cell.take(tmp_path), cell.pose()).refused
        cell.jog(move, None)
    assert not one.verdict().odd
    cell.X_LC = RigidTransform([0.004, 0.0, 0.0]) @ cell.X_LC
    one.take(cell.take(tmp_path), cell.pose())
    assert [id for id, _ in one.verdict().odd] == ["007"]


@pytest.mark.parametrize(("turns", "words"), [(np.zeros((6, 3)), "turned by at most"), (np.eye(3)[[2] * 6], "axis")])
def test_motion_that_leaves_the_camera_open_is_named(tmp_path: Path, turns: np.ndarray, words: str) -> None:
    """The arm only shifts, or only turns about one axis: reported of every hand-eye tool."""
    drawing, rng = BOARDS[TEXT], np.random.default_rng(3)
    truth = draw.world(drawing, 3, 6)
    one, verdict = CaptureSession(tmp_path / "s", BoardTask(TEXT, "eye_in_hand")), CaptureVerdict(symbol="", said=())
    for k, axis in enumerate(turns):
        M = truth.robot[0] @ draw.se3(0.12 * k * axis, 0.02 * rng.uniform(-1.0, 1.0, 3))
        C = np.linalg.inv(M @ truth.X) @ truth.Y
        cv2.imwrite(str(tmp_path / "shot.png"), draw.render(drawing, C, rng, sub=2))
        one.take(tmp_path / "shot.png", ArmPose(X_BF=RigidTransform(M)))
        verdict = one.verdict()
    assert re.search(words, " ".join(verdict.said)), verdict.said
