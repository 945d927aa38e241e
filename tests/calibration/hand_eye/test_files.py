"""Pose files of every kind read alike, and what is wrong with one is said in a sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye.poses import Array, co_manipulation, eye_in_hand
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.geometry.se3 import inverse
from weldcal.calibration.hand_eye.opencv_methods import opencv_held_out
from weldcal.calibration.hand_eye.pairs.files import PosePairs, read_pairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.starts import motions
from weldcal.calibration.recorded_hand_eye import HandEyeOptions
from weldcal.models.errors import InputError
from weldcal.tools.commands.hand_eye import run_hand_eye

HEADER = ",".join(f"{who}_{c}" for who in ("robot", "camera") for c in ("x", "y", "z", "qw", "qx", "qy", "qz"))


@pytest.fixture(scope="module")
def poses() -> tuple[Array, Array]:
    F, G, _, _ = eye_in_hand(12, np.random.default_rng(0), np.radians(0.05), 2e-4)
    return F, G


def numbers(X: Array, scale: float = 1.0) -> list[float]:
    return [*(scale * X[:3, 3]), *Rotation.from_matrix(X[:3, :3]).as_quat(scalar_first=True)]


def transform(X: Array) -> dict[str, dict[str, float]]:
    x, y, z = X[:3, 3]
    qw, qx, qy, qz = Rotation.from_matrix(X[:3, :3]).as_quat(scalar_first=True)
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def write(kind: str, folder: Path, F: Array, G: Array) -> Path:
    path = folder / {"npz": "a.npz", "csv": "a.csv", "rotvec": "b.csv", "json": "a.json"}.get(kind, "a.yaml")
    if kind == "npz":
        np.savez(path, A=F, B=G, mode="eye_in_hand")
    elif kind == "csv":
        path.write_text(
            "\n".join(
                [HEADER, *(",".join(map(repr, map(float, numbers(a) + numbers(b)))) for a, b in zip(F, G, strict=True))]
            )
        )
    elif kind == "rotvec":
        names = ",".join(f"{w}_{c}" for w in ("robot", "camera") for c in ("x", "y", "z", "rx", "ry", "rz"))
        rows = [[*a[:3, 3], *Rotation.from_matrix(a[:3, :3]).as_rotvec()] for a in np.concatenate([F, G])]
        both = [rows[i] + rows[len(F) + i] for i in range(len(F))]
        path.write_text(
            "\n".join(
                [f"id,{names}", *(f"p{i}," + ",".join(f"{v!r}" for v in map(float, r)) for i, r in enumerate(both))]
            )
        )
    elif kind == "json":
        path.write_text(json.dumps({"A": F.tolist(), "B": G.tolist(), "mode": "eye_in_hand"}))
    elif kind == "moveit":
        lines = []
        for a, b in zip(F, G, strict=True):
            lines += [f"- effector_wrt_world: {a.ravel().tolist()}", f"  object_wrt_sensor: {b.ravel().tolist()}"]
        path.write_text("\n".join(lines))
    else:  # easy_handeye2; JSON is YAML
        samples = [{"robot": transform(a), "tracking": transform(b)} for a, b in zip(F, G, strict=True)]
        path.write_text(json.dumps({"parameters": {"calibration_type": ""}, "samples": samples}))
    return path


@pytest.mark.parametrize("kind", ["npz", "csv", "rotvec", "json", "moveit", "easy_handeye2"])
def test_every_kind_of_file_holds_the_same_poses(kind: str, tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    pairs = read_pairs(write(kind, tmp_path, F, G), mounting="eye_in_hand")
    np.testing.assert_allclose(pairs.F, F, atol=1e-12)
    np.testing.assert_allclose(pairs.G, G, atol=1e-12)


def test_easy_handeye_stores_the_base_in_the_hand_where_the_eye_is_on_the_base(
    tmp_path: Path, poses: tuple[Array, Array]
) -> None:
    F, G = poses
    pairs = read_pairs(write("easy_handeye2", tmp_path, F, G), mounting="eye_on_base")
    np.testing.assert_allclose(pairs.robot, inverse(F), atol=1e-12)
    np.testing.assert_allclose(pairs.F, F, atol=1e-12)


def read_error(text: str, path: Path, **options: str) -> str:
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_pairs(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_bad_file_is_named_in_a_sentence(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    csv = tmp_path / "a.csv"
    assert "no list of poses" in read_error("1,2,3\n4,5,6", csv)
    assert "is empty" in read_error("", csv)
    assert "holds no poses" in read_error(HEADER, csv, mounting="eye_in_hand")
    row = ",".join(map(str, numbers(F[0]) + numbers(G[0])))
    assert "add --mounting" in read_error(f"{HEADER}\n{row}", csv)
    assert "A number is missing" in read_error(f"{HEADER}\n{row.replace(row.split(',')[0], 'x', 1)}", csv)
    assert "A number is missing" in read_error(
        f"{HEADER}\n" + ",".join(row.split(",")[:9]), csv, mounting="eye_in_hand"
    )
    assert "cannot be read as JSON" in read_error("{", tmp_path / "a.json")
    assert "holds no poses" in read_error("a: 1", tmp_path / "a.yaml", mounting="eye_in_hand")
    assert "holds no poses" in read_error(
        "- effector_wrt_world: [1, 2]\n  object_wrt_sensor: [1]", tmp_path / "a.yaml", mounting="eye_in_hand"
    )
    with pytest.raises(DatasetError, match="no file"):
        read_pairs(tmp_path / "none.csv")
    path = write("npz", tmp_path, F, G)
    with pytest.raises(DatasetError, match="correct one of them"):
        read_pairs(path, mounting="eye_on_base")


def test_millimetres_follow_from_the_reach_and_the_motion(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    mm_F, mm_G = F.copy(), G.copy()
    for X in (mm_F, mm_G):
        X[:, :3, 3] *= 1e3
    for robot, camera, units in ((mm_F, mm_G, ("mm", "mm")), (mm_F, G, ("mm", "m")), (F, mm_G, ("m", "mm"))):
        pairs = read_pairs(write("json", tmp_path, robot, camera))
        np.testing.assert_allclose(pairs.F, F, atol=1e-12)
        np.testing.assert_allclose(pairs.G, G, atol=1e-12)
        assert tuple(pairs.reading[who]["unit"] for who in ("robot", "camera")) == units
    np.testing.assert_allclose(read_pairs(write("json", tmp_path, mm_F, mm_G), length="mm").G, G, atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [("camera", "poses are inverted"), ("robot", "mounted eye_on_base"), ("unit", "multiplied by")],
)
def test_one_mistake_is_recognised(wrong: str, sentence: str, tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses[0].copy(), poses[1].copy()
    if wrong == "robot":
        F = inverse(F)
    if wrong == "camera":
        G = inverse(G)
    if wrong == "unit":  # squares of 28.5 mm were counted
        G[:, :3, 3] /= 0.0285
    np.savez(tmp_path / "a.npz", A=F, B=G, mode="eye_in_hand")
    with pytest.raises(InconsistentPoses, match=sentence):
        run_hand_eye(tmp_path / "a.npz", tmp_path, HandEyeOptions())


def test_the_command_writes_what_other_programs_read(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    report = run_hand_eye(write("npz", tmp_path, *poses), tmp_path / "out", HandEyeOptions())
    names = {p.name for p in report.files}
    assert {"hand_eye.yaml", "hand_eye.json", "X_FC.urdf.xacro", "X_FC.drake.yaml", "X_BM.static_transform.sh"} <= names
    saved = json.loads((tmp_path / "out" / "hand_eye.json").read_text())
    assert saved["poses"]["X_FC"]["meaning"] == "pose of the camera in the flange frame: X_FC"
    np.testing.assert_allclose(saved["poses"]["X_FC"]["matrix"], report.result.X.GetAsMatrix4(), atol=1e-15)
    assert "mm" in report.first.rows()["one sigma"]
    assert {c.method for c in report.comparison} >= {"weldcal", "PARK", "SHAH"}
    assert report.next_pose is not None
    assert report.next_pose.sigma_after < report.next_pose.sigma_before


def test_two_robots_want_their_own_equation(tmp_path: Path) -> None:
    A, B, C, *_ = co_manipulation(20, np.random.default_rng(1), np.radians(0.02), 1e-4)
    path = tmp_path / "two.npz"
    np.savez(path, A=A, B=B, C=C)
    with pytest.raises(InputError, match="hand-eye axb-ycz"):
        run_hand_eye(path, tmp_path, HandEyeOptions())
    report = run_hand_eye(path, tmp_path, HandEyeOptions(equation="axb-ycz"))
    assert set(report.result.poses) == {"X", "Y", "Z"}
    assert report.summary()["Y_is"] == "pose of the second robot's base in the first robot's base frame: X_BD"


def test_pairs_know_their_equation() -> None:
    F, G, _, _ = eye_in_hand(3, np.random.default_rng(2))
    np.testing.assert_allclose(PosePairs(source="a", robot=F, camera=G, mode="eye_on_base").F, inverse(F))


def test_a_table_of_another_spreadsheet_is_the_same_table(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    plain = write("csv", tmp_path, F, G)
    header, *rows = plain.read_text().splitlines()
    other = tmp_path / "other.csv"
    text = "\n".join(["# Monday", header.upper() + ",note", *(f"{row},fine" for row in rows), "," * 14])
    other.write_text("\ufeff" + text.replace(",", ";").replace(".", ","), encoding="utf-8")
    read, wanted = (read_pairs(f, mounting="eye_in_hand") for f in (other, plain))
    assert np.array_equal(read.F, wanted.F)
    assert np.array_equal(read.G, wanted.G)


def test_a_file_that_no_pairs_can_be_in_is_named(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    (tmp_path / "a.npz").write_bytes(b"")
    with pytest.raises(DatasetError, match="not an npz file"):
        read_pairs(tmp_path / "a.npz")
    np.savez(tmp_path / "streams.npz", hand=np.zeros((9, 8)), eye=np.zeros((9, 8)))
    with pytest.raises(DatasetError, match="two streams"):
        read_pairs(tmp_path / "streams.npz")
    degrees = [[*X[:3, 3], *np.degrees(Rotation.from_matrix(X[:3, :3]).as_rotvec())] for X in (F[0], G[0])]
    names = ",".join(f"{who}_{c}" for who in ("robot", "camera") for c in ("x", "y", "z", "rx", "ry", "rz"))
    row = ",".join(str(v) for v in degrees[0] + degrees[1])
    np.testing.assert_allclose(
        read_pairs(_text(tmp_path / "a.csv", f"{names}\n{row}"), mounting="eye_in_hand").robot, F[:1], atol=1e-12
    )


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_word_of_an_npz_may_be_bytes_or_an_array(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    for word in (np.bytes_(b"eye_in_hand"), np.array(["eye_in_hand"])):
        np.savez(tmp_path / "a.npz", X_base_gripper=F, X_camera_target=G, mode=word)
        assert read_pairs(tmp_path / "a.npz").mode == "eye_in_hand"


def test_samples_that_repeat_others_are_named(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    path = write("npz", tmp_path, np.concatenate([F, F[:3]]), np.concatenate([G, G[:3]]))
    report = run_hand_eye(path, tmp_path / "out", HandEyeOptions())
    assert any(text.startswith("The 15 samples repeat 12 poses") for text in report.first.notes)


def test_corners_that_are_of_no_use_leave_the_poses_as_given(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    marker = np.array([[-0.05, 0.05, 0.0], [0.05, 0.05, 0.0], [0.05, -0.05, 0.0], [-0.05, -0.05, 0.0]])
    seen = {"obj": marker, "K": np.diag([600.0, 600.0, 1.0])}
    for count, sentence in ((len(F), "only 4 corners"), (len(F) - 1, "it must be")):
        path = tmp_path / "marker.npz"
        np.savez(path, A=F, B=G, mode="eye_in_hand", img=np.ones((count, 4, 2)), **seen)
        report = run_hand_eye(path, tmp_path / "out", HandEyeOptions(corners=None))
        assert sentence in report.corners
        with pytest.raises(DatasetError, match=sentence):
            run_hand_eye(path, tmp_path / "out", HandEyeOptions(corners=True))


def test_ragged_and_impossible_numbers_are_named(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = (X.tolist() for X in poses)
    path = tmp_path / "a.json"

    def said(**change: object) -> str:
        return read_error(json.dumps({"A": F, "B": G, "mode": "eye_in_hand", **change}), path)

    assert "each row as long as the others" in said(A=[*F[:-1], F[-1][:3]])
    assert "one list of poses" in said(A=[*F[:-1], 10**400])
    assert "pair in order" in said(B=G[:5])
    assert "mode by a word" in said(mode=["eye_in_hand"])
    assert "key 'A' twice" in read_error('{"A": [], "A": []}', path)
    assert "correct --unit" in read_error(json.dumps({"A": F, "B": G}), path, mounting="eye_in_hand", length="mm")
    (tmp_path / "a.npz").write_bytes(write("npz", tmp_path, *poses).read_bytes()[:-300])
    with pytest.raises(DatasetError, match="not an npz file, or damaged"):
        read_pairs(tmp_path / "a.npz")


def test_opencv_is_compared_on_as_many_poses_as_it_can_hold(tmp_path: Path, poses: tuple[Array, Array]) -> None:
    F, G = poses
    whole = opencv_held_out("PARK", F, G)
    assert np.array_equal(opencv_held_out("PARK", F, G, most=len(F)).translation, whole.translation)
    assert not np.array_equal(opencv_held_out("PARK", F, G, most=5).translation, whole.translation)


@pytest.mark.parametrize("n", [2, 3, 30, 137])
def test_motions_are_every_so_many_of_all_pairs(n: int) -> None:
    F, G, _, _ = eye_in_hand(n, np.random.default_rng(3))
    i, j = np.triu_indices(n, 1)
    step = max(1, n * (n - 1) // (2 * 600))
    P, _ = motions(full_problem(F, G), (np.eye(4),) * 3)
    np.testing.assert_allclose(P, (inverse(F[i]) @ F[j])[::step], atol=1e-12)
