"""A session of captures: wrong acts are named where they happen, good ones are kept, and a killed session goes on.

The scans are cast at the drawn arm of the demonstration; its scanner's true pose is not known to the session.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.figures.hand_eye.guidance import CAPTURES, at_random, error_m, looked_at
from tests.figures.hand_eye.sessions import cell_and_task
from tests.places import SHARED_DATA, require_data
from weldcal.calibration.capture.session import POSES_FILE, ArmPose, Capture, CaptureSession, jog, require_mounting
from weldcal.calibration.capture.tasks import BoardTask, FlangeTask, next_scan
from weldcal.calibration.data.clouds import read_cloud, save_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.recorded_flange import calibrate_flange
from weldcal.models.errors import InputError
from weldcal.tools.dashboard.capture_demo import ROBOT, DemoCell

FLANGE = "ISO 9409-1-50-4-M6"
MOVES = ("+x", "+ry", "+y", "-rx", "-z", "+rx", "-x", "-ry")


def session(folder: Path) -> CaptureSession:
    return CaptureSession(folder, FlangeTask(ROBOT, FLANGE))


def take(one: CaptureSession, cell: DemoCell, scratch: Path, pose: ArmPose | None = None) -> Capture:
    return one.take(cell.take(scratch), pose or cell.pose())


@pytest.fixture
def cell() -> DemoCell:
    return DemoCell(11)


@pytest.fixture
def begun(tmp_path: Path, cell: DemoCell) -> CaptureSession:
    """Three good captures."""
    one = session(tmp_path / "session")
    for move in MOVES[:3]:
        assert not take(one, cell, tmp_path).refused
        cell.jog(move, None)
    return one


def test_captures_that_follow_the_advice_give_the_scanner_inside_its_region(tmp_path: Path) -> None:
    """Eight cells: the error at the work point is that of 95 %, and the folder's command gives the same to the bit."""
    inside = 0
    for seed in range(8):
        cell, one = DemoCell(seed), session(tmp_path / f"s{seed}")
        for k in range(8):
            assert not take(one, cell, tmp_path).refused
            verdict = one.verdict()
            cell.jog("next" if verdict.advice is not None else MOVES[k], verdict.advice)
        assert verdict.X is not None
        assert verdict.error_95_m is not None
        work = np.mean([c.pose.X_BF.translation() for c in one.captures if c.pose.X_BF is not None], axis=0)
        error = np.linalg.norm(verdict.X @ cell.X_LC.inverse() @ work - work)
        inside += bool(error < verdict.error_95_m)
    assert inside >= 6
    assert (calibrate_flange(one.folder).result.X_BC.GetAsMatrix4() == verdict.X.GetAsMatrix4()).all()


def wrong_scan(cell: DemoCell, scratch: Path, change: str) -> Path:
    """A scan of the cell in which something is wrong."""
    path = cell.take(scratch)
    points = read_cloud(path)
    fit_at = np.nanmedian(points.reshape(-1, 3), axis=0)
    if change == "nothing there":
        points[...] = np.nan
    elif change == "cut off":
        near = np.nonzero(points[..., 2] < np.nanmin(points[..., 2]) + 0.03)[1]  # columns of the flange
        points[:, int(np.median(near)) :] = np.nan
    elif change == "another thing":
        points[np.isfinite(points[..., 2]), 2] = fit_at[2] + 0.2
    elif change == "scan in inches":
        points /= 0.0254
    save_cloud(path, points)
    return path


def rotated(X: RigidTransform, angle_deg: float) -> RigidTransform:
    return RigidTransform(X.rotation() @ RotationMatrix(RollPitchYaw(np.radians(angle_deg), 0.0, 0.0)), X.translation())


