"""Lists of very many poses: refused in a sentence, or paired in time and memory that grow with their lengths alone."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.documents.scans import write_scans
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.poses.listing import Listing, listing_of_array
from weldcal.calibration.data.poses.lists import together
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.hand_eye.pairs.files import read_pairs


def listing(n: int, times: np.ndarray | None = None) -> Listing:
    X = np.tile(np.eye(4), (n, 1, 1))
    X[:, 0, 3] = np.linspace(0.1, 1.0, n)
    return listing_of_array("poses", X, times=times)


def test_rows_pair_by_the_nearest_time() -> None:
    rng = np.random.default_rng(0)
    robot, camera = rng.permutation(np.arange(0.0, 50.0, 0.02)), rng.uniform(-1.0, 51.0, 300)
    a, b, how = together(listing(len(robot), robot), listing(len(camera), camera))
    gap = np.abs(camera[:, None] - robot[None, :])
    keep = np.flatnonzero(gap.min(axis=1) <= 0.05)
    assert how == "by time"
    assert np.array_equal(b, keep)
    assert np.allclose(np.abs(robot[a] - camera[b]), gap.min(axis=1)[keep])


def test_long_lists_pair_without_their_product() -> None:
    """The product of 100,000 and 90,000 rows is 72 GB."""
    begin = time.process_time()
    robot, camera = np.arange(100_000) * 0.01, np.arange(90_000) * 0.01 + 0.003
    a, b, _ = together(listing(len(robot), robot), listing(len(camera), camera))
    assert np.array_equal(a, b)
    assert time.process_time() - begin < 5.0


def test_a_million_rows_are_refused_before_they_are_parsed(tmp_path: Path) -> None:
    row = "0.1,0.2,0.3,0.0,0.0,0.0\n"
    (tmp_path / "robot.csv").write_text("x,y,z,rx,ry,rz\n" + row * 1_000_000)
    (tmp_path / "camera.csv").write_text("x,y,z,rx,ry,rz\n" + row * 12)
    begin = time.process_time()
    with pytest.raises(DatasetError, match="1,000,001 lines, and at most 100,000 poses are read"):
        read_pairs(tmp_path, mounting="eye_in_hand")
    assert time.process_time() - begin < 5.0


def test_a_million_poses_of_a_dataset_are_refused(tmp_path: Path) -> None:
    write_scans(tmp_path / "scans", 4, 0)
    table = tmp_path / "scans" / "poses.csv"
    text = table.read_text().splitlines()
    more = ",".join(text[1].split(",")[1:8])
    table.write_text(
        "\n".join([",".join(text[0].split(",")[:8]), *(f"x{k},{more[:40]}" for k in range(1_000_000))]) + "\n"
    )
    begin = time.process_time()
    with pytest.raises(DatasetError, match="lines, and at most 100,000 poses are read"):
        load_dataset(tmp_path / "scans")
    assert time.process_time() - begin < 5.0
