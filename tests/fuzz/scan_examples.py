"""Builds small valid files of clouds and poses as scanners, robots and calibration tools write them, from a seed."""

import gzip
import io
import json
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from tests.fuzz.file_examples import Files, Rng, hand_eye_lists, points
from weldcal.models.arrays import Array

_W, _H = 12, 10
_XYZ = "property float x\nproperty float y\nproperty float z\n"


def _scan(rng: Rng) -> Array:
    """Return a sloping face on a grid (H, W, 3) m, zeros beside a disc of 60 to 70 pixels."""
    v, u = np.mgrid[:_H, :_W]
    z = 0.6 + rng.uniform(-0.002, 0.002) * u + rng.uniform(-0.002, 0.002) * v
    scan = np.stack([(u - 5.5) * z / 300.0, (v - 4.5) * z / 300.0, z], axis=-1)
    return np.where((np.hypot(u - 5.5, v - 4.5) < 4.6)[..., None], scan, 0.0).astype(np.float32).astype(float)


def _order(rng: Rng) -> tuple[str, str]:
    letter, name = [("<", "binary_little_endian"), (">", "binary_big_endian"), ("", "ascii")][int(rng.integers(3))]
    return letter, name


def ply_grid(rng: Rng) -> Files:
    """Return a whole scan with num_cols and num_rows, or its measured points and a range_grid."""
    scan = _scan(rng).reshape(-1, 3)
    seen = scan.any(axis=1)
    letter, name = _order(rng)
    gridded = rng.random() < 0.7
    kept = scan[seen] if gridded else scan
    cells = np.where(seen, np.cumsum(seen) - 1, -1)
    head = f"ply\nformat {name} 1.0\nobj_info num_cols {_W}\nobj_info num_rows {_H}\nelement vertex {len(kept)}\n{_XYZ}"
    if gridded:
        head += f"element range_grid {len(cells)}\nproperty list uchar int vertex_indices\n"
    if not letter:
        rows = [" ".join(f"{v:.9g}" for v in p) for p in kept]
        rows += ["0" if k < 0 else f"1 {k}" for k in cells] if gridded else []
        return {"a.ply": f"{head}end_header\n".encode() + "\n".join(rows).encode() + b"\n"}
    packed = (b"\0" if k < 0 else b"\1" + np.array(k, f"{letter}i4").tobytes() for k in cells)
    body = kept.astype(f"{letter}f4").tobytes() + (b"".join(packed) if gridded else b"")
    return {"a.ply": f"{head}end_header\n".encode() + body}


def ply_lists(rng: Rng) -> Files:
    """Points with a list each, of one length or several."""
    letter, name = _order(rng)
    lengths = rng.integers(0, 4, 60) if rng.random() < 0.5 else np.full(60, 2)
    head = f"ply\nformat {name} 1.0\nelement vertex 60\n{_XYZ}property list uchar int view\nend_header\n".encode()
    if not letter:
        rows = [
            f"{x:.6f} {y:.6f} {z:.6f} {' '.join(map(str, [n, *range(n)]))}"
            for (x, y, z), n in zip(points(rng), lengths, strict=True)
        ]
        return {"a.ply": head + "\n".join(rows).encode() + b"\n"}
    body = b"".join(
        p.astype(f"{letter}f4").tobytes() + bytes([n]) + np.arange(n).astype(f"{letter}i4").tobytes()
        for p, n in zip(points(rng), lengths, strict=True)
    )
    return {"a.ply": head + body}


def ply_gz(rng: Rng) -> Files:
    """Return a packed whole scan."""
    return {"a.ply.gz": gzip.compress(ply_grid(rng)["a.ply"], mtime=0)}


def pcd_stored(rng: Rng) -> Files:
    """Return a compressed PCD whose body is stored as it is, field by field."""
    body = points(rng).astype("<f4").T.tobytes()
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 60\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        "POINTS 60\nDATA binary_compressed\n"
    )
    return {"a.pcd": head.encode() + np.array([len(body), len(body)], "<u4").tobytes() + body}


def pts(rng: Rng) -> Files:
    """Return the number of points, then x y z, intensity and colour of each."""
    rows = "".join(f"{x:.6f} {y:.6f} {z:.6f} 55 52 44 65\n" for x, y, z in points(rng))
    return {"a.pts": f"60\n{rows}".encode()}


