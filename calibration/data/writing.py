"""Writes a calibration dataset folder: poses, clouds and dataset.yaml."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform

from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.header import DatasetHeader, without_cloud_form
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.files import whole_result, write_atomic

JOINTS = tuple(f"q{k}" for k in range(1, 7))
SECOND_JOINTS = tuple(f"second_q{k}" for k in range(1, 7))


def save_dataset(
    folder: Path,
    header: DatasetHeader,
    poses: Mapping[str, RigidTransform],
    clouds: Mapping[str, Array],
    *,
    times: Mapping[str, float] | None = None,
    joints: Mapping[str, Array] | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> None:
    """Record scans as a dataset folder that load_dataset reads back.

    X_BF and a cloud in metres ((N, 3) or (H, W, 3)) per id.

    ``times`` (s) adds the column `time`, ``joints`` (6,) or (12,) rad q1 to q6, and of a second arm second_q1 to
    second_q6; ``intrinsics`` writes organised clouds as depth maps. ``header.units`` is written as metres. Raises
    DatasetError when the ids of poses and clouds differ.
    """
    if set(poses) != set(clouds):
        raise DatasetError("A recording needs one cloud for each pose; the ids of poses and clouds differ.")
    document = {**without_cloud_form(header), "schema": 1, "units": {"clouds": "m", "poses": "m"}}
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    angles = [] if not joints else [*JOINTS, *SECOND_JOINTS][: len(next(iter(joints.values())))]
    writer.writerow(["id", "x", "y", "z", "qw", "qx", "qy", "qz", *(["time"] if times else []), *angles])
    for id, X_BF in poses.items():
        more = [] if not times else [float(times[id])]
        more += [] if not joints else [float(v) for v in joints[id]]
        writer.writerow([id, *map(repr, [*X_BF.translation().tolist(), *_wxyz(X_BF), *more])])
    with whole_result(folder):
        write_atomic(folder / "dataset.yaml", yaml_dump(document))
        for id, points in clouds.items():
            save_cloud(folder / "clouds" / f"{id}.npz", points, intrinsics)
        write_atomic(folder / "poses.csv", table.getvalue())


def _wxyz(X: RigidTransform) -> list[float]:
    q = X.rotation().ToQuaternion()
    return [float(v) for v in (q.w(), q.x(), q.y(), q.z())]
