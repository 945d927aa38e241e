"""Scans that nothing but their order pairs with the poses are paired by the distances between the flanges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.eye_on_base.observations import _in_found_order, _read_by_scans
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arrays import Array

RNG = np.random.default_rng(4)
N = 10
X_BF = pose(Rotation.from_rotvec(0.5 * RNG.normal(size=(N, 3))).as_matrix(), RNG.uniform(0.2, 0.7, (N, 3)))
X_BC = pose(Rotation.from_rotvec([0.2, 2.8, 0.3]).as_matrix(), np.array([0.6, 0.1, 1.2]))
X_CF = inverse(X_BC) @ X_BF


def dataset(folder: Path, poses: Array, rotvec: bool) -> Dataset:
    """Poses without names, as quaternions or as three numbers in any notation, and as many clouds."""
    turn = Rotation.from_matrix(poses[:, :3, :3])
    numbers = turn.as_rotvec() if rotvec else turn.as_quat()
    header = "x,y,z,rx,ry,rz" if rotvec else "x,y,z,qx,qy,qz,qw"
    rows = [",".join(f"{v:.9f}" for v in (*p[:3, 3], *r)) for p, r in zip(poses, numbers, strict=True)]
    (folder / "poses.csv").write_text("\n".join([header, *rows]) + "\n")
    for k in range(len(poses)):
        save_cloud(folder / "clouds" / f"s{k:02d}.npz", np.random.default_rng(k).uniform(0.5, 1.0, (50, 3)))
    return load_dataset(folder)


def observations(data: Dataset, rows: list[int]) -> list[Observation]:
    """The flange of each cloud, 0.2 mm and 0.1 degrees off; cloud k shows the pose in row ``rows[k]``."""
    rng = np.random.default_rng(2)
    return [
        Observation(
            id=id,
            X_BR=RigidTransform(),
            p_CR=X_CF[row, :3, 3] + 2e-4 * rng.normal(size=3),
            n_C=Rotation.from_rotvec(0.002 * rng.normal(size=3)).apply(X_CF[row, :3, 2]),
        )
        for id, row in zip(data.poses, rows, strict=True)
    ]


@pytest.mark.parametrize("rotvec", [False, True])
def test_shuffled_scans_get_their_own_poses(tmp_path: Path, rotvec: bool) -> None:
    data = dataset(tmp_path, X_BF, rotvec)
    order = np.random.default_rng(1).permutation(N).tolist()
    found = _in_found_order(data, observations(data, order))
    for id, row in zip(found.poses, order, strict=True):
        assert found.poses[id].translation() == pytest.approx(X_BF[row, :3, 3], abs=1e-8)
    assert f"another order: s00 to row {order[0] + 1}," in found.notes[-1]
    if rotvec:
        assert found.readings[0].X[:, :3, 3] == pytest.approx(X_BF[order][:, :3, 3], abs=1e-8)


def test_scans_in_order_and_of_another_motion_stay(tmp_path: Path) -> None:
    data = dataset(tmp_path, X_BF, False)
    assert _in_found_order(data, observations(data, list(range(N)))) is data
    other = pose(Rotation.random(N, rng=RNG).as_matrix(), RNG.uniform(0.2, 0.7, (N, 3)))
    (tmp_path / "other").mkdir()
    strange = dataset(tmp_path / "other", other, False)
    assert _in_found_order(strange, observations(strange, list(range(N)))) is strange


def test_scans_that_fit_two_poses_are_refused_by_row(tmp_path: Path) -> None:
    poses = X_BF.copy()
    poses[6] = poses[2] @ pose(np.eye(3), np.array([1e-5, 0.0, 0.0]))
    data = dataset(tmp_path, poses, False)
    order = list(range(N))[::-1]
    order[order.index(6)] = 2  # two scans of the same place
    with pytest.raises(InconsistentPoses, match=r"order of all poses but 3, 7\. Add a column 'id'"):
        _in_found_order(data, observations(data, order))


@pytest.mark.parametrize(
    ("axes", "form"), [("ZYX", "euler_ZYX,deg"), ("ZYZ", "euler_ZYZ,deg"), ("xyz", "euler_xyz,deg")]
)
def test_letters_a_b_c_are_of_another_maker_where_the_scans_say_so(tmp_path: Path, axes: str, form: str) -> None:
    angles = Rotation.from_matrix(X_BF[:, :3, :3]).as_euler(axes, degrees=True)
    rows = [",".join(f"{v:.6f}" for v in (*(1e3 * X[:3, 3]), *r)) for X, r in zip(X_BF, angles, strict=True)]
    (tmp_path / "poses.csv").write_text("\n".join(["x,y,z,a,b,c", *rows]) + "\n")
    for k in range(N):
        save_cloud(tmp_path / "clouds" / f"s{k:02d}.npz", np.random.default_rng(k).uniform(0.5, 1.0, (50, 3)))
    data = load_dataset(tmp_path)
    assert data.readings[0].form == "euler_ZYX,deg"
    found = _read_by_scans(data, observations(data, list(range(N))))
    assert found.readings[0].form == form
    assert pytest.approx(X_BF, abs=1e-7) == found.readings[0].X
