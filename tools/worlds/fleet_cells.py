"""Writes a folder of made cells with several datasets each; robot and scanner have errors that no calibration
models."""

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial.transform import Rotation

from weldcal.models.arrays import Array
from weldcal.tools.report.files import csv_text

FAULTS = ("none", "moved", "drifts", "broken")
SHARES = (0.7, 0.1, 0.1, 0.1)
COLUMNS = (
    "id",
    "base_x",
    "base_y",
    "base_z",
    "base_qw",
    "base_qx",
    "base_qy",
    "base_qz",
    "camera_x",
    "camera_y",
    "camera_z",
)
HEADER = (
    "schema: 1\nrobot: ur10e\nflange: iso9409-1-50-4-m6\nconfiguration: eye_on_base\nunits: {clouds: m, poses: m}\n"
)
SCANS = 20
NOISE_M = 1.0e-4  # of a flange centre, one sigma, an axis
ROBOT_M = 1.0e-4  # amplitude of the robot's position error, smooth over the work space
SCALE = 5.0e-4  # of the scanner, one sigma over the fleet
MOVED_M, MOVED_DEG = (0.0015, 0.004), 0.15
DRIFT_M = 0.0002  # from one dataset to the next
LEFT = 2  # pairs in a broken dataset


def write_fleet(folder: Path, cells: int, datasets: int, seed: int) -> dict[str, str]:
    """Write ``cells`` cells with ``datasets`` datasets each; the fault of each cell by its name."""
    rng = np.random.default_rng(seed)
    faults = {}
    for k in range(cells):
        name = f"cell_{k:03d}"
        faults[name] = FAULTS[rng.choice(len(FAULTS), p=SHARES)]
        write_cell(folder / name, faults[name], datasets, rng)
    return faults


def write_cell(folder: Path, fault: str, datasets: int, rng: np.random.Generator) -> None:
    """Write one cell with a fault of FAULTS: its datasets by month."""
    X_BC = RigidTransform(
        RollPitchYaw(np.pi + rng.normal(0.0, 0.1), rng.normal(0.0, 0.1), rng.uniform(-3, 3)), [0.6, 0.0, 1.2]
    )
    scale = 1.0 + SCALE * rng.normal()
    waves = rng.normal(size=(3, 3)) * 4.0, rng.uniform(0.0, 2 * np.pi, 3)
    way = _unit(rng)
    since = int(rng.integers(1, datasets)) if datasets > 1 else 0
    step = RigidTransform(RollPitchYaw(np.radians(MOVED_DEG) * _unit(rng)), rng.uniform(*MOVED_M) * _unit(rng))
    for k in range(datasets):
        X = X_BC
        if fault == "moved" and k >= since:
            X = X_BC @ step
        elif fault == "drifts":
            X = RigidTransform(k * DRIFT_M * way) @ X_BC
        _write_dataset(
            folder / f"2026-{k + 1:02d}",
            X,
            scale,
            waves,
            rng,
            LEFT if fault == "broken" and k == datasets - 1 else SCANS,
        )


def _write_dataset(
    folder: Path, X_BC: RigidTransform, scale: float, waves: tuple[Array, Array], rng: np.random.Generator, scans: int
) -> None:
    p = np.array([0.6, 0.0, 0.3]) + rng.uniform(-1.0, 1.0, (scans, 3)) * [0.25, 0.3, 0.2]
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.35, (scans, 3)))
    true = p + ROBOT_M * np.sin(p @ waves[0] + waves[1])
    seen = scale * X_BC.inverse().multiply(true.T).T + NOISE_M * rng.standard_t(5, (scans, 3))
    q = turns.as_quat(scalar_first=True)
    rows = [[f"scan{i:02d}", *map(repr, map(float, (*p[i], *q[i], *seen[i])))] for i in range(scans)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pairs.csv").write_text(csv_text(COLUMNS, rows), encoding="utf-8")
    (folder / "dataset.yaml").write_text(HEADER, encoding="utf-8")


def _unit(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))
