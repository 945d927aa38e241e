"""Clouds as scanners and programs write them: missing points, grids, packed files, lists, VIEWPOINT."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.checks import to_metres
from weldcal.calibration.data.clouds import CloudError, CloudForm, read_cloud
from weldcal.calibration.data.dataset import load_dataset

W, H = 24, 18
V, U = np.mgrid[:H, :W]
Z = 600.0 + 0.5 * U + 20.0 * (V > 9)
GRID = np.stack([(U - 11.5) * Z / 400.0, (V - 8.5) * Z / 400.0, Z], axis=-1).astype(np.float32).astype(float)
SEEN = np.hypot(U - 12, V - 9) < 8.0
MISSING = {"zeros": 0.0, "nan": np.nan}
TRUTH = np.where(SEEN[..., None], GRID, np.nan)
XYZ = "property float x\nproperty float y\nproperty float z\n"


def with_missing(kind: str) -> np.ndarray:
    return np.where(SEEN[..., None], GRID, MISSING[kind])


def ply(vertices: str, body: bytes, *, info: str = "", after: str = "", order: str = "binary_little_endian") -> bytes:
    """A PLY of a header's vertex properties and a body."""
    return f"ply\nformat {order} 1.0\n{info}{vertices}{after}end_header\n".encode() + body


