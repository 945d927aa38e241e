"""`weldcal profiler clock`: the offset from profiles of an edge, crossings or raw; what is missing is named."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.calibration.motion.test_line_clock import EDGE, EDGE_POINT, SECONDS, X_FP, hand_at
from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.models.arrays import Array
from weldcal.tools.cli.app import app

OFFSET_S, WEAVE_M = 0.0123, 0.01


def crossings() -> tuple[Array, Array]:
    """Times (n,) s and points (n, 2) m [x, z] at which the plane y = 0 of the profiler crosses the edge."""
    t = np.arange(1.0, SECONDS - 1.0, 0.02)
    X_BP = hand_at(t, WEAVE_M) @ X_FP
    n, o = X_BP[:, :3, 1], X_BP[:, :3, 3]
    d = EDGE / np.linalg.norm(EDGE)
    q = EDGE_POINT + (((EDGE_POINT - o) * n).sum(axis=1) / -(n @ d))[:, None] * d
    points = np.einsum("nji,nj->ni", X_BP[:, :3, :3], q - o)[:, [0, 2]]
    return t, points + 2e-5 * np.random.default_rng(0).standard_normal(points.shape)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the stream and the calibration, without profiles."""
    t = np.arange(0.0, SECONDS, 0.004)
    X = hand_at(t, WEAVE_M)
    rows = [
        ",".join(f"{v:.9f}" for v in (a, *1e3 * x[:3, 3], *RigidTransform(x).rotation().ToQuaternion().wxyz()))
        for a, x in zip(t, X, strict=True)
    ]
    (tmp_path / "stream.csv").write_text("time,x,y,z,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    save_record(ProfilerRecord(method="edge", rotation=X_FP[:3, :3], translation=X_FP[:3, 3]), tmp_path / "calibration")
    return tmp_path


def written(folder: Path, rows: list[tuple[float, float, float]]) -> None:
    text = "\n".join(f"{t:.6f},{1e3 * x:.6f},{1e3 * z:.6f}" for t, x, z in rows)
    (folder / "profiles.csv").write_text(f"time,x,z\n{text}\n")


def run(folder: Path) -> dict[str, Any]:
    words = ["profiler", "clock", str(folder), "--calibration", str(folder / "calibration"), "--unit", "mm", "--json"]
    found = CliRunner().invoke(app, [*words, "--out", str(folder / "out")])
    assert found.exit_code == 0, found.output
    return dict(json.loads(found.stdout.strip().splitlines()[-1]))


def test_the_offset_of_crossings(folder: Path) -> None:
    t, points = crossings()
    written(folder, [(a + OFFSET_S, *p) for a, p in zip(t, points, strict=True)][::-1])
    said = run(folder)
    assert said["clock_offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=0.5)
    assert 0.0 < said["clock_offset_sigma_ms"] < 0.5
    assert said["rms_mm"] < 0.05 < said["rms_before_mm"]
    assert (folder / "out" / "clock.json").is_file()


def test_the_offset_of_raw_profiles(folder: Path) -> None:
    t, points = crossings()
    rows = []
    for a, (x, z) in zip(t[::3], points[::3], strict=True):
        across = x + np.arange(-8.0, 8.0, 0.1) * 1e-3 + 5e-5
        rows += [(a + OFFSET_S, float(u), float(z + (0.03 if u < x else 0.0))) for u in across]
    written(folder, rows)
    said = run(folder)
    assert said["clock_offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=1.0)
    assert said["profiles"] > 60


def test_missing_profiles_are_named(folder: Path) -> None:
    words = [
        "profiler",
        "clock",
        str(folder),
        "--calibration",
        str(folder / "calibration"),
        "--unit",
        "mm",
        "--out",
        str(folder / "o"),
    ]
    found = CliRunner().invoke(app, words)
    assert found.exit_code == 1
    assert "profiles.csv" in found.stderr
