"""Tables of joint angles stand for poses where the arm is named, and `poses.csv` is read in any form of a table."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.data.pose_texts import MATRICES, TEXTS, N, P, Q
from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.dataset import joint_angles, load_dataset
from weldcal.calibration.data.poses.names import columns_of, joint_columns
from weldcal.calibration.data.poses.text import lists_of_text
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

ANGLES = np.random.default_rng(5).uniform(-2.5, 2.5, (N, 6))
# Universal Robots' published table of the UR10e: a, d in m, alpha in quarter turns
UR10E = ((0, 0.1807, 1), (-0.6127, 0, 0), (-0.57155, 0, 0), (0, 0.17415, 1), (0, 0.11985, -1), (0, 0.11655, 0))


def flange(q: Array) -> Array:
    """Denavit and Hartenberg's product, by hand."""
    X = np.eye(4)
    for (a, d, quarter), angle in zip(UR10E, q, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), float(quarter == 0), float(quarter)
        X = X @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return X


POSES = np.array([flange(q) for q in ANGLES])
HEADERS = {
    "j": "j1,j2,j3,j4,j5,j6",
    "q": "q1,q2,q3,q4,q5,q6",
    "from zero": "q0,q1,q2,q3,q4,q5",
    "joint": "joint_1;joint_2;joint_3;joint_4;joint_5;joint_6",
    "KUKA": "A1;A2;A3;A4;A5;A6",
    "Fanuc": "J1 [deg];J2 [deg];J3 [deg];J4 [deg];J5 [deg];J6 [deg]",
    "Kawasaki": "JT1,JT2,JT3,JT4,JT5,JT6",
    "RTDE": "actual_q_0,actual_q_1,actual_q_2,actual_q_3,actual_q_4,actual_q_5",
    "ROS": "elbow_joint,shoulder_lift_joint,shoulder_pan_joint,wrist_1_joint,wrist_2_joint,wrist_3_joint",
    "Yaskawa": "S,L,U,R,B,T",
}


def write_clouds(folder: Path, first: int) -> Path:
    for k in range(N):
        cloud = np.random.default_rng(k).uniform(0.5, 1.0, (50, 3))
        save_cloud(folder / "clouds" / f"s{k + first}.npz", cloud)
    return folder


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    return write_clouds(tmp_path, 1)


def table(header: str, *, degrees: bool) -> str:
    mark = ";" if ";" in header else ","
    order = [2, 1, 0, 3, 4, 5] if header.startswith("elbow") else [0, 1, 2, 3, 4, 5]
    angles = np.degrees(ANGLES[:, order]) if degrees else ANGLES[:, order]
    return "\n".join([header, *(mark.join(f"{v:.9f}" for v in row) for row in angles)]) + "\n"


@pytest.mark.parametrize("case", TEXTS)
def test_poses_csv_is_read_in_any_form_of_a_table(tmp_path: Path, case: str) -> None:
    scans = write_clouds(tmp_path, 0 if case in ("ABB RAPID", "ids, rvec, tvec") else 1)
    (scans / "poses.csv").write_text(TEXTS[case][0])
    data = load_dataset(scans)
    assert len(data.clouds) == N
    assert data.joints() == {}
    assert joint_angles(data, list(data.clouds), 6) is None


@pytest.mark.parametrize("degrees", [False, True])
@pytest.mark.parametrize("case", HEADERS)
def test_joint_angles_stand_for_poses_of_a_named_arm(scans: Path, case: str, degrees: bool) -> None:
    header = HEADERS[case] if degrees else HEADERS[case].replace(" [deg]", "")
    (scans / "poses.csv").write_text(table(header, degrees=degrees))
    data = load_dataset(scans, robot="ur10e")
    assert np.array([X.GetAsMatrix4() for X in data.poses.values()]) == pytest.approx(POSES, abs=1e-6)
    assert joint_angles(data, list(data.poses), 6) == pytest.approx(ANGLES, abs=1e-6)
    assert f"joint angles in {'degrees' if degrees else 'radians'} with the kinematics of ur10e" in data.notes[0]


@pytest.mark.parametrize("case", HEADERS)
def test_joint_angles_of_no_named_arm_ask_for_it(scans: Path, case: str) -> None:
    (scans / "poses.csv").write_text(table(HEADERS[case], degrees=True))
    with pytest.raises(DatasetError, match="holds joint angles and no poses: name the arm by --robot"):
        load_dataset(scans)
    with pytest.raises(DatasetError, match="6 joint angles a row, and franka_panda has 7"):
        load_dataset(scans, robot="franka_panda")
    (scans / "dataset.yaml").write_text("schema: 1\nrobot: ur10e\nconfiguration: eye_on_base\n")
    assert len(load_dataset(scans).poses) == N


def test_pulses_and_degrees_called_radians_are_refused() -> None:
    with pytest.raises(DatasetError, match="they look like degrees"):
        lists_of_text(table(HEADERS["Fanuc"].replace("deg", "rad"), degrees=True), "a.csv")
    with pytest.raises(DatasetError, match="write angles in degrees or radians"):
        lists_of_text("s,l,u,r,b,t\n" + "12000,-48100,33,1,2,3\n" * 3, "a.csv")


