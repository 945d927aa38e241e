"""Poses as robots, trackers and spreadsheets store them, beside a plain table of the camera."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye.pair_world import (
    CAMERA,
    CAMERA_BASE,
    HAND,
    ROBOT,
    A,
    B,
    N,
    Source,
    beside,
    dump,
    every,
    row,
    text,
    xyz,
)


def one_sheet(folder: Path) -> Path:
    head = (
        "No;Robot X [mm];Robot Y [mm];Robot Z [mm];Robot A [°];Robot B [°];Robot C [°];Cam X [mm];Cam Y [mm];Cam Z"
        " [mm];Cam Rx [rad];Cam Ry [rad];Cam Rz [rad]\n"
    )
    rows = every(
        lambda k: f"{k + 1};" + row(ROBOT.mm[k], ROBOT.ZYX[k], CAMERA.mm[k], CAMERA.v[k], mark=";").replace(".", ",")
    )
    return text(folder / "table.csv", rows, head)


def two_header_lines(folder: Path) -> Path:
    head = "robot,robot,robot,robot,robot,robot,robot,camera,camera,camera,camera,camera,camera,camera\nx,y,z,qw,qx,qy,qz,x,y,z,qw,qx,qy,qz\n"
    return text(
        folder / "table.csv", every(lambda k: row(ROBOT.p[k], ROBOT.wxyz[k], CAMERA.p[k], CAMERA.wxyz[k])), head
    )


def wide_no_header(folder: Path) -> Path:
    return text(folder / "pairs.txt", every(lambda k: row(ROBOT.p[k], ROBOT.v[k], CAMERA.p[k], CAMERA.v[k], mark=" ")))


def side_by_side(folder: Path) -> Path:
    return text(
        folder / "poses.csv",
        every(lambda k: row(ROBOT.p[k], ROBOT.v[k], CAMERA.p[k], CAMERA.v[k])),
        "tcp_x,tcp_y,tcp_z,tcp_rx,tcp_ry,tcp_rz,board_x,board_y,board_z,board_rx,board_ry,board_rz\n",
    )


def labelled(folder: Path) -> Path:
    lines = [
        line
        for k in range(N)
        for line in (
            f"robot {row(ROBOT.mm[k], ROBOT.xyz[k], mark=' ')}",
            f"camera {row(CAMERA.mm[k], CAMERA.xyz[k], mark=' ')}",
        )
    ]
    return text(folder / "log.txt", lines)


def rtde(folder: Path) -> Path:
    return beside(
        "robot.csv",
        every(lambda k: row(f"{k * 0.008:.3f}", ROBOT.p[k], ROBOT.v[k], "4", mark=" ")),
        "timestamp actual_TCP_pose_0 actual_TCP_pose_1 actual_TCP_pose_2 actual_TCP_pose_3 actual_TCP_pose_4"
        " actual_TCP_pose_5 output_int_register_0\n",
    )(folder)


def urp(folder: Path) -> Path:
    beside("robot.txt", [])(folder)
    (folder / "robot.txt").unlink()
    points = "".join(
        f'<Waypoint name="W{k}"><position joints="0.1, -1.5, 1.5, -1.5, -1.5, 0.0" '
        f'pose="{row(ROBOT.p[k], ROBOT.v[k], mark=", ")}"/></Waypoint>'
        for k in range(N)
    )
    (folder / "robot.urp").write_bytes(
        gzip.compress(f'<?xml version="1.0"?><URProgram name="a"><children>{points}</children></URProgram>'.encode())
    )
    return folder


def kuka(k: int) -> str:
    fields = ",".join(f"{n} {v:.6f}" for n, v in zip("XYZABC", (*ROBOT.mm[k], *ROBOT.ZYX[k]), strict=True))
    return f"DECL E6POS XP{k + 1}={{{fields},S 2,T 35}}"


DTX = (
    '<?xml version="1.0" encoding="utf-8" ?>\n<Database xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">\n '
    ' <Datas>\n    <Data name="p" access="public" xsi:type="array" type="pointRx" size="13">\n'
)


def dtx(k: int) -> str:
    return (
        f'      <Value key="{k}" '
        + " ".join(
            f'{n}="{v:.6f}"'
            for n, v in zip(("x", "y", "z", "rx", "ry", "rz"), (*ROBOT.mm[k], *ROBOT.XYZ[k]), strict=True)
        )
        + ' fatherId="world[0]" />'
    )


def tf_csv(folder: Path) -> Path:
    head = ",".join(
        [
            "%time",
            *(
                f"field.transforms0.{w}"
                for w in (
                    "header.seq",
                    "header.stamp",
                    "header.frame_id",
                    "child_frame_id",
                    *(f"transform.translation.{a}" for a in "xyz"),
                    *(f"transform.rotation.{a}" for a in "xyzw"),
                )
            ),
        ]
    )
    lines = [line for k in range(N) for line in (
        f"{1600000000000000000 + k * 10**9},{k},{1600000000000000000 + k * 10**9},base_link,tool0,{row(ROBOT.p[k], ROBOT.q[k])}",
        f"{1600000000000000000 + k * 10**9},{k},{1600000000000000000 + k * 10**9},camera_color_optical_frame,aruco_marker,{row(CAMERA.p[k], CAMERA.q[k])}",
    )]  # fmt: skip
    return text(folder / "tf.csv", lines, head + "\n")


def ndi(folder: Path) -> Path:
    return beside(
        "robot.csv",
        every(lambda k: row(str(k), "OK", ROBOT.wxyz[k], ROBOT.mm[k])),
        "Frame,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz\n",
    )(folder)


def vicon(folder: Path) -> Path:
    head = "Segments\n100\n,,Tool:Root,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,rad,rad,rad,mm,mm,mm\n"
    return beside("robot.csv", every(lambda k: row(str(k), "0", ROBOT.v[k], ROBOT.mm[k])), head)(folder)


def jbi(lines: Sequence[str], kind: str) -> str:
    head = "/JOB\n//NAME P\n//POS\n///NPOS 13,0,0,0,0,0\n///TOOL 0\n"
    head += (
        "///POSTYPE PULSE\n///PULSE\n" if kind == "pulse" else "///POSTYPE BASE\n///RECTAN\n///RCONF 1,0,0,0,0,0,0,0\n"
    )
    return head + "\n".join(lines) + "\n//INST\n///DATE 2020/01/01 00:00\nNOP\nMOVJ C00000 VJ=5.00\nEND\n"


def pulse(folder: Path) -> Path:
    return beside("robot.JBI", [], jbi(every(lambda k: f"C{k:05d}={1000 + k},{-20 * k},300,4,5,6"), "pulse"))(folder)


def shuffled_ids(folder: Path) -> Path:
    text(
        folder / "robot.csv",
        every(lambda k: row(f"img_{k:02d}.png", ROBOT.p[k], ROBOT.q[k])),
        "image,x,y,z,qx,qy,qz,qw\n",
    )
    text(
        folder / "camera.csv",
        [row(f"img_{k:02d}.png", CAMERA.p[k], CAMERA.q[k]) for k in reversed(range(N))],
        "image,x,y,z,qx,qy,qz,qw\n",
    )
    return folder


def colmap(folder: Path) -> Path:
    beside("robot.csv", every(lambda k: row(ROBOT.p[k], ROBOT.q[k])), "x,y,z,qx,qy,qz,qw\n")(folder)
    (folder / "camera.csv").unlink()
    text(
        folder / "images.txt",
        [f"{k + 1} {row(CAMERA.wxyz[k], CAMERA.p[k], mark=' ')} 1 {k}.png\n1 2 -1" for k in range(N)],
        "# Image list with two lines of data per image:\n",
    )
    return folder


def base_fixed(folder: Path) -> Path:
    text(
        folder / "robot.csv",
        every(lambda k: row(ROBOT.mm[k], ROBOT.xyz[k])),
        "X(mm),Y(mm),Z(mm),Rx(deg),Ry(deg),Rz(deg)\n",
    )
    text(folder / "camera.csv", every(lambda k: row(100.0 * CAMERA_BASE.p[k], CAMERA_BASE.v[k])), "tx,ty,tz,rx,ry,rz\n")
    return folder


def base_fixed_npz(folder: Path) -> Path:
    path = folder / "fixed.npz"
    np.savez(
        path,
        R_base2gripper=np.linalg.inv(A)[:, :3, :3],
        t_base2gripper=np.linalg.inv(A)[:, :3, 3],
        R_target2cam=CAMERA_BASE.R,
        t_target2cam=CAMERA_BASE.p,
    )
    return path


def printed(folder: Path) -> Path:
    lines = [
        line
        for k in range(N)
        for line in (
            f"Sample {k}",
            "robot:",
            *str(np.array2string(A[k], precision=6, suppress_small=True)).splitlines(),
            "camera:",
            *np.array2string(B[k], precision=6, suppress_small=True).splitlines(),
        )
    ]
    return text(folder / "log.txt", lines)


def code_lists(folder: Path) -> Path:
    rows = [
        "robot_poses = [\n" + ",\n".join(f"    [{row(ROBOT.mm[k], ROBOT.xyz[k], mark=', ')}]" for k in range(N)) + "\n]"
    ]
    rows += [
        "camera_poses = np.array([\n"
        + ",\n".join(f"    [{row(CAMERA.p[k], CAMERA.v[k], mark=', ')}]" for k in range(N))
        + "\n])"
    ]
    return text(folder / "poses.txt", rows)


def rsi(k: int) -> str:
    names = " ".join(f'{n}="{v:.4f}"' for n, v in zip("XYZABC", [*ROBOT.mm[k], *ROBOT.ZYX[k]], strict=True))
    return f'<Rob Type="KUKA"><RIst {names}/><Delay D="0"/><IPOC>{4208163634 + 4 * k}</IPOC></Rob>'


def last_row_zero(folder: Path) -> Path:
    seen = B.copy()
    seen[:, 3, 3] = 0.0
    np.savez(folder / "pairs.npz", robot=A, camera=seen)
    return folder / "pairs.npz"


def itk(folder: Path) -> Path:
    for turn, name in ((ROBOT, "robot"), (CAMERA, "camera")):
        for k in range(N):
            text(
                folder / name / f"T_{k:02d}.tfm",
                ["Transform: AffineTransform_double_3_3", f"Parameters: {row(turn.R[k], turn.mm[k], mark=' ')}"],
                "#Insight Transform File V1.0\n#Transform 0\n",
                "FixedParameters: 0 0 0\n",
            )
    return folder


def orientation_vectors(folder: Path) -> Path:
    angles = Rotation.from_matrix(ROBOT.R).as_euler("ZYZ", degrees=True)
    poses = [
        {
            "frame": {
                "parent": "world",
                "translation": xyz(ROBOT.mm[k]),
                "orientation": {"type": "ov_degrees", "value": xyz(ROBOT.R[k][:, 2]) | {"th": float(angles[k, 2])}},
            }
        }
        for k in range(N)
    ]
    beside("x.txt", [""])(folder)
    (folder / "x.txt").unlink()
    dump(folder / "robot.json", poses)
    return folder


def copies(folder: Path) -> Path:
    """Two files with the robot's poses, in two notations."""
    beside("robot_poses.csv", every(lambda k: row(ROBOT.p[k], ROBOT.q[k])), "x,y,z,qx,qy,qz,qw\n")(folder)
    text(folder / "robot_backup.txt", every(lambda k: row(ROBOT.mm[k], ROBOT.v[k], mark=" ")))
    return folder


