"""`weldcal calibrate` on a rendered recording in motion: X_BC and clock against the truth, files, refusals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.worlds.flange_frames import empty_frame, flange_frame
from tests.worlds.moves import cube_moves, observed_frames
from tests.worlds.streams import recorded_stream
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, save_motion_dataset
from weldcal.calibration.data.results import load_result
from weldcal.calibration.errors import DatasetError, TooFewPoses
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.app import app
from weldcal.tools.commands.calibrate_motion import calibrate_recording

SECONDS = 6.0
FLANGE = "iso9409-1-50-4-m6"
EMPTY = "f0007"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RigidTransform]:
    """Six seconds with every second frame of 20 per second, arrivals only, and one frame without the flange."""
    folder = tmp_path_factory.mktemp("motion") / "recording"
    rng = np.random.default_rng(1)
    scanner = get_scanner("motioncam_3d_motion", 480)
    scanner = replace(scanner, noise=replace(scanner.noise, sigma_m=1e-4))
    moves, X_BC = cube_moves(rng, tilt_deg=10.0)
    stream = recorded_stream(moves, SECONDS, rng, joints=True)
    seen, capture = observed_frames(moves, X_BC, SECONDS, rng, device=True, epoch_s=100.0)
    picked = range(0, len(capture), 2)
    standard = get_flange(FLANGE)

    def clouds() -> Iterator[tuple[str, Array]]:
        for j, k in enumerate(picked):
            X_CR = X_BC.inverse() @ RigidTransform(moves.at(capture[k]))
            each = np.random.default_rng(j)
            frame = (
                empty_frame(scanner, standard, each)
                if j == 7
                else flange_frame(scanner, standard, each, X_CR=X_CR, clutter=0)
            )
            yield f"f{j:04d}", frame.points_C

    assert seen.device is not None
    times = [FrameTime(f"f{j:04d}", float(seen.arrival[k]), float(seen.device[k])) for j, k in enumerate(picked)]
    header = DatasetHeader(robot="ur10e", flange=FLANGE, scanner="motioncam_3d_motion", configuration="eye_on_base")
    intrinsics = (scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    save_motion_dataset(folder, header, stream, times, clouds(), intrinsics=intrinsics)
    return folder, X_BC


def check_pose(found: RigidTransform, truth: RigidTransform, bound_mm: float) -> None:
    p = np.array([0.0, 0.0, 0.75])
    assert 1e3 * np.linalg.norm(np.asarray(found @ p) - np.asarray(truth @ p)) < bound_mm


def test_device_times(recording: tuple[Path, RigidTransform], tmp_path: Path) -> None:
    folder, X_BC = recording
    ran = CliRunner().invoke(app, ["calibrate", str(folder), "--json", "--centres", "--out", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    said = json.loads(ran.output.strip().splitlines()[-1])
    assert said["clock"] == "device"
    assert said["clock_offset_ms"] == pytest.approx(1e5, abs=0.5)
    assert 0.0 < said["clock_offset_sigma_ms"] < 0.3
    check_pose(RigidTransform(np.array(said["X_BC"])), X_BC, 0.12)
    assert said["held_out_mm"]["median"] < 0.2
    assert EMPTY in {row["id"] for row in said["refused"]}
    assert said["along_motion_rms_mm"]["before"] > 50.0 * said["along_motion_rms_mm"]["after"]
    result = load_result(tmp_path / "out")
    assert result.clock is not None
    assert result.clock.offset_s == pytest.approx(1e-3 * said["clock_offset_ms"])
    assert result.clock_covariance is not None
    assert result.clock_covariance.shape == (8, 8)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Residual along the motion" in page
    assert "device time" in page
    assert (tmp_path / "out" / "centres.csv").read_text().startswith("id,capture,")
    assert (tmp_path / "out" / "ur_pose.script").is_file()


def test_arrivals(recording: tuple[Path, RigidTransform], tmp_path: Path) -> None:
    folder, X_BC = recording
    copy = shutil.copytree(folder, tmp_path / "copy")
    rows = [line.rsplit(",", 1)[0] for line in (copy / "frames.csv").read_text().splitlines()]
    (copy / "frames.csv").write_text("\n".join([rows[0], *rows[:0:-1]]))
    report = calibrate_recording(copy, tmp_path / "out")
    clock = report.estimate.clock
    assert clock.kind == "arrival"
    assert clock.offset_s is not None
    assert clock.sigma_s is not None
    assert abs(clock.offset_s - 0.140) < 3.5 * clock.sigma_s
    assert 1e-3 < clock.sigma_s < 4e-3
    check_pose(report.result.X_BC, X_BC, 0.2)


def test_refusals(recording: tuple[Path, RigidTransform], tmp_path: Path) -> None:
    folder, _ = recording
    copy = shutil.copytree(folder, tmp_path / "copy")
    head, *rows = (copy / "frames.csv").read_text().splitlines()
    (copy / "frames.csv").write_text("\n".join([head, *rows[:4]]))
    with pytest.raises(TooFewPoses, match="4 frames"):
        calibrate_recording(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError):
        calibrate_recording(copy, tmp_path / "out", flange="iso9409-1-80-6-m8")
    text = (copy / "dataset.yaml").read_text()
    (copy / "dataset.yaml").write_text(text.replace("mode: motion", "mode: static"))
    with pytest.raises(DatasetError, match="no recording in motion"):
        calibrate_recording(copy, tmp_path / "out")
    ran = CliRunner().invoke(app, ["calibrate", str(folder), "--poses", "a:b", "--out", str(tmp_path / "out")])
    assert ran.exit_code == 2
