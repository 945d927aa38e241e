"""`weldcal monitor` on a recording: the contract's keys, a knock with its time and size, a report, a recalibrated
result."""

import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from typer.testing import CliRunner

from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream, save_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, load_result, save_result
from weldcal.calibration.geometry.se3 import pose
from weldcal.models.arrays import Array
from weldcal.models.flanges import get_flange
from weldcal.tools.cli.app import app

FLANGE = "iso9409-1-50-4-m6"
KNOCK_S, SHIFT = 1006.0, np.array([0.0, 0.6e-3, 0.8e-3])
FRAMES, RATE = 110, 10.0
WIDTH, HEIGHT, FOCAL = 300, 260, 420.0


def feature(t: Array) -> Array:
    """Flange poses (n, 4, 4): a figure of eight with some lean, seen from above."""
    t = t - 1000.0
    p = np.array([0.5, 0.1, 0.3]) + np.column_stack(
        [0.06 * np.sin(1.3 * t), 0.05 * np.sin(2.1 * t + 0.4), 0.05 * np.sin(0.9 * t + 1.0)]
    )
    lean = np.column_stack([0.12 * np.sin(1.1 * t), 0.12 * np.cos(0.7 * t), 0.2 * np.sin(0.5 * t)])
    R = np.array([RollPitchYaw(*a).ToRotationMatrix().matrix() for a in lean])
    return pose(R, p)


def rendered(X_CR: RigidTransform, rng: np.random.Generator) -> Array:
    """The flange's face as an organised cloud (H, W, 3), nothing else in view."""
    standard = get_flange(FLANGE)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 0.5 * (WIDTH - 1)) / FOCAL, (v - 0.5 * (HEIGHT - 1)) / FOCAL, np.ones(u.shape)], axis=-1)
    c, n = X_CR.translation(), X_CR.rotation().matrix()[:, 2]
    z = (n @ c) / (rays @ n)
    rho = np.linalg.norm(rays * z[..., None] - c, axis=-1)
    on = (rho < standard.face_outer_radius_m) & (rho > standard.face_inner_radius_m)
    z = np.where(on, z + 3e-5 * rng.standard_normal(z.shape), np.nan)
    return np.asarray(rays * z[..., None])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording with a knock, and a calibration from before it."""
    folder = tmp_path_factory.mktemp("monitor")
    rng = np.random.default_rng(1)
    X_BC = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.5, 0.1, 0.75])
    t = np.arange(999.0, 1013.0, 0.004)
    capture = 1000.0 + np.arange(FRAMES) / RATE
    frames = [FrameTime(f"{k:03d}", float(c + 0.14), float(c - 500.0)) for k, c in enumerate(capture)]
    clouds = []
    for f, c, X in zip(frames, capture, feature(capture), strict=True):
        now = RigidTransform(X_BC.rotation(), X_BC.translation() + SHIFT * (c > KNOCK_S))
        X_CR = now.InvertAndCompose(RigidTransform(X))
        clouds.append((f.id, rendered(X_CR, rng) if f.id != "020" else np.full((HEIGHT, WIDTH, 3), np.nan)))
    header = DatasetHeader(schema=1, robot="ur5e", flange=FLANGE, scanner="a scanner", configuration="eye_on_base")
    intrinsics = (FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))
    save_motion_dataset(folder / "moving", header, RobotStream(t, feature(t)), frames, clouds, intrinsics=intrinsics)
    result = CalibrationResult(
        X_BC=X_BC,
        covariance=np.diag([1e-9] * 6),
        held_out_mm={},
        tilt_deg={},
        poses=(),
        robot="ur5e",
        flange=FLANGE,
        scanner="a scanner",
    )
    save_result(result, folder / "calibration")
    return folder / "moving", folder / "calibration"


def test_monitor_reports_the_knock(recording: tuple[Path, Path], tmp_path: Path) -> None:
    moving, calibration = recording
    out = tmp_path / "out"
    found = CliRunner().invoke(
        app, ["monitor", str(moving), "--calibration", str(calibration), "--recalibrate", "--out", str(out), "--json"]
    )
    assert found.exit_code == 1, found.output  # the verdict is "do not use"
    result = json.loads(found.stdout.strip().splitlines()[-1])
    assert list(result)[-4:] == ["rms_mm", "frames", "dropped", "drift"]
    assert (result["frames"], result["dropped"]) == (FRAMES - 1, 1)
    (drift,) = result["drift"]
    assert abs(drift["time_s"] - KNOCK_S) < 0.3
    assert drift["found_s"] - KNOCK_S < 2.0
    assert drift["translation_mm"] == pytest.approx(1.0, abs=0.1)
    assert drift["translation_B_mm"] == pytest.approx((1e3 * SHIFT).tolist(), abs=0.1)
    assert drift["rotation_deg"] < 0.02
    assert result["rms_after_drift_mm"] < 0.1 < result["rms_mm"]
    assert result["delay_ms"] == pytest.approx(140.0, abs=1.0)
    again = load_result(out / "recalibrated")
    assert again.X_BC.translation() == pytest.approx(np.array([0.5, 0.1, 0.75]) + SHIFT, abs=1.5e-4)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "The scanner has moved" in page
    assert json.loads((out / "monitor.json").read_text(encoding="utf-8"))["drift"] == result["drift"]


@pytest.mark.parametrize("what", ["moving", "calibration"])
def test_monitor_says_what_is_missing(recording: tuple[Path, Path], tmp_path: Path, what: str) -> None:
    moving, calibration = recording
    lost = tmp_path / "lost"
    paths = (lost, calibration) if what == "moving" else (moving, lost)
    found = CliRunner().invoke(
        app, ["monitor", str(paths[0]), "--calibration", str(paths[1]), "--out", str(tmp_path / "o")]
    )
    assert found.exit_code == 1
    assert "lost" in found.stderr
    assert not (tmp_path / "o").exists()
