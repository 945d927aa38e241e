"""Calibration from pictures of a board: every kind is found, bad pictures are named, and the stated region holds the
truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution
from typer.testing import CliRunner

from tests.calibration.hand_eye import rendering as draw
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.geometry.se3 import difference
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.hand_eye.pictures import search as picture_search
from weldcal.calibration.hand_eye.pictures.boards import Board, find_board, find_circles, parse_board, with_layout
from weldcal.calibration.hand_eye.pictures.search import picture_files
from weldcal.calibration.hand_eye.pictures.sets import read_pictures
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.tools.cli.app import app

BOARDS = {
    "chessboard:9x6:20": draw.draw_chessboard(9, 6, 20),
    "chessboard:7x5:20": draw.draw_chessboard(7, 5, 20),
    "charuco:8x6:20:15:5X5_100": draw.draw_charuco(8, 6, 20, 15, "5X5_100"),
    "charuco:7x6:20:15:4X4_50": draw.draw_charuco(7, 6, 20, 15, "4X4_50", old=True),
    "circles:7x5:20": draw.draw_circles(7, 5, 20),
    "circles:6x4:20": draw.draw_circles(6, 4, 20, inverse=True),
    "acircles:4x11:12": draw.draw_circles(4, 11, 12, asymmetric=True),
    "tag:7:60:APRILTAG_36h11": draw.draw_tags(1, 1, 60, 0, "APRILTAG_36h11", 7),
    "tags:4x3:30:10:4X4_50": draw.draw_tags(4, 3, 30, 10, "4X4_50"),
    "tags:4x3:30:9:APRILTAG_36h11": draw.draw_tags(4, 3, 30, 9, "APRILTAG_36h11", upward=True, border=2),
}


FOUND: dict[tuple[str, int], np.ndarray] = {}


def solve(folder: Path, board: str, *more: str, mounting: str = "eye_in_hand") -> tuple[int, dict]:
    out = folder.parent / f"out_{len(list(folder.parent.glob('out_*')))}"
    done = CliRunner().invoke(
        app,
        [
            "hand-eye",
            "ax-yb",
            str(folder),
            "--mounting",
            mounting,
            "--board",
            board,
            *more,
            "--json",
            "--out",
            str(out),
        ],
    )
    found = json.loads([line for line in done.stdout.splitlines() if line.startswith("{")][-1])
    return done.exit_code, found | {"out": out}


@pytest.fixture(scope="module")
def chess(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, draw.World]:
    """A folder 00.png ..., and the robot's poses in mm."""
    folder = tmp_path_factory.mktemp("chess") / "shots"
    drawing = BOARDS["chessboard:9x6:20"]
    found = draw.world(drawing, 5, 12)
    draw.write_pictures(folder, drawing, found, 5, sub=2)
    draw.write_robot(folder / "poses.txt", found.robot, mm=True)
    return folder, found


