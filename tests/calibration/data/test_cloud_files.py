"""A cloud's header is believed only where its body agrees, and text only where it can be read in one way."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from weldcal.calibration.data.clouds import CloudError, read_cloud

N = 40
POINTS = np.random.default_rng(0).uniform(0.1, 0.9, (N, 3))


def ply(order: str = "little", types: str = "fff", n: int = N, after: str = "") -> bytes:
    """A binary PLY of POINTS (mm where the type is a whole number)."""
    names = {"f": ("float", "f4"), "d": ("double", "f8"), "i": ("int", "i4")}
    head = f"ply\nformat binary_{order}_endian 1.0\nelement vertex {n}\n"
    head += "".join(f"property {names[t][0]} {c}\n" for t, c in zip(types, "xyz", strict=True))
    table = np.zeros(
        N, dtype=[(c, ("<" if order == "little" else ">") + names[t][1]) for t, c in zip(types, "xyz", strict=True)]
    )
    for c, v in zip("xyz", POINTS.T, strict=True):
        table[c] = 1000 * v if "i" in types else v
    return (head + after + "end_header\n").encode() + table.tobytes()


def pcd(data: str = "binary", head: str = "WIDTH 40\nHEIGHT 1\nPOINTS 40\n", body: bytes | None = None) -> bytes:
    """A PCD of POINTS."""
    text = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n{head}DATA {data}\n"
    return text.encode() + (POINTS.astype("<f4").tobytes() if body is None else body)


def reason(path: Path, content: bytes) -> str:
    """The refusal, which must come at once: in computing time, for other programs may take the rest."""
    path.write_bytes(content)
    begin = time.process_time()
    with pytest.raises(CloudError) as caught:
        read_cloud(path)
    assert time.process_time() - begin < 0.5
    return caught.value.reason


@pytest.mark.parametrize("ending", ["ply", "pcd"])
@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
def test_clouds_are_read_as_open3d_reads_them(tmp_path: Path, ending: str, text: bool, compressed: bool) -> None:
    path = str(tmp_path / f"a.{ending}")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.normals = o3d.utility.Vector3dVector(POINTS)
    assert o3d.io.write_point_cloud(path, cloud, write_ascii=text, compressed=compressed)
    theirs = np.asarray(o3d.io.read_point_cloud(path).points)
    assert np.array_equal(read_cloud(Path(path)), theirs)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("types", ["fff", "ddd", "fdf", "iii", "ifd"])
def test_coordinates_of_any_type_and_order_are_read(tmp_path: Path, order: str, types: str) -> None:
    (tmp_path / "a.ply").write_bytes(ply(order, types))
    wanted = 1000 * POINTS if "i" in types else POINTS
    assert np.allclose(read_cloud(tmp_path / "a.ply"), wanted, atol=1.0 if "i" in types else 1e-6)


FACES = "element face 2\nproperty list uchar int vertex_indices\n"
TWO = b"\x03" + b"\1" * 12


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.ply", ply()[:-100], "header promises 40 points and 31 are there"),
        ("a.ply", ply(n=50_000_000), "promises 50000000 points, more than"),
        ("a.ply", ply(n=5_000_000_000), "promises 5000000000 points, more than"),
        ("a.ply", ply(n=1_000_000), "truncated"),
        ("a.ply", ply(n=39), "does not end where its header with 39 points says"),
        ("a.ply", ply(n=41, after=FACES) + TWO * 2, "1 entries"),
        ("a.ply", ply().replace(b"property float y", b"property list uchar float y"), "no coordinate y"),
        ("a.ply", ply().replace(b"float y", b"float x"), "twice"),
        ("a.ply", ply().replace(b"vertex 40", b"vertex -4"), "is no line of a PLY header"),
        ("a.pcd", pcd()[:-100], "header promises 40 points and 31 are there"),
        ("a.pcd", pcd() + b"more than a newline", "19 bytes more follow"),
        ("a.pcd", pcd(head="WIDTH 7\nHEIGHT 7\nPOINTS 40\n"), "WIDTH 7 times HEIGHT 7 is not POINTS 40"),
        ("a.pcd", pcd(head="WIDTH 50000000\nHEIGHT 1\nPOINTS 50000000\n"), "promises 50000000 points"),
        ("a.pcd", pcd().replace(b"SIZE 4 4 4", b"SIZE 4 4"), "not as many"),
        ("a.pcd", pcd().replace(b"TYPE F", b"TYPE X"), "do not fit each other"),
        ("a.pcd", pcd("binary_compressed", body=b"\xff\xff\xff\xff\x10\0\0\0"), "4294967295 bytes are promised"),
        ("a.pcd", pcd("binary_compressed", body=b"\4\0\0\0\xff\xff\xff\xff" + b"\0" * 4), "and its body 4294967295"),
        ("a.pcd", pcd("ascii", body=b"1 2 3\n" * 41), "1 lines more follow"),
        ("a.pcd", pcd("ascii", body=b"1 2 3\n" * 39 + b"1 2\n"), "point 40 has 2 numbers"),
    ],
)  # fmt: skip
def test_a_header_that_lies_is_refused_at_once(tmp_path: Path, name: str, content: bytes, sentence: str) -> None:
    found = reason(tmp_path / name, content)
    assert any(part in found for part in sentence.split("|")), found


def test_faces_behind_the_points_are_no_points(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply(after=FACES) + TWO * 2)
    assert read_cloud(tmp_path / "a.ply").shape == (N, 3)
    mixed = b"\x04" + b"\1" * 16 + TWO
    (tmp_path / "b.ply").write_bytes(ply(after=FACES) + mixed)
    assert read_cloud(tmp_path / "b.ply").shape == (N, 3)


def rows(separator: str, decimal: str = ".", header: str = "", more: str = "") -> str:
    cells = [separator.join(f"{v:.3f}".replace(".", decimal) for v in p) + more for p in POINTS]
    return "\n".join(([header] if header else []) + cells) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        rows(","), rows(", "), rows(";"), rows("\t"), rows("  "), rows(";", ","), rows("\t", ","), rows(" ", ","),
        rows(",", header="x,y,z,grey", more=",7"), rows(";", header="X;Y;Z"), rows(",", header="X [mm],Y [mm],Z [mm]"),
        rows(";", more=";"), "# a note\n// another\n" + rows(" "),
    ],
)  # fmt: skip
def test_text_is_read_with_any_separator_and_decimal_commas(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    assert np.allclose(read_cloud(tmp_path / "a.csv"), POINTS, atol=5.1e-4)


def test_columns_that_a_header_names_are_found_by_their_names(tmp_path: Path) -> None:
    lines = ["id,z,y,x"] + [f"{k},{z},{y},{x}" for k, (x, y, z) in enumerate(POINTS)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    assert np.array_equal(read_cloud(tmp_path / "a.csv"), POINTS)


def test_a_header_of_as_many_columns_says_that_commas_separate_whole_numbers(tmp_path: Path) -> None:
    """Millimetres with colours: without the header each two of them could be one number."""
    whole = np.arange(3 * N).reshape(N, 3) + 600
    cells = "".join(f"{x},{y},{z},255,128,0\n" for x, y, z in whole)
    (tmp_path / "a.csv").write_text("x,y,z,r,g,b\n" + cells)
    assert np.array_equal(read_cloud(tmp_path / "a.csv"), whole)
    assert "could be separators or decimal commas" in reason(tmp_path / "b.csv", cells.encode())


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (rows(",", ","), "could be separators or decimal commas"),
        (rows(",", ",", header="x,y,z"), "has 6 cells and the first row 3"),
        (rows(",") + "0.1,0.2\n", "line 41, has 2 cells"),
        (rows(",") + "0.1,0.2,x\n", "line 41: 'x' is not a number"),
        (rows(",") + "0.1,0.2," + "9" * 200_000, "is not a number"),
        (rows(" ").replace(" ", ",", 1), "fewer than three numbers"),
        ("x,y,z\n", "is empty"),
        (rows(",", header="x,x,z"), "x, y or z twice"),
    ],
)
def test_text_that_can_be_read_in_two_ways_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    found = reason(tmp_path / "a.csv", text.encode())
    assert sentence in found, found


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_every_pattern_of_nan_is_a_missing_point(tmp_path: Path) -> None:
    content = ply()
    (tmp_path / "a.ply").write_bytes(content)
    whole = len(read_cloud(tmp_path / "a.ply"))
    (tmp_path / "a.ply").write_bytes(content[:-4] + bytes([1, 0, 0xA0, 0x7F]))  # a signalling NaN
    assert len(read_cloud(tmp_path / "a.ply")) == whole - 1