def _depth_set(rng: Rng, name: str, content: bytes) -> Files:
    numbers = "300.0, 0.0, 5.5, 0.0, 300.0, 4.5, 0.0, 0.0, 1.0"
    camera = f"image_width: {_W}\nimage_height: {_H}\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{numbers}]\n"
    poses = "id,x,y,z,qw,qx,qy,qz\ns0,0.5,0.1,0.4,1,0,0,0\n"
    return {f"clouds/s0{name}": content, "camera_info.yaml": camera.encode(), "poses.csv": poses.encode()}


def depth_png(rng: Rng) -> Files:
    """Return a depth image of 16 bits in mm, and its camera."""
    depth = np.round(1e3 * _scan(rng)[..., 2]).astype(np.uint16)
    return _depth_set(rng, ".png", bytes(cv2.imencode(".png", depth)[1]))


def depth_tiff(rng: Rng) -> Files:
    """Return a depth image of floating-point metres or 16 bits in mm, and its camera."""
    depth = _scan(rng)[..., 2]
    pixels = depth.astype(np.float32) if rng.random() < 0.5 else np.round(1e3 * depth).astype(np.uint16)
    return _depth_set(rng, ".tif", bytes(cv2.imencode(".tif", pixels)[1]))


def depth_npy(rng: Rng) -> Files:
    """Return a depth image as an array of mm or metres, and its camera."""
    depth = _scan(rng)[..., 2]
    stream = io.BytesIO()
    np.save(stream, np.round(1e3 * depth).astype(np.uint16) if rng.random() < 0.5 else depth.astype(np.float32))
    return _depth_set(rng, ".npy", stream.getvalue())


def _row(*parts: Array, mark: str = ",") -> str:
    return mark.join(f"{v:.7f}" for part in parts for v in np.ravel(part))


def _kuka(k: int, p: Array, turn: Rotation) -> str:
    values = (*1e3 * p, *turn.as_euler("ZYX", degrees=True))
    fields = ",".join(f"{name} {v:.6f}" for name, v in zip("XYZABC", values, strict=True))
    return f"DECL E6POS XP{k}={{{fields},S 2,T 35}}"


def _fanuc(k: int, p: Array, turn: Rotation) -> str:
    x, y, z = 1e3 * p
    w, v, r = turn.as_euler("xyz", degrees=True)
    return (
        f"P[{k}]{{\n   GP1:\n\tX = {x:.4f} mm, Y = {y:.4f} mm, Z = {z:.4f} mm,\n\tW = {w:.5f} deg, P = {v:.5f} deg, R ="
        f" {r:.5f} deg\n}};"
    )


def _rapid(k: int, p: Array, turn: Rotation) -> str:
    return (
        "CONST robtarget"
        f" p{k}:=[[{_row(1e3 * p)}],[{_row(turn.as_quat(scalar_first=True))}],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];"
    )


def _staubli(k: int, p: Array, turn: Rotation) -> str:
    values = (*1e3 * p, *turn.as_euler("XYZ", degrees=True))
    fields = " ".join(f'{n}="{v:.6f}"' for n, v in zip(("x", "y", "z", "rx", "ry", "rz"), values, strict=True))
    return f'<Value key="{k}" {fields} />'


_PROGRAMS: tuple[tuple[str, str, Callable[[int, Array, Rotation], str]], ...] = (
    ("DEFDAT A", "ENDDAT", _kuka),
    ("/POS", "/END", _fanuc),
    ("MODULE M", "ENDMODULE", _rapid),
    ('<Data name="p" type="pointRx" size="12">', "</Data>", _staubli),
    ("def f():", "end", lambda k, p, turn: f"  movel(p[{_row(p, turn.as_rotvec())}], a=1.2, v=0.25)"),
    ("", "", lambda k, p, turn: f"movel(posx({_row(1e3 * p, turn.as_euler('ZYZ', degrees=True))}), vel=100)"),
    (
        "//POS\n///POSTYPE BASE\n///RECTAN",
        "//INST\nEND",
        lambda k, p, turn: f"C{k:05d}={_row(1e3 * p, turn.as_euler('xyz', degrees=True))}",
    ),
    (".TRANS", ".END", lambda k, p, turn: f"p{k} {_row(1e3 * p, turn.as_euler('ZYZ', degrees=True), mark=' ')}"),
    (
        "At time 1.0",
        "",
        lambda k, p, turn: f"- Translation: [{_row(p)}]\n- Rotation: in Quaternion [{_row(turn.as_quat())}]",
    ),
)