@pytest.fixture
def once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same picture is searched once in the whole module."""
    search = picture_search.find_board

    def remembered(grey: np.ndarray, board: Board) -> np.ndarray:
        key = (str(board), hash(grey.tobytes()))
        if key not in FOUND:
            FOUND[key] = search(grey, board)
        return FOUND[key]

    monkeypatch.setattr(picture_search, "find_board", remembered)


def quick(pairs: PosePairs) -> np.ndarray:
    """X of the poses alone."""
    config = HandEyeConfig(folds=0, usual_discord_rad=0.0)
    return np.asarray(solve_problem(full_problem(pairs.F, pairs.G), config=config).X.GetAsMatrix4())


def copied(folder: Path, to: Path, rename=lambda k: f"{k:02d}.png") -> list[Path]:
    """The pictures of a folder under other names."""
    made = []
    for k, path in enumerate(sorted(folder.glob("*.png"))):
        target = to / rename(k)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
        made.append(target)
    return made


@pytest.mark.parametrize("text", BOARDS)
def test_every_kind_of_board_is_found_where_it_was_drawn(text: str) -> None:
    drawing, board = BOARDS[text], parse_board(text)
    assert str(board) == text
    views = draw.world(drawing, 3, 2)
    images = [draw.render(drawing, C, np.random.default_rng(k), sub=2) for k, C in enumerate(views.camera)]
    board = with_layout(images, board)
    for picture, C in zip(images, views.camera, strict=True):
        truth = draw.project(np.c_[1e-3 * drawing.points, np.zeros(len(drawing.points))], C)
        found = find_board(picture, board)
        assert np.isfinite(found).all()
        error = min(float(np.linalg.norm(found[order] - truth, axis=1).max()) for order in board.symmetries)
        assert error < 0.6


@pytest.mark.parametrize("small", [False, True])
def test_a_large_picture_is_searched_in_a_small_one(small: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three times as large, or a part of the whole: corners of a tenth of a pixel, and no search that samples the
    picture up."""
    drawing, calls = BOARDS["chessboard:9x6:20"], []
    C = draw.world(drawing, 0, 1).camera[0]
    picture = draw.render(drawing, C, np.random.default_rng(0), sub=3)
    truth = draw.project(np.c_[1e-3 * drawing.points, np.zeros(len(drawing.points))], C)
    if small:
        whole = np.full((2048, 2448), 110, np.uint8)
        whole[900:1380, 300:940] = picture
        picture, truth = whole, truth + np.array([300.0, 900.0])
    else:
        picture = cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
        truth = 3.0 * (truth + 0.5) - 0.5
    search = cv2.findChessboardCornersSB

    def counted(grey: np.ndarray, size: tuple[int, int], flags: int) -> tuple[bool, np.ndarray]:
        calls.append((grey.shape[1], bool(flags & cv2.CALIB_CB_ACCURACY)))
        return search(grey, size, flags=flags)

    monkeypatch.setattr(cv2, "findChessboardCornersSB", counted)
    found = find_board(picture, parse_board("chessboard:9x6:20"))
    assert np.sqrt(((found - truth) ** 2).mean()) < (0.03 if small else 0.15)
    assert calls[0] == (700, False)
    assert not any(up for _, up in calls)


@pytest.mark.parametrize("text", ["circles:7x5:20", "circles:6x4:20", "acircles:4x11:12"])
def test_centroids_of_circles_become_their_centres(text: str) -> None:
    """The pictures of the drawn circles' centres, by the lens equation, are met five times better than by the
    centroids."""
    drawing, board = BOARDS[text], parse_board(text)
    C = draw.world(drawing, 1, 1).camera[0]
    found, radius = find_circles(draw.render(drawing, C, np.random.default_rng(0), sub=5), board)
    assert found is not None
    truth = draw.project(np.c_[1e-3 * drawing.points, np.zeros(len(drawing.points))], C)
    off = found[min(board.symmetries, key=lambda order: float(np.abs(found[order] - truth).max()))] - truth
    left = off - picture_search.offsets(replace(board, radius=radius), C, draw.K, draw.DIST)
    assert radius == pytest.approx((0.45 if board.kind == "acircles" else 0.25) * board.size, rel=0.01)
    assert np.sqrt((left**2).mean()) < 0.2 * np.sqrt((off**2).mean())


def test_sides_that_the_lens_bends_meet_where_they_were_drawn() -> None:
    """The tags of a picture are shifted away from its middle by bent sides; with the offsets taken off they are not."""
    text = "tags:4x3:30:10:4X4_50"
    drawing, board = BOARDS[text], parse_board(text)
    before, after = [], []
    for seed in range(3):
        C = draw.world(drawing, seed, 1).camera[0]
        truth = draw.project(np.c_[1e-3 * drawing.points, np.zeros(len(drawing.points))], C)
        off = find_board(draw.render(drawing, C, np.random.default_rng(seed), sub=5), board) - truth
        away = truth - draw.K[:2, 2]
        for to, one in ((before, off), (after, off - picture_search.offsets(board, C, draw.K, draw.DIST))):
            to.append((one * away).sum() / (away**2).sum())
    assert np.mean(before) > 1.2e-4
    assert abs(np.mean(after)) < 0.3e-4


