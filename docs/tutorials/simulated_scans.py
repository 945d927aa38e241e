"""Simulate a scanner that sees a robot's flange, and write scans as a folder that weldcal reads."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

NOISE_M = 5e-5  # a choice: one sigma of the depth of a point


def pose(roll: float, pitch: float, yaw: float, p: Any) -> RigidTransform:
    """Make a pose from angles (rad) and a position (3,) m."""
    return RigidTransform(RollPitchYaw(roll, pitch, yaw), p)


X_BC: Any = pose(3.12, 0.03, 0.4, [0.66, 0.02, 0.94])  # a choice: a scanner above the table, looking down


def scan(X_CF: RigidTransform, rng: np.random.Generator) -> NDArray[np.float64]:
    """Scan the face of a flange ISO 9409-1-50-4-M6 at X_CF: (H, W, 3) m in the camera frame, NaN beside the face."""
    p_CF, R_CF = X_CF.translation(), X_CF.rotation().matrix()
    u, v = np.meshgrid(np.arange(-130, 130) / 1500, np.arange(-130, 130) / 1500)
    rays = np.stack([u + p_CF[0] / p_CF[2], v + p_CF[1] / p_CF[2], np.ones_like(u)], axis=-1)
    depth = (R_CF[:, 2] @ p_CF) / (rays @ R_CF[:, 2]) + NOISE_M * rng.standard_normal(u.shape)
    points = rays * depth[..., None]
    x, y, _ = np.moveaxis((points - p_CF) @ R_CF, -1, 0)
    face = (np.hypot(x, y) < 0.0305) & (np.hypot(x, y) > 0.01675)  # without the chamfers
    for angle in np.deg2rad([45, 90, 135, 225, 315]):  # four screws, and a dowel at 90 degrees
        face &= np.hypot(x - 0.025 * np.cos(angle), y - 0.025 * np.sin(angle)) > 0.003
    return np.where(face[..., None], points, np.nan)


def write_scans(folder: Path, n: int = 8, seed: int = 1) -> None:
    """Write n scans of a scanner at X_BC, whose distances are 0.3 % too long."""
    rng = np.random.default_rng(seed)
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    rows = ["id,x,y,z,qw,qx,qy,qz"]
    for k in range(n):
        roll, pitch, yaw = rng.uniform([-0.5, -0.5, -3.0], [0.5, 0.5, 3.0])
        p_CF = rng.uniform([-0.12, -0.1, 0.55], [0.12, 0.1, 0.75])
        X_CF = pose(np.pi + roll, pitch, yaw, p_CF)
        X_BF = X_BC @ X_CF
        np.savez_compressed(folder / "clouds" / f"pose{k}.npz", points=1.003 * scan(X_CF, rng))
        numbers = [*X_BF.translation(), *X_BF.rotation().ToQuaternion().wxyz()]
        rows.append(",".join([f"pose{k}", *(f"{number:.9f}" for number in numbers)]))
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    (folder / "dataset.yaml").write_text(
        "schema: 1\nrobot: ur10e\nflange: iso9409-1-50-4-m6\nscanner: phoxi_m\nconfiguration: eye_on_base\n"
    )
