"""Builds small valid files of each format that weldcal reads, from a seed."""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.results import CalibrationResult, IcpRecord, PoseRecord, save_result
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.calibration.tablet.result import TabletResult, save_tablet_result
from weldcal.models.arrays import Array
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, scenario_names
from weldcal.welding.record.process import WeldProcess
from weldcal.welding.record.weld_log import COLUMNS, WeldRecord, weld_log_texts

Files = dict[str, bytes]
Rng = np.random.Generator
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
DATASET = (
    "schema: 1\nrobot: ur10e\nflange: iso9409-1-50-4-m6\nscanner: phoxi_m\nconfiguration: eye_on_base\nunits: {clouds:"
    " m, poses: m}\n"
)


def points(rng: Rng, n: int = 60) -> Array:
    """Points (n, 3) m in front of a camera."""
    return np.asarray(rng.uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 0.8], (n, 3)))


def ply(rng: Rng) -> Files:
    """Text or binary of either order.

    Coordinates of several types, among other properties, a camera or faces behind.
    """
    n, kind = 60, str(rng.choice(["ascii", "binary_little_endian", "binary_big_endian"]))
    names = ["x", "y", "z"] + (["intensity"] if rng.random() < 0.5 else [])
    types = [str(rng.choice(["float", "double", "int"])) for _ in names]
    values = np.column_stack([points(rng, n) * 1000.0, np.arange(n)])[:, : len(names)]
    head = [f"ply\nformat {kind} 1.0\ncomment an example", f"element vertex {n}"]
    head += [f"property {t} {name}" for t, name in zip(types, names, strict=True)]
    after = str(rng.choice(["", "camera", "face"]))
    if after == "camera":
        head += ["element camera 1", "property float view_px", "property int viewportx"]
    if after == "face":
        head += ["element face 2", "property list uchar int vertex_indices"]
    text = ("\n".join([*head, "end_header"]) + "\n").encode()
    letters = {"float": "f4", "double": "f8", "int": "i4"}
    if kind == "ascii":
        rows = [
            " ".join(f"{int(v)}" if t == "int" else f"{v:.6f}" for v, t in zip(row, types, strict=True))
            for row in values
        ]
        rows += {"": [], "camera": ["0.5 640"], "face": ["3 0 1 2", "3 1 2 3"]}[after]
        return {"a.ply": text + "\n".join(rows).encode() + b"\n"}
    order = "<" if kind == "binary_little_endian" else ">"
    table = np.zeros(n, dtype=[(name, order + letters[t]) for name, t in zip(names, types, strict=True)])
    for k, name in enumerate(names):
        table[name] = values[:, k]
    camera = np.array([(0.5, 640)], dtype=[("a", order + "f4"), ("b", order + "i4")]).tobytes()
    face = np.array([(3, 0, 1, 2), (3, 1, 2, 3)], dtype=[("n", "u1"), *((c, order + "i4") for c in "abc")]).tobytes()
    return {"a.ply": text + table.tobytes() + {"": b"", "camera": camera, "face": face}[after]}


def pcd(rng: Rng) -> Files:
    """Text, binary or compressed (a body of literals only), in one row or organised."""
    data = str(rng.choice(["ascii", "binary", "binary_compressed"]))
    width, height = (60, 1) if rng.random() < 0.5 else (10, 6)
    values = points(rng).astype(np.float32)
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {width}\nHEIGHT {height}\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 60\nDATA {data}\n"
    ).encode()
    if data == "ascii":
        return {"a.pcd": head + "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in values).encode()}
    if data == "binary":
        return {"a.pcd": head + values.tobytes()}
    raw = values.T.tobytes()
    packed = b"".join(bytes([len(raw[k : k + 32]) - 1]) + raw[k : k + 32] for k in range(0, len(raw), 32))
    return {"a.pcd": head + np.array([len(packed), len(raw)], "<u4").tobytes() + packed}


def text_cloud(rng: Rng) -> Files:
    """Rows of x, y, z with any separator, with or without a header and a fourth column."""
    separator = str(rng.choice([",", ";", " ", "\t"]))
    more = rng.random() < 0.5
    rows = [separator.join(["x", "y", "z"] + ["grey"] * more)] if rng.random() < 0.5 else []
    comma = separator != "," and rng.random() < 0.5
    for p in points(rng):
        cells = [f"{v:.6f}" for v in p] + ["17"] * more
        rows.append(separator.join(c.replace(".", ",") for c in cells) if comma else separator.join(cells))
    return {"a.csv": ("\n".join(rows) + "\n").encode()}


def npz(arrays: Mapping[str, Any], compressed: bool = False) -> bytes:
    """Return the bytes of an npz of these arrays."""
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)
    return stream.getvalue()