def write(path: Path, form: str, points: np.ndarray) -> Path:
    """Points (N, 3) in a file of a form that has no grid."""
    rows = "".join(f"{x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in points)
    n = len(points)
    if form == "npy":
        np.save(path / "a.npy", points)
    elif form == "npz":
        np.savez(path / "a.npz", points=points)
    elif form == "ply":
        (path / "a.ply").write_bytes(ply(f"element vertex {n}\n{XYZ}", points.astype("<f4").tobytes()))
    elif form == "pcd":
        head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA "
        (path / "a.pcd").write_bytes(f"{head}binary\n".encode() + points.astype("<f4").tobytes())
    else:
        (path / f"a.{form}").write_text(rows)
    return path / f"a.{form}"


@pytest.mark.parametrize("kind", MISSING)
@pytest.mark.parametrize("form", ["npy", "npz", "ply", "pcd", "xyz", "txt", "csv", "asc"])
def test_a_list_in_the_sensors_order_is_organised(tmp_path: Path, form: str, kind: str) -> None:
    assert np.array_equal(read_cloud(write(tmp_path, form, with_missing(kind).reshape(-1, 3))), TRUTH, equal_nan=True)


@pytest.mark.parametrize("kind", MISSING)
@pytest.mark.parametrize("form", ["npy", "npz", "ply", "pcd", "xyz", "csv"])
def test_missing_points_of_a_list_are_no_points(tmp_path: Path, form: str, kind: str) -> None:
    order = np.random.default_rng(0).permutation(W * H)
    mixed = with_missing(kind).reshape(-1, 3)[order]
    assert np.array_equal(read_cloud(write(tmp_path, form, mixed)), GRID.reshape(-1, 3)[order][SEEN.ravel()[order]])


@pytest.mark.parametrize("kind", MISSING)
def test_missing_points_of_a_grid_are_nan(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", with_missing(kind))
    assert np.array_equal(read_cloud(tmp_path / "a.npy"), TRUTH, equal_nan=True)


@pytest.mark.parametrize("unit", ["mm", "auto"])
def test_zeros_do_not_decide_the_unit(unit: str) -> None:
    points = np.where(SEEN[..., None], GRID, 0.0)
    assert SEEN.mean() < 0.5
    assert np.allclose(to_metres(points.copy(), unit, "a"), 1e-3 * TRUTH, equal_nan=True)
    assert len(to_metres(points.reshape(-1, 3)[::5].copy(), unit, "a")) == SEEN.ravel()[::5].sum()


def test_a_grid_without_a_clear_width_stays_a_list(tmp_path: Path) -> None:
    """Noise of several steps between neighbours hides which point is below which."""
    noisy = GRID + np.random.default_rng(1).normal(scale=30.0, size=GRID.shape)
    noisy[~SEEN] = 0.0
    assert read_cloud(write(tmp_path, "npy", noisy.reshape(-1, 3))).shape == (SEEN.sum(), 3)


INFO = f"obj_info num_cols {W}\nobj_info num_rows {H}\n"


@pytest.mark.parametrize("info", [INFO, f"obj_info num_cols {H}\nobj_info num_rows {W}\n"], ids=["right", "exchanged"])
def test_num_cols_and_num_rows_give_the_grid_of_a_whole_scan(tmp_path: Path, info: str) -> None:
    """Nothing is missing, so that only the header says that there is a grid; programs exchange its sides."""
    record = np.zeros(W * H, dtype=[*((c, "<f4") for c in "xyz"), *((c, "u1") for c in "rgb")])
    for k, c in enumerate("xyz"):
        record[c] = GRID.reshape(-1, 3)[:, k]
    colours = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    content = ply(f"element vertex {W * H}\n{XYZ}{colours}", record.tobytes(), info=info)
    (tmp_path / "a.ply").write_bytes(content)
    assert np.array_equal(read_cloud(tmp_path / "a.ply"), GRID)


def test_a_header_of_one_row_is_a_list(tmp_path: Path) -> None:
    """What the Point Cloud Library writes of a list: all columns, one row, and a range_grid of as many cells."""
    points = GRID[SEEN]
    n = len(points)
    cells = b"".join(b"\1" + struct.pack("<i", k) for k in range(n))
    info = f"obj_info is_mesh 0\nobj_info num_cols {n}\nobj_info num_rows 1\n"
    after = f"element range_grid {n}\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_bytes(
        ply(f"element vertex {n}\n{XYZ}", points.astype("<f4").tobytes() + cells, info=info, after=after)
    )
    assert np.array_equal(read_cloud(tmp_path / "a.ply"), points)


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", ["uchar", "int"])
def test_a_range_grid_places_the_points(tmp_path: Path, order: str, count: str) -> None:
    points, letter = GRID[SEEN], ">" if order == "binary_big_endian" else "<"
    of_cells = np.full(W * H, -1)
    of_cells[SEEN.ravel()] = np.arange(len(points))
    if order == "ascii":
        rows = [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in points] + ["0" if k < 0 else f"1 {k}" for k in of_cells]
        body = ("\n".join(rows) + "\n").encode()
    else:
        kind = "B" if count == "uchar" else "i"
        cells = [
            struct.pack(f"{letter}{kind}", 0) if k < 0 else struct.pack(f"{letter}{kind}i", 1, k) for k in of_cells
        ]
        body = points.astype(f"{letter}f4").tobytes() + b"".join(cells)
    after = f"element range_grid {W * H}\nproperty list {count} int vertex_indices\n"
    head = f"element vertex {len(points)}\n{XYZ}"
    (tmp_path / "a.ply").write_bytes(ply(head, body, info=INFO, after=after, order=order))
    assert np.array_equal(read_cloud(tmp_path / "a.ply"), TRUTH, equal_nan=True)
    (tmp_path / "b.ply").write_bytes(ply(head, body, after=after, order=order))  # neighbours tell the width as well
    assert np.array_equal(read_cloud(tmp_path / "b.ply"), TRUTH, equal_nan=True)


@pytest.mark.parametrize(
    ("cells", "info", "sentence"),
    [
        (b"\1\0\0\0\0" * 2 + b"\0" * 430, INFO, "names a point twice"),
        (b"\1\0\0\0\0\1\x50\0\0\0" + b"\0" * 430, INFO, "names point 80"),
        (b"\2\0\0\0\0\1\0\0\0" + b"\0" * 431, INFO, "more than one point"),
        (b"\0" * 432, "obj_info num_cols 24\nobj_info num_rows 17\n", "is not the 432 cells"),
        (b"\0" * 431, INFO, "truncated"),
        (b"\0" * 440, INFO, "does not end"),
    ],
)
def test_a_range_grid_that_contradicts_itself_is_refused(
    tmp_path: Path, cells: bytes, info: str, sentence: str
) -> None:
    after = "element range_grid 432\nproperty list uchar int vertex_indices\n"
    body = GRID.reshape(-1, 3)[:40].astype("<f4").tobytes() + cells
    (tmp_path / "a.ply").write_bytes(ply(f"element vertex 40\n{XYZ}", body, info=info, after=after))
    with pytest.raises(CloudError, match=sentence):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("varied", [True, False])
@pytest.mark.parametrize("first", [True, False])
def test_lists_of_a_vertex_are_passed_over(tmp_path: Path, text: bool, varied: bool, first: bool) -> None:
    """The views or classes of each point, as many for each point or not, before or behind its coordinates."""
    points = GRID.reshape(-1, 3)
    views = [list(range(k % 4 if varied else 2)) for k in range(len(points))]
    named = "property list uchar int view\n"
    order = "ascii" if text else "binary_little_endian"
    body = b""
    for p, view in zip(points, views, strict=True):
        if text:
            coordinates, listed = " ".join(f"{v:.17g}" for v in p), " ".join(map(str, [len(view), *view]))
            body += (f"{listed} {coordinates}\n" if first else f"{coordinates} {listed}\n").encode()
        else:
            xyz, packed = p.astype("<f4").tobytes(), struct.pack(f"<B{len(view)}i", len(view), *view)
            body += packed + xyz if first else xyz + packed
    properties = named + XYZ if first else XYZ + named
    after = "element face 0\nproperty list ushort int vertex_indices\n"
    content = ply(f"element vertex {len(points)}\n{properties}", body, order=order, after=after)
    (tmp_path / "a.ply").write_bytes(content)
    assert np.array_equal(read_cloud(tmp_path / "a.ply"), points)
    (tmp_path / "b.ply").write_bytes(content[:-9])
    with pytest.raises(CloudError, match=r"truncated|damaged"):
        read_cloud(tmp_path / "b.ply")


def test_a_count_in_the_first_line_is_no_point(tmp_path: Path) -> None:
    """The .pts form: the number of points, then x y z, intensity and colour of each."""
    rows = "".join(f"{x:.17g} {y:.17g} {z:.17g} 55 52 44 65\n" for x, y, z in GRID[SEEN])
    for name in ("a.pts", "a.txt", "a.xyz"):
        (tmp_path / name).write_text(f"{SEEN.sum()} \n{rows}")
        assert np.array_equal(read_cloud(tmp_path / name), GRID[SEEN])
    (tmp_path / "b.pts").write_text(f"{SEEN.sum() + 1}\n{rows}")
    with pytest.raises(CloudError, match=f"promises {SEEN.sum() + 1} points, and {SEEN.sum()} are there"):
        read_cloud(tmp_path / "b.pts")


@pytest.mark.parametrize("form", ["ply", "pcd", "xyz"])
def test_packed_files_are_read(tmp_path: Path, form: str) -> None:
    plain = write(tmp_path, form, GRID[SEEN])
    packed = tmp_path / f"b.{form}.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert np.array_equal(read_cloud(packed), GRID[SEEN])
    packed.write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(CloudError, match="truncated"):
        read_cloud(packed)
    packed.write_bytes(gzip.compress(b"\0" * 400_000_000, 1))
    with pytest.raises(CloudError, match="would expand to more than"):
        read_cloud(packed)


PCD = (
    "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {}\nHEIGHT {}\nVIEWPOINT"
    " {}\nPOINTS {}\nDATA {}\n"
)


def pcd(points: np.ndarray, viewpoint: str, data: str = "binary") -> bytes:
    record = np.zeros(points.size // 3, dtype=[*((c, "<f4") for c in "xyz"), ("rgb", "<u4")])
    for k, c in enumerate("xyz"):
        record[c] = points.reshape(-1, 3)[:, k]
    height, width = points.shape[:2] if points.ndim == 3 else (1, len(points))
    head = PCD.format(width, height, viewpoint, width * height, data).encode()
    if data == "binary":
        return head + record.tobytes()
    body = b"".join(record[c].tobytes() for c in ("x", "y", "z", "rgb"))
    return head + struct.pack("<II", len(body), len(body)) + body


def test_a_compressed_pcd_of_equal_lengths_is_stored(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(with_missing("nan"), "0 0 0 1 0 0 0", "binary_compressed"))
    assert np.array_equal(read_cloud(tmp_path / "a.pcd"), TRUTH, equal_nan=True)


def test_viewpoint_is_never_ignored(tmp_path: Path) -> None:
    """Identity says nothing; another pose is refused until its meaning is stated, and undone where the points were
    moved."""
    R, t = Rotation.from_euler("xyz", [0.3, -0.7, 2.0]), np.array([120.0, -80.0, 500.0])
    pose = " ".join(f"{v:.12g}" for v in (*t, *R.as_quat(scalar_first=True)))
    for same in ("0 0 0 1 0 0 0", "0 0 0 -1 0 0 0", "0 0 0 0 0 0 0"):
        (tmp_path / "a.pcd").write_bytes(pcd(GRID, same))
        assert np.array_equal(read_cloud(tmp_path / "a.pcd"), GRID)
    moved = np.where(SEEN[..., None], R.apply(GRID.reshape(-1, 3)).reshape(GRID.shape) + t, np.nan)
    (tmp_path / "b.pcd").write_bytes(pcd(moved, pose))
    with pytest.raises(
        CloudError, match=r"has the VIEWPOINT 120 -80 500 .*write 'viewpoint: sensor' into dataset.yaml"
    ):
        read_cloud(tmp_path / "b.pcd")
    assert np.allclose(read_cloud(tmp_path / "b.pcd", CloudForm(viewpoint="world")), TRUTH, atol=1e-3, equal_nan=True)
    read = read_cloud(tmp_path / "b.pcd", CloudForm(viewpoint="sensor"))
    assert np.allclose(read, moved, atol=1e-3, equal_nan=True)
    for wrong in ("1 2 3", "1 2 x 1 0 0 0", "0 0 1 0.5 0 0 0"):
        (tmp_path / "c.pcd").write_bytes(pcd(GRID, wrong))
        with pytest.raises(CloudError, match="VIEWPOINT"):
            read_cloud(tmp_path / "c.pcd")


@pytest.mark.parametrize(("meaning", "moved"), [("sensor", False), ("world", True)])
def test_the_advice_on_viewpoint_leads_on(tmp_path: Path, meaning: str, moved: bool) -> None:
    R, t = Rotation.from_euler("xyz", [0.1, 0.2, -0.3]), np.array([0.1, 0.0, 0.05])
    pose = " ".join(f"{v:.12g}" for v in (*t, *R.as_quat(scalar_first=True)))
    points = 1e-3 * GRID[SEEN]
    (tmp_path / "clouds").mkdir()
    for id in "ab":
        content = pcd((R.apply(points) + t if moved else points) + (1e-4 if id == "b" else 0.0), pose)
        (tmp_path / "clouds" / f"{id}.pcd").write_bytes(content)
    (tmp_path / "poses.csv").write_text("id,x,y,z,qw,qx,qy,qz\na,0.5,0,0.4,1,0,0,0\nb,0.5,0.2,0.4,0,1,0,0\n")
    with pytest.raises(CloudError) as refusal:
        load_dataset(tmp_path).cloud("a")
    advice = f"viewpoint: {meaning}"
    assert f"'{advice}'" in refusal.value.reason
    (tmp_path / "dataset.yaml").write_text(advice + "\n")
    assert np.allclose(load_dataset(tmp_path).cloud("a"), points, atol=1e-5)
