"""Poses as people record them: each notation gives the same flange poses, and what cannot be told is asked for in one
sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.poses.names import mounting_name, natural
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange

N = 5
RNG = np.random.default_rng(3)
TURN = Rotation.random(N, rng=RNG)
X = pose(TURN.as_matrix(), RNG.uniform(0.2, 0.8, (N, 3)))
ROWS = list(zip(X[:, :3, 3].tolist(), TURN.as_quat().tolist(), strict=True))
P, MM = X[:, :3, 3], 1e3 * X[:, :3, 3]


def rows(*columns: np.ndarray, header: str = "", mark: str = ",") -> str:
    table = np.hstack(columns)
    return header + "".join(mark.join(repr(float(v)) for v in row) + "\n" for row in table)


def described(folder: Path, poses: str, units: str = "{clouds: m, poses: auto}") -> None:
    (folder / "dataset.yaml").write_text(
        f"schema: 1\nflange: 50-4-M6\nconfiguration: Eye-to-Hand\nunits: {units}\nposes: {poses}\n"
    )


def opencv(path: Path, nodes: dict[str, np.ndarray]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in nodes.items():
        storage.write(name, value)
    storage.release()


def each(folder: Path, write: Callable[[Path, np.ndarray], None], ending: str) -> None:
    (folder / "poses").mkdir()
    for k, one in enumerate(X):
        write(folder / "poses" / f"pos{k + 1:02d}.{ending}", one)


def text(name: str, content: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_text(content)

    return write


def euler(name: str, axes: str, unit: str = "deg") -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "poses.txt").write_text(rows(MM, TURN.as_euler(axes, degrees=True)))
        described(folder, f"{{rotation: {name}, angles: {unit}}}")

    return write


def unnamed_quaternion(order: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "poses.csv").write_text(rows(P, TURN.as_quat(scalar_first=order == "wxyz")))
        described(folder, f"{{rotation: quaternion_{order}}}")

    return write


def the_inverse(folder: Path) -> None:
    np.save(folder / "poses.npy", inverse(X))
    described(folder, "{frame: base_in_flange}")


def the_tcp(folder: Path) -> None:
    tcp = pose(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.01, 0.02, 0.15]))
    np.savez(folder / "poses.npz", poses=X @ tcp)
    described(folder, "{tcp: [0.01, 0.02, 0.15, 0.1, -0.2, 0.3]}")


def storage_of_vectors(folder: Path) -> None:
    (folder / "poses.json").write_text(
        '{"poses": ['
        + ",".join(
            f'{{"position": {{"x": {p[0]!r}, "y": {p[1]!r}, "z": {p[2]!r}}}, "orientation": {{"x": {q[0]!r}, "y":'
            f' {q[1]!r}, "z": {q[2]!r}, "w": {q[3]!r}}}}}'
            for p, q in zip(P.tolist(), TURN.as_quat().tolist(), strict=True)
        )
        + "]}"
    )


ROSTOPIC = "%time,field.header.stamp,field.header.frame_id," + ",".join(
    [f"field.pose.position.{a}" for a in "xyz"] + [f"field.pose.orientation.{a}" for a in "xyzw"]
)
TF = (
    "%time,field.transforms0.header.stamp,field.transforms0.header.frame_id,field.transforms0.child_frame_id,"
    + ",".join(
        [f"field.transforms0.transform.translation.{a}" for a in "xyz"]
        + [f"field.transforms0.transform.rotation.{a}" for a in "xyzw"]
    )
)


def rostopic(folder: Path) -> None:
    body = "".join(
        f"{10**18 + k},{10**18 + k},base,{','.join(map(repr, [*p, *q]))}\n"
        for k, (p, q) in enumerate(zip(P.tolist(), TURN.as_quat().tolist(), strict=True))
    )
    (folder / "tool_pose.csv").write_text(ROSTOPIC + "\n" + body)


def rostopic_tf(folder: Path) -> None:
    body = "".join(
        f"{10**18},{10**18},base,tool0_controller,{','.join(map(repr, [*p, *q]))}\n{10**18},{10**18},map,base,0,0,0,0,0,0,1\n"
        for p, q in zip(P.tolist(), TURN.as_quat().tolist(), strict=True)
    )
    (folder / "tf.csv").write_text(TF + "\n" + body)


FORMS: dict[str, Callable[[Path], None]] = {
    "UR vectors": text("poses.txt", "".join(f"p[{', '.join(map(repr, [*p, *r]))}]\n" for p, r in zip(P.tolist(), TURN.as_rotvec().tolist(), strict=True))),
    "UR vectors, mm and a header": text("poses.csv", rows(MM, TURN.as_rotvec(), header="x [mm],y [mm],z [mm],rx,ry,rz\n")),
    "RTDE recording": text("poses.csv", rows(P, TURN.as_rotvec(), mark=" ", header=" ".join(f"actual_TCP_pose_{k}" for k in range(6)) + "\n")),
    "roll, pitch, yaw": text("poses.csv", rows(P, TURN.as_euler("xyz"), header="x,y,z,roll,pitch,yaw\n")),
    "KUKA": text("poses.csv", rows(MM, TURN.as_euler("ZYX", degrees=True), header="X;Y;Z;A;B;C\n", mark=";")),
    "Fanuc": text("poses.csv", rows(MM, TURN.as_euler("xyz", degrees=True), header="x,y,z,w,p,r\n")),
    "Euler, moving axes": euler("euler_ZYZ", "ZYZ"),
    "Euler, fixed axes": euler("euler_xyz", "xyz"),
    "quaternions, w last": unnamed_quaternion("xyzw"),
    "quaternions, w first": unnamed_quaternion("wxyz"),
    "the inverse": the_inverse,
    "a TCP": the_tcp,
    "16 numbers, column by column": text("poses.csv", rows(np.swapaxes(X, 1, 2).reshape(N, 16))),
    "matrices, one below the other": text("poses.txt", "\n".join("\n".join(" ".join(map(repr, r)) for r in M) + "\n" for M in X.tolist())),
    "16 numbers a row": text("poses.csv", rows(X.reshape(N, 16))),
    "one text a pose": lambda folder: each(folder, lambda path, M: np.savetxt(path, M, fmt="%.17g"), "txt"),
    "one npy a pose": lambda folder: each(folder, np.save, "npy"),
    "one FileStorage a pose": lambda folder: each(folder, lambda path, M: opencv(path, {"T": M}), "yml"),
    "Zivid": lambda folder: each(folder, lambda path, M: opencv(path, {"PoseState": np.block([[M[:3, :3], 1e3 * M[:3, 3:]], [M[3:]]])}), "yaml"),
    "FileStorage, a node a pose": lambda folder: opencv(folder / "poses.yml", {f"pose{k}": M for k, M in enumerate(X, 1)}),
    "FileStorage, XML": lambda folder: opencv(folder / "poses.xml", {f"pose{k}": M for k, M in enumerate(X, 1)}),
    "FileStorage, JSON": lambda folder: opencv(folder / "poses.json", {f"pose{k}": M for k, M in enumerate(X, 1)}),
    "FileStorage, R and t": lambda folder: opencv(folder / "poses.yml", {"R_gripper2base": X[:, :3, :3].reshape(-1, 3).copy(),
                                                                         "t_gripper2base": P.reshape(-1, 1).copy(), "K": np.eye(3)}),
    "JSON of ROS poses": storage_of_vectors,
    "rostopic echo -p": rostopic,
    "rostopic echo -p tf": rostopic_tf,
    "ros2 topic echo --csv": text("tool_pose.csv", "".join(f"17000000,5,base,{','.join(map(repr, [*p, *q]))}\n" for p, q in ROWS)),
}  # fmt: skip


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    (tmp_path / "clouds").mkdir()
    for k in range(N):
        points = np.random.default_rng(k).uniform(0.3, 0.6, (40, 3))
        save_cloud(tmp_path / "clouds" / f"img{k + 1:02d}.npz", points)
    return tmp_path


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_flange_poses_and_says_how_it_was_read(scans: Path, form: str) -> None:
    FORMS[form](scans)
    data = load_dataset(scans)
    found = np.array([data.poses[id].GetAsMatrix4() for id in data.clouds])
    assert found == pytest.approx(X, abs=1e-9)
    assert [p.stem for p in data.clouds.values()] == [f"img{k + 1:02d}" for k in range(N)]
    assert data.header.configuration == "eye_on_base"
    assert f"{N} poses" in data.notes[0]
    assert data.cloud(next(iter(data.clouds))).shape == (40, 3)


HALF = X.copy()
HALF[:, :3, :3] *= 1.1
SENTENCES = {
    "fewer poses than clouds": ("poses.txt", rows(P[:-1], TURN.as_rotvec()[:-1]), "has 4 poses, but there are 5 clouds"),
    "no rotations": ("poses.csv", rows(HALF.reshape(N, 16)), "are no rigid pose"),
    "5 numbers": ("poses.txt", rows(P, P[:, :2]), "which is no list of poses"),
    "other names": ("poses.csv", "name,x,y,z,rx,ry,rz\n" + "".join(f"view{k + 20},0.5,0,0.5,0,0,{k}\n" for k in range(N)), "names do not go together"),
    "two units": ("poses.csv", rows(P, TURN.as_rotvec(), header="x_mm,y_m,z_m,rx,ry,rz\n"), "state units that differ"),
}  # fmt: skip


@pytest.mark.parametrize("case", SENTENCES)
def test_what_cannot_be_told_is_asked_for_in_one_sentence(scans: Path, case: str) -> None:
    name, content, sentence = SENTENCES[case]
    (scans / name).write_text(content)
    with pytest.raises(DatasetError) as caught:
        load_dataset(scans)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_that_begin_elsewhere_are_not_paired(scans: Path) -> None:
    opencv(scans / "poses.yml", {f"pose{k}": M for k, M in enumerate(X)})  # pose0 to pose4, and img01 to img05
    with pytest.raises(
        DatasetError,
        match=r"names do not go together: 'poses\.yml.*' has 5 poses, pose0 to pose4, and there are 5 clouds",
    ):
        load_dataset(scans)


OTHER = {
    "rotation vectors in degrees": (rows(P, TURN.as_rotvec(degrees=True), header="x,y,z,rx,ry,rz\n"), "rotation_vector,deg"),
    "fixed angles in degrees": (rows(P, TURN.as_euler("xyz", degrees=True), header="x,y,z,rx,ry,rz\n"), "euler_xyz,deg"),
    "three unnamed angles": (rows(P, TURN.as_euler("zyx"), header="x,y,z,alpha,beta,gamma\n"), "euler_zyx,rad"),
    "seven numbers": (rows(P, TURN.as_quat(scalar_first=True)), "quaternion_wxyz"),
    "a numbered quaternion": (rows(P, TURN.as_quat(), header="x,y,z,q0,q1,q2,q3\n"), "quaternion_xyzw"),
}  # fmt: skip


@pytest.mark.parametrize("case", OTHER)
def test_a_form_that_states_no_convention_keeps_every_reading(scans: Path, case: str) -> None:
    content, form = OTHER[case]
    (scans / "poses.csv").write_text(content)
    data = load_dataset(scans)
    found = next(one for one in data.readings if one.form == form)
    assert pytest.approx(X, abs=1e-9) == found.X


def test_radians_called_degrees_and_a_wrong_unit_are_named(scans: Path) -> None:
    (scans / "poses.txt").write_text(rows(P, TURN.as_rotvec()))
    described(scans, "{angles: deg}")
    with pytest.raises(DatasetError, match=r"look like radians. State rad by 'poses: {angles: rad}' in dataset\.yaml"):
        load_dataset(scans)
    described(scans, "{}", "{clouds: m, poses: mm}")
    with pytest.raises(DatasetError, match="look like m; correct units"):
        load_dataset(scans)


def test_captures_in_a_closed_format_are_to_be_exported(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / f"img{k:02d}.zdf").write_bytes(b"closed")
        opencv(tmp_path / f"pos{k:02d}.yaml", {"PoseState": X[k]})
    with pytest.raises(DatasetError, match=r"\.zdf files .* Export each as \.ply or \.pcd"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("missing", ["qz", "qw", "z"])
def test_joint_angles_do_not_stand_for_a_missing_column(scans: Path, missing: str) -> None:
    names = [
        n for n in ("id", "x", "y", "z", "qw", "qx", "qy", "qz", "q1", "q2", "q3", "q4", "q5", "q6") if n != missing
    ]
    text = [
        ",".join(names),
        *(",".join([f"s{k}", *(f"{0.1 * k + 0.01 * c:.3f}" for c in range(12))]) for k in range(6)),
    ]
    (scans / "poses.csv").write_text("\n".join(text) + "\n")
    with pytest.raises(DatasetError, match=f"lacks the column {missing}|names no columns|no rotation that it names"):
        load_dataset(scans)


@pytest.mark.parametrize("configuration", ["eye-in-hand", "co_manipulation"])
def test_scans_of_a_carried_scanner_are_sent_to_calibrate(scans: Path, configuration: str) -> None:
    np.save(scans / "poses.npy", X)
    (scans / "dataset.yaml").write_text(f"schema: 1\nconfiguration: {configuration}\n")
    with pytest.raises(DatasetError, match="Give the folder to 'weldcal calibrate'"):
        load_dataset(scans)


@pytest.mark.parametrize(
    "name",
    [
        "ISO 9409-1-50-4-M6",
        "ISO 9409-1 - 50 - 4 - M6",
        "50-4-M6",
        "DIN EN ISO 9409-1:2004-A50-4-M6",
        "iso9409-1-50-4-m6",
    ],
)
def test_a_flange_is_known_by_its_catalogue_names(name: str) -> None:
    assert get_flange(name).designation == "iso9409-1-50-4-m6"
    with pytest.raises(InputError, match="is not known"):
        get_flange("ISO 9409-1-55-4-M6")


def test_names_of_mountings_and_numbers_in_names() -> None:
    assert {mounting_name(n) for n in ("eye_to_hand", "Eye-to-hand", "eye on base")} == {"eye_on_base"}
    assert {mounting_name(n) for n in ("eye-in-hand", "EYE IN HAND", "eye_on_hand")} == {"eye_in_hand"}
    assert sorted(["img10", "img2", "img1"], key=natural) == ["img1", "img2", "img10"]


SEEN = inverse(X @ pose(np.eye(3), np.array([0.0, 0.1, 0.2])))  # target at the base, camera on the flange


def by_opencv(folder: Path) -> Path:
    opencv(
        folder / "hand_eye.yml",
        {"R_gripper2base": X[:, :3, :3].reshape(-1, 3).copy(), "t_gripper2base": P.reshape(-1, 1).copy(),
         "R_target2cam": SEEN[:, :3, :3].reshape(-1, 3).copy(), "t_target2cam": SEEN[:, :3, 3].reshape(-1, 1).copy()},
    )  # fmt: skip
    return folder / "hand_eye.yml"


def by_npz(folder: Path) -> Path:
    X_FB = inverse(X)
    np.savez(folder / "h.npz", R_base2gripper=X_FB[:, :3, :3], t_base2gripper=X_FB[:, :3, 3], R_target2cam=SEEN[:, :3, :3], t_target2cam=SEEN[:, :3, 3])  # fmt: skip
    return folder / "h.npz"


def by_folders(folder: Path) -> Path:
    for name, poses in (("robot", X), ("camera", SEEN)):
        (folder / name).mkdir()
        for k, one in enumerate(poses):
            np.savetxt(folder / name / f"{name}{k}.txt", one, fmt="%.17g")
    return folder


def by_two_tables(folder: Path) -> Path:
    for name, poses in (("robot", X), ("camera", SEEN)):
        turn = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
        (folder / f"{name}.csv").write_text(rows(poses[:, :3, 3], turn, header="x,y,z,rx,ry,rz\n"))
    return folder


@pytest.mark.parametrize("write", [by_opencv, by_npz, by_folders, by_two_tables])
def test_hand_eye_reads_both_lists_from_other_tools_files(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    pairs = read_pairs(write(tmp_path), mounting="eye-in-hand")
    assert pairs.mode == "eye_in_hand"
    assert pairs.robot == pytest.approx(X, abs=1e-9)
    assert pairs.camera == pytest.approx(SEEN, abs=1e-9)


def test_a_folder_of_scans_is_sent_from_hand_eye_to_calibrate(scans: Path) -> None:
    with pytest.raises(DatasetError, match="weldcal calibrate"):
        read_pairs(scans, mounting="eye_in_hand")
