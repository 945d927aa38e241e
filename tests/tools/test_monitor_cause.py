"""`weldcal monitor` tells a moved base from a moved scanner by the table and walls in a rendered recording."""

import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from typer.testing import CliRunner

from tests.tools.test_monitor import FLANGE, FOCAL, HEIGHT, WIDTH, feature, rendered
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream, save_motion_dataset
from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.calibration.motion.drift.watch import BASE, SCANNER
from weldcal.models.arrays import Array
from weldcal.tools.cli.app import app

X_BC = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.5, 0.1, 0.75])
KNOCK_S, SHIFT = 1003.0, np.array([0.5e-3, -0.7e-3, 0.9e-3])
FRAMES, RATE = 60, 10.0
# of the room, n . x = d in the base: the table and two walls that lean
PLANES = ((np.array([0.0, 0.0, 1.0]), 0.0), (np.array([-0.8, 0.0, 0.6]), -0.53), (np.array([0.0, -0.8, 0.6]), -0.2))


def room(X_WC: RigidTransform, rng: np.random.Generator) -> Array:
    """Table and walls as an organised cloud (H, W, 3) m, 0.1 mm of noise."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 0.5 * (WIDTH - 1)) / FOCAL, (v - 0.5 * (HEIGHT - 1)) / FOCAL, np.ones(u.shape)], axis=-1)
    R, o = X_WC.rotation().matrix(), X_WC.translation()
    z = np.full(u.shape, np.inf)
    for n, d in PLANES:
        with np.errstate(divide="ignore"):
            depth = (d - n @ o) / (rays @ (R.T @ n))
        z = np.where((depth > 0.1) & (depth < z), depth, z)
    return np.asarray(rays * (z + 1e-4 * rng.standard_normal(z.shape))[..., None])


def recording(folder: Path, moved: str) -> Path:
    """A recording in which the scanner, or the robot's base, jumps by the same change of the scanner's pose in the
    base."""
    rng = np.random.default_rng(1)
    t = np.arange(999.0, 1008.0, 0.004)
    capture = 1000.0 + np.arange(FRAMES) / RATE
    frames = [FrameTime(f"{k:03d}", float(c + 0.14), float(c - 500.0)) for k, c in enumerate(capture)]
    clouds = []
    for f, c, X in zip(frames, capture, feature(capture), strict=True):
        after = c > KNOCK_S
        seen_from = RigidTransform(X_BC.rotation(), X_BC.translation() + SHIFT * after)  # X_BC, as the flange tells it
        # the room is where the base was: with a moved base the scanner has not moved in it
        in_room = X_BC if moved == "base" else seen_from
        flange = rendered(seen_from.InvertAndCompose(RigidTransform(X)), rng)
        behind = room(in_room, rng)
        clouds.append((f.id, np.where(np.isfinite(flange[..., 2:]), flange, behind)))
    header = DatasetHeader(schema=1, robot="ur5e", flange=FLANGE, scanner="a scanner", configuration="eye_on_base")
    intrinsics = (FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))
    save_motion_dataset(folder / moved, header, RobotStream(t, feature(t)), frames, clouds, intrinsics=intrinsics)
    save_result(
        CalibrationResult(
            X_BC=X_BC,
            covariance=np.diag([1e-9] * 6),
            held_out_mm={},
            tilt_deg={},
            poses=(),
            robot="ur5e",
            flange=FLANGE,
        ),
        folder / "calibration",
    )
    return folder / moved


@pytest.mark.parametrize(("moved", "cause"), [("base", BASE), ("scanner", SCANNER)])
def test_what_stands_still_tells_what_moved(moved: str, cause: str, tmp_path: Path) -> None:
    folder = recording(tmp_path, moved)
    words = f"monitor {folder} --calibration {tmp_path}/calibration --out {tmp_path}/out --json"
    found = CliRunner().invoke(app, words.split())
    assert found.exit_code == 1, found.output  # the verdict is "do not use"
    said = json.loads(found.stdout.strip().splitlines()[-1])
    (drift,) = said["drift"]
    assert drift["translation_B_mm"] == pytest.approx(1e3 * SHIFT, abs=0.15)
    assert drift["cause"] == said["cause"] == cause
