"""Lists of poses in the text that robots, cameras and other programs write; each gives the same ten poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.lists import read_lists
from weldcal.calibration.data.poses.text import lists_of_text
from weldcal.calibration.errors import DatasetError

N = 10
RNG = np.random.default_rng(11)
TURN = Rotation.random(N, rng=RNG)
P = RNG.uniform(0.2, 0.8, (N, 3))
V, Q, MM = TURN.as_rotvec(), TURN.as_quat(), 1e3 * P


def lines(make: Callable[[int], str], before: str = "", after: str = "") -> str:
    return before + "".join(make(k) + "\n" for k in range(N)) + after


def join(*parts: np.ndarray, mark: str = ",") -> str:
    return mark.join(f"{v:.9f}" for part in parts for v in np.ravel(part))


def tag(values: np.ndarray, names: str) -> str:
    return ",".join(f"{n} {v:.6f}" for n, v in zip(names, values, strict=True))


KUKA, FANUC = TURN.as_euler("ZYX", degrees=True), TURN.as_euler("xyz", degrees=True)
TEXTS = {  # text, the form of the right reading, unit
    "KUKA DAT": (lines(lambda k: f"DECL E6POS XP{k + 1}={{{tag(MM[k], 'XYZ')},{tag(KUKA[k], 'ABC')},S 2,T 35,E1 0.0}}", "DEFDAT X\n", "ENDDAT\n"), "euler_ZYX,deg", "mm"),
    "KUKA SRC": (lines(lambda k: f"PTP {{{tag(MM[k], 'XYZ')}, {tag(KUKA[k], 'ABC')}}}"), "euler_ZYX,deg", "mm"),
    "ABB RAPID": (lines(lambda k: f"CONST robtarget p{k}:=[[{join(MM[k])}],[{join(Q[k][[3, 0, 1, 2]])}],[0,-1,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];", "MODULE M\n"), "quaternion_wxyz", "mm"),
    "ABB RAPID, inline": (lines(lambda k: f"MoveL [[{join(MM[k])}],[{join(Q[k][[3, 0, 1, 2]])}],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,fine,tool0;"), "quaternion_wxyz", "mm"),
    "Fanuc LS": (lines(lambda k: "P[%d]{\n   GP1:\n\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',\n\tX = %.6f  mm,\tY = %.6f  mm,\tZ = %.6f  mm,\n\tW = %.6f deg,\tP = %.6f deg,\tR = %.6f deg\n};" % (k + 1, *MM[k], *FANUC[k]), "/POS\n"), "euler_xyz,deg", "mm"),
    "UR script": (lines(lambda k: f"  movel(p[{join(P[k], V[k])}], a=1.2, v=0.25)", "def f():\n  set_tcp(p[0,0,0.1,0,0,0])\n  movej([0,-1.57,1.57,-1.57,-1.57,0], a=1)\n", "end\n"), "rotation_vector,rad", "m"),
    "UR waypoints": (lines(lambda k: f"global Waypoint_{k}_p=p[{join(P[k], V[k])}]"), "rotation_vector,rad", "m"),
    "UR pendant": (lines(lambda k: f"p[{join(P[k], V[k], mark=', ')}]"), "rotation_vector,rad", "m"),
    "tf2_echo": (lines(lambda k: f"At time {k}.5\n- Translation: [{join(P[k], mark=', ')}]\n- Rotation: in Quaternion [{join(Q[k], mark=', ')}]\n            in RPY (radian) [0.1, 0.2, 0.3]"), "quaternion_xyzw", "m"),
    "tf2_echo, newer": (lines(lambda k: f"At time {k}.5\n- Translation: [{join(P[k], mark=', ')}]\n- Rotation: in Quaternion (xyzw) [{join(Q[k], mark=', ')}]"), "quaternion_xyzw", "m"),
    "TUM": (lines(lambda k: f"{1.6e9 + k:.3f} {join(P[k], Q[k], mark=' ')}", "# timestamp tx ty tz qx qy qz qw\n"), "quaternion_wxyz", ""),
    "TUM, no header": (lines(lambda k: f"{1.6e9 + k:.3f} {join(P[k], Q[k], mark=' ')}"), "quaternion_xyzw", ""),
    "EuRoC": (lines(lambda k: f"{1403636580838555648 + k * 10**9},{join(P[k], Q[k][[3, 0, 1, 2]])}", "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"), "quaternion_wxyz", "m"),
    "KITTI": (lines(lambda k: join(np.column_stack([TURN[k].as_matrix(), P[k]]), mark=" ")), "matrix", ""),
    "rotation, then position": (lines(lambda k: join(TURN[k].as_matrix(), P[k])), "matrix", ""),
    "libfranka O_T_EE": (lines(lambda k: join(np.block([[TURN[k].as_matrix(), P[k][:, None]], [0, 0, 0, 1]]).T)), "matrix", ""),
    "captions": (lines(lambda k: f"Pose number {k}:\n" + "\n".join(join(row, mark=" ") for row in np.block([[TURN[k].as_matrix(), P[k][:, None]], [np.zeros((1, 3)), 1]]))), "matrix", ""),
    "spreadsheet": ("\ufeff" + lines(lambda k: join(MM[k], V[k], mark=";").replace(".", ",") + ";", "X [mm];Y [mm];Z [mm];RX [rad];RY [rad];RZ [rad];\r\n"), "rotation_vector,rad", "mm"),
    "ids, rvec, tvec": (lines(lambda k: f"{k}, {join(V[k], MM[k], mark=', ')}", "id,rvec_x,rvec_y,rvec_z,tvec_x,tvec_y,tvec_z\n"), "rotation_vector,rad", ""),
    "fixed angles in degrees": (lines(lambda k: join(MM[k], FANUC[k]), "X,Y,Z,Rx,Ry,Rz\n"), "euler_xyz,deg", ""),
    "yaw, pitch, roll": (lines(lambda k: join(P[k], TURN[k].as_euler("xyz")[::-1], mark=" "), "x y z yaw pitch roll\n"), "euler_xyz,rad", ""),
    "Kawasaki": (lines(lambda k: join(MM[k], TURN[k].as_euler("ZYZ", degrees=True)), "x,y,z,o,a,t\n"), "euler_ZYZ,deg", ""),
    "numbered quaternion": (lines(lambda k: join(MM[k], Q[k][[3, 0, 1, 2]]), "x,y,z,q1,q2,q3,q4\n"), "quaternion_wxyz", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_each_form_holds_the_same_poses(name: str) -> None:
    text, form, unit = TEXTS[name]
    (found,) = lists_of_text(text, "poses.txt")
    assert len(found) == N
    assert found.unit == unit
    X = next(one for one in found.readings if one.form == form).X
    scale = 1e-3 if np.median(np.abs(X[:, :3, 3])) > 10.0 else 1.0
    assert scale * X[:, :3, 3] == pytest.approx(P, abs=1e-6)
    assert X[:, :3, :3] == pytest.approx(TURN.as_matrix(), abs=1e-5)


def test_rows_with_two_labels_are_two_lists() -> None:
    text = "".join(f"hand,{join(P[k], V[k])}\neye,{join(-P[k], V[k])}\n" for k in range(N))
    hand, eye = lists_of_text(text, "a.csv")
    assert (len(hand), len(eye)) == (N, N)
    assert hand.name.endswith("hand")
    assert eye.readings[0].X[:, :3, 3] == pytest.approx(-P, abs=1e-8)


def test_rows_without_a_pose_are_left_out_with_the_reason() -> None:
    rows = [join(P[k], Q[k]) for k in range(N)]
    rows[3], rows[5], rows[7] = "nan,0.1,0.2,0,0,0,1", "0,0,0,0,0,0,1", "0,0,0,0,0,0,0"
    (found,) = lists_of_text("x,y,z,qx,qy,qz,qw\n" + "\n".join(rows), "a.csv")
    assert [row for row, _ in found.left_out] == [3, 5, 7]
    assert "missing" in found.left_out[0][1]
    assert all("nothing was detected" in why for _, why in found.left_out[1:])


def test_colmap_is_refused_with_what_to_write() -> None:
    with pytest.raises(DatasetError, match="no unit of length"):
        lists_of_text("# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 a.png\n\n", "images.txt")


def test_matlab_arrays_with_the_poses_last_are_read(tmp_path: Path) -> None:
    from scipy.io import savemat

    X = np.zeros((N, 4, 4))
    X[:, :3, :3], X[:, :3, 3], X[:, 3, 3] = TURN.as_matrix(), P, 1.0
    savemat(tmp_path / "a.mat", {"A": np.moveaxis(X, 0, 2), "B": np.moveaxis(X, 0, 2)})
    lists = read_lists(tmp_path / "a.mat")
    assert {one.name for one in lists} == {"a.mat, A", "a.mat, B"}
    assert lists[0].readings[0].X == pytest.approx(X)
