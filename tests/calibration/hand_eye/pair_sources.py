"""Robot and camera poses as calibration tools store them: files and folders with one known X."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from tests.calibration.hand_eye.pair_robots import (
    ROBOTS,
    base_fixed,
    base_fixed_npz,
    code_lists,
    colmap,
    labelled,
    ndi,
    one_sheet,
    printed,
    pulse,
    rtde,
    shuffled_ids,
    side_by_side,
    tf_csv,
    two_header_lines,
    urp,
    vicon,
    wide_no_header,
)
from tests.calibration.hand_eye.pair_world import (
    BASE,
    CAMERA,
    CAMERA_MM,
    HAND,
    ROBOT,
    ROBOT_MM,
    A,
    B,
    N,
    Source,
    Turn,
    block,
    dump,
    every,
    opencv,
    ros,
    ros_pose,
    row,
    text,
)


def samples_easy_handeye2(folder: Path) -> Path:
    return text(
        folder / "cal.samples",
        [block({"samples": every(lambda k: {"robot": ros(ROBOT, k), "tracking": ros(CAMERA, k)})})],
    )


def samples_easy_handeye(folder: Path) -> Path:
    return text(
        folder / "a.yaml",
        every(lambda k: "- " + block({"robot": ros(ROBOT, k), "optical": ros(CAMERA, k)}, 2).lstrip()),
    )


def moveit(folder: Path) -> Path:
    flat = every(
        lambda k: f"- effector_wrt_world: [{row(A[k], mark=', ')}]\n  object_wrt_sensor: [{row(B[k], mark=', ')}]"
    )
    return text(folder / "samples.yaml", flat)


def zivid(folder: Path) -> Path:
    for k in range(N):
        text(folder / f"pos{k + 1:02d}.yaml", [opencv("PoseState", np.round(ROBOT_MM[k], 6))], "%YAML:1.0\n---\n")
        text(
            folder / f"camera{k + 1:02d}.yaml",
            [
                "__version__:",
                "    serializer: 1",
                "FloatMatrix:",
                "    Data:",
                "        [",
                *(f"            [ {row(r, mark=', ')} ]," for r in CAMERA_MM[k]),
                "        ]",
            ],
        )
    return folder


def camodocal(folder: Path) -> Path:
    lines = [f"frameCount: {N}"]
    for k in range(N):
        lines += [opencv(f"T1_{k}", A[k]), opencv(f"T2_{k}", B[k])]
    return text(folder / "pairs.yml", lines, "%YAML:1.0\n")


def visp(folder: Path) -> Path:
    for k in range(N):
        for turn, word in ((ROBOT, "fPe"), (CAMERA, "cPo")):
            values = np.concatenate([turn.p[k], turn.v[k]])
            text(
                folder / f"pose_{word}_{k + 1}.yaml",
                ["rows: 6", "cols: 1", "data:", *(f"  - [{v:.8f}]" for v in values)],
            )
    return folder


def aslam(folder: Path) -> Path:
    for turn, name in ((ROBOT, "robot_B_H"), (CAMERA, "camera_C_W")):
        text(folder / f"{name}.csv", every(lambda k, t=turn: f"{1.6e9 + 0.5 * k:.6f},{row(t.p[k], t.q[k])}"))
    return folder


def halcon(folder: Path) -> Path:
    for k in range(N):
        for turn, word in ((ROBOT, "robot_in_base_pose"), (CAMERA, "calib_obj_in_cam_pose")):
            text(
                folder / f"{word}_{k:02d}.dat",
                ["f 0", f"r {row(turn.XYZ[k] % 360.0, mark=' ')}", f"t {row(turn.p[k], mark=' ')}"],
            )
    return folder


def echo(folder: Path) -> Path:
    for turn, name in ((ROBOT, "robot_pose"), (CAMERA, "camera_pose")):
        docs = every(
            lambda k, t=turn: (
                block(
                    {
                        "header": {"seq": k, "stamp": {"secs": 1600000000 + k, "nsecs": 0}, "frame_id": "base"},
                        "pose": ros_pose(t, k),
                    }
                )
                + "\n---"
            )
        )
        text(folder / f"{name}.yaml", docs)
    return folder


def detections(folder: Path) -> Path:
    text(folder / "robot.csv", every(lambda k: row(ROBOT.p[k], ROBOT.q[k])), "x,y,z,qx,qy,qz,qw\n")
    docs = every(
        lambda k: (
            block(
                {
                    "header": {"seq": k, "frame_id": "camera"},
                    "detections": [
                        {
                            "id": [3],
                            "size": [0.08],
                            "pose": {
                                "header": {"seq": k},
                                "pose": {"pose": ros_pose(CAMERA, k), "covariance": [0.0] * 36},
                            },
                        }
                    ],
                }
            )
            + "\n---"
        )
    )
    text(folder / "tag.txt", docs)
    return folder


def one_json_each(folder: Path) -> Path:
    for k in range(N):
        dump(
            folder / f"sample_{k:03d}.json",
            {
                "timestamp": 1.6e9 + k,
                "robot_pose": A[k].tolist(),
                "board_pose": {"rvec": CAMERA.v[k].tolist(), "tvec": CAMERA.p[k].tolist()},
            },
        )
    return folder


def folder_per_pose(folder: Path) -> Path:
    for k in range(N):
        text(folder / f"pose_{k}" / "robot.txt", [row(r, mark=" ") for r in A[k]])
        text(folder / f"pose_{k}" / "camera.txt", [row(r, mark=" ") for r in B[k]])
    return folder


def numbered_dict(folder: Path) -> Path:
    return dump(
        folder / "data.json",
        {str(k): {"gripper": row(ROBOT.mm[k], ROBOT.xyz[k]).split(","), "target": B[k].tolist()} for k in range(N)},
    )


def numbered_dict_matrices(folder: Path) -> Path:
    return dump(
        folder / "data.json",
        {f"frame_{k}": {"T_base_gripper": A[k].tolist(), "T_cam_target": B[k].tolist()} for k in range(N)},
    )


def nested(folder: Path) -> Path:
    return dump(
        folder / "run.json",
        {"meta": {"date": "1"}, "data": {"arm": {"pose": A.tolist()}, "vision": {"marker": {"pose": B.tolist()}}}},
    )


def axis_angle(folder: Path) -> Path:
    def link(turn: Turn, k: int) -> dict[str, Any]:
        angle = float(np.linalg.norm(turn.v[k]))
        return {"rotation": {"angle": angle, "axis": (turn.v[k] / angle).tolist()}, "translation": turn.mm[k].tolist()}

    return dump(
        folder / "ensenso.json", [{"robotPose": link(ROBOT, k), "patternPose": link(CAMERA, k)} for k in range(N)]
    )


def npz_names(folder: Path) -> Path:
    path = folder / "calib_data.npz"
    np.savez(path, R_g2b=ROBOT.R, t_g2b=ROBOT.p[..., None], R_t2c=CAMERA.R, t_t2c=CAMERA.p[..., None])
    return path


def npz_rvecs(folder: Path) -> Path:
    path = folder / "calib.npz"
    np.savez(
        path, robot_poses=np.column_stack([ROBOT.mm, ROBOT.xyz]), rvecs=CAMERA.v[..., None], tvecs=CAMERA.p[..., None]
    )
    return path


def npy_two(folder: Path) -> Path:
    np.save(folder / "ee_poses.npy", A)
    np.save(folder / "marker_poses.npy", B)
    return folder


def mat_names(folder: Path) -> Path:
    savemat(
        folder / "d.mat", {"Hgrip2base": np.moveaxis(A, 0, 2), "Hmarker2cam": np.moveaxis(B, 0, 2), "fc": [1.0, 2.0]}
    )
    return folder / "d.mat"


def mat_cells(folder: Path) -> Path:
    cells = [np.empty((1, N), dtype=object) for _ in range(2)]
    for k in range(N):
        cells[0][0, k], cells[1][0, k] = A[k], B[k]
    savemat(folder / "d.mat", {"robot": cells[0], "camera": cells[1]})
    return folder / "d.mat"


def mat_struct(folder: Path) -> Path:
    savemat(folder / "d.mat", {"data": {"bHg": np.moveaxis(A, 0, 2), "cHw": np.moveaxis(B, 0, 2)}})
    return folder / "d.mat"


def tum(folder: Path) -> Path:
    for turn, name in ((ROBOT, "robot"), (CAMERA, "camera")):
        text(folder / f"{name}.tum", every(lambda k, t=turn: f"{1.6e9 + k:.4f} {row(t.p[k], t.q[k], mark=' ')}"))
    return folder


READ: dict[str, Source] = {
    "easy_handeye2 samples": (samples_easy_handeye2, HAND),
    "easy_handeye list of samples": (samples_easy_handeye, HAND),
    "MoveIt samples": (moveit, HAND),
    "Zivid pos and camera": (zivid, HAND),
    "ViSP fPe, cPo": (visp, HAND),
    "hand_eye_calibration CSV": (aslam, HAND),
    "HALCON pose files": (halcon, HAND),
    "rostopic echo documents": (echo, HAND),
    "apriltag detections": (detections, HAND),
    "one JSON a sample": (one_json_each, HAND),
    "one folder a pose": (folder_per_pose, HAND),
    "numbered dict of strings": (numbered_dict, HAND),
    "numbered dict of matrices": (numbered_dict_matrices, HAND),
    "nested dict": (nested, HAND),
    "Ensenso axis and angle": (axis_angle, HAND),
    "npz, short names": (npz_names, HAND),
    "npz, rvecs": (npz_rvecs, HAND),
    "two npy": (npy_two, HAND),
    "mat, other names": (mat_names, HAND),
    "mat, cells": (mat_cells, HAND),
    "mat, struct": (mat_struct, HAND),
    "TUM": (tum, HAND),
    "one sheet, German": (one_sheet, HAND),
    "two header lines": (two_header_lines, HAND),
    "twelve numbers a row": (wide_no_header, HAND),
    "tcp_ and board_ columns": (side_by_side, HAND),
    "rows with labels": (labelled, HAND),
    "UR RTDE recorder": (rtde, HAND),
    "UR program file": (urp, HAND),
    "tf CSV": (tf_csv, HAND),
    "NDI tracker": (ndi, HAND),
    "Vicon": (vicon, HAND),
    "ids of pictures, in other order": (shuffled_ids, HAND),
    "printed matrices": (printed, HAND),
    "lists of a script": (code_lists, HAND),
    "fixed camera, other units": (base_fixed, BASE),
    "fixed camera, base2gripper": (base_fixed_npz, BASE),
    **ROBOTS,
}
NAMED: dict[str, tuple[Callable[[Path], Path], str, str, str]] = {"CamOdoCal T1_k, T2_k": (camodocal, HAND, "T1", "T2")}
"""Lists whose names do not say whose they are, and the names to state."""
REFUSED: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "Yaskawa job, pulses": (pulse, HAND, r"pulses of the joints.*base coordinates"),
    "COLMAP": (colmap, HAND, "no unit of length"),
}