MOTIVE = (
    "Format Version,1.23,Take Name,hand,Rotation Type,Quaternion,Length Units,Millimeters\n\n"
    + ",Type" + 8 * ",Rigid Body" + "\n,Name" + 8 * ",Hand" + "\n"
    + ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error\n"
    + "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,\n"
)  # fmt: skip
ROBOTS: dict[str, Source] = {
    "KUKA RSI lines": (beside("robot.xml", every(rsi)), HAND),
    "a last row of zeros": (last_row_zero, HAND),
    "ITK transforms": (itk, HAND),
    "viam orientation vectors": (orientation_vectors, HAND),
    "two copies of the robot's poses": (copies, HAND),
    "Motive": (beside("robot.csv", every(lambda k: row(str(k), f"{k}.0", ROBOT.q[k], ROBOT.mm[k], 0.2)), MOTIVE), HAND),
    "g2o": (beside("robot.g2o", every(lambda k: f"VERTEX_SE3:QUAT {k} {row(ROBOT.p[k], ROBOT.q[k], mark=' ')}")), HAND),
    "a TCP before the waypoints": (
        beside(
            "robot.script",
            every(lambda k: f"  global Waypoint_{k}_p=p[{row(ROBOT.p[k], ROBOT.v[k], mark=', ')}]"),
            "def calib():\n  global Gripper_ToolTcp = p[0, 0, 0.215, 0, 0, 0]\n",
        ),
        HAND,
    ),
    "inch and mm": (
        beside("robot.csv", every(lambda k: row(ROBOT.mm[k] / 25.4, ROBOT.v[k])), "x,y,z,rx,ry,rz\n"),
        HAND,
    ),
    "Franka O_T_EE": (beside("robot.csv", every(lambda k: row(A[k].T))), HAND),
    "KUKA DAT": (beside("robot.dat", every(kuka), "DEFDAT A\n", "ENDDAT\n"), HAND),
    "Yaskawa job, base": (
        beside("robot.JBI", [], jbi(every(lambda k: f"C{k:05d}={row(ROBOT.mm[k], ROBOT.xyz[k], digits=4)}"), "base")),
        HAND,
    ),
    "Staubli dtx": (beside("robot.dtx", every(dtx), DTX, "    </Data>\n  </Datas>\n</Database>\n"), HAND),
    "Doosan posx": (
        beside(
            "robot.py.txt",
            every(lambda k: f"movel(posx({row(ROBOT.mm[k], ROBOT.ZYZ[k], mark=', ')}), vel=100, acc=100)"),
        ),
        HAND,
    ),
    "Epson points": (
        beside("robot.txt", every(lambda k: f"P{k} = XY({row(ROBOT.mm[k], ROBOT.ZYX[k], mark=', ')})")),
        HAND,
    ),
    "Mitsubishi positions": (
        beside("robot.txt", every(lambda k: f"P{k + 1}=({row(ROBOT.mm[k], ROBOT.xyz[k])})(7,0)")),
        HAND,
    ),
    "Kawasaki TRANS": (
        beside("robot.as", every(lambda k: f"p{k} {row(ROBOT.mm[k], ROBOT.ZYZ[k], mark='  ')}"), ".TRANS\n", ".END\n"),
        HAND,
    ),
    "Denso P()": (
        beside("robot.txt", every(lambda k: f"P[{k}] = P( {row(ROBOT.mm[k], ROBOT.xyz[k], mark=', ')}, 5 )")),
        HAND,
    ),
    "Dobot points": (
        lambda folder: (
            beside("x.txt", [""])(folder),
            (folder / "x.txt").unlink(),
            dump(
                folder / "robot.json",
                [
                    {
                        "name": f"P{k}",
                        "id": k,
                        "pose": [*ROBOT.mm[k], *ROBOT.xyz[k]],
                        "joint": [1.0, 2.0, 3.0, 4.0, 5.0, float(k)],
                    }
                    for k in range(N)
                ],
            ),
            folder,
        )[-1],
        HAND,
    ),
    "JAKA printed tuples": (
        beside("robot.txt", every(lambda k: f"(0, ({row(ROBOT.mm[k], ROBOT.rpy[k], mark=', ')}))")),
        HAND,
    ),
    "xArm lists": (beside("robot.txt", every(lambda k: f"[{row(ROBOT.mm[k], ROBOT.xyz[k], mark=', ')}]")), HAND),
    "Aubo position and orientation": (
        lambda folder: (
            beside("x.txt", [""])(folder),
            (folder / "x.txt").unlink(),
            dump(
                folder / "robot.json",
                [{"joint": [0.1] * 6, "pos": ROBOT.p[k].tolist(), "ori": ROBOT.wxyz[k].tolist()} for k in range(N)],
            ),
            folder,
        )[-1],
        HAND,
    ),
    "Techman CSV": (
        beside("robot.csv", every(lambda k: row(f"P{k}", ROBOT.mm[k], ROBOT.xyz[k])), "Point,X,Y,Z,Rx,Ry,Rz\n"),
        HAND,
    ),
    "RoboDK joints and pose": (
        beside(
            "robot.csv",
            every(lambda k: row(f"Target {k}", np.arange(6.0) + k, ROBOT.mm[k], ROBOT.ZYX[k])),
            "Name,J1,J2,J3,J4,J5,J6,X,Y,Z,rZ,rY,rX\n",
        ),
        HAND,
    ),
    "columns with units in words": (
        beside(
            "robot.csv",
            every(lambda k: row(ROBOT.mm[k], ROBOT.xyz[k], mark="\t")),
            "Pos X mm\tPos Y mm\tPos Z mm\tRoll deg\tPitch deg\tYaw deg\n",
        ),
        HAND,
    ),
}
