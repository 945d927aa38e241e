"""The finger is calibrated from pictures drawn ray by ray through a lens with distortion, with a tag that is not as
large as it says."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from typer.testing import CliRunner

from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.models.errors import InputError
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.finger_file import read_finger_file
from weldcal.systems.drivers.sensors.video_finger_camera import VideoFingerCamera
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell.board import CharucoBoard, described_sheet, write_board
from weldcal.welding.finger.calibration import calibrate_tip
from weldcal.welding.finger.deformation import TagLimits, TagModel, detect_tag, tag_cells

SIZE = (400, 300)
K = np.array([[443.7, 0.0, 203.9], [0.0, 446.2, 144.6], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.11, 0.06, 8e-4, -6e-4])
BOARD = CharucoBoard()
TRUE_TAG_M = 0.00963
TOOL = WeldingTool()
SEAT = np.array([0.0, 0.0, 1.2e-4])
STIFFNESS = np.array([600.0, 600.0, 300.0])


@cache
def rays(samples: int = 3) -> np.ndarray:
    """Rays (H, W, samples^2, 3) through the pixels, by inverting the lens."""
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    grid = np.stack([u[..., None] + np.tile(offsets, samples), v[..., None] + np.repeat(offsets, samples)], axis=-1)
    flat = cv2.undistortPointsIter(
        grid.reshape(-1, 1, 2).astype(np.float64), K, DISTORTION, None, None, (cv2.TERM_CRITERIA_COUNT, 60, 0.0)
    )
    shaped = flat.reshape(*grid.shape)
    return np.concatenate([shaped, np.ones((*grid.shape[:-1], 1))], axis=-1)


def drawn(texture: np.ndarray, pixels_per_m: float, X_KP: RigidTransform, number: int) -> np.ndarray:
    """What the camera sees of a plane's print; `texture` has its first pixel's corner at the plane's origin, x right, y
    down."""
    R, p = X_KP.rotation().matrix(), X_KP.translation()
    t = (R[:, 2] @ p) / (rays() @ R[:, 2])
    on = (rays() * t[..., None] - p) @ R
    column, row = (np.floor(on[..., k] * pixels_per_m).astype(int) for k in (0, 1))
    inside = (column >= 0) & (row >= 0) & (column < texture.shape[1]) & (row < texture.shape[0])
    grey = np.where(inside, texture[np.where(inside, row, 0), np.where(inside, column, 0)], 215).mean(axis=2)
    noisy = grey * 0.8 + 25.0 + np.random.default_rng(number).normal(0.0, 1.5, grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen pictures of the board, one of which shows nothing, and the board's description."""
    folder, described = tmp_path_factory.mktemp("finger"), parse_board("charuco:8x6:4:3:4X4_50")
    write_board(folder, described_sheet(described, "A5"), described)
    scale = 40  # pixels of the print per mm
    square = int(BOARD.square_mm * scale)
    texture = BOARD.opencv().generateImage((BOARD.columns * square, BOARD.rows * square), marginSize=0, borderBits=1)
    middle = 1e-3 * np.array([BOARD.columns, BOARD.rows, 0]) * BOARD.square_mm / 2.0
    rng = np.random.default_rng(4)
    (folder / "board").mkdir()
    for k in range(16):
        turn = RollPitchYaw(rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(-0.3, 0.3)).ToRotationMatrix()
        centre = np.array([rng.uniform(-0.004, 0.004), rng.uniform(-0.003, 0.003), rng.uniform(0.038, 0.055)])
        cv2.imwrite(
            str(folder / "board" / f"{k:02d}.png"),
            drawn(texture, 1e3 * scale, RigidTransform(turn, centre - turn @ middle), k),
        )
    cv2.imwrite(str(folder / "board" / "99.png"), np.full(SIZE[::-1], 120, np.uint8))
    return folder