def _camera(G: Array) -> bytes:
    rows = [_row(X[:3, 3], Rotation.from_matrix(X[:3, :3]).as_quat()) for X in G]
    return ("x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n").encode()


def program(rng: Rng) -> Files:
    """Return a robot program beside a table of the camera's poses."""
    F, G = hand_eye_lists(rng)
    before, after, line = _PROGRAMS[int(rng.integers(len(_PROGRAMS)))]
    rows = [line(k, X[:3, 3], Rotation.from_matrix(X[:3, :3])) for k, X in enumerate(F)]
    return {"set/robot.txt": "\n".join([before, *rows, after]).encode() + b"\n", "set/camera.csv": _camera(G)}


def captions(rng: Rng) -> Files:
    """Matrices below captions, or lines with labels."""
    F, G = hand_eye_lists(rng)
    lines: list[str] = []
    for a, b in zip(F, G, strict=True):
        lines += ["robot:", *(_row(r, mark=" ") for r in a), "camera:", *(_row(r, mark=" ") for r in b)]
    return {"poses.txt": ("\n".join(lines) + "\n").encode()}


def documents(rng: Rng) -> Files:
    """Return a YAML document for each pose, as ROS prints messages."""
    F, G = hand_eye_lists(rng)
    found = []
    for X in F:
        p, q = X[:3, 3], Rotation.from_matrix(X[:3, :3]).as_quat()
        lines = ["pose:", "  position:", *(f"    {a}: {v:.7f}" for a, v in zip("xyz", p, strict=True))]
        found += [*lines, "  orientation:", *(f"    {a}: {v:.7f}" for a, v in zip("xyzw", q, strict=True)), "---"]
    return {"set/robot.yaml": ("\n".join(found) + "\n").encode(), "set/camera.csv": _camera(G)}


def nested(rng: Rng) -> Files:
    """Samples under numbered keys, with an axis and an angle, a matrix, or fields."""
    F, G = hand_eye_lists(rng)

    def one(X: Array, kind: int) -> Any:
        v = Rotation.from_matrix(X[:3, :3]).as_rotvec()
        angle = float(np.linalg.norm(v))
        if kind == 0:
            return {
                "rotation": {"axis": (v / angle if angle else np.eye(3)[2]).tolist(), "angle": angle},
                "translation": X[:3, 3].tolist(),
            }
        return X.tolist() if kind == 1 else {"rvec": v.tolist(), "tvec": X[:3, 3].tolist()}

    kinds = rng.integers(0, 3, 2)
    samples = {
        f"frame_{k}": {"gripper": one(a, int(kinds[0])), "board": one(b, int(kinds[1]))}
        for k, (a, b) in enumerate(zip(F, G, strict=True))
    }
    return {"pairs.json": json.dumps(samples).encode()}


def matlab(rng: Rng) -> Files:
    """Arrays of MATLAB, with the poses last or in cells."""
    F, G = hand_eye_lists(rng)
    arrays: dict[str, Any] = {"A": np.moveaxis(F, 0, 2), "B": np.moveaxis(G, 0, 2)}
    if rng.random() < 0.5:
        for name, listed in (("A", F), ("B", G)):
            cells = np.empty((1, len(listed)), dtype=object)
            for k, X in enumerate(listed):
                cells[0, k] = X
            arrays[name] = cells
    stream = io.BytesIO()
    savemat(stream, arrays, do_compression=bool(rng.random() < 0.5))  # type: ignore[arg-type]
    return {"pairs.mat": stream.getvalue()}


def folder(rng: Rng) -> Files:
    """Return a JSON file for each sample."""
    F, G = hand_eye_lists(rng)
    return {
        f"set/sample_{k}.json": json.dumps({"robot": a.tolist(), "camera": b.tolist()}, indent=1).encode()
        for k, (a, b) in enumerate(zip(F, G, strict=True))
    }
