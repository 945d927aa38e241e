"""ROS recordings with a robot and a board detector give the camera, at rest and in motion.

Topics and frames are those of public packages: aruco_ros, apriltag_ros, ar_track_alvar, easy_handeye, the drivers of UR
and Franka.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.calibration.errors import DatasetError
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.profiler.importing import import_profiles
from weldcal.calibration.recorded_hand_eye import HandEyeOptions, calibrate_recorded
from weldcal.calibration.verified_pairs import holds_scans
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import chain_poses
from weldcal.models.arrays import Array
from weldcal.tools.cli.app import app

pytest.importorskip("rosbags", reason="the extra ros is not installed")

RATE = 25.0  # Hz, of both streams
TRUTH = {"eye_in_hand": [0.05, -0.03, 0.09], "eye_on_base": [1.1, -0.4, 0.8]}  # p_FC and p_BC, m
JOINTS = ("elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
"""As a UR's driver sorts them."""


def transform(p: Array, w: Array) -> Array:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.from_rotvec(w).as_matrix(), p
    return X


@dataclass
class Run:
    """Times (n,) s, flange X_BF and board X_CM (n, 4, 4), joints (n, 6) rad, and X as the command should find it."""

    t: Array
    robot: Array
    camera: Array
    q: Array
    X: Array
    mode: str = field(default="eye_in_hand")


def run(mode: str = "eye_in_hand", *, moving: bool = False, poses: int = 14, seed: int = 0) -> Run:
    """An arm that rests for 1.4 s at each pose and moves in between, or never rests."""
    rng = np.random.default_rng(seed)
    q0 = np.array([0.3, -1.4, 1.6, -1.7, -1.5, 0.2])
    nodes = q0 + rng.uniform(-0.35, 0.35, (poses, 6))
    rest, move = (0.0, 0.8) if moving else (1.4, 0.6)
    knots = np.concatenate([[k * (rest + move), k * (rest + move) + rest] for k in range(poses)])
    t = np.arange(0.0, knots[-1], 1.0 / RATE)
    if moving:
        from scipy.interpolate import CubicSpline

        q = CubicSpline(knots[::2], nodes)(t)
    else:
        q = np.stack([np.interp(t, knots, np.repeat(nodes[:, k], 2)) for k in range(6)], axis=1)
    robot = chain_poses(load_chain("ur10e"), q)
    X = transform(np.array(TRUTH[mode]), np.array([0.1, -0.2, 0.4]))
    board = transform(np.array([0.7, 0.1, 0.02]), np.array([0.2, 0.1, 1.0]))
    chain = np.linalg.inv(robot @ X) @ board if mode == "eye_in_hand" else np.linalg.inv(X) @ robot @ board
    noise = [transform(3e-4 * rng.standard_normal(3), 1e-3 * rng.standard_normal(3)) for _ in t]
    return Run(t, robot, chain @ np.array(noise), q, X, mode)


