"""One camera's pose as the files of other programs state it, written by their own conventions with SciPy alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def truth(seed: int = 0) -> Array:
    """A pose (4, 4) of a camera on a flange, m."""
    rng = np.random.default_rng(seed)
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    X[:3, 3] = rng.uniform(0.02, 0.2, 3) * rng.choice([-1, 1], 3)
    return X


def _storage(M: Array) -> str:
    data = ", ".join(f"{v:.10f}" for v in M.ravel())
    return f"!!opencv-matrix\n   rows: {M.shape[0]}\n   cols: {M.shape[1]}\n   dt: d\n   data: [ {data} ]\n"


def write(form: str, X: Array, folder: Path) -> Path:
    """Write X in a form; returns the file."""
    R = Rotation.from_matrix(X[:3, :3])
    x, y, z = X[:3, 3]
    qx, qy, qz, qw = R.as_quat()
    roll, pitch, yaw = R.as_euler("xyz")
    inverse = np.linalg.inv(X)
    position = f"{x:.9f} {y:.9f} {z:.9f}"
    grid = "\n".join(" ".join(f"{v:.9f}" for v in row) for row in X)
    named = "".join(
        f'"--{key}", "{value:.9f}",\n'
        for key, value in (("x", x), ("y", y), ("z", z), ("qx", qx), ("qy", qy), ("qz", qz), ("qw", qw))
    )
    files = {
        "easy_handeye": (
            "eye.yaml",
            "parameters:\n  eye_on_hand: true\n  freehand_robot_movement: true\n  robot_base_frame: base_link\n  robot_effector_frame: tool0\n"
            f"  tracking_base_frame: camera\n  tracking_marker_frame: tag\ntransformation:\n  qw: {qw}\n  qx: {qx}\n  qy: {qy}\n  qz: {qz}\n"
            f"  x: {x}\n  y: {y}\n  z: {z}\n",
        ),
        "easy_handeye2": (
            "eye.calib",
            "parameters:\n  calibration_type: eye_in_hand\n  name: eye\n  robot_base_frame: base\n  robot_effector_frame: tool0\n"
            f"transform:\n  rotation:\n    w: {qw}\n    x: {qx}\n    y: {qy}\n    z: {qz}\n  translation:\n    x: {x}\n    y: {y}\n    z: {z}\n",
        ),
        "MoveIt launch": (
            "camera.launch",
            f'<launch>\n  <!-- xyz="1 2 3" rpy="0 0 0" -->\n  <node pkg="tf2_ros" type="static_transform_publisher" name="broadcaster"\n'
            f'     args="{position}   {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f} tool0 camera_2" />\n</launch>\n',
        ),
        "MoveIt 2 launch": (
            "camera.launch.py",
            '""" EYE-IN-HAND: tool0 -> camera """\nfrom launch import LaunchDescription\nNode(\n  package="tf2_ros",\n'
            '  executable="static_transform_publisher",\n  output="log",\n  arguments=[\n"--frame-id",\n"tool0",\n"--child-frame-id",\n"camera",\n'
            f'{named}# "--roll",\n# "1.5",\n])\n',
        ),
        "static transform, yaw pitch roll": (
            "static.sh", f"rosrun tf static_transform_publisher {position} {yaw:.9f} {pitch:.9f} {roll:.9f} tool0 camera 100\n"
        ),
        "URDF": (
            "robot.urdf",
            '<?xml version="1.0"?>\n<robot name="cell">\n<link name="tool0"/><link name="camera_optical"/>\n<joint name="one" type="fixed">'
            '<origin xyz="0 0 0.5" rpy="0 0 1"/><parent link="world"/><child link="tool0"/></joint>\n<joint name="two" type="fixed">'
            f'<origin xyz="{position}" rpy="{roll:.9f} {pitch:.9f} {yaw:.9f}"/><parent link="tool0"/><child link="camera_optical"/></joint>\n</robot>\n',
        ),
        "origin excerpt": ("origin.txt", f"<origin rpy='{roll:.9f} {pitch:.9f} {yaw:.9f}' xyz='{position}' />\n"),
        "OpenCV storage": (
            "handeye.yml",
            f"%YAML:1.0\n---\nK: {_storage(np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]))}R_cam2gripper: {_storage(X[:3, :3])}"
            f"t_cam2gripper: {_storage(X[:3, 3:])}",
        ),
        "OpenCV matrix": ("handeye.yaml", f"%YAML:1.0\n---\nT_cam2gripper: {_storage(X)}"),
        "Kalibr": (
            "camchain.yaml",
            "cam0:\n  T_cam_imu:\n" + "".join(f"  - {[float(v) for v in row]}\n" for row in X)
            + "  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]\n  distortion_model: radtan\n"
            "  intrinsics: [458.6, 457.3, 367.2, 248.4]\n  resolution: [752, 480]\n  rostopic: /cam0\n  timeshift_cam_imu: 0.001\n",
        ),
        "ViSP": ("eMc.yaml", "# eMc\nrows: 6\ncols: 1\ndata:\n" + "".join(f"  - [{v:.9f}]\n" for v in (x, y, z, *R.as_rotvec()))),
        "matrix txt": ("eMc.txt", grid + "\n"),
        "matrix of NumPy": ("printed.txt", str(np.array2string(X, precision=9))),
        "matrix JSON": ("X.json", json.dumps({"T_cam2gripper": X.tolist(), "error": 0.4})),
        "matrix mm": ("mm.csv", "\n".join(",".join(f"{v:.9f}" for v in row) for row in np.vstack([np.hstack([X[:3, :3], 1e3 * X[:3, 3:]]), X[3:]]))),
        "quaternion": ("q.txt", f"{position} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}\n"),
        "quaternion wxyz first": ("w.txt", f"{position} {qw:.9f} {qx:.9f} {qy:.9f} {qz:.9f}\n"),
        "quaternion with header": ("h.csv", f"x,y,z,qw,qx,qy,qz\n{x:.9f},{y:.9f},{z:.9f},{qw:.9f},{qx:.9f},{qy:.9f},{qz:.9f}\n"),
        "UR pose": ("pose.script", "p[" + ", ".join(f"{v:.9f}" for v in (x, y, z, *R.as_rotvec())) + "]\n"),
        "tf2_echo": (
            "echo.txt",
            f"At time 0.0\n- Translation: [{x:.6f}, {y:.6f}, {z:.6f}]\n- Rotation: in Quaternion [{qx:.6f}, {qy:.6f}, {qz:.6f}, {qw:.6f}]\n",
        ),
        "tf_static": (
            "tf_static.txt",
            "transforms:\n- header:\n    stamp:\n      sec: 17\n      nanosec: 0\n    frame_id: tool0\n  child_frame_id: camera\n  transform:\n"
            f"    translation:\n      x: {x}\n      y: {y}\n      z: {z}\n    rotation:\n      x: {qx}\n      y: {qy}\n      z: {qz}\n      w: {qw}\n---\n",
        ),
        "pasted array": ("X.txt", "X = np.array([" + ",\n".join("[" + ", ".join(f"{v:.9f}" for v in row) + "]" for row in X) + "])\n"),
        "inverse": ("inverse.txt", "\n".join(" ".join(f"{v:.9f}" for v in row) for row in inverse)),
    }  # fmt: skip
    if form == "npy":
        np.save(folder / "X.npy", X)
        return folder / "X.npy"
    name, text = files[form]
    (folder / name).write_text(text)
    return folder / name


FORMS = (
    "easy_handeye", "easy_handeye2", "MoveIt launch", "MoveIt 2 launch", "static transform, yaw pitch roll", "URDF", "origin excerpt",
    "OpenCV storage", "OpenCV matrix", "Kalibr", "ViSP", "matrix txt", "matrix of NumPy", "matrix JSON", "matrix mm", "quaternion",
    "quaternion wxyz first", "quaternion with header", "UR pose", "tf2_echo", "npy", "tf_static", "pasted array",
)  # fmt: skip
