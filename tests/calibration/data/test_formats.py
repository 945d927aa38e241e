"""The forms of files of poses are one table: a new form is a row and a function, and every reader takes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.calibration.hand_eye.pair_world import A, B
from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses import formats
from weldcal.calibration.data.poses.formats import Format, PoseFile, format_of, known_forms
from weldcal.calibration.data.poses.listing import listing_of_array
from weldcal.calibration.data.poses.source import find_poses, read_poses
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.calibration.profiler.importing import import_profiles


def doubles(path: Path) -> PoseFile:
    return PoseFile([listing_of_array(path.name, np.fromfile(path).reshape(-1, 4, 4))])


ROW = Format("matrices as doubles", (".dbl",), doubles)


def test_a_new_form_is_one_row_and_one_function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    A.tofile(tmp_path / "robot.dbl")
    B.tofile(tmp_path / "camera.dbl")
    with pytest.raises(DatasetError, match=r"Files \.dbl are not read, but .*Excel \(\.xlsx\)"):
        read_pairs(tmp_path, mounting="eye_in_hand")
    monkeypatch.setattr(formats, "FORMATS", (*formats.FORMATS, ROW))
    assert "matrices as doubles (.dbl)" in known_forms()
    pairs = read_pairs(tmp_path, mounting="eye_in_hand")
    np.testing.assert_allclose(pairs.robot, A, atol=1e-9)
    found = find_poses(tmp_path)
    assert found is not None
    np.testing.assert_allclose(read_poses(found, PoseForm()).X, A, atol=1e-9)
    (tmp_path / "profiles.csv").write_text("scan,px_mm,pz_mm\n" + "".join(f"{k},0,200\n" for k in range(len(A))))
    np.testing.assert_allclose(import_profiles(tmp_path / "profiles.csv").readings[0].X, A, atol=1e-9)


def test_each_row_is_found_by_its_ending(tmp_path: Path) -> None:
    for row in formats.FORMATS:
        for ending in row.endings:
            (tmp_path / f"a{ending}").write_text("x y z\n")
            assert ending in format_of(tmp_path / f"a{ending}").endings
    (tmp_path / "a.unknown").write_text("1 2 3\n")
    assert format_of(tmp_path / "a.unknown").says == "a table, a robot program or a log"