def test_joint_angles_beside_poses_are_kept_with_them(scans: Path) -> None:
    rows = [",".join(f"{v:.9f}" for v in (*P[k], *Q[k], *np.degrees(ANGLES[k]))) for k in range(N)]
    (scans / "poses.csv").write_text("x,y,z,qx,qy,qz,qw," + HEADERS["j"] + "\n" + "\n".join(rows) + "\n")
    data = load_dataset(scans)
    assert next(iter(data.poses.values())).GetAsMatrix4() == pytest.approx(MATRICES[0], abs=1e-7)
    assert joint_angles(data, list(data.poses), 6) == pytest.approx(ANGLES, abs=1e-6)


def test_a_quaternion_and_velocities_are_no_joint_angles() -> None:
    assert joint_columns(["x", "y", "z", "q1", "q2", "q3", "q4"]) == []
    assert joint_columns([f"actual_qd_{k}" for k in range(6)]) == []
    both = [f"{who}_q_{k}" for who in ("target", "actual") for k in range(6)]
    assert [one.indices for one in joint_columns(both)] == [(6, 7, 8, 9, 10, 11)]


def test_pairs_take_the_robots_poses_from_joint_angles(tmp_path: Path) -> None:
    (tmp_path / "robot.csv").write_text(table(HEADERS["KUKA"], degrees=True))
    seen = np.linalg.inv(POSES) @ MATRICES[0]
    np.save(tmp_path / "camera.npy", seen)
    with pytest.raises(DatasetError, match="name the arm by --robot"):
        read_pairs(tmp_path, mounting="eye_in_hand")
    found = read_pairs(tmp_path, mounting="eye_in_hand", stated=StatedForms(arm="ur10e"))
    assert found.robot == pytest.approx(POSES, abs=1e-6)
    assert found.q == pytest.approx(ANGLES, abs=1e-6)
    with pytest.raises(InputError, match="no arm 'ur99'"):
        read_pairs(tmp_path, mounting="eye_in_hand", stated=StatedForms(arm="ur99"))


SEEN = np.linalg.inv(POSES) @ MATRICES[0]


def beside(header: str, X: Array) -> str:
    rows = np.hstack([np.degrees(ANGLES), X[:, :3, 3], Rotation.from_matrix(X[:, :3, :3]).as_quat()])
    return HEADERS["j"] + f",{header}\n" + "".join(",".join(f"{v:.9f}" for v in row) + "\n" for row in rows)


WRITTEN: dict[str, Callable[[Path], object]] = {
    "unnamed.csv": lambda file: file.write_text(beside("x,y,z,qx,qy,qz,qw", SEEN)),
    "named.csv": lambda file: file.write_text(
        beside(",".join(f"cam_{k}" for k in ("x", "y", "z", "qx", "qy", "qz", "qw")), SEEN)
    ),
    "letters.npz": lambda file: np.savez(file, q=ANGLES, B=SEEN),
    "words.npz": lambda file: np.savez(file, joint_angles_deg=np.degrees(ANGLES), T_cam_target=SEEN),
    "samples.json": lambda file: file.write_text(
        json.dumps([{"joints": q.tolist(), "T_cam_board": X.tolist()} for q, X in zip(ANGLES, SEEN, strict=True)])
    ),
    "lists.json": lambda file: file.write_text(
        json.dumps({"joint_positions": ANGLES.tolist(), "marker_poses": SEEN.tolist()})
    ),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_joint_angles_and_camera_poses_of_one_file_are_pairs(name: str, tmp_path: Path) -> None:
    WRITTEN[name](tmp_path / name)
    with pytest.raises(DatasetError, match="name the arm by --robot"):
        read_pairs(tmp_path / name, mounting="eye_in_hand")
    found = read_pairs(tmp_path / name, mounting="eye_in_hand", stated=StatedForms(arm="ur10e"))
    assert found.robot == pytest.approx(POSES, abs=1e-6)
    assert found.camera == pytest.approx(SEEN, abs=1e-6)
    assert found.q == pytest.approx(ANGLES, abs=1e-6)


def test_poses_of_the_tool_beside_its_joint_angles_are_no_pairs(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(beside("x,y,z,qx,qy,qz,qw", POSES @ MATRICES[1]))
    with pytest.raises(DatasetError, match="are those of the joint angles beside them"):
        read_pairs(tmp_path / "log.csv", mounting="eye_in_hand", stated=StatedForms(arm="ur10e"))


def test_an_arm_that_does_not_turn_has_camera_poses_beside_its_joint_angles(tmp_path: Path) -> None:
    """Moved along the base's axes alone, the camera's poses do not turn either."""
    still = ANGLES[0] + 1e-4 * np.random.default_rng(1).normal(size=ANGLES.shape)
    arm = np.array([flange(q) for q in still])
    rows = [
        [*q, *X[:3, 3], *Rotation.from_matrix(X[:3, :3]).as_quat()]
        for q, X in zip(still, np.linalg.inv(arm), strict=True)
    ]
    text = "\n".join(",".join(f"{v:.12f}" for v in row) for row in rows)
    (tmp_path / "log.csv").write_text(HEADERS["j"] + ",x,y,z,qx,qy,qz,qw\n" + text + "\n")
    found = read_pairs(tmp_path / "log.csv", mounting="eye_in_hand", stated=StatedForms(arm="ur10e"))
    assert found.camera == pytest.approx(np.linalg.inv(arm), abs=1e-6)


@pytest.mark.parametrize("header", ["x,y,z,qx,qy,qz,qw,u,v", "x,y,z,rx,ry,rz,e,theta", "u,v,x,z"])
def test_pixels_and_errors_are_no_part_of_a_pose(header: str) -> None:
    names = header.split(",")
    assert not {c.role for c in columns_of(names)[0]} & {"u", "v", "e", "th"}