@pytest.mark.parametrize("text", ["circles:7x5:20", "tags:4x3:30:10:4X4_50"])
def test_a_camera_is_estimated_from_points_with_offsets(text: str) -> None:
    """Exact points with their offsets added: the camera and the pictures of the points are found as they are without
    offsets."""
    board = replace(parse_board(text), radius=0.009 if text[0] == "c" else 0.0)
    views = draw.world(BOARDS[text], 4, 12).camera
    points = [draw.project(board.points, C) for C in views]
    measured = [p + picture_search.offsets(board, C, draw.K, draw.DIST) for p, C in zip(points, views, strict=True)]
    pictures = [picture_search.Picture(name="", points=p, size=draw.SIZE, thumbnail=b"") for p in measured]
    K, _, _, corrected = picture_search.estimate_camera(pictures, board, draw.SIZE, None, False)
    assert np.abs(K - draw.K).max() < 0.02
    assert max(float(np.abs(p.points - q).max()) for p, q in zip(corrected, points, strict=True)) < 1e-3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("chess:9x6:25", "names no kind of board"),
        ("chessboard:9x6", "chessboard:COLSxROWS:SQUARE with lengths in mm, such as chessboard:9x6:25"),
        ("chessboard:9by6:25", "COLSxROWS"),
        ("charuco:8x6:20:25:5X5_100", "must be smaller than the squares"),
        ("charuco:8x6:20:15:5X5", "There is no dictionary of markers '5X5'"),
        ("charuco:12x12:20:15:4X4_50", "has 50 markers, and 72 are needed"),
        ("tag:7:-3:4X4_50", "tag:ID:SIZE:DICT"),
    ],
)  # fmt: skip
def test_a_string_that_describes_no_board_is_refused_with_an_example(text: str, words: str) -> None:
    with pytest.raises(DatasetError, match=words.replace("(", r"\(")):
        parse_board(text)


def test_pictures_and_poses_give_camera_and_hand_eye_pose(chess: tuple[Path, draw.World]) -> None:
    folder, truth = chess
    code, found = solve(folder, "chessboard:9x6:20")
    assert code == 0
    X = np.array(found["X"])
    e = difference(X, truth.X)
    assert float(e @ np.linalg.solve(np.array(found["covariance_X"]), e)) < 6.0 * f_distribution.ppf(0.999, 6, 30)
    assert float(np.linalg.norm(e[3:])) < 1.5e-3
    assert np.abs(np.array(found["camera_matrix"]) - draw.K).max() < 4.0
    assert found["reprojection_px"] < 0.2
    assert found["robot_sigma_mm"] == pytest.approx(0.1, rel=0.5)
    assert [p["used"] for p in found["pictures"]] == [True] * 12
    assert (found["out"] / "report.html").read_text().count("data:image/jpeg;base64,") == 12


def test_a_stated_camera_is_used_as_it_is(chess: tuple[Path, draw.World], tmp_path: Path) -> None:
    folder, truth = chess
    (tmp_path / "ost.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [620, 0, 322, 0, 623, 236,"
        " 0, 0, 1]\ndistortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [-0.12, 0.06,"
        " 0.0008, -0.0006, 0]}\n"
    )
    for option in ("--camera",):
        code, found = solve(folder, "chessboard:9x6:20", option, str(tmp_path / "ost.yaml"))
        assert code == 0
        assert found["camera_matrix"] == draw.K.tolist()
        assert not found["camera_estimated"]
        assert float(np.linalg.norm(np.array(found["X"])[:3, 3] - truth.X[:3, 3])) < 1e-3


def test_the_group_alone_means_ax_yb(chess: tuple[Path, draw.World], tmp_path: Path) -> None:
    arguments = [
        str(chess[0]),
        "--mounting",
        "eye_in_hand",
        "--board",
        "chessboard:9x6:20",
        "--json",
        "--out",
        str(tmp_path / "o"),
    ]
    done = CliRunner().invoke(app, ["hand-eye", *arguments])
    assert done.exit_code == 0
    assert '"Y"' in done.stdout


