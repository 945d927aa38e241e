"""`weldcal profiler clock`: the offset from profiles of an edge, crossings or raw; what is missing is named."""

import json
from collections.abc import Callable
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


def raw() -> tuple[Array, Array, Array]:
    """Stamps (n,) s, x (n, m) and z (n, m) mm of raw profiles of a step at the crossings."""
    t, points = crossings()
    t, points = t[::3] + OFFSET_S, 1e3 * points[::3]
    x = points[:, :1] + np.arange(-8.0, 8.0, 0.1) + 0.05
    return t, x, points[:, 1:] + 30.0 * (x < points[:, :1])


def gocator(folder: Path, t: Array, x: Array, z: Array) -> None:
    """Times in microseconds."""
    m = x.shape[1]
    lines = [
        "Info",
        "CSV Version,Sensor Count",
        "2,1",
        "End",
        "RawProfile",
        "Frame Count,Column Count",
        f"{len(t)},{m}",
    ]
    lines.append("Frame,Source,Time,Encoder,Z Encoder,Inputs,Exposure,Y,Axis," + ",".join(map(str, range(m))))
    for k, (a, u, v) in enumerate(zip(t, x, z, strict=True)):
        for axis, values in (("X", u), ("Z", v)):
            lines.append(f"{k},0,{1e6 * a:.0f},0,0,0,300,0,{axis}," + ",".join(f"{b:.4f}" for b in values))
    (folder / "export.csv").write_text("\n".join([*lines, "End"]) + "\n")


def scancontrol(folder: Path, t: Array, x: Array, z: Array) -> None:
    """One table with decimal commas and times in milliseconds."""
    rows = ["Profile;Timestamp [ms];X [mm];Z [mm]"]
    for k, (a, u, v) in enumerate(zip(t, x, z, strict=True)):
        rows += [f"{k};{1e3 * a:.3f};{b:.4f};{c:.4f}".replace(".", ",") for b, c in zip(u, v, strict=True)]
    (folder / "export.csv").write_text("\n".join(rows) + "\n")


def heights(folder: Path, t: Array, x: Array, z: Array) -> None:
    """A grid of heights with x in its first row, and the times in a file of their own."""
    at = np.arange(x.min(), x.max(), 0.1)
    rows = [np.interp(at, u, v, left=np.nan, right=np.nan) for u, v in zip(x, z, strict=True)]
    text = [
        ",".join(f"{a:.4f}" for a in at),
        *(",".join("-99999.9999" if np.isnan(v) else f"{v:.4f}" for v in r) for r in rows),
    ]
    (folder / "export.csv").write_text("\n".join(text) + "\n")
    (folder / "times.csv").write_text("time\n" + "\n".join(f"{a:.6f}" for a in t) + "\n")


def one_file_each(folder: Path, t: Array, x: Array, z: Array) -> None:
    (folder / "profiles").mkdir()
    for k, (a, u, v) in enumerate(zip(t, x, z, strict=True)):
        rows = [f"{a:.6f},{b:.4f},{c:.4f}" for b, c in zip(u, v, strict=True)]
        (folder / "profiles" / f"profile{k + 1}.csv").write_text("time,X [mm],Z [mm]\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize("write", [gocator, scancontrol, heights, one_file_each])
def test_the_offset_of_exports(folder: Path, write: Callable[[Path, Array, Array, Array], None]) -> None:
    write(folder, *raw())
    found = run(folder)
    assert found["clock_offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=1.0)
    assert found["profiles"] > 60


def test_an_export_without_times_is_refused_with_advice_that_works(folder: Path) -> None:
    t, x, z = raw()
    heights(folder, t, x, z)
    times = (folder / "times.csv").read_text()
    (folder / "times.csv").unlink()
    assert "Write their times into times.csv" in refusal(folder)
    (folder / "times.csv").write_text("\n".join(str(float(a) + 3600.0) for a in times.split()[1:]))
    assert "Bring both to one clock" in refusal(folder)
    (folder / "times.csv").write_text("\n".join(times.split()[1:-1]))
    assert "Give one for each" in refusal(folder)
    (folder / "times.csv").write_text("\n".join(times.split()[1:]))
    assert run(folder)["clock_offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=1.0)


def refusal(folder: Path) -> str:
    words = ["profiler", "clock", str(folder), "--calibration", str(folder / "calibration"), "--unit", "mm"]
    found = CliRunner().invoke(app, [*words, "--out", str(folder / "out")])
    assert found.exit_code == 1, found.output
    return " ".join(found.stderr.split())