def test_wrong_acts_are_named_at_the_capture_where_they_happen(
    begun: CaptureSession, cell: DemoCell, tmp_path: Path
) -> None:
    now = cell.pose()
    assert now.X_BF is not None
    X = now.X_BF
    before = begun.captures[0].pose
    assert before.X_BF is not None
    moved = ArmPose(X_BF=X @ RigidTransform([0.0, 0.0, 0.002]))
    acts: list[tuple[Callable[[], Path], ArmPose, ArmPose | None, str]] = [
        (lambda: begun.captures[1].file, now, None, "same data as for 002"),
        (lambda: cell.take(tmp_path), before, None, "where it was in 001"),
        (lambda: cell.take(tmp_path), now, moved, "moved by 2.0 mm"),
        (lambda: cell.take(tmp_path), now, ArmPose(X_BF=rotated(X, 0.5), q=now.q), r"0.50 deg while"),
        (lambda: wrong_scan(cell, tmp_path, "nothing there"), now, None, "nothing was measured"),
        (lambda: wrong_scan(cell, tmp_path, "another thing"), now, None, "edge of the face"),
        (lambda: wrong_scan(cell, tmp_path, "cut off"), now, None, "flange|edge"),
        (
            lambda: cell.take(tmp_path),
            ArmPose(X_BF=RigidTransform(X.rotation(), 1e3 * X.translation()), q=now.q),
            None,
            "in its unit",
        ),
        (
            lambda: cell.take(tmp_path),
            ArmPose(X_BF=X @ RigidTransform([0.08, 0.0, 0.0]), q=now.q),
            None,
            "an older one",
        ),
        (
            lambda: cell.take(tmp_path),
            ArmPose(X_BF=RigidTransform(X.rotation(), -X.translation()), q=now.q),
            None,
            "at the robot",
        ),
    ]
    for k, (scan, pose, after, said) in enumerate(acts):
        refused = begun.take(scan(), pose, after).refused
        assert re.search(said, refused), (k, said, refused)
        assert len(begun.captures) == 3
    assert not take(begun, cell, tmp_path).refused, "what was refused leaves nothing behind"


def test_a_tcp_that_is_set_shows_by_turns(tmp_path: Path) -> None:
    """A pose with a TCP moves by its lever where the flange only turns."""
    cell, tcp = DemoCell(2), RigidTransform([0.0, 0.06, 0.15])
    one, said = session(tmp_path / "s"), ""
    for move in ("+rx", "-ry", "-rx"):
        X = cell.pose().X_BF
        assert X is not None
        said = said or take(one, cell, tmp_path, ArmPose(X_BF=X @ tcp)).refused
        cell.jog(move, None)
    assert "a TCP is set at the robot" in said


@pytest.mark.parametrize("numbers", [(1.0, 2.0, 3.0), (1.0,) * 8])
def test_numbers_that_are_no_pose_are_refused_before_any_work(
    tmp_path: Path, cell: DemoCell, numbers: tuple[float, ...]
) -> None:
    one = session(tmp_path / "s")
    with pytest.raises(InputError, match="A pose has 6 numbers"):
        take(one, cell, tmp_path, ArmPose(numbers=numbers))
    assert not one.captures