def test_three_bad_pictures_are_named_and_left_out(chess: tuple[Path, draw.World], tmp_path: Path) -> None:
    folder, truth = chess
    shots = tmp_path / "shots"
    files = copied(folder, shots)
    robot = truth.robot.copy()
    robot[7, :3, 3] += [0.02, -0.01, 0.03]
    robot[7, :3, :3] = Rotation.from_rotvec([0.1, 0.0, -0.05]).as_matrix() @ robot[7, :3, :3]
    draw.write_robot(shots / "poses.txt", robot)
    cv2.imwrite(str(files[2]), np.full((480, 640), 90, np.uint8))
    files[4].write_bytes(b"no picture")
    code, found = solve(shots, "chessboard:9x6:20")
    assert code == 0
    unused = {p["file"]: p["why_not"] for p in found["pictures"] if not p["used"]}
    assert set(unused) == {"02.png", "04.png", "07.png"}
    assert "not found" in unused["02.png"]
    assert "cannot be read" in unused["04.png"]
    assert "disagree" in unused["07.png"]
    assert any(all(name in w for name in unused) for w in found["warnings"])
    assert float(np.linalg.norm(np.array(found["X"])[:3, 3] - truth.X[:3, 3])) < 1.5e-3


@pytest.mark.parametrize(
    ("board", "words"),
    [
        ("chessboard:8x6:20", "9x6 inner corners of a chessboard were found, not 8x6"),
        ("chessboard:10x7:20", "9x6 inner corners of a chessboard were found, not 10x7"),
        ("charuco:8x6:20:15:5X5_100", "9x6 inner corners of a chessboard were found"),
    ],
)
def test_a_wrong_board_is_refused_with_what_was_found(chess: tuple[Path, draw.World], board: str, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        read_pictures(chess[0], parse_board(board), mounting="eye_in_hand")


def test_a_wrong_size_of_squares_is_named_with_the_right_one(chess: tuple[Path, draw.World], once: None) -> None:
    with pytest.raises(InconsistentPoses, match=r"a size of (19\.9|20)\S* mm in place of 25 mm"):
        read_pictures(chess[0], parse_board("chessboard:9x6:25"), mounting="eye_in_hand")


def test_the_wrong_mounting_is_refused_with_both_options(chess: tuple[Path, draw.World], once: None) -> None:
    with pytest.raises(
        InconsistentPoses, match=r"--mounting eye_in_hand\), or the robot poses are inverted \(--as robot-form"
    ):
        read_pictures(chess[0], parse_board("chessboard:9x6:20"), mounting="eye_on_base")


def euler_table(robot: np.ndarray) -> np.ndarray:
    return np.c_[Rotation.from_matrix(robot[:, :3, :3]).as_euler("xyz", degrees=True), 1e3 * robot[:, :3, 3]]


def layout_counted_from_one(shots: Path, to: Path, robot: np.ndarray) -> int:
    """N.png and line N of poses.txt; two pictures were thrown away."""
    for k in (3, 6):
        copied(shots, to, lambda j: f"{j + 1}.png")[k].unlink()
    (to / "4.png").unlink()
    draw.write_robot(to / "poses.txt", robot)
    return 10


def layout_one_file_each(shots: Path, to: Path, robot: np.ndarray) -> int:
    """pos0.png beside pos0.txt with angles first, in degrees and mm."""
    copied(shots, to, lambda j: f"pos{j}.png")
    for k, row in enumerate(euler_table(robot)):
        (to / f"pos{k}.txt").write_text(" ".join(f"{v:.5f}" for v in row) + "\n")
    return 12


def layout_folders_of_npz(shots: Path, to: Path, robot: np.ndarray) -> int:
    """RGBImgs/color_image001.png, T_base2ee/T_Base2EE_001.npz (the base in the hand), and pictures of detected
    corners."""
    copied(shots, to, lambda j: f"RGBImgs/color_image{j + 1:03d}.png")
    copied(shots, to, lambda j: f"DetectedCorners/DetectedCorners{j + 1}.png")
    (to / "T_base2ee").mkdir()
    for k, B in enumerate(robot):
        np.savez(to / "T_base2ee" / f"T_Base2EE_{k + 1:03d}.npz", np.linalg.inv(B))
    return 12


def layout_pose_files_and_camera_xml(shots: Path, to: Path, robot: np.ndarray) -> int:
    """image-1.png, pose_fPe_1.yaml with six numbers, camera.xml with px, py, u0, v0."""
    copied(shots, to, lambda j: f"image-{j + 1}.png")
    for k, B in enumerate(robot):
        six = np.r_[B[:3, 3], Rotation.from_matrix(B[:3, :3]).as_rotvec()]
        lines = "\n".join(f"  - [{v:.8f}]" for v in six)
        (to / f"pose_fPe_{k + 1}.yaml").write_text(f"rows: 6\ncols: 1\ndata:\n{lines}\n")
    return 12


def layout_images_and_npy(shots: Path, to: Path, robot: np.ndarray) -> int:
    """images/0001.png and poses.npy (n, 4, 4)."""
    copied(shots, to, lambda j: f"images/{j + 1:04d}.png")
    np.save(to / "poses.npy", robot)
    return 12


def layout_images_and_yaml_poses(shots: Path, to: Path, robot: np.ndarray) -> int:
    """images/0.png, poses/0.yaml with x ... qw, and a list of both."""
    copied(shots, to, lambda j: f"images/{j}.png")
    (to / "poses").mkdir()
    rows = []
    for k, B in enumerate(robot):
        q = Rotation.from_matrix(B[:3, :3]).as_quat()
        names = ("x", "y", "z", "qx", "qy", "qz", "qw")
        (to / "poses" / f"{k}.yaml").write_text(
            "".join(f"{n}: {v:.9f}\n" for n, v in zip(names, [*B[:3, 3], *q], strict=True))
        )
        rows.append(f"  - image: images/{k}.png\n    pose: poses/{k}.yaml\n")
    (to / "data.yaml").write_text("data:\n" + "".join(rows))
    return 12


def layout_nested_csv(shots: Path, to: Path, robot: np.ndarray) -> int:
    """calib_images/img_00.png and robot/poses_xyzrxryrz.csv with a header, degrees and mm."""
    copied(shots, to, lambda j: f"calib_images/img_{j:02d}.png")
    (to / "robot").mkdir()
    e = euler_table(robot)
    text = "x,y,z,rx,ry,rz\n" + "".join(",".join(f"{v:.5f}" for v in [*r[3:], *r[:3]]) + "\n" for r in e)
    (to / "robot" / "poses_xyzrxryrz.csv").write_text(text)
    return 12


def layout_depth_beside_colour(shots: Path, to: Path, robot: np.ndarray) -> int:
    """pos00.bmp with a depth image pos00.tiff, poses in a JSON list."""
    for path in copied(shots, to, lambda j: f"pos{j:02d}.bmp"):
        cv2.imwrite(str(path.with_suffix(".tiff")), np.full((480, 640), 700, np.uint16))
    (to / "robot_poses.json").write_text(json.dumps({"poses": robot.tolist()}))
    return 12


def layout_timestamps(shots: Path, to: Path, robot: np.ndarray) -> int:
    """rgb/1700000000.10.png ... in order of time, and TUM lines."""
    copied(shots, to, lambda j: f"rgb/17000000{j:02d}.50.png")
    q = Rotation.from_matrix(robot[:, :3, :3]).as_quat()
    np.savetxt(to / "robot.tum", np.c_[1.7e9 + np.arange(len(robot)), robot[:, :3, 3], q], fmt="%.8f")
    return 12


def layout_kalibr_camera(shots: Path, to: Path, robot: np.ndarray) -> int:
    """img0.png, poses.csv and a camchain of Kalibr."""
    copied(shots, to, lambda j: f"img{j}.png")
    draw.write_robot(to / "poses.csv", robot)
    (to / "camchain.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [620.0, 623.0, 322.0, 236.0]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [-0.12, 0.06, 0.0008, -0.0006]\n  resolution: [640, 480]\n  rostopic: /cam0/image_raw\n"
    )
    return 12


LAYOUTS = [one for name, one in list(globals().items()) if name.startswith("layout_")]


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda one: one.__name__.removeprefix("layout_"))
def test_folders_as_people_have_them_are_read(
    layout, chess: tuple[Path, draw.World], tmp_path: Path, once: None
) -> None:
    shots, truth = chess
    folder = tmp_path / "data"
    folder.mkdir()
    n = layout(shots, folder, truth.robot)
    data = read_pictures(folder, parse_board("chessboard:9x6:20"), mounting="eye_in_hand")
    assert len(data.pairs.robot) == n
    assert (data.camera == "camchain.yaml") == (layout is layout_kalibr_camera)
    X = quick(data.pairs)
    assert float(np.linalg.norm(X[:3, 3] - truth.X[:3, 3])) < 2e-3


