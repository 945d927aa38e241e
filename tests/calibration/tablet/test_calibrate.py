"""weldcal tablet calibrate: from an npz, or from the page's CSV with robot poses and a picture, to a result others can
read."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.tablet.visit import MM_PER_PX, P_FP, X_FC, csv_options, rows_of, run, write, write_visit
from tests.worlds.tablet import published_touches
from weldcal.calibration.errors import TabletDataError
from weldcal.calibration.tablet.planar_files import load_planar
from weldcal.calibration.tablet.result import load_tablet_result
from weldcal.calibration.tablet.wrist.diagnostics import wrist_diagnostics
from weldcal.calibration.tablet.wrist.files import WristVisit, load_visit
from weldcal.calibration.tablet.wrist.fit import fit_wrist
from weldcal.models.errors import InputError


@pytest.fixture
def npz(tmp_path: Path) -> Path:
    """The paper's touches in the documented layout."""
    t = published_touches()
    np.savez(
        tmp_path / "touches.npz", uv=t.uv_px, depth=1e3 * t.depth_m, hand=1e3 * t.hand_m, theta_deg=np.degrees(t.theta_rad),
        delta_px=t.delta_px, tablet_px=t.landmark_px, mm_per_px=1e3 * t.pitch_m, f=617.7, c=t.centre_px,
        hand_capture=1e3 * t.hand_capture_m,
    )  # fmt: skip
    return tmp_path / "touches.npz"


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_visit(tmp_path_factory.mktemp("visit"))


def test_an_npz_is_calibrated_and_its_size_questioned(npz: Path, tmp_path: Path) -> None:
    code, said, output = run(npz, "--out", tmp_path / "out", "--two-stages")
    assert code == 0, output
    assert said["model"] == "closed_form"
    assert said["leave_one_out_mm"] <= 0.46 < said["leave_one_out_of_other_models_mm"]["pnp"]
    assert (said["F1"], said["F2"]) == (pytest.approx(1.277, abs=0.0015), pytest.approx(0.5915, abs=0.0015))
    assert "-0.9 % in length" in said["warnings"][0]
    read = load_tablet_result(tmp_path / "out")
    assert read.parameters == said["parameters"]
    assert json.loads((tmp_path / "out" / "tablet.json").read_text())["parameters"] == said["parameters"]
    assert not (tmp_path / "out" / "ur_pose.script").exists()


def test_a_picture_touches_and_poses_give_camera_and_pen(visit: Path, tmp_path: Path) -> None:
    code, said, output = run(*csv_options(visit), "--image", visit / "picture.png", "--out", tmp_path / "out")
    assert code == 0, output
    found = RigidTransform(np.array(said["X_FC"]))
    # one picture with 0.05 px of noise in nine points some 100 mm apart at 300 mm: its tilt to 0.1 deg, that is 0.6 mm
    assert np.linalg.norm(found.translation() - X_FC.translation()) < 1.2e-3
    assert np.degrees((found.inverse() @ X_FC).rotation().ToAngleAxis().angle()) < 0.25
    np.testing.assert_allclose(said["p_FP_mm"], 1e3 * P_FP, atol=0.3)
    assert said["leave_one_out_mm"] < 0.2
    assert said["unobservable"] == said["warnings"] == []
    read = load_tablet_result(tmp_path / "out" / "tablet.yaml")
    assert read.X_FC is not None
    assert read.X_FC.IsNearlyEqualTo(found, 1e-12)
    assert (tmp_path / "out" / "ur_pose.script").read_text().startswith("p[0.0")
    assert "camera_optical_frame" in (tmp_path / "out" / "camera.urdf.xacro").read_text()
    assert set(read.data_sha256) == {"touches.csv", "poses.csv", "camera.yaml", "picture.png"}


