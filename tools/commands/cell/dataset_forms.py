"""Rewrites a calibration dataset in another form that people use: UR vectors, matrices, OpenCV, Zivid-like, ROS."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydrake.common.yaml import yaml_dump
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.data.poses.bag import INSTALL
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError

SECOND = 1_000_000_000
_APART_S = 5.0  # between two scans of a recording
_REST_S = 2.0


def rewrite(folder: Path, form: str) -> Path:
    """Write poses and clouds of a plain dataset folder in another form, in their place; dataset.yaml keeps the rest.

    Raises:
        InputError: no such form, or a package that it needs is not installed.
    """
    if form not in FORMS:
        raise InputError(f"There is no form '{form}': use {', '.join(FORMS)}.")
    data = load_dataset(folder)
    poses = np.array([data.poses[id].GetAsMatrix4() for id in data.clouds])
    clouds = [data.cloud(id) for id in data.clouds]
    header = read_document(folder / "dataset.yaml")
    FORMS[form](folder, poses, clouds, data)
    if form in ("zivid", "mcap"):  # the clouds are elsewhere now
        shutil.rmtree(folder / "clouds")
    (folder / "poses.csv").unlink()
    header = {k: v for k, v in header.items() if v is not None} | {"units": {"clouds": "auto", "poses": "auto"}}
    (folder / "dataset.yaml").write_text(yaml_dump(header), encoding="utf-8")
    return folder


def _ur(folder: Path, poses: Array, clouds: list[Array], data: Dataset) -> None:
    rows = (
        ", ".join(repr(float(v)) for v in (*X.translation(), *rotation_vector(X.rotation())))
        for X in map(data.poses.get, data.clouds)
        if X
    )
    (folder / "poses.txt").write_text("".join(f"p[{row}]\n" for row in rows), encoding="utf-8")


def _matrices(folder: Path, poses: Array, clouds: list[Array], data: Dataset) -> None:
    (folder / "poses").mkdir()
    for id, X in zip(data.clouds, poses, strict=True):
        text = "\n".join(" ".join(repr(float(v)) for v in row) for row in X)
        (folder / "poses" / f"{id}.txt").write_text(text + "\n", encoding="utf-8")


def _opencv(folder: Path, poses: Array, clouds: list[Array], data: Dataset) -> None:
    storage = cv2.FileStorage(str(folder / "robot_poses.yml"), cv2.FILE_STORAGE_WRITE)
    for id, X in zip(data.clouds, poses, strict=True):
        storage.write(id if id[0].isalpha() else f"scan_{id}", X)
    storage.release()


def _zivid(folder: Path, poses: Array, clouds: list[Array], data: Dataset) -> None:
    for k, (X, points) in enumerate(zip(poses, clouds, strict=True), start=1):
        X = X.copy()
        X[:3, 3] *= 1e3
        storage = cv2.FileStorage(str(folder / f"pos{k:02d}.yaml"), cv2.FILE_STORAGE_WRITE)
        storage.write("PoseState", X)
        storage.release()
        write_pcd(folder / f"img{k:02d}.pcd", 1e3 * points)


def write_pcd(path: Path, points: Array) -> None:
    """Write points (N, 3) or (H, W, 3) as binary PCD in double precision."""
    width, height = (points.shape[1], points.shape[0]) if points.ndim == 3 else (len(points), 1)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {width * height}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + np.ascontiguousarray(points, dtype="<f8").tobytes())


def _ros(folder: Path, poses: Array, clouds: list[Array], data: Dataset) -> None:
    names = [
        "%time",
        "field.header.seq",
        "field.header.stamp",
        "field.header.frame_id",
        *(f"field.pose.position.{a}" for a in "xyz"),
        *(f"field.pose.orientation.{a}" for a in "xyzw"),
    ]
    rows = [",".join(names)]
    for k, id in enumerate(data.clouds):
        stamp = 1_700_000_000 * SECOND + int(k * _APART_S * SECOND)
        X = data.poses[id]
        q = X.rotation().ToQuaternion()
        numbers = (*X.translation(), q.x(), q.y(), q.z(), q.w())
        rows.append(",".join([str(stamp), str(k), str(stamp), "base", *(repr(float(v)) for v in numbers)]))
    (folder / "tool_pose.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def _mcap(folder: Path, poses: Array, clouds: list[Array], data: Dataset) -> None:
    write_bag(folder / "recording", poses, clouds)


def write_bag(path: Path, poses: Array, clouds: list[Array], *, kind: str = "mcap") -> None:
    """Write a ROS 2 recording: a PoseStamped topic at 10 Hz around each scan, and a PointCloud2 at rest at each pose.

    ``kind`` is mcap or sqlite3. Raises InputError where rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"A ROS recording needs the package rosbags: {INSTALL}.") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    t: Any = store.types
    pose_type, cloud_type = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/PointCloud2"

    def header(ns: int, frame: str) -> Any:
        return t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](ns // SECOND, ns % SECOND), frame)

    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        stamped = writer.add_connection("/tcp_pose_broadcaster/pose", pose_type, typestore=store)
        seen = writer.add_connection("/scanner/points", cloud_type, typestore=store)
        for k, (X, points) in enumerate(zip(poses, clouds, strict=True)):
            begin = 1_700_000_000 * SECOND + int(k * _APART_S * SECOND)
            q = map(float, Rotation.from_matrix(X[:3, :3]).as_quat())
            turn = t["geometry_msgs/msg/Quaternion"](*q)
            for j in range(int(_REST_S * 10)):
                ns = begin + j * SECOND // 10
                at = t["geometry_msgs/msg/Point"](*map(float, X[:3, 3]))
                message = t[pose_type](header(ns, "base"), t["geometry_msgs/msg/Pose"](at, turn))
                writer.write(stamped, ns, store.serialize_cdr(message, pose_type))
            ns = begin + SECOND
            height, width = points.shape[:2] if points.ndim == 3 else (1, len(points))
            fields = [t["sensor_msgs/msg/PointField"](a, 8 * i, 8, 1) for i, a in enumerate("xyz")]
            body = np.frombuffer(np.ascontiguousarray(points, dtype="<f8").tobytes(), np.uint8)
            cloud = t[cloud_type](
                header(ns, "scanner_optical"), height, width, fields, False, 24, 24 * width, body, False
            )
            writer.write(seen, ns, store.serialize_cdr(cloud, cloud_type))


FORMS: dict[str, Callable[[Path, Array, list[Array], Dataset], None]] = {
    "ur": _ur,
    "matrices": _matrices,
    "opencv": _opencv,
    "zivid": _zivid,
    "ros": _ros,
    "mcap": _mcap,
}
"""What writes each form."""