def test_another_form_of_pose_is_refused(begun: CaptureSession, cell: DemoCell, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give all in one form"):
        take(begun, cell, tmp_path, ArmPose(numbers=(400.0, 0.0, 300.0, 180.0, 0.0, 90.0)))


def test_typed_poses_in_millimetres_and_degrees_are_read_by_what_the_scans_show(tmp_path: Path, cell: DemoCell) -> None:
    """A Fanuc's W, P, R: fixed-axis roll, pitch and yaw in degrees, typed as they stand on its screen."""
    one = session(tmp_path / "s")
    for move in (*MOVES, "+z"):
        X = cell.pose().X_BF
        assert X is not None
        angles = np.degrees(RollPitchYaw(X.rotation()).vector())
        typed = tuple(np.round([*1e3 * X.translation(), *angles], 3).tolist())
        assert not take(one, cell, tmp_path, ArmPose(numbers=typed)).refused
        cell.jog(move, None)
    verdict = one.verdict()
    assert verdict.X is not None, verdict.said
    assert np.linalg.norm(verdict.X.translation() - cell.X_LC.translation()) < 5e-4


def test_the_result_in_use_is_judged_by_new_captures(tmp_path: Path, cell: DemoCell) -> None:
    """A right one by less than a tenth of a millimetre; after a knock of the scanner by about what it was."""
    one = session(tmp_path / "s" / "captures")
    for move in MOVES:
        assert not take(one, cell, tmp_path).refused
        cell.jog(move, None)
    one.task.save(one.folder)
    checked, error = one.check(cell.take(tmp_path), cell.pose())
    assert not checked.refused
    assert error < 1e-4
    assert (tmp_path / "s" / "calibration" / "calibration.yaml").is_file()
    cell.jog("+y", None)
    cell.X_LC = RigidTransform([0.003, 0.0, 0.0]) @ cell.X_LC
    assert one.check(cell.take(tmp_path), cell.pose())[1] == pytest.approx(3e-3, abs=2e-4)
    assert len(one.captures) == len(MOVES), "what judges is not what calibrates"


def test_a_session_of_another_kind_is_refused_and_left_as_it_is(begun: CaptureSession) -> None:
    before = sorted(p.name for p in begun.folder.rglob("*"))
    with pytest.raises(InputError, match="is a session of clouds, not of pictures"):
        CaptureSession(begun.folder, BoardTask(BOARD, "eye_in_hand"))
    assert sorted(p.name for p in begun.folder.rglob("*")) == before


def test_a_pose_whose_scan_was_refused_is_not_proposed_again(
    begun: CaptureSession, cell: DemoCell, tmp_path: Path
) -> None:
    assert not take(begun, cell, tmp_path).refused
    first = begun.verdict().advice
    assert first is not None
    assert first.X_BF is not None
    cell.jog("next", first)
    assert begun.take(wrong_scan(cell, tmp_path, "nothing there"), cell.pose()).refused
    second = begun.verdict().advice
    assert second is not None
    assert max(ArmPose(X_BF=first.X_BF).moved(ArmPose(X_BF=second.X_BF))) > 0.05


def test_a_capture_is_taken_back(begun: CaptureSession, cell: DemoCell, tmp_path: Path) -> None:
    begun.take_back("002")
    assert [c.id for c in begun.captures] == ["001", "003"]
    assert take(begun, cell, tmp_path).id == "004"
    again = session(begun.folder)
    assert [c.id for c in again.captures] == ["001", "003", "004"]
    with pytest.raises(InputError, match="There is no capture 002"):
        begun.take_back("002")


def _keep_on(folder: Path, scans: list[Path], poses: list[np.ndarray]) -> None:
    one = session(folder)
    for scan, M in list(zip(scans, poses, strict=True))[len(one.captures) :]:
        one.take(scan, ArmPose(X_BF=RigidTransform(M)))


def test_a_session_that_is_killed_loses_and_doubles_nothing(tmp_path: Path, cell: DemoCell) -> None:
    """At 100 moments over sessions of four captures; no file is without its row: the folder calibrates at any moment."""
    scans, poses = [], []
    for k, move in enumerate(MOVES[:4]):
        scans.append(cell.take(tmp_path).rename(tmp_path / f"scan{k}.npz"))
        X = cell.pose().X_BF
        assert X is not None
        poses.append(X.GetAsMatrix4())
        cell.jog(move, None)
    rng, kills, sessions, kept = np.random.default_rng(3), 0, 0, 0
    context = multiprocessing.get_context("fork")
    whole, began = context.Process(target=_keep_on, args=(tmp_path / "whole", scans, poses)), time.monotonic()
    whole.start()
    whole.join()
    longest = time.monotonic() - began  # of this machine, as busy as it is
    while kills < 100:
        folder = tmp_path / f"s{sessions}"
        process = context.Process(target=_keep_on, args=(folder, scans, poses))
        process.start()
        time.sleep(float(rng.uniform(0.02, longest)))
        if process.is_alive() and process.pid is not None:
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.join()
        rows = (folder / POSES_FILE).read_text().splitlines()[1:] if (folder / POSES_FILE).is_file() else []
        assert len(rows) >= kept, "a capture is lost"
        kept = len(rows)
        for k, row in enumerate(rows):
            id = row.split(",")[0]
            assert id == f"{k + 1:03d}"
            file = folder / "clouds" / f"{id}.npz"
            file = file if file.is_file() else file.with_name(f".{file.name}")
            np.testing.assert_array_equal(read_cloud(file), read_cloud(scans[k]))
        assert {p.stem for p in (folder / "clouds").glob("[0-9]*")} <= {row.split(",")[0] for row in rows}
        if kept == 4:
            assert len(session(folder).captures) == len(load_dataset(folder).clouds) == 4
            sessions, kept = sessions + 1, 0
    assert sessions


def test_the_odd_one_out_is_named(tmp_path: Path) -> None:
    """Real scans of an AUBO i5; one pose is 4 mm off, which no pair of captures shows by itself."""
    require_data(SHARED_DATA)
    data = load_dataset(SHARED_DATA / "flange" / "aubo_i5_phoxi_s")
    one = CaptureSession(tmp_path / "s" / "captures", FlangeTask("aubo_i5", data.header.flange))
    for k, id in enumerate(list(data.clouds)[:9]):
        X = data.poses[id]
        wrong = RigidTransform(X.rotation(), X.translation() + np.array([0.0, 0.004, 0.0]))
        assert not one.take(data.clouds[id], ArmPose(X_BF=wrong if k == 5 else X)).refused
    assert [id for id, _ in one.verdict().odd] == ["006"]


def test_the_advice_is_worth_more_than_poses_at_random() -> None:
    """By the rms error of a formula of the figure's own, with noise of scans and arm and an unknown centre."""
    for seed in range(3):
        rng, seen = np.random.default_rng(seed), []
        X_BC = RigidTransform(RollPitchYaw(np.pi, 0.1, seed), [0.5, 0.0, 1.2])
        for _ in range(3):
            seen.append(looked_at(X_BC, at_random(rng, 0.5), np.zeros(3), rng))
        while len(seen) < CAPTURES:
            advice = next_scan(seen, X_BC, RigidTransform(), "", ArmPose())
            assert advice is not None
            assert advice.X_BF is not None
            assert advice.sigma_after_m < advice.sigma_before_m
            seen.append(looked_at(X_BC, X_BC.inverse() @ advice.X_BF, np.zeros(3), rng))
        guided = error_m([X_BC.inverse() @ o.X_BR for o in seen], X_BC)
        others = [error_m([at_random(rng, 0.5) for _ in range(CAPTURES)], X_BC) for _ in range(200)]
        assert guided < 0.85 * float(np.median(others))


def test_a_jog_is_said_as_a_person_does_it() -> None:
    """The words, carried out by hand, lead to the goal."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        now = RigidTransform(RotationMatrix(RollPitchYaw(rng.uniform(-1.0, 1.0, 3))), rng.uniform(-0.5, 0.5, 3))
        shift, turns = rng.uniform(-0.3, 0.3, 3), rng.uniform(-1.2, 1.2, 3)
        R = RotationMatrix.MakeZRotation(turns[2]) @ RotationMatrix.MakeYRotation(turns[1])
        goal = RigidTransform(R @ RotationMatrix.MakeXRotation(turns[0]) @ now.rotation(), now.translation() + shift)
        words = jog(ArmPose(X_BF=now), goal)
        for value, axis in zip(1e3 * shift, "XYZ", strict=True):
            said = f"{abs(value):.0f} mm along the base's {'+' if value > 0 else '-'}{axis}"
            assert said in words or abs(value) < 2.5
        for value, axis in zip(np.degrees(turns), "XYZ", strict=True):
            assert f"{value:+.0f} deg about the base's {axis}" in words or abs(value) < 1.5
    assert jog(ArmPose(X_BF=now), now) == "Stay."


BOARD = "chessboard:9x6:20"


def board_picture(px: float, blur: float = 0.0, cut: float = 0.0, angle_deg: float = 20.0) -> np.ndarray:
    """A chessboard of 9 x 6 inner corners drawn with squares of so many px, turned, on grey."""
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((40, 40))).astype(np.uint8)
    sheet = np.pad(220 - 190 * squares, 60, constant_values=220)
    scale = px / 40.0
    M = cv2.getRotationMatrix2D((sheet.shape[1] / 2, sheet.shape[0] / 2), angle_deg, scale)
    M[:, 2] += np.array([640.0 + 1280.0 * cut, 480.0]) - np.array(sheet.shape[::-1]) / 2
    shown = cv2.warpAffine(sheet, M, (1280, 960), flags=cv2.INTER_AREA, borderValue=120)
    return cv2.GaussianBlur(shown, (0, 0), blur) if blur else np.asarray(shown)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (board_picture(60.0), ""),
        (board_picture(35.0, angle_deg=-40.0), ""),
        (board_picture(60.0, blur=6.0), "blurred|not in the picture"),
        (board_picture(60.0, blur=12.0), "blurred|not in the picture"),
        (board_picture(60.0, cut=0.35), "not in the picture"),
        (board_picture(6.0), "px apart|not in the picture"),
        (np.full((960, 1280), 120, np.uint8), "not in the picture"),
    ],
)
def test_a_picture_is_judged_at_once(tmp_path: Path, picture: np.ndarray, said: str) -> None:
    cv2.imwrite(str(tmp_path / "p.png"), picture)
    task = BoardTask(BOARD, "eye_in_hand")
    began = time.process_time()
    found, refused = task.look("001", tmp_path / "p.png", ArmPose())
    assert time.process_time() - began < 3.0
    assert bool(refused) == bool(said), refused
    assert re.search(said, refused)
    assert said or found is not None


def test_pictures_of_a_standing_board_while_the_arm_moves_are_refused(tmp_path: Path) -> None:
    """The camera's old picture, sent again with other noise."""
    rng = np.random.default_rng(1)
    task, one = BoardTask(BOARD, "eye_in_hand"), None
    s = CaptureSession(tmp_path / "s", task)
    for k in range(2):
        noisy = np.clip(board_picture(60.0) + rng.normal(0.0, 2.0, (960, 1280)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{k}.png"), noisy)
        one = s.take(tmp_path / f"{k}.png", ArmPose(X_BF=RigidTransform([0.1 * k, 0.0, 0.4])))
    assert one is not None
    assert "the picture is an older one" in one.refused
    assert replace(one, refused="").file.parent.name == "pictures"


def test_a_session_of_another_mounting_is_refused_and_left_as_it_is(begun: CaptureSession) -> None:
    before = (begun.folder / "dataset.yaml").read_text()
    with pytest.raises(InputError, match="a session of the mounting eye_on_base, not eye_in_hand: name another folder"):
        require_mounting(begun.folder, "eye_in_hand")
    loaded = cell_and_task("eye_in_hand", 1)[1]
    with pytest.raises(InputError, match="name another folder"):
        CaptureSession(begun.folder, loaded)
    assert (begun.folder / "dataset.yaml").read_text() == before


def test_the_next_scan_lies_whole_in_what_the_scanner_sees() -> None:
    """A scanner with a narrow view, and scans near its edge."""
    rng, X_BC = np.random.default_rng(2), RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.5, 0.0, 1.2])
    seen = [looked_at(X_BC, at_random(rng, 0.4), np.zeros(3), rng) for _ in range(4)]
    view = np.array([[-0.15, -0.2], [0.3, 0.2]])
    beyond = 0
    for k in range(12):
        part = seen[: 3 + k % 2]
        for limits in (view, None):
            advice = next_scan(part, X_BC, RigidTransform(), "", ArmPose(), (), limits)
            assert advice is not None
            assert advice.X_BF is not None
            p = X_BC.inverse() @ advice.X_BF.translation()
            inside = (p[:2] / p[2] > view[0] + 0.06 / p[2] - 1e-9).all() and (
                p[:2] / p[2] < view[1] - 0.06 / p[2]
            ).all()
            assert inside or limits is None
            beyond += not inside
        seen = [looked_at(X_BC, at_random(rng, 0.4), np.zeros(3), rng) for _ in range(4)]
    assert beyond, "without the limits some lie beyond"