def test_pictures_one_row_late_are_shifted(chess: tuple[Path, draw.World], tmp_path: Path, once: None) -> None:
    folder, truth = chess
    copied(folder, tmp_path / "shots")
    draw.write_robot(
        tmp_path / "shots" / "poses.txt",
        np.r_[truth.robot[:1] @ draw.se3([0.3, 0.1, 0.2], [0.1, 0, 0]), truth.robot[:-1]],
    )
    data = read_pictures(tmp_path / "shots", parse_board("chessboard:9x6:20"), mounting="eye_in_hand")
    assert any("were shifted" in note for note in data.pairs.notes)
    assert float(np.linalg.norm(quick(data.pairs)[:3, 3] - truth.X[:3, 3])) < 2e-3


def test_a_symmetric_board_that_is_seen_upside_down_is_turned_back(tmp_path: Path) -> None:
    text = "chessboard:7x5:20"
    drawing = BOARDS[text]
    found = draw.world(drawing, 2, 10)
    centre = 1e-3 * drawing.points.mean(axis=0)
    for k in (1, 4, 5, 8):  # the camera turned by half a turn about the board's middle
        middle = draw.se3([0.0, 0.0, np.pi], [2 * centre[0], 2 * centre[1], 0.0])
        found.camera[k] = found.camera[k] @ middle
        found.robot[k] = found.Y @ np.linalg.inv(found.X @ found.camera[k])
    draw.write_pictures(tmp_path / "shots", drawing, found, 2, sub=2)
    draw.write_robot(tmp_path / "shots" / "robot.csv", found.robot)
    data = read_pictures(tmp_path / "shots", parse_board(text), mounting="eye_in_hand")
    assert len(data.rows) == 10
    assert float(np.linalg.norm(quick(data.pairs)[:3, 3] - found.X[:3, 3])) < 2e-3


def test_several_kinds_of_pictures_are_refused_until_one_is_named(
    chess: tuple[Path, draw.World], tmp_path: Path
) -> None:
    copied(chess[0], tmp_path, lambda j: f"cam_a/{j}.png")
    copied(chess[0], tmp_path, lambda j: f"cam_b/{j}.png")
    with pytest.raises(DatasetError, match=r"several kinds of pictures.*--camera-poses"):
        picture_files(tmp_path)
    assert len(picture_files(tmp_path, "cam_a")) == 12


def test_a_folder_without_robot_poses_says_what_to_add(chess: tuple[Path, draw.World], tmp_path: Path) -> None:
    copied(chess[0], tmp_path / "shots")
    with pytest.raises(DatasetError, match=r"holds pictures and no robot poses: add robot\.csv"):
        read_pictures(
            tmp_path / "shots", parse_board("chessboard:9x6:20"), mounting="eye_in_hand", stated=StatedForms()
        )


def test_a_folder_without_pictures_is_named_where_it_is_given_as_a_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DatasetError, match=f"'{tmp_path.name}' holds no pictures .*: name the folder that holds them"):
        picture_files(Path("."))
