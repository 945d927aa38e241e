"""Touches, poses and images that contradict each other are refused with their cause; nothing is written."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.tablet.visit import MM_PER_PX, X_BT, X_FC, csv_options, rows_of, run, write, write_visit


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_visit(tmp_path_factory.mktemp("visit"))


Touch = Callable[[float, float], tuple[float, float]]


def _touches(folder: Path, change: Touch, only: tuple[str, ...] = ()) -> None:
    rows = rows_of(folder / "touches.csv")
    for row in rows:
        if not only or row["landmark"] in only:
            x, y = change(float(row["touch_x_px"]), float(row["touch_y_px"]))
            row["touch_x_px"], row["touch_y_px"] = str(x), str(y)
    write(folder / "touches.csv", rows)


def _other_rows(folder: Path) -> None:
    rows = rows_of(folder / "touches.csv")
    moved = [
        {**r, **{c: o[c] for c in ("touch_x_px", "touch_y_px")}} for r, o in zip(rows, rows[1:] + rows[:1], strict=True)
    ]
    write(folder / "touches.csv", moved)


def _told(visit: Path, tmp_path: Path, change: Callable[[Path], None]) -> tuple[int, dict[str, object]]:
    folder = tmp_path / "files"
    shutil.copytree(visit, folder)
    change(folder)
    code, said, output = run(*csv_options(folder), "--seen", folder / "seen.csv", "--out", tmp_path / "out")
    assert "Internal error" not in output
    assert (tmp_path / "out").exists() == (code == 0)
    return code, said


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda x, y: (y, x), "touch_x and touch_y are swapped"),
        (lambda x, y: (1260.0 - x, y), "touch_x is mirrored"),
        (lambda x, y: (x, 850.0 - y), "touch_y is mirrored"),
        (lambda x, y: (1260.0 - x, 850.0 - y), "touch_x and touch_y are mirrored"),
        (lambda x, y: (900.0 - y, x), "turned by 90 deg"),
        (lambda x, y: (MM_PER_PX * x, MM_PER_PX * y), "the touches are in millimetres"),
        (lambda x, y: (2.0 * x, 2.0 * y), r"2.0\d times the landmarks', as device pixels are"),
        (lambda x, y: (x + 240.0, y - 160.0), r"shifted by \(30\.\d, -2\d\.\d\) mm"),
        (lambda x, y: (y + 0.3 * x, 100.0 + 0.1 * y), "and so were . others"),
    ],
)
def test_touches_far_from_their_landmarks_are_refused_with_the_cause(
    visit: Path, tmp_path: Path, change: Touch, sentence: str
) -> None:
    code, said = _told(visit, tmp_path, lambda folder: _touches(folder, change))
    assert code == 1
    assert re.search(sentence, str(said["reason"])), said["reason"]


def test_touches_in_another_order_are_refused(visit: Path, tmp_path: Path) -> None:
    code, said = _told(visit, tmp_path, _other_rows)
    assert code == 1
    assert "touch 0 lies on landmark 1" in str(said["reason"])


def test_one_touch_near_another_landmark_is_told_and_does_no_harm(visit: Path, tmp_path: Path) -> None:
    """It was touched there: the pose says so, and a touch may be anywhere on the glass."""

    def change(folder: Path) -> None:
        _touches(folder, lambda x, y: (x + 200.0, y), ("3",))
        rows = rows_of(folder / "poses.csv")
        # the hand moved with it: 25 mm along the page's x
        along = 200.0 * 1e-3 * MM_PER_PX * X_BT.rotation().matrix()[:, 0]
        for row in rows:
            if row["landmark"] == "3":
                row |= {a: str(float(row[a]) + v) for a, v in zip("xyz", along, strict=True)}
        write(folder / "poses.csv", rows)

    code, said = _told(visit, tmp_path, change)
    assert code == 0, said
    assert any("Touched nearer to another landmark" in w and "landmark 3" in w for w in said["warnings"])  # type: ignore[attr-defined]
    assert np.linalg.norm(RigidTransform(np.array(said["X_FC"])).translation() - X_FC.translation()) < 0.5e-3


def test_poses_that_do_not_fit_are_refused_and_nothing_is_exported(visit: Path, tmp_path: Path) -> None:
    def change(folder: Path) -> None:
        rng = np.random.default_rng(2)
        rows = rows_of(folder / "poses.csv")
        write(
            folder / "poses.csv",
            [{**r, **{a: float(r[a]) + 0.03 * rng.standard_normal() for a in "xyz"}} for r in rows],
        )

    code, said = _told(visit, tmp_path, change)
    assert code == 1
    assert "Nothing is written" in str(said["reason"])
    assert "mm only" in str(said["reason"])


def test_an_image_that_is_mirrored_is_refused(visit: Path, tmp_path: Path) -> None:
    def change(folder: Path) -> None:
        write(folder / "seen.csv", [{**r, "u": 640.0 - float(r["u"])} for r in rows_of(folder / "seen.csv")])

    code, said = _told(visit, tmp_path, change)
    assert code == 1
    assert "mirrored" in str(said["reason"])


def test_an_image_of_another_camera_is_refused(visit: Path, tmp_path: Path) -> None:
    def change(folder: Path) -> None:
        rng = np.random.default_rng(3)
        rows = rows_of(folder / "seen.csv")
        write(
            folder / "seen.csv", [{**r, **{a: float(r[a]) + 25.0 * rng.standard_normal() for a in "uv"}} for r in rows]
        )

    code, said = _told(visit, tmp_path, change)
    assert code == 1
    assert "px from the positions of the fit" in str(said["reason"])