class Bag:
    """Writes messages of ROS 2."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.writer.open()
        self.topics: dict[str, Any] = {}

    def write(self, topic: str, kind: str, t: float, message: Any) -> None:
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        self.writer.write(self.topics[topic], self.ns(t), self.store.serialize_cdr(message, kind))

    @staticmethod
    def ns(t: float) -> int:
        return 1_700_000_000_000_000_000 + round(1e9 * t)

    def of(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, t: float, frame: str) -> Any:
        seconds, ns = divmod(self.ns(t), 10**9)
        return self.of("std_msgs/msg/Header", self.of("builtin_interfaces/msg/Time", seconds, ns), frame)

    def pose(self, topic: str, t: float, X: Array, frame: str = "base") -> None:
        turn = self.of("geometry_msgs/msg/Quaternion", *map(float, Rotation.from_matrix(X[:3, :3]).as_quat()))
        at = self.of("geometry_msgs/msg/Point", *map(float, X[:3, 3]))
        message = self.of(
            "geometry_msgs/msg/PoseStamped", self.header(t, frame), self.of("geometry_msgs/msg/Pose", at, turn)
        )
        self.write(topic, "geometry_msgs/msg/PoseStamped", t, message)

    def transform(self, t: float, X: Array, parent: str, child: str) -> Any:
        turn = self.of("geometry_msgs/msg/Quaternion", *map(float, Rotation.from_matrix(X[:3, :3]).as_quat()))
        at = self.of("geometry_msgs/msg/Vector3", *map(float, X[:3, 3]))
        whole = self.of("geometry_msgs/msg/Transform", at, turn)
        return self.of("geometry_msgs/msg/TransformStamped", self.header(t, parent), child, whole)

    def tf(self, t: float, X: Array, parent: str, child: str, topic: str = "/tf") -> None:
        message = self.of("tf2_msgs/msg/TFMessage", [self.transform(t, X, parent, child)])
        self.write(topic, "tf2_msgs/msg/TFMessage", t, message)

    def joints(self, t: float, q: Array) -> None:
        order = [2, 1, 0, 3, 4, 5]
        message = self.of(
            *("sensor_msgs/msg/JointState", self.header(t, ""), list(JOINTS), q[order]), np.zeros(0), np.zeros(0)
        )
        self.write("/joint_states", "sensor_msgs/msg/JointState", t, message)


def tf_robot(bag: Bag, t: float, X: Array, q: Array, flange: str = "tool0") -> None:
    """Two links: what lies between base and flange is split."""
    half = transform(np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 0.5]))
    bag.tf(t, half, "base_link", "shoulder_link")
    bag.tf(t, np.linalg.inv(half) @ X, "shoulder_link", flange)


def ur_pose(bag: Bag, t: float, X: Array, q: Array) -> None:
    bag.pose("/tcp_pose_broadcaster/pose", t, X)


def transform_stamped(bag: Bag, t: float, X: Array, q: Array) -> None:
    bag.write("/EETF", "geometry_msgs/msg/TransformStamped", t, bag.transform(t, X, "base", "ee"))


def joint_states(bag: Bag, t: float, X: Array, q: Array) -> None:
    bag.joints(t, q)


ROBOTS: dict[str, Callable[[Bag, float, Array, Array], None]] = {
    "tf": tf_robot,
    "tf of Franka": lambda bag, t, X, q: tf_robot(bag, t, X, q, "panda_link8"),
    "pose of UR": ur_pose,
    "pose of Franka": lambda bag, t, X, q: bag.pose("/franka_robot_state_broadcaster/current_pose", t, X),
    "transform": transform_stamped,
    "joints": joint_states,
}
CAMERAS: dict[str, Callable[[Bag, float, Array], None]] = {
    "aruco_ros": lambda bag, t, X: bag.pose("/aruco_single/pose", t, X, "camera_color_optical_frame"),
    "apriltag_ros": lambda bag, t, X: bag.tf(t, X, "camera_color_optical_frame", "tag36h11:0"),
    "apriltag_ros, named": lambda bag, t, X: bag.tf(t, X, "camera_color_optical_frame", "tag_0"),
    "ar_track_alvar": lambda bag, t, X: bag.tf(t, X, "camera_link", "ar_marker_90"),
    "easy_handeye": lambda bag, t, X: bag.tf(t, X, "camera_link", "camera_marker"),
    "calibration_aruco": lambda bag, t, X: bag.tf(t, X, "camera_color_frame", "calibration_aruco"),
    "charuco": lambda bag, t, X: bag.pose("/charuco_detector/board_pose", t, X, "camera"),
}


def recorded(path: Path, data: Run, robot: str, camera: str) -> Path:
    bag = Bag(path)
    for t, X, C, q in zip(data.t, data.robot, data.camera, data.q, strict=True):
        ROBOTS[robot](bag, t, X, q)
        if robot == "joints" or rng_seen(t):
            CAMERAS[camera](bag, t + 0.004, C)
    bag.writer.close()
    return path


def rng_seen(t: float) -> bool:
    """The detector misses one picture of five."""
    return round(t * RATE) % 5 != 2


@pytest.mark.parametrize(
    ("robot", "camera", "mode"),
    [
        ("tf", "aruco_ros", "eye_in_hand"),
        ("tf", "apriltag_ros", "eye_on_base"),
        ("tf of Franka", "apriltag_ros, named", "eye_in_hand"),
        ("joints", "ar_track_alvar", "eye_in_hand"),
        ("joints", "aruco_ros", "eye_on_base"),
        ("pose of UR", "easy_handeye", "eye_on_base"),
        ("pose of UR", "charuco", "eye_in_hand"),
        ("pose of Franka", "calibration_aruco", "eye_in_hand"),
        ("transform", "aruco_ros", "eye_on_base"),
    ],
)
def test_a_recording_at_rest_gives_the_camera(tmp_path: Path, robot: str, camera: str, mode: str) -> None:
    data = run(mode)
    path = recorded(tmp_path / "bag", data, robot, camera)
    heard: list[str] = []
    asked = HandEyeOptions(mounting=mode, robot="ur10e" if robot == "joints" else None)
    found = calibrate_recorded(path, asked, heard.append)
    assert found.result.X.translation() == pytest.approx(data.X[:3, 3], abs=8e-4)
    assert np.asarray(found.result.X.rotation().matrix()) == pytest.approx(data.X[:3, :3], abs=2e-3)
    assert len(found.result.rotation_rad) == 14
    assert any("at rest, " in one for one in heard)


@pytest.mark.parametrize("moving", [False, True])
def test_verify_and_import_read_the_same_recording(tmp_path: Path, moving: bool) -> None:
    data = run(moving=moving, poses=24 if moving else 14)
    path = recorded(tmp_path / "bag", data, "tf", "aruco_ros")
    assert not holds_scans(path)
    assert not holds_scans(next(path.glob("*.mcap")))
    for words in (
        ["hand-eye", "ax-yb", str(path), "--out", str(tmp_path / "x")],
        ["import", str(path), "--out", str(tmp_path / "y")],
    ):
        done = CliRunner().invoke(app, [*words, "--mounting", "eye_in_hand"])
        assert done.exit_code == 0, done.output
    with np.load(tmp_path / "y" / "pairs.npz") as pairs:
        n = len(pairs["A"])
        assert n > 50 if moving else n == 14
    found = CliRunner().invoke(app, ["verify", str(tmp_path / "x"), str(path)])
    assert f"The held-out error of {n} pairs" in " ".join(found.output.split())


def test_a_recording_gives_the_flange_at_the_time_of_each_profile(tmp_path: Path) -> None:
    data = run(poses=6)
    path = recorded(tmp_path / "bag", data, "joints", "aruco_ros")
    at = np.arange(12, len(data.t), 50)
    rows = [f"{Bag.ns(data.t[k]) * 1e-9:.3f},{x},200" for k in at for x in range(3)]
    (tmp_path / "export.csv").write_text("time [s],px_mm,pz_mm\n" + "\n".join(rows) + "\n")
    with pytest.raises(DatasetError, match="joint angles and no poses"):
        import_profiles(tmp_path / "export.csv", poses=path)
    path = recorded(tmp_path / "tf", data, "tf", "aruco_ros")
    for one in (path, next(path.glob("*.mcap"))):
        found = import_profiles(tmp_path / "export.csv", poses=one)
        np.testing.assert_allclose(found.readings[0].X, data.robot[at], atol=1e-6)


def test_a_recording_without_rest_is_synchronised(tmp_path: Path) -> None:
    data = run(moving=True, poses=24)
    late = Run(data.t, data.robot, data.camera, data.q, data.X)
    path = recorded(tmp_path / "bag", late, "pose of UR", "aruco_ros")
    found = calibrate_recorded(path, HandEyeOptions(mounting="eye_in_hand"))
    assert found.streams is not None
    assert found.streams.offset_s == pytest.approx(0.004, abs=2e-3)
    assert found.result.X.translation() == pytest.approx(data.X[:3, 3], abs=1.5e-3)


def test_what_is_missing_or_unclear_is_named(tmp_path: Path) -> None:
    data = run(poses=4)
    bag = Bag(tmp_path / "few")  # a detector of two pictures a second cannot be followed in motion
    for k, (t, X, C, q) in enumerate(zip(data.t, data.robot, data.camera, data.q, strict=True)):
        ur_pose(bag, t, X, q)
        if k % 12 == 0:
            CAMERAS["aruco_ros"](bag, t, C)
    bag.writer.close()
    few = tmp_path / "few"
    with pytest.raises(DatasetError, match="fewer than 6 poses at which the arm rested"):
        calibrate_recorded(few, HandEyeOptions(mounting="eye_in_hand"))
    with pytest.raises(DatasetError, match="holds joint angles and no poses: name the arm by --robot"):
        calibrate_recorded(
            recorded(tmp_path / "joints", data, "joints", "aruco_ros"), HandEyeOptions(mounting="eye_in_hand")
        )
    bag = Bag(tmp_path / "alone")
    for t, X, q in zip(data.t, data.robot, data.q, strict=True):
        ur_pose(bag, t, X, q)
    bag.writer.close()
    with pytest.raises(DatasetError, match="one list of poses, '/tcp_pose_broadcaster/pose', and two are needed"):
        calibrate_recorded(tmp_path / "alone", HandEyeOptions(mounting="eye_in_hand"))


def test_one_of_two_tags_is_chosen_by_its_name(tmp_path: Path) -> None:
    data = run()
    bag = Bag(tmp_path / "two")
    for t, X, C, q in zip(data.t, data.robot, data.camera, data.q, strict=True):
        tf_robot(bag, t, X, q)
        bag.tf(t, C, "camera_color_optical_frame", "tag_0")
        bag.tf(t, C @ transform(np.array([0.1, 0.0, 0.0]), np.zeros(3)), "camera_color_optical_frame", "tag_1")
    bag.writer.close()
    with pytest.raises(DatasetError, match=r"tag_0.*tag_1.*--camera-poses"):
        calibrate_recorded(tmp_path / "two", HandEyeOptions(mounting="eye_in_hand"))
    stated = StatedForms(camera_poses="tag_1")
    found = calibrate_recorded(tmp_path / "two", HandEyeOptions(mounting="eye_in_hand", stated=stated))
    assert found.result.X.translation() == pytest.approx(data.X[:3, 3], abs=8e-4)


def test_pictures_alone_are_no_poses(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "pictures")
    data = run(poses=3)
    for t, X, q in zip(data.t, data.robot, data.q, strict=True):
        ur_pose(bag, t, X, q)
    kind = "sensor_msgs/msg/Image"
    image = bag.of(kind, bag.header(0.0, "camera"), 2, 2, "mono8", 0, 2, np.zeros(4, np.uint8))
    bag.write("/camera/color/image_raw", kind, 0.0, image)
    bag.writer.close()
    with pytest.raises(DatasetError, match=r"holds pictures \(/camera/color/image_raw\).*--board"):
        calibrate_recorded(tmp_path / "pictures", HandEyeOptions(mounting="eye_in_hand"))
