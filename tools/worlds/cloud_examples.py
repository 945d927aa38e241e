"""Builds small valid clouds as scanners write them, from a seed: grids, lists of a vertex, packed and stored files,
depth images."""

import gzip
import io

import cv2
import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.worlds.file_examples import Files, Rng, points

_W, _H = 12, 10
_XYZ = "property float x\nproperty float y\nproperty float z\n"


def _scan(rng: Rng) -> Array:
    """A sloping face on a grid (H, W, 3) m, zeros beside a disc of 60 to 70 pixels."""
    v, u = np.mgrid[:_H, :_W]
    z = 0.6 + rng.uniform(-0.002, 0.002) * u + rng.uniform(-0.002, 0.002) * v
    scan = np.stack([(u - 5.5) * z / 300.0, (v - 4.5) * z / 300.0, z], axis=-1)
    return np.where((np.hypot(u - 5.5, v - 4.5) < 4.6)[..., None], scan, 0.0).astype(np.float32).astype(float)


def _order(rng: Rng) -> tuple[str, str]:
    letter, name = [("<", "binary_little_endian"), (">", "binary_big_endian"), ("", "ascii")][int(rng.integers(3))]
    return letter, name


def ply_grid(rng: Rng) -> Files:
    """A whole scan with num_cols and num_rows, or its measured points and a range_grid."""
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
    """A packed whole scan."""
    return {"a.ply.gz": gzip.compress(ply_grid(rng)["a.ply"], mtime=0)}


def pcd_stored(rng: Rng) -> Files:
    """A compressed PCD whose body is stored as it is, field by field."""
    body = points(rng).astype("<f4").T.tobytes()
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 60\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        "POINTS 60\nDATA binary_compressed\n"
    )
    return {"a.pcd": head.encode() + np.array([len(body), len(body)], "<u4").tobytes() + body}


def pts(rng: Rng) -> Files:
    """The number of points, then x y z, intensity and colour of each."""
    rows = "".join(f"{x:.6f} {y:.6f} {z:.6f} 55 52 44 65\n" for x, y, z in points(rng))
    return {"a.pts": f"60\n{rows}".encode()}


def _depth_set(rng: Rng, name: str, content: bytes) -> Files:
    numbers = "300.0, 0.0, 5.5, 0.0, 300.0, 4.5, 0.0, 0.0, 1.0"
    camera = f"image_width: {_W}\nimage_height: {_H}\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{numbers}]\n"
    poses = "id,x,y,z,qw,qx,qy,qz\ns0,0.5,0.1,0.4,1,0,0,0\n"
    return {f"clouds/s0{name}": content, "camera_info.yaml": camera.encode(), "poses.csv": poses.encode()}


def depth_png(rng: Rng) -> Files:
    """A depth image of 16 bits in mm, and its camera."""
    depth = np.round(1e3 * _scan(rng)[..., 2]).astype(np.uint16)
    return _depth_set(rng, ".png", bytes(cv2.imencode(".png", depth)[1]))


def depth_tiff(rng: Rng) -> Files:
    """A depth image of floating-point metres or 16 bits in mm, and its camera."""
    depth = _scan(rng)[..., 2]
    pixels = depth.astype(np.float32) if rng.random() < 0.5 else np.round(1e3 * depth).astype(np.uint16)
    return _depth_set(rng, ".tif", bytes(cv2.imencode(".tif", pixels)[1]))


def depth_npy(rng: Rng) -> Files:
    """A depth image as an array of mm or metres, and its camera."""
    depth = _scan(rng)[..., 2]
    stream = io.BytesIO()
    np.save(stream, np.round(1e3 * depth).astype(np.uint16) if rng.random() < 0.5 else depth.astype(np.float32))
    return _depth_set(rng, ".npy", stream.getvalue())