@pytest.fixture(scope="module")
def touches(pictures: Path) -> Path:
    """Pictures of the tag, whose print is 4 % too small, at rest and pressed; the seat is 0.12 mm off."""
    cells = tag_cells(TagModel(TOOL.tag_dictionary, TOOL.tag_id, TRUE_TAG_M)).astype(np.uint8) * 255
    print_ = cv2.copyMakeBorder(
        np.kron(cells, np.ones((60, 60), np.uint8)), 90, 90, 90, 90, cv2.BORDER_CONSTANT, value=255
    )
    per_m = cells.shape[0] * 60 / TRUE_TAG_M
    half = 0.5 * len(print_) / per_m
    pressed = [(0, 0, 0.5), (0, 0, 1.5), (0, 0, 3), (1, 0, 2), (-1, 0, 2), (0, 1.5, 2.5), (0, -1.5, 2.5), (0.5, 0.5, 1)]
    rows = ["picture,x_mm,y_mm,z_mm,fx_N,fy_N,fz_N"]
    R_TK = TOOL.X_FT.rotation().inverse() @ TOOL.X_FK.rotation()
    for k, push in enumerate([None, *pressed]):
        moved = np.zeros(3) if push is None else 1e-3 * np.array(push) + SEAT
        p_KM = TOOL.X_KM_rest.translation() + R_TK.inverse() @ moved
        X_KP = RigidTransform(p_KM - np.array([half, half, 0.0]))  # the print's corner, x right, y down
        cv2.imwrite(str(pictures / f"touch{k}.png"), drawn(print_, per_m, X_KP, 100 + k))
        cells_ = (
            ["", "", "", "", "", ""] if push is None else [*map(str, push), *(f"{v:.4f}" for v in STIFFNESS * moved)]
        )
        rows.append(",".join([f"touch{k}.png", *cells_]))
    (pictures / "touches.csv").write_text("\n".join(rows) + "\n")
    return pictures / "touches.csv"