def test_positions_in_the_image_do_as_well_as_the_image(visit: Path, tmp_path: Path) -> None:
    code, said, output = run(*csv_options(visit), "--seen", visit / "seen.csv", "--out", tmp_path / "out")
    assert code == 0, output
    assert np.linalg.norm(np.array(said["X_FC"])[:3, 3] - X_FC.translation()) < 0.3e-3


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda f: (f / "poses.csv").write_text("landmark,x\n0,1\n"),
            "'poses.csv' lacks the columns y, z, qw, qx, qy, qz.",
        ),
        (lambda f: _edit(f / "poses.csv", "camera", "photo"), "is not a number|lacks the row 'camera'"),
        (lambda f: (f / "camera.yaml").write_text("fx: 600\n"), "must hold fx, fy, cx and cy"),
        (
            lambda f: (f / "camera.yaml").write_text("fx: -1\nfy: 1\ncx: 1\ncy: 1\n"),
            "focal length that is not positive",
        ),
        (lambda f: _edit(f / "touches.csv", "0.125", "0.126", 1), "mixes sizes"),
        (lambda f: _edit(f / "touches.csv", "0.125", "nan", 1), "'nan' in the column mm_per_px is not a number"),
        (lambda f: (f / "touches.csv").unlink(), "There is no file"),
        (lambda f: (f / "picture.png").write_bytes(b"no picture"), "'picture.png' is not a readable image"),
        (lambda f: cv2.imwrite(str(f / "picture.png"), np.full((480, 640), 200, np.uint8)), "0 of 9 landmarks"),
        (lambda f: _millimetres(f / "poses.csv"), "must be in metres"),
    ],
)
def test_a_mistake_is_one_sentence_and_writes_nothing(visit: Path, tmp_path: Path, change: Any, sentence: str) -> None:
    folder = tmp_path / "files"
    shutil.copytree(visit, folder)
    change(folder)
    code, said, output = run(*csv_options(folder), "--image", folder / "picture.png", "--out", tmp_path / "out")
    assert code == 1
    assert said["state"] == "failed"
    assert re.search(sentence, said["reason"]), said["reason"]
    assert "Internal error" not in output
    assert not (tmp_path / "out").exists()


