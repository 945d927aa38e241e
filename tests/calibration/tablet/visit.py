"""A simulated tablet visit as files, and the command that calibrates from them."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from typer.testing import CliRunner

from tests.calibration.tablet.image import grid, picture, project
from weldcal.models.arrays import Array
from weldcal.tools.cli.app import app

X_FC = RigidTransform(RollPitchYaw(0.03, -0.05, 1.5), [0.06, 0.02, 0.05])
P_FP = np.array([-0.002, -0.021, 0.163])
X_BT = RigidTransform(RollPitchYaw(np.pi + 0.01, -0.02, 0.4), [0.5, -0.1, 0.02])
K = np.array([[617.7, 0.0, 316.5], [0.0, 617.7, 242.3], [0.0, 0.0, 1.0]])
PAGE = grid(3, 3, 0.06, 0.038)
MM_PER_PX = 0.125


def run(*arguments: object) -> tuple[int, dict[str, Any], str]:
    finished = CliRunner().invoke(app, ["tablet", "calibrate", *map(str, arguments), "--json"])
    return finished.exit_code, json.loads(finished.stdout.splitlines()[-1]) if finished.stdout else {}, finished.output


def write(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_visit(folder: Path, p_FP: Array = P_FP, X_FC: RigidTransform = X_FC) -> Path:
    """A simulated visit as files: the page's CSV, flange poses, intrinsics and a picture that is blurred and noisy."""
    rng = np.random.default_rng(5)
    shown = PAGE / (1e-3 * MM_PER_PX) + [150.5, 120.5]
    touched = np.round(shown + rng.normal(0.0, 4.0, shown.shape), 1)
    rows, poses = [], []
    for k, p in enumerate(touched):
        R = RollPitchYaw(
            np.pi + 0.2 * rng.uniform(-1, 1), 0.2 * rng.uniform(-1, 1), np.radians(-90 + 22.5 * k)
        ).ToRotationMatrix()
        tip = X_BT.multiply(np.r_[1e-3 * MM_PER_PX * (p - shown[0]), 0.0]) + rng.normal(0.0, 0.05e-3, 3)
        poses.append(_pose_row(str(k), RigidTransform(R, tip - R.multiply(p_FP))))
        rows.append(
            {"landmark": k, "time_utc": "2026-01-01T00:00:00.000Z", "landmark_x_px": shown[k, 0], "landmark_y_px": shown[k, 1],
             "touch_x_px": p[0], "touch_y_px": p[1], "mm_per_px": MM_PER_PX, "size_checked": 1}
        )  # fmt: skip
    middle = X_BT.multiply(np.r_[PAGE[4], 0.0])
    R_BF = RollPitchYaw(np.pi + 0.1, -0.08, -1.0).ToRotationMatrix()
    X_BF = RigidTransform(
        R_BF, middle - (R_BF @ X_FC.rotation()).multiply([0.0, 0.0, 0.3]) - R_BF.multiply(X_FC.translation())
    )
    poses.append(_pose_row("camera", X_BF))
    X_CT = (X_BF @ X_FC).inverse() @ X_BT
    cv2.imwrite(str(folder / "picture.png"), picture(X_CT, PAGE, K))
    write(folder / "touches.csv", rows)
    write(folder / "poses.csv", poses)
    uv = project(X_CT, PAGE, K)
    write(folder / "seen.csv", [{"landmark": k, "u": u, "v": v} for k, (u, v) in enumerate(uv)])
    (folder / "camera.yaml").write_text("fx: 617.7\nfy: 617.7\ncx: 316.5\ncy: 242.3\n")
    return folder


def _pose_row(name: str, X: RigidTransform) -> dict[str, object]:
    q, p = X.rotation().ToQuaternion().wxyz(), X.translation()
    return {"landmark": name, **dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), (*p, *q), strict=True))}


def csv_options(visit: Path) -> list[object]:
    return [visit / "touches.csv", "--poses", visit / "poses.csv", "--camera", visit / "camera.yaml"]


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))
