"""Scans of the flange select how the robot's poses are to be read: written by SciPy in many notations, read without a
setting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.source import read_poses
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.eye_on_base.observations import choose_reading

WRITERS = {
    "fixed xyz": lambda R: R.as_euler("xyz", degrees=True),
    "zyx": lambda R: R.as_euler("ZYX", degrees=True),
    "moving xyz": lambda R: R.as_euler("XYZ", degrees=True),
    "zyz": lambda R: R.as_euler("ZYZ", degrees=True),
    "rotation vector": lambda R: R.as_rotvec(degrees=True),
    "radians": lambda R: R.as_euler("xyz"),
}
SETS = 40


def outcome(path: Path, writer: str, seed: int) -> str:
    """What becomes of one set: right, wrong, or refused."""
    rng = np.random.default_rng([17, seed])
    n = int(rng.integers(7, 20))
    toward = Rotation.from_euler("xyz", [180.0, 0.0, rng.uniform(-180, 180)], degrees=True)
    R_BF = toward * Rotation.from_rotvec(rng.uniform(-0.6, 0.6, (n, 3)))
    p_BF = rng.uniform([0.3, -0.3, 0.1], [0.8, 0.3, 0.6], (n, 3))
    R_BC, p_BC = Rotation.random(random_state=seed), rng.uniform(-1.0, 1.0, 3)
    # SciPy warns of a middle angle near a singularity; none of these poses is near one of "fixed xyz"
    numbers = np.hstack([1e3 * p_BF, WRITERS[writer](R_BF)])
    path.write_text(
        "id,X,Y,Z,Rx,Ry,Rz\n"
        + "".join(f"p{k:02d}," + ",".join(f"{v:.4f}" for v in row) + "\n" for k, row in enumerate(numbers))
    )
    p_CR = R_BC.inv().apply(p_BF - p_BC) + rng.normal(size=(n, 3)) * rng.uniform(1e-4, 8e-4)
    n_C = R_BC.inv().apply(R_BF.as_matrix()[:, :, 2]) + rng.normal(size=(n, 3)) * np.radians(rng.uniform(0.03, 0.15))
    n_C /= np.linalg.norm(n_C, axis=1)[:, None]
    found = read_poses(path, PoseForm())
    readings = []
    for one in found.readings:
        X = one.X.copy()
        X[:, :3, 3] *= 1e-3
        readings.append(type(one)(one.form, one.words, X))
    try:
        chosen, _ = choose_reading(readings, np.arange(n), p_CR, n_C, np.eye(4))
    except InconsistentPoses:
        return "refused"
    X = readings[0].X if chosen is None else chosen.X
    off = (Rotation.from_matrix(X[:, :3, :3]).inv() * R_BF).magnitude()
    return "right" if off.max() < np.radians(0.01) else "wrong"


@pytest.mark.parametrize("writer", WRITERS)
def test_the_reading_is_found_and_never_a_wrong_one(tmp_path: Path, writer: str) -> None:
    found = [outcome(tmp_path / "poses.csv", writer, k) for k in range(SETS)]
    assert found.count("wrong") == 0
    assert found.count("right") >= 0.9 * SETS