def _edit(path: Path, old: str, new: str, count: int = -1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def _millimetres(path: Path) -> None:
    rows = list(csv.DictReader(path.read_text().splitlines()))
    write(path, [{**r, **{c: 1e3 * float(r[c]) for c in "xyz"}} for r in rows])


def test_options_that_do_not_belong_together_are_told(npz: Path, visit: Path, tmp_path: Path) -> None:
    for arguments, sentence in (
        ((npz, "--poses", visit / "poses.csv"), "is complete"),
        ((visit / "touches.csv",), "need the robot's poses"),
        ((visit / "nothing.csv",), "There is no file"),
        ((visit / "picture.png",), "neither .csv nor .npz"),
        (csv_options(visit), "--image"),
        ((*csv_options(visit), "--seen", visit / "seen.csv", "--two-stages"), "belong to planar touches"),
        ((*csv_options(visit), "--image", visit / "picture.png", "--look", "stars"), "rings or dots"),
    ):
        code, said, _ = run(*arguments, "--out", tmp_path / "out")
        assert code == 1
        assert sentence in said["reason"]


def test_an_npz_that_is_none_is_told(tmp_path: Path, npz: Path) -> None:
    broken = tmp_path / "broken.npz"
    broken.write_bytes(npz.read_bytes()[:500])
    with pytest.raises(TabletDataError, match="not an npz file"):
        load_planar(broken)
    np.savez(tmp_path / "part.npz", uv=np.zeros((4, 2)))
    with pytest.raises(TabletDataError, match="lacks hand, theta_deg"):
        load_planar(tmp_path / "part.npz")


def test_a_result_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no tablet calibration at"):
        load_tablet_result(tmp_path)
    (tmp_path / "tablet.yaml").write_text("schema: 7\n")
    with pytest.raises(InputError, match="not a tablet calibration of schema 1"):
        load_tablet_result(tmp_path)


def _comma(folder: Path) -> None:
    """As a spreadsheet of a country with a decimal comma writes it, with a byte order mark."""
    for name in ("touches.csv", "poses.csv"):
        text = (folder / name).read_text().replace(",", ";").replace(".", ",")
        (folder / name).write_text("\ufeff" + text.replace("\n", "\r\n"), encoding="utf-8")


def _header(folder: Path) -> None:
    _edit(folder / "poses.csv", "landmark,x,y,z", "Landmark, X, Y, Z")
    _edit(folder / "poses.csv", "camera", "Camera")


def _backwards(folder: Path) -> None:
    for name in ("touches.csv", "poses.csv"):
        write(folder / name, [dict(reversed(list(r.items()))) for r in reversed(rows_of(folder / name))])


def _turned_page(folder: Path) -> None:
    rows = rows_of(folder / "touches.csv")
    for row in rows:
        for what in ("landmark", "touch"):
            x, y = float(row[f"{what}_x_px"]), float(row[f"{what}_y_px"])
            row[f"{what}_x_px"], row[f"{what}_y_px"] = str(900.0 - y), str(x)
    write(folder / "touches.csv", rows)


ROS = (
    "camera_matrix: {rows: 3, cols: 3, data: [617.7, 0, 316.5, 0, 617.7, 242.3, 0, 0, 1]}\ndistortion_coefficients:"
    " {data: [0, 0, 0, 0]}\n"
)
OPENCV = (
    "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 617.7, 0., 316.5, 0., 617.7, 242.3, 0., 0., 1. ]\n"
)


@pytest.mark.parametrize(
    "change",
    [
        _comma,
        _header,
        _backwards,
        _turned_page,
        lambda f: (f / "camera.yaml").write_text(ROS),
        lambda f: (f / "camera.yaml").write_text(OPENCV),
        lambda f: write(
            f / "touches.csv", rows_of(f / "touches.csv")[:6]
        ),  # the third row is in the picture all the same
        lambda f: write(f / "touches.csv", rows_of(f / "touches.csv")[:8]),
    ],
)
def test_the_same_visit_in_another_dress_is_the_same(visit: Path, tmp_path: Path, change: Any) -> None:
    folder = tmp_path / "files"
    shutil.copytree(visit, folder)
    change(folder)
    plain, other = (_loaded(f, image=f / "picture.png") for f in (visit, folder))
    assert other.warnings == ()
    n = len(other.names)
    assert list(other.names) == list(plain.names)[:n]
    np.testing.assert_allclose(other.data.views[0][1], plain.data.views[0][1][:n], atol=1e-9)
    for X, Y in zip(other.data.X_BF, plain.data.X_BF[:n], strict=True):
        assert X.IsNearlyEqualTo(Y, 1e-9)
    for found, said in ((other.data.landmark_m, plain.data.landmark_m), (other.data.touched_m, plain.data.touched_m)):
        np.testing.assert_allclose(_distances(found), _distances(said[:n]), atol=1e-9)


def _loaded(folder: Path, **seen: Path) -> WristVisit:
    return load_visit(folder / "touches.csv", folder / "poses.csv", folder / "camera.yaml", **seen)  # type: ignore[arg-type]


def _distances(points: np.ndarray) -> np.ndarray:
    """Between all pairs, whichever way the page is turned."""
    return np.asarray(np.linalg.norm(points[:, None] - points[None], axis=2))


def _shifted(folder: Path, column: str, by: float) -> None:
    rows = rows_of(folder / "poses.csv")
    write(folder / "poses.csv", [{**r, column: float(r[column]) + by * (r["landmark"] == "4")} for r in rows])


@pytest.mark.parametrize(
    ("change", "warning"),
    [
        (lambda f: _shifted(f, "x", 0.01), "without landmark 4 to 0.*: touch it again"),
        (lambda f: _edit(f / "poses.csv", "qw,qx,qy,qz", "qx,qy,qz,qw"), "with the quaternions' w where x is written"),
        (lambda f: _edit(f / "touches.csv", str(MM_PER_PX), str(1.03 * MM_PER_PX)), "differ by -[23].. % in length"),
        (lambda f: _edit(f / "camera.yaml", "cx: 316.5", "cx: 200.0"), "principal point of 'camera.yaml'"),
        (
            lambda f: write(f / "poses.csv", [r for r in rows_of(f / "poses.csv") if r["landmark"] != "2"]),
            "without a pose in",
        ),
    ],
)
def test_what_looks_wrong_with_full_poses_is_told(visit: Path, tmp_path: Path, change: Any, warning: str) -> None:
    folder = tmp_path / "files"
    shutil.copytree(visit, folder)
    change(folder)
    loaded = _loaded(
        folder, **({"image": folder / "picture.png"} if "principal" in warning else {"seen": folder / "seen.csv"})
    )
    told = (
        *loaded.warnings,
        *wrist_diagnostics(loaded.data, fit_wrist(loaded.data, leave_one_out=False), loaded.names),
    )
    assert re.search(warning, " ".join(told)), told


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda f: _edit(f / "touches.csv", "\n1,", "\n1.5,"), "whole numbers from 0, not '1.5'"),
        (
            lambda f: write(
                f / "poses.csv",
                [{**r, "landmark": r["landmark"] if r["landmark"] == "camera" else int(r["landmark"]) + 1} for r in rows_of(f / "poses.csv")],
            ),
            "counts its landmarks from 1",
        ),
        (lambda f: write(f / "touches.csv", [{**r, "landmark": 2 * int(r["landmark"]) % 9} for r in rows_of(f / "touches.csv")]), "not a grid"),
        (lambda f: (f / "touches.csv").write_text((f / "touches.csv").read_text().splitlines()[0]), "holds no touch"),
        (lambda f: (f / "camera.yaml").write_text("K: [600, 0, 320, 0, 600, 240, 0, 0, 1]\nD: [1, 2, 3]\n"), "OpenCV knows 4, 5"),
    ],
)  # fmt: skip
def test_files_that_contradict_each_other_are_refused(visit: Path, tmp_path: Path, change: Any, sentence: str) -> None:
    folder = tmp_path / "files"
    shutil.copytree(visit, folder)
    change(folder)
    code, said, _ = run(*csv_options(folder), "--image", folder / "picture.png", "--out", tmp_path / "out")
    assert code == 1
    assert re.search(sentence, said["reason"]), said["reason"]