def npz_cloud(rng: Rng) -> Files:
    """Points, or a depth map with intrinsics."""
    squeezed = bool(rng.random() < 0.5)
    if rng.random() < 0.5:
        return {"a.npz": npz({"points": points(rng).astype(np.float32)}, squeezed)}
    depth = rng.uniform(0.4, 0.8, (8, 10)).astype(np.float32)
    depth[0, :3] = 0.0
    return {"a.npz": npz({"depth": depth, "intrinsics": np.array([500.0, 500.0, 4.5, 3.5])}, squeezed)}


def npy_cloud(rng: Rng) -> Files:
    """Points alone."""
    stream = io.BytesIO()
    np.save(stream, points(rng))
    return {"a.npy": stream.getvalue()}


def _table(header: Sequence[str], rows: Sequence[Sequence[object]], separator: str = ",") -> bytes:
    lines = [separator.join(header), *(separator.join(str(v) for v in row) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


def _seven(X: Array) -> list[str]:
    q = Rotation.from_matrix(X[:3, :3]).as_quat(scalar_first=True)
    return [f"{v:.9f}" for v in (*X[:3, 3], *q)]


def _poses(rng: Rng, n: int) -> Array:
    return pose(exp_rotation(rng.normal(size=(n, 3)) * 0.5), rng.uniform([0.3, -0.3, 0.2], [0.7, 0.3, 0.6], (n, 3)))


def dataset(rng: Rng) -> Files:
    """Return a folder of three scans, with a feature and a guess in its header."""
    poses = _poses(rng, 3)
    header = DATASET + "feature_in_flange: {xyz: [0.14, 0.0, -0.012], wxyz: [0.0, 1.0, 0.0, 0.0]}\n"
    header += (
        "scanner_guess:\n  xyz: [0.6, 0.0, 1.0]\n  wxyz: [0.0, 1.0, 0.0, 0.0]\n  radius_m: 0.05\nnote: an example\n"
    )
    rows = [[f"s{k}", *_seven(X), k] for k, X in enumerate(poses)]
    clouds = {f"clouds/s{k}.npz": npz({"points": points(rng, 40)}) for k in range(3)}
    return {"dataset.yaml": header.encode(), "poses.csv": _table(["id", *_POSE, "time"], rows), **clouds}


def pairs(rng: Rng) -> Files:
    """Return a folder of centres found by other means."""
    base, camera = rng.uniform([0.1, -0.5, -0.1], [1.1, 0.5, 0.9], (6, 3)), points(rng, 6)
    turn = Rotation.random(6, rng).as_quat(scalar_first=True)
    names = [*(f"base_{c}" for c in "xyz"), *(f"camera_{c}" for c in "xyz"), *(f"base_q{c}" for c in "wxyz")]
    rows = [[f"p{k}", *(f"{v:.9f}" for v in (*base[k], *camera[k], *turn[k]))] for k in range(6)]
    return {"dataset.yaml": DATASET.encode(), "pairs.csv": _table(["id", *names], rows)}


def calibration(rng: Rng) -> Files:
    """calibration.yaml with every optional key."""
    A = rng.normal(size=(9, 9)) * 1e-4
    result = CalibrationResult(
        X_BC=RigidTransform(RollPitchYaw(*rng.uniform(-1.0, 1.0, 3)), rng.uniform(-1.0, 1.0, 3)),
        covariance=A[:6] @ A[:6].T,
        held_out_mm={"median": 0.2, "mean": 0.3, "p95": 0.5},
        tilt_deg={"median": 0.08, "p95": None},
        poses=(
            PoseRecord(
                id="a", used=True, reason="", residual_mm=0.1, held_out_mm=0.2, tilt_deg=0.01, held_out_tilt_deg=0.02
            ),
            PoseRecord(id="b", used=False, reason="no plane"),
        ),
        icp=(
            IcpRecord(
                id="a",
                method="point_to_point",
                rotation_deg=(0.0, 0.1, 0.2),
                translation_mm=(0.1, 0.2, 0.3),
                translation_norm_mm=0.37,
                unseen=("rotation",),
                true_error_mm=0.4,
            ),
        ),
        unobservable=("a bias",),
        warnings=("one",),
        robot="ur10e",
        flange="iso9409-1-50-4-m6",
        scanner="phoxi_m",
        sigma_position_mm=0.1,
        sigma_normal_deg=0.2,
        seed=7,
        data_hashes={"poses.csv": "ab" * 32},
        scanner_correction={"scale": 0.998, "gradient_per_m": [1e-3, 2e-3]},
        joint_covariance=A @ A.T,
        axis_turn_deg=(12.5, 0.2),
    )
    return _saved(lambda folder: save_result(result, folder), "calibration.yaml")


def _saved(save: Any, *names: str) -> Files:
    with TemporaryDirectory() as place:
        save(Path(place))
        return {name: (Path(place) / name).read_bytes() for name in names}


def profiler_record(rng: Rng) -> Files:
    """profiler.yaml with an arm's corrections."""
    from weldcal.calibration.profiler.arm_errors import DhArm

    table = np.column_stack([rng.uniform(0.0, 0.5, (6, 3)), np.zeros(6)])
    R = Rotation.random(rng=rng).as_matrix()
    record = ProfilerRecord(
        method="sphere, joint",
        rotation=R,
        translation=rng.uniform(-0.1, 0.1, 3),
        covariance=1e-8 * np.eye(6),
        tip=np.array([0.0, 0.0, 0.15]),
        arm=DhArm.checked(table),
        figures={"scans": 12, "warnings": ["one"]},
        data_sha256="cd" * 32,
    )
    return _saved(lambda folder: save_record(record, folder), "profiler.yaml")


def tablet_record(rng: Rng) -> Files:
    """tablet.yaml of a wrist camera."""
    X = RigidTransform(RollPitchYaw(*rng.uniform(-1.0, 1.0, 3)), [0.05, 0.0, 0.03])
    result = TabletResult(
        model="wrist",
        parameters={"x": 0.1, "y": 0.2},
        covariance=[[1e-8, 0.0], [0.0, 1e-8]],
        residual_mm=[0.1, 0.2, 0.1],
        leave_one_out_mm=[0.1, None, 0.2],
        X_FC=X,
        X_FC_covariance=(1e-8 * np.eye(6)).tolist(),
        p_FP_m=[0.0, 0.0, 0.15],
        p_FP_covariance=(1e-8 * np.eye(3)).tolist(),
        two_stages=None,
        other_models={"pnp": 0.2},
        unobservable=("a",),
        warnings=("b",),
        data_sha256={"touches.csv": "ef" * 32},
    )
    return _saved(lambda folder: save_tablet_result(result, folder), "tablet.yaml")


def hand_eye_lists(rng: Rng) -> tuple[Array, Array]:
    F, X = _poses(rng, 8), pose(exp_rotation(rng.normal(size=3)), rng.normal(size=3) * 0.1)
    Y = F[0] @ X @ pose(np.eye(3), np.array([0.0, 0.0, 0.6]))
    return F, inverse(F @ X) @ Y


def hand_eye_npz(rng: Rng) -> Files:
    """Return a and B, with the mounting and the unit."""
    F, G = hand_eye_lists(rng)
    return {
        "pairs.npz": npz(
            {"A": F, "B": G, "mode": np.array("eye_in_hand"), "unit": np.array("m")}, bool(rng.random() < 0.5)
        )
    }


def hand_eye_csv(rng: Rng) -> Files:
    """Robot and camera poses by columns, with joints."""
    F, G = hand_eye_lists(rng)
    header = [f"{who}_{c}" for who in ("robot", "camera") for c in _POSE] + [f"q{k}" for k in range(1, 7)]
    rows = [
        [*_seven(a), *_seven(b), *(f"{v:.6f}" for v in rng.uniform(-2.0, 2.0, 6))] for a, b in zip(F, G, strict=True)
    ]
    return {"pairs.csv": _table(header, rows, str(rng.choice([",", ";"])))}


def hand_eye_json(rng: Rng) -> Files:
    """Matrices A and B, or samples as easy_handeye2 writes them."""
    F, G = hand_eye_lists(rng)
    if rng.random() < 0.5:
        return {
            "pairs.json": json.dumps({"A": F.tolist(), "B": G.tolist(), "mode": "eye_in_hand", "unit": "m"}).encode()
        }

    def transform(X: Array) -> dict[str, Any]:
        q = Rotation.from_matrix(X[:3, :3]).as_quat()
        return {
            "translation": dict(zip("xyz", X[:3, 3].tolist(), strict=True)),
            "rotation": dict(zip("xyzw", q.tolist(), strict=True)),
        }

    samples = [{"robot": transform(a), "tracking": transform(b)} for a, b in zip(F, G, strict=True)]
    return {"pairs.json": json.dumps({"parameters": {"calibration_type": "eye_in_hand"}, "samples": samples}).encode()}


def hand_eye_yaml(rng: Rng) -> Files:
    """MoveIt's samples."""
    F, G = hand_eye_lists(rng)
    samples = [
        {"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()}
        for a, b in zip(F, G, strict=True)
    ]
    return {"pairs.yaml": yaml_dump({"samples": samples}).encode()}


def profiler_npz(rng: Rng) -> Files:
    """Poses and one profile each, ragged (n, xz) or of one length."""
    F = _poses(rng, 6)
    F[:, :3, 3] *= 1e3
    profiles = rng.uniform([-20.0, 80.0], [20.0, 120.0], (6, 12, 2))
    own = {"xz": profiles.reshape(-1, 2), "n": np.full(6, 12)} if rng.random() < 0.5 else {"profiles": profiles}
    arrays = {"T": F, "points": profiles[:, 0], "unit": np.array("mm"), "radius": np.array(20.0), **own}
    return {"a.npz": npz(arrays, bool(rng.random() < 0.5))}


def profiler_csv(rng: Rng) -> Files:
    """One row for each profile point, with scans."""
    F = _poses(rng, 6)
    turn = Rotation.from_matrix(F[:, :3, :3]).as_rotvec()
    rows = [
        [
            k,
            *(f"{1e3 * v:.4f}" for v in F[k, :3, 3]),
            *(f"{v:.6f}" for v in turn[k]),
            *(f"{v:.3f}" for v in rng.uniform(1.0, 90.0, 2)),
        ]
        for k in range(6)
        for _ in range(4)
    ]
    header = ["scan", "x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad", "px_mm", "pz_mm"]
    return {"a.csv": _table(header, rows, str(rng.choice([",", ";", "\t"])))}


def profiler_poses(rng: Rng) -> Files:
    """Flange poses of six profiles: quaternions, or A, B, C of a KUKA."""
    F = _poses(rng, 6)
    if rng.random() < 0.5:
        turn, header = Rotation.from_matrix(F[:, :3, :3]).as_euler("ZYX", degrees=True), ["a_deg", "b_deg", "c_deg"]
    else:
        turn, header = Rotation.from_matrix(F[:, :3, :3]).as_quat(), ["qx", "qy", "qz", "qw"]
    rows = [[*(f"{1e3 * v:.4f}" for v in X[:3, 3]), *(f"{v:.6f}" for v in r)] for X, r in zip(F, turn, strict=True)]
    return {"poses.csv": _table(["x_mm", "y_mm", "z_mm", *header], rows)}


def profiler_gocator(rng: Rng) -> Files:
    """Sections with raw or uniform profiles of six frames, and their poses."""
    x, raw = np.linspace(-20.0, 20.0, 12), rng.random() < 0.5
    lead = "Frame,Source,Time,Encoder,Z Encoder,Inputs,Exposure,Y,Axis"
    lines = [
        "Info",
        "CSV Version,Sensor Count",
        "2,1",
        "End",
        "RawProfile" if raw else "Profile",
        "Frame Count,Column Count",
        "6,12",
    ]
    lines.append(f"{lead}," + ",".join(str(k) if raw else f"{v:.3f}" for k, v in enumerate(x)))
    for k in range(6):
        z = ",".join("" if rng.random() < 0.1 else f"{v:.4f}" for v in rng.uniform(80.0, 120.0, 12))
        lines += [f"{k},0,{k},0,0,0,300,0,X," + ",".join(f"{v:.4f}" for v in x)] * raw + [
            f"{k},0,{k},0,0,0,300,0,Z,{z}"
        ]
    return {"a.csv": ("\n".join([*lines, "End"]) + "\n").encode(), **profiler_poses(rng)}


def profiler_blocks(rng: Rng) -> Files:
    """Profiles with decimal commas: numbered rows, or a block with a caption each; and their poses."""
    numbered = rng.random() < 0.5
    lines = ["scanner 2900-50", "Profile;X [mm];Z [mm]"] if numbered else []
    for k in range(6):
        points = [
            ";".join(f"{v:.3f}".replace(".", ",") for v in p) for p in rng.uniform([-20.0, 80.0], [20.0, 120.0], (8, 2))
        ]
        lines += [f"{k};{p}" for p in points] if numbered else ["", f"Profile {k + 1}", "X [mm];Z [mm]", *points]
    return {"a.csv": ("\n".join(lines) + "\n").encode(), **profiler_poses(rng)}


def profiler_heights(rng: Rng) -> Files:
    """Return a grid of heights with the x of its columns in the first row, or of its rows in the first column.

    And their poses.
    """
    grid = np.vstack([np.linspace(-20.0, 20.0, 12), rng.uniform(80.0, 120.0, (6, 12))])
    grid[3, 4] = -99999.9999
    rows = grid if rng.random() < 0.5 else grid.T
    return {"a.csv": "".join(",".join(f"{v:.4f}" for v in r) + "\n" for r in rows).encode(), **profiler_poses(rng)}


def tablet(rng: Rng) -> Files:
    """Touches, poses, intrinsics and positions in the image of one visit."""
    shown = np.array([[400.0 * i, 250.0 * j] for j in range(3) for i in range(3)])
    header = ("landmark", "landmark_x_px", "landmark_y_px", "touch_x_px", "touch_y_px", "mm_per_px", "size_checked")
    touches = [[k, *(f"{v:.3f}" for v in (*p, *(p + rng.normal(size=2)))), "0.19", 1] for k, p in enumerate(shown)]
    X = _poses(rng, 10)
    poses = [[k, *_seven(X[k])] for k in range(9)] + [["camera", *_seven(X[9])]]
    seen = [[k, *(f"{v:.2f}" for v in 320.0 + 0.3 * (p - shown.mean(axis=0)))] for k, p in enumerate(shown)]
    return {
        "touches.csv": _table(header, touches),
        "poses.csv": _table(["landmark", *_POSE], poses),
        "seen.csv": _table(["landmark", "u", "v"], seen),
        "camera.yaml": b"fx: 617.7\nfy: 617.7\ncx: 319.5\ncy: 239.5\ndistortion: [0.01, -0.02, 0.0, 0.0, 0.0]\n",
    }


def planar(rng: Rng) -> Files:
    """Planar touches with depths and queries."""
    px = np.array([[400.0 * i, 250.0 * j] for j in range(3) for i in range(3)])
    arrays = {
        "uv": 320.0 + 0.3 * px + rng.normal(size=(9, 2)),
        "depth": np.full(9, 420.0),
        "hand": rng.uniform(-200.0, 200.0, (9, 2)),
        "theta_deg": np.linspace(-90.0, 90.0, 9),
        "delta_px": rng.normal(size=(9, 2)),
        "tablet_px": px,
        "mm_per_px": np.array(0.19),
        "f": np.array([617.7, 617.7]),
        "c": np.array([319.5, 239.5]),
        "hand_capture": np.array([0.0, 0.0, 300.0]),
        "uv_q": rng.uniform(0.0, 600.0, (3, 2)),
        "theta_q": rng.uniform(-1.0, 1.0, 3),
        "hand_q": rng.uniform(-200.0, 200.0, (3, 2)),
    }
    return {"a.npz": npz(arrays)}


def scenario(rng: Rng) -> Files:
    """One of the shipped scenarios."""
    return {"cell.yaml": (SCENARIO_FOLDER / f"{rng.choice(scenario_names())}.yaml").read_bytes()}


def kinematics(rng: Rng) -> Files:
    """A factory calibration of a UR10e, of small changes."""
    from weldcal.models.arms import kinematics as arms

    text = (Path(arms.__file__).parent / "ur10e" / "default_kinematics.yaml").read_text(encoding="utf-8")
    return {"kinematics.yaml": text.encode()}


def weld_log(rng: Rng) -> Files:
    """Return a table of five rows and its header."""
    columns = {c.name: rng.normal(size=5) for c in COLUMNS if c.name != "phase"}
    process = WeldProcess("MAG", 180.0, 24.0)
    table, header = weld_log_texts(WeldRecord(columns, np.array(["TRACK"] * 5), process, {"seed": 1}))
    return {"weld.csv": table.encode(), "weld.json": header.encode()}


def image(rng: Rng) -> Files:
    """Return a small image."""
    ending = str(rng.choice([".png", ".jpg", ".bmp"]))
    picture = rng.integers(0, 255, (24, 32), dtype=np.uint8)
    return {"a.png": bytes(cv2.imencode(ending, picture)[1])}