@pytest.fixture(scope="module")
def done(pictures: Path, touches: Path) -> dict[str, object]:
    words = ["finger", "calibrate", str(pictures / "board"), "--board", str(pictures / "board.yaml")]
    words += ["--touches", str(touches), "--out", str(pictures / "out"), "--json"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    found: dict[str, object] = json.loads(result.stdout.splitlines()[-1])
    return found


def test_the_camera_is_the_one_that_took_the_pictures(done: dict[str, dict[str, float]]) -> None:
    camera = done["camera"]
    found = np.array([camera[key] for key in ("fx", "fy", "cx", "cy")])
    # 16 pictures of 35 corners at some 0.1 px: focal length and principal point to a fraction of a percent
    assert np.abs(found - [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]).max() < 2.0
    assert camera["rms_px"] < 0.2
    assert camera["held_out_px"] < 0.25
    assert (camera["pictures"], camera["held_out_pictures"]) == (16, 4)
    assert done["without_board"] == ["99.png"]


def test_the_tag_the_seat_and_the_stiffness_are_found(done: dict[str, dict[str, object]]) -> None:
    tag, tip = done["tag"], done["tip"]
    assert tag["size_mm"] == pytest.approx(1e3 * TRUE_TAG_M, abs=0.05)
    assert tip["seat_mm"][2] == pytest.approx(1e3 * SEAT[2], abs=0.05)  # type: ignore[index]
    assert tip["held_out_mm"] < 0.05  # type: ignore[operator]
    stiffness = tip["stiffness_N_per_mm"]
    assert [stiffness[axis] for axis in "xyz"] == pytest.approx([0.6, 0.6, 0.3], rel=0.02)  # type: ignore[index]
    assert tip["unknown"] == []


def test_a_scenario_that_names_the_file_sees_a_pinhole_and_the_true_tag(done: object, pictures: Path) -> None:
    path = pictures / "out" / "finger.yaml"
    config = VideoFingerCamera(width=SIZE[0], height=SIZE[1], source="x.avi", calibration=str(path))
    found = read_finger_file(path)
    rectified = found.rectifier()(cv2.imread(str(pictures / "touch3.png"), cv2.IMREAD_GRAYSCALE))
    tag_size = config.tag_size_m()
    assert tag_size is not None
    tag = TagModel(TOOL.tag_dictionary, TOOL.tag_id, tag_size)
    seen = detect_tag(rectified, config.camera().camera_matrix, tag)
    assert seen.X_KM is not None
    R_TK = TOOL.X_FT.rotation().inverse() @ TOOL.X_FK.rotation()
    expected = TOOL.X_KM_rest.translation() + R_TK.inverse() @ (np.array([0.0, 0.0, 3e-3]) + SEAT)
    # 0.5 % of the distance of 40 mm, as the focal length is known, and laterally by the principal point
    assert np.abs(seen.X_KM.translation() - expected).max() < 2.5e-4
    raw = detect_tag(
        cv2.imread(str(pictures / "touch3.png"), cv2.IMREAD_GRAYSCALE),
        VideoFingerCamera(width=SIZE[0], height=SIZE[1]).camera().camera_matrix,
        tag,
        TagLimits(lateral_m=1.0, depth_m=1.0),  # the raw picture would be refused
    )
    assert raw.X_KM is not None
    assert np.abs(raw.X_KM.translation() - expected).max() > 3e-4  # without the file it is further off


def test_the_station_takes_the_tags_size_from_the_file(done: object, pictures: Path) -> None:
    scenario = load_scenario("s_groove", "job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95]}}")
    scenario.finger_camera = _Named(
        width=SIZE[0], height=SIZE[1], source="x.avi", calibration=str(pictures / "out" / "finger.yaml")
    )
    station = make_station(scenario, 0)
    assert station.tool is not None
    assert station.tool.tag_size_m == pytest.approx(TRUE_TAG_M, abs=5e-5)
    station.close()


class _Named(VideoFingerCamera):
    """A camera that is not opened."""


def test_pictures_of_another_size_than_the_files_are_refused(done: object, pictures: Path) -> None:
    config = VideoFingerCamera(width=640, height=480, source="x.avi", calibration=str(pictures / "out" / "finger.yaml"))
    with pytest.raises(InputError, match="was made with pictures of 400 x 300, and finger_camera has 640 x 480"):
        config.camera()


def test_what_is_no_calibration_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("schema: 1\ncamera: {fx: 400}\n")
    with pytest.raises(InputError, match="is no finger calibration: make one with weldcal finger calibrate"):
        read_finger_file(tmp_path / "a.yaml")
    result = CliRunner().invoke(app, ["finger", "calibrate", str(tmp_path), "--board", str(tmp_path / "a.yaml")])
    assert result.exit_code == 1


def pressed_along_z(scale: float = 0.97) -> tuple[np.ndarray, np.ndarray]:
    pressed = np.array([[0.0, 0.0, d] for d in (0.5e-3, 1e-3, 2e-3, 3e-3, 4e-3)])
    noise = np.random.default_rng(0).normal(0.0, 5e-6, pressed.shape)
    return pressed, scale * pressed + np.array([0.0, 0.0, 1e-4]) + noise


def test_touches_in_one_direction_say_what_they_leave_open() -> None:
    found = calibrate_tip(*pressed_along_z())
    assert found.scale == pytest.approx(0.97, abs=0.01)
    assert found.rotation_deg is None
    assert np.isnan(found.seat_m[:2]).all()
    assert found.seat_m[2] == pytest.approx(1e-4, abs=2e-5)
    assert len(found.unknown) == 2


def test_touches_that_say_nothing_are_refused() -> None:
    pressed, shown = pressed_along_z()
    with pytest.raises(InputError, match="3 touches can be used, and 4 are needed"):
        calibrate_tip(pressed[:3], shown[:3])
    with pytest.raises(InputError, match="differ by less than half a millimetre"):
        calibrate_tip(0.1 * pressed, 0.1 * shown)
    with pytest.raises(InputError, match="the tip slipped, the plate yielded"):
        calibrate_tip(pressed, 0.5 * shown)
