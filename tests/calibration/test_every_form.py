"""What `hand-eye` reads, `verify`, `import` and `profiler` read too; advice that is followed ends."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.hand_eye.pair_sources import READ
from tests.calibration.hand_eye.pair_world import BASE, HAND, X_BASE, A, B, X
from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.eye_on_base.observations import choose_reading
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.calibration.profiler.importing import import_profiles
from weldcal.calibration.recorded_hand_eye import pairs_or_streams, stated_forms
from weldcal.calibration.verified_pairs import PairsOptions, verify_pairs
from weldcal.models.errors import InputError
from weldcal.tools.commands.import_data import import_pose_pairs
from weldcal.tools.commands.profiler.files import read_profiler_file

STATED = stated_forms(None, None, None, None)


@pytest.mark.parametrize("name", READ)
def test_profiles_take_the_robots_poses_of_each_form_of_pairs(name: str, tmp_path: Path) -> None:
    make, mounting = READ[name]
    (tmp_path / "pairs").mkdir()
    source = make(tmp_path / "pairs")
    rows = "".join(f"{k},{x},200\n" for k in range(len(A)) for x in range(3))
    (tmp_path / "export.csv").write_text("scan,px_mm,pz_mm\n" + rows)
    found = import_profiles(tmp_path / "export.csv", poses=source)
    wanted = read_pairs(source, mounting=mounting).robot
    if "," not in name and name != "inch and mm":  # another order is paired by numbers; no size tells inches
        assert any(np.allclose(one.X[0], wanted[0], atol=2e-3) for one in found.readings)
    assert len(found.readings[0].X) == len(A)


def streams(path: Path) -> Path:
    """An npz of two recordings in motion, 25 and 20 Hz."""
    rng = np.random.default_rng(5)
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation

    knots = np.arange(0.0, 31.0, 1.5)
    p, w = (CubicSpline(knots, s * rng.standard_normal((len(knots), 3))) for s in (0.08, 0.25))

    def hand(t: np.ndarray) -> np.ndarray:
        F = np.tile(np.eye(4), (len(t), 1, 1))
        F[:, :3, :3], F[:, :3, 3] = Rotation.from_rotvec(w(t)).as_matrix(), p(t) + np.array([0.5, 0.0, 0.4])
        return F

    def table(t: np.ndarray, poses: np.ndarray) -> np.ndarray:
        return np.column_stack([t, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])

    t, s = np.arange(0.0, 30.0, 0.04), np.arange(0.1, 29.9, 0.05)
    np.savez(path, hand=table(t, hand(t)), eye=table(s, np.linalg.inv(X_BASE) @ hand(s) @ X))
    return path


def test_verify_and_import_read_two_streams(tmp_path: Path) -> None:
    path = streams(tmp_path / "streams.npz")
    pairs, clock = pairs_or_streams(path, mounting=HAND, unit=None, stated=STATED)
    assert clock is not None
    np.savetxt(tmp_path / "X.txt", clock.X)
    found = verify_pairs(tmp_path / "X.txt", path, PairsOptions(mounting=HAND))
    assert found.judgement.off_mm < 1.0
    assert import_pose_pairs([path], tmp_path / "out", mounting=HAND).count == len(pairs.robot)
    with pytest.raises(DatasetError, match="does not say where the camera is"):
        pairs_or_streams(path, mounting=None, unit=None, stated=STATED)


@pytest.mark.parametrize("who", ["robot", "camera"])
@pytest.mark.parametrize("change", ["transposed", "inverse"])
def test_a_stated_change_that_is_wrong_is_named_and_the_advice_ends(tmp_path: Path, who: str, change: str) -> None:
    np.savez(tmp_path / "a.npz", A=A, B=B, mode=HAND)
    forms = {"robot": None, "camera": None, who: f"matrix,{change}"}
    stated = stated_forms(None, None, forms["robot"], forms["camera"])
    with pytest.raises(InconsistentPoses) as caught:
        read_pairs(tmp_path / "a.npz", stated=stated)
    advised = re.findall(rf"--as {who}-form=(\S+?)[).]", str(caught.value))
    assert advised == ["matrix"]
    forms[who] = advised[0]
    read = read_pairs(tmp_path / "a.npz", stated=stated_forms(None, None, forms["robot"], forms["camera"]))
    np.testing.assert_allclose(read.robot, A)


def test_scans_name_a_stated_transposition_that_is_wrong() -> None:
    X_CB = np.linalg.inv(X_BASE)
    seen = X_CB @ A
    plain = PoseReading("matrix", "matrices", A)
    stated = plain.changed("transposed")
    with pytest.raises(InconsistentPoses, match=r"only if they are not .*\{rotation: matrix\}"):
        choose_reading([stated], np.arange(len(A)), seen[:, :3, 3], seen[:, :3, 2], np.eye(4))
    found, _ = choose_reading([plain], np.arange(len(A)), seen[:, :3, 3], seen[:, :3, 2], np.eye(4))
    assert found is plain
    assert stated.changed("transposed").form == "matrix"


def test_a_name_that_inverts_a_list_is_part_of_the_advice(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", T_base2gripper=A, T_target2cam=B, mode=HAND)
    with pytest.raises(InconsistentPoses) as caught:
        read_pairs(tmp_path / "a.npz")
    (form,) = re.findall(r"--as robot-form=(\S+?)[).]", str(caught.value))
    read = read_pairs(tmp_path / "a.npz", stated=stated_forms(None, None, form, None))
    np.testing.assert_allclose(read.robot, A, atol=1e-9)


def test_a_wrong_unit_in_a_file_is_to_be_corrected_there(tmp_path: Path) -> None:
    far = A.copy()
    far[:, :3, 3] *= 1e3
    np.savez(tmp_path / "a.npz", A=far, B=B, mode=HAND, unit="m")
    with pytest.raises(DatasetError, match=r"correct the unit in 'a\.npz'\."):
        read_pairs(tmp_path / "a.npz")
    np.savez(tmp_path / "p.npz", T=far, points=np.zeros((len(A), 2)), unit="m")
    with pytest.raises(InputError, match="Correct the file's entry 'unit' to mm"):
        read_profiler_file(tmp_path / "p.npz")


def test_the_mounting_of_a_camera_beside_the_robot_is_read_alike(tmp_path: Path) -> None:
    make, mounting = READ["fixed camera, base2gripper"]
    assert mounting == BASE
    path = make(tmp_path)
    np.savetxt(tmp_path / "X.txt", X_BASE)
    assert verify_pairs(tmp_path / "X.txt", path, PairsOptions(mounting=BASE)).judgement.off_mm < 1.0
