"""Ten poses as robots, cameras and other programs write them: text, the form of the right reading, and the unit that
the text states."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

N = 10
RNG = np.random.default_rng(11)
TURN = Rotation.random(N, rng=RNG)
P = RNG.uniform(0.2, 0.8, (N, 3))
V, Q, MM = TURN.as_rotvec(), TURN.as_quat(), 1e3 * P
WXYZ = Q[:, [3, 0, 1, 2]]
KUKA, FANUC = TURN.as_euler("ZYX", degrees=True), TURN.as_euler("xyz", degrees=True)
KAWASAKI, YPR = TURN.as_euler("ZYZ", degrees=True), TURN.as_euler("xyz")[:, ::-1]
MATRICES = [np.block([[TURN[k].as_matrix(), P[k][:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) for k in range(N)]


def lines(make: Callable[[int], str], before: str = "", after: str = "") -> str:
    return before + "".join(make(k) + "\n" for k in range(N)) + after


def join(*parts: np.ndarray, mark: str = ",") -> str:
    return mark.join(f"{v:.9f}" for part in parts for v in np.ravel(part))


def tag(values: np.ndarray, names: str, form: str = "{} {:.6f}", mark: str = ",") -> str:
    return mark.join(form.format(n, v) for n, v in zip(names, values, strict=True))


def rapid(k: int) -> str:
    return f"[[{join(MM[k])}],[{join(WXYZ[k])}],[0,-1,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"


def fanuc(k: int) -> str:
    position, angles = (
        tag(v, names, "{} = {:.6f} " + unit) for v, names, unit in ((MM[k], "XYZ", "mm"), (FANUC[k], "WPR", "deg"))
    )
    return f"P[{k + 1}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',\n\t{position},\n\t{angles}\n}};"


def echo(k: int, words: str) -> str:
    p, q = join(P[k], mark=", "), join(Q[k], mark=", ")
    return (
        f"At time {k}.5\n- Translation: [{p}]\n- Rotation: in Quaternion {words}[{q}]\n            in RPY (radian)"
        " [0.1, 0.2, 0.3]"
    )


def caption(k: int) -> str:
    return f"Pose number {k}:\n" + "\n".join(join(row, mark=" ") for row in MATRICES[k])


UR_HEAD = "def f():\n  set_tcp(p[0,0,0.1,0,0,0])\n  movej([0,-1.57,1.57,-1.57,-1.57,0], a=1)\n"
EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
SHEET = "X [mm];Y [mm];Z [mm];RX [rad];RY [rad];RZ [rad];\r\n"
TUM = "# timestamp tx ty tz qx qy qz qw\n"
TEXTS = {
    "KUKA DAT": (
        lines(
            lambda k: f"DECL E6POS XP{k + 1}={{{tag(MM[k], 'XYZ')},{tag(KUKA[k], 'ABC')},S 2,T 35,E1 0.0}}",
            "DEFDAT X\n",
        ),
        "euler_ZYX,deg",
        "mm",
    ),
    "KUKA SRC": (lines(lambda k: f"PTP {{{tag(MM[k], 'XYZ')}, {tag(KUKA[k], 'ABC')}}}"), "euler_ZYX,deg", "mm"),
    "ABB RAPID": (lines(lambda k: f"CONST robtarget p{k}:={rapid(k)};", "MODULE M\n"), "quaternion_wxyz", "mm"),
    "ABB RAPID, inline": (lines(lambda k: f"MoveL {rapid(k)},v100,fine,tool0;"), "quaternion_wxyz", "mm"),
    "Fanuc LS": (lines(fanuc, "/POS\n"), "euler_xyz,deg", "mm"),
    "UR script": (
        lines(lambda k: f"  movel(p[{join(P[k], V[k])}], a=1.2, v=0.25)", UR_HEAD, "end\n"),
        "rotation_vector,rad",
        "m",
    ),
    "UR waypoints": (lines(lambda k: f"global Waypoint_{k}_p=p[{join(P[k], V[k])}]"), "rotation_vector,rad", "m"),
    "UR pendant": (lines(lambda k: f"p[{join(P[k], V[k], mark=', ')}]"), "rotation_vector,rad", "m"),
    "tf2_echo": (lines(lambda k: echo(k, "")), "quaternion_xyzw", "m"),
    "tf2_echo, newer": (lines(lambda k: echo(k, "(xyzw) ")), "quaternion_xyzw", "m"),
    "TUM": (lines(lambda k: f"{1.6e9 + k:.3f} {join(P[k], Q[k], mark=' ')}", TUM), "quaternion_wxyz", ""),
    "TUM, no header": (lines(lambda k: f"{1.6e9 + k:.3f} {join(P[k], Q[k], mark=' ')}"), "quaternion_xyzw", ""),
    "EuRoC": (
        lines(lambda k: f"{1403636580838555648 + k * 10**9},{join(P[k], WXYZ[k])}", EUROC),
        "quaternion_wxyz",
        "m",
    ),
    "KITTI": (lines(lambda k: join(MATRICES[k][:3], mark=" ")), "matrix", ""),
    "rotation, then position": (lines(lambda k: join(TURN[k].as_matrix(), P[k])), "matrix", ""),
    "libfranka O_T_EE": (lines(lambda k: join(MATRICES[k].T)), "matrix", ""),
    "captions": (lines(caption), "matrix", ""),
    "spreadsheet": (
        "\ufeff" + lines(lambda k: join(MM[k], V[k], mark=";").replace(".", ",") + ";", SHEET),
        "rotation_vector,rad",
        "mm",
    ),
    "ids, rvec, tvec": (
        lines(lambda k: f"{k}, {join(V[k], MM[k], mark=', ')}", "id,rvec_x,rvec_y,rvec_z,tvec_x,tvec_y,tvec_z\n"),
        "rotation_vector,rad",
        "",
    ),
    "fixed angles in degrees": (lines(lambda k: join(MM[k], FANUC[k]), "X,Y,Z,Rx,Ry,Rz\n"), "euler_xyz,deg", ""),
    "yaw, pitch, roll": (lines(lambda k: join(P[k], YPR[k], mark=" "), "x y z yaw pitch roll\n"), "euler_xyz,rad", ""),
    "Kawasaki": (lines(lambda k: join(MM[k], KAWASAKI[k]), "x,y,z,o,a,t\n"), "euler_ZYZ,deg", ""),
    "numbered quaternion": (lines(lambda k: join(MM[k], WXYZ[k]), "x,y,z,q1,q2,q3,q4\n"), "quaternion_wxyz", ""),
}
