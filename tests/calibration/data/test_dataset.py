"""Reading dataset folders: what is right is read, what is wrong is named in one sentence."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.data.clouds import CloudError, read_cloud, save_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.writing import save_dataset
from weldcal.calibration.errors import DatasetError

HEADER = """\
schema: 1
robot: ur10e
flange: iso9409-1-50-4-m6
scanner: phoxi_m
configuration: eye_on_base
units: {clouds: m, poses: m}
note: test
"""
POSES = """\
id,x,y,z,qw,qx,qy,qz
a,0.5,0.1,0.4,1,0,0,0
b,0.5,0.2,0.4,0,1,0,0
"""
PLY = """\
ply
format ascii 1.0
element vertex 40
property float x
property float y
property float z
element camera 1
property float view_px
property int viewportx
end_header
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "dataset.yaml").write_text(HEADER)
    (tmp_path / "poses.csv").write_text(POSES)
    (tmp_path / "clouds").mkdir()
    points = np.random.default_rng(0).uniform(0.1, 0.5, (200, 3))
    save_cloud(tmp_path / "clouds" / "a.npz", points)
    o3d.io.write_point_cloud(tmp_path / "clouds" / "b.pcd", o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    return tmp_path


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_good_folder_is_read_with_its_hashes(folder: Path) -> None:
    data = load_dataset(folder)
    assert list(data.poses) == ["a", "b"]
    assert np.allclose(data.poses["b"].translation(), [0.5, 0.2, 0.4])
    assert data.poses["b"].rotation().matrix()[1, 1] == pytest.approx(-1.0)
    assert data.refused == ()
    assert set(data.hashes) == {"dataset.yaml", "poses.csv", "clouds/a.npz", "clouds/b.pcd"}
    assert all(len(h) == 64 for h in data.hashes.values())
    a, b = data.cloud("a"), data.cloud("b")
    # single precision of half a metre
    assert np.allclose(a, b, atol=1e-7)
    assert data.X_FR.IsExactlyIdentity()


def test_units_are_converted(folder: Path) -> None:
    metres = load_dataset(folder).cloud("a")
    change(folder / "dataset.yaml", "clouds: m,", "clouds: mm,")
    save_cloud(folder / "clouds" / "a.npz", 1e3 * metres)
    assert np.allclose(load_dataset(folder).cloud("a"), metres)


def test_feature_in_the_flange_frame_is_read(folder: Path) -> None:
    with (folder / "dataset.yaml").open("a") as stream:
        stream.write("feature_in_flange: {xyz: [0.14, 0.0, -0.012], wxyz: [0.0, 1.0, 0.0, 0.0]}\n")
    assert np.allclose(load_dataset(folder).X_FR.translation(), [0.14, 0.0, -0.012])


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        ("dataset.yaml", "schema: 1", "schema: 2", "schema 2"),
        ("dataset.yaml", "schema: 1", "schema: 1\nschema: 1", "the key 'schema' twice"),
        (
            "dataset.yaml",
            "note: test",
            "feature_in_flange: {xyz: [0.1, 0.2]}",
            r"feature_in_flange\.xyz must hold 3 numbers",
        ),
        (
            "dataset.yaml",
            "note: test",
            "feature_in_flange: {wxyz: [1, 0, 0]}",
            r"feature_in_flange\.wxyz must hold 4 numbers",
        ),
        ("dataset.yaml", "note: test", "feature_in_flange: {wxyz: [.nan, 0, 0, 0]}", "not finite"),
        ("dataset.yaml", "note: test", "scanner_guess: {xyz: [600, 0, 900]}", "must be in metres"),
        ("dataset.yaml", "note: test", "scanner_guess: {radius_m: .nan}", "radius_m must be a positive number"),
        ("dataset.yaml", "note: test", "scanner_guess: {radius_m: -0.1}", "radius_m must be a positive number"),
        ("dataset.yaml", "note: test", "scanner_guess: {radius_m: [1]}", "cannot be read as a dataset description"),
        ("dataset.yaml", "note: test", "poses: {rotaton: matrix}", "no key 'poses.rotaton'; did you mean 'rotation'"),
        ("dataset.yaml", "clouds: m,", "cloud: m,", "no key 'units.cloud'; did you mean 'clouds'"),
        ("dataset.yaml", "poses: m}", "poses: mm}", "look like m;"),
        ("poses.csv", "0.5,0.2,0.4", "0,5,0.2,0.4", "line 3: 9 cells, and the header names 8 columns"),
        ("poses.csv", "id,x,y,z,qw", "id,x,y,z,x,qw", "two columns 'x'"),
        ("poses.csv", "0.5,0.2,0.4", "0.5,1e308,0.4", "beyond 1e\\+09"),
        ("dataset.yaml", "clouds: m,", "clouds: inch,", "unit 'inch' for clouds; write m or mm"),
        ("dataset.yaml", "eye_on_base", "eye_in_foot", "configuration 'eye_in_foot'"),
        ("dataset.yaml", "eye_on_base", "eye_in_hand", "on an arm \\(eye_in_hand\\)"),
        ("dataset.yaml", "robot: ur10e", "robots: ur10e", "has no key 'robots'; did you mean 'robot'"),
        ("poses.csv", "0.5,0.2,0.4", "0.5,,0.4", "'' in column y of 'b'; a number is needed"),
        ("poses.csv", "0.5,0.2,0.4", "0.5,nan,0.4", "nan in column y of 'b'"),
        ("poses.csv", "0,1,0,0", "0,0.5,0,0", "quaternion of 'b' has the length 0.5000"),
        ("poses.csv", "b,0.5", "a,0.5", "id 'a' twice"),
        ("poses.csv", "id,x,y,z,qw", "id,x,y,z,w", "no rotation that it names: add qw,qx,qy,qz"),
        ("poses.csv", "b,0.5,0.2,0.4,0,1,0,0\n", "", "no pose for b.pcd; add the missing row"),
        ("poses.csv", "a,0.5,0.1,0.4,1,0,0,0\nb,0.5,0.2,0.4", "a,500,100,400,1,0,0,0\nb,500,200,400", "look like mm"),
    ],
)
def test_what_is_wrong_is_named(folder: Path, file: str, old: str, new: str, sentence: str) -> None:
    change(folder / file, old, new)
    with pytest.raises(DatasetError, match=sentence) as caught:
        load_dataset(folder)
    assert "\n" not in str(caught.value)


def test_missing_folder_and_files_are_named(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        load_dataset(tmp_path / "nowhere")
    (folder / "poses.csv").unlink()
    with pytest.raises(DatasetError, match=r"neither poses\.csv nor pairs\.csv"):
        load_dataset(folder)


def test_a_pose_without_a_cloud_is_refused_by_name(folder: Path) -> None:
    (folder / "clouds" / "b.pcd").unlink()
    data = load_dataset(folder)
    assert data.refused[0][0] == "b"
    assert "no cloud for this pose" in data.refused[0][1]


def test_two_clouds_for_one_pose_are_not_guessed_at(folder: Path) -> None:
    save_cloud(folder / "clouds" / "b.npz", np.ones((50, 3)))
    assert "more than one cloud" in load_dataset(folder).refused[0][1]


def test_a_recording_reads_back_as_it_was(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    poses = {f"s{k}": RigidTransform(RollPitchYaw(*rng.uniform(-1, 1, 3)), rng.uniform(0.1, 1, 3)) for k in range(4)}
    clouds = {k: rng.uniform(0.3, 0.6, (20, 30, 3)).astype(np.float32) for k in poses}
    clouds["s1"][3, 4] = np.nan
    header = DatasetHeader(robot="ur10e", flange="iso9409-1-50-4-m6", scanner="phoxi_m", configuration="eye_on_base")
    header.feature_in_flange.xyz = [0.14, 0.0, -0.012]
    save_dataset(tmp_path / "r", header, poses, clouds)
    data = load_dataset(tmp_path / "r")
    for k, X_BF in poses.items():
        # a quaternion and back: rounding
        assert np.allclose(data.poses[k].GetAsMatrix34(), X_BF.GetAsMatrix34(), atol=1e-14)
        assert np.array_equal(data.cloud(k), clouds[k], equal_nan=True)
    assert data.X_FR.translation()[0] == 0.14
    with pytest.raises(DatasetError, match="ids of poses and clouds differ"):
        save_dataset(tmp_path / "s", header, poses, {})


def test_pairs_are_read_and_mixed_units_are_noticed(tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text(HEADER)
    rows = [f"{k},{0.1 * k},{0.2 + 0.05 * k},0.3,{0.1 * k},0.1,{0.5 + 0.05 * k}" for k in range(5)]
    path = tmp_path / "pairs.csv"
    path.write_text("id,base_x,base_y,base_z,camera_x,camera_y,camera_z\n" + "\n".join(rows) + "\n")
    data = load_dataset(tmp_path)
    assert len(data.pairs) == 5
    assert not data.pairs[0].has_orientation
    change(tmp_path / "dataset.yaml", "clouds: m,", "clouds: mm,")
    with pytest.raises(DatasetError, match="One of the two is in millimetres"):
        load_dataset(tmp_path)


def test_text_ply_with_a_camera_element_is_read(tmp_path: Path) -> None:
    rows = "\n".join(f"{k} {2 * k} 700.5" for k in range(40))
    (tmp_path / "c.ply").write_text(PLY + rows + "\n0 640\n")
    points = read_cloud(tmp_path / "c.ply")
    assert points.shape == (40, 3)
    assert np.allclose(points[7], [7, 14, 700.5])


def test_depth_map_uses_pixel_centres_at_whole_numbers(tmp_path: Path) -> None:
    depth = np.zeros((40, 60))
    depth[10:, 20:] = 0.5
    np.savez(tmp_path / "d.npz", depth=depth, intrinsics=[100.0, 110.0, 30.0, 20.0])
    points = read_cloud(tmp_path / "d.npz")
    assert points.shape == (40, 60, 3)
    assert np.isnan(points[0, 0]).all()
    assert np.allclose(points[20, 40], [0.05, 0.0, 0.5])


def test_nan_is_a_missing_pixel_in_an_image_and_no_point_in_a_list(tmp_path: Path) -> None:
    rows = ["nan nan nan"] * 7 + ["1 1 1"] * 93
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {}\nHEIGHT {}\nPOINTS 100\nDATA ascii\n"
    (tmp_path / "image.pcd").write_text("VERSION 0.7\n" + header.format(20, 5) + "\n".join(rows) + "\n")
    got = read_cloud(tmp_path / "image.pcd")
    assert got.shape == (5, 20, 3)
    assert np.isnan(got).all(axis=2).sum() == 7
    (tmp_path / "list.pcd").write_text("VERSION 0.7\n" + header.format(100, 1) + "\n".join(rows) + "\n")
    assert np.array_equal(read_cloud(tmp_path / "list.pcd"), np.ones((93, 3)))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (np.full((100, 3), np.nan), "is missing"),
        (np.zeros((100, 3)), "is missing"),
        (np.zeros((0, 3)), "is empty"),
        (np.vstack([np.ones((40, 3)), [[np.inf, 0, 0]]]), "infinite"),
        (np.vstack([np.ones((20, 3)), np.full((900, 3), np.nan)]), "only 20 valid points"),
        (np.ones((5, 3)), "only 5 valid points"),
        (np.ones((50, 4)), "shape"),
    ],
)
def test_clouds_of_no_use_are_refused(tmp_path: Path, content: np.ndarray, reason: str) -> None:
    np.savez(tmp_path / "x.npz", points=content)
    with pytest.raises(CloudError, match=reason):
        read_cloud(tmp_path / "x.npz")


def test_truncated_and_damaged_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "t.ply").write_text(PLY + "\n".join("1 2 3" for _ in range(25)))
    with pytest.raises(CloudError, match="promises 40 points and 25 are there"):
        read_cloud(tmp_path / "t.ply")
    (tmp_path / "e.pcd").write_text("")
    with pytest.raises(CloudError, match="is empty"):
        read_cloud(tmp_path / "e.pcd")
    (tmp_path / "g.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(CloudError, match="cannot be read"):
        read_cloud(tmp_path / "g.npz")


@pytest.mark.parametrize(
    "table",
    [
        POSES.replace(",", ";"),
        POSES.replace(",", "\t"),
        POSES.replace(",", ";").replace(".", ","),
        "# poses of Monday\n" + POSES.replace("id,x,y,z", "ID, X, Y, Z") + ",,,,,,,\n",
    ],
    ids=["semicolons", "tabs", "decimal commas", "comment, case and an empty row"],
)
def test_a_table_is_read_as_spreadsheets_write_it(folder: Path, table: str) -> None:
    plain = load_dataset(folder).poses
    (folder / "poses.csv").write_text(table)
    read = load_dataset(folder).poses
    assert all(read[id].IsExactlyEqualTo(plain[id]) for id in ("a", "b"))


def test_clouds_are_found_and_read_by_any_of_their_endings(folder: Path) -> None:
    points = read_cloud(folder / "clouds" / "a.npz")
    (folder / "clouds" / "a.npz").unlink()
    np.save(folder / "clouds" / "a.npy", points)
    (folder / "clouds" / "b.pcd").rename(folder / "clouds" / "b.PCD")
    (folder / "clouds" / "._b.pcd").write_text("what a file manager leaves")
    data = load_dataset(folder)
    assert np.array_equal(data.cloud("a"), points)
    assert len(data.cloud("b")) == 200
    text = folder / "clouds" / "c.csv"
    text.write_text("x;y;z;grey\n" + "".join(f"{x};{y};{z};7\n" for x, y, z in points))
    assert np.array_equal(read_cloud(text), points)


def test_a_scan_that_repeats_another_counts_once(folder: Path) -> None:
    change(folder / "poses.csv", "b,0.5", "c,0.5,0.1,0.4,1,0,0,0\nb,0.5")
    (folder / "clouds" / "c.npz").write_bytes((folder / "clouds" / "a.npz").read_bytes())
    data = load_dataset(folder)
    assert set(data.clouds) == {"a", "b"}
    assert [id for id, _ in data.refused] == ["c"]


@pytest.mark.parametrize("scale", [1.0, 1.5, 9.0])
def test_metres_called_millimetres_are_noticed_at_any_reach(folder: Path, scale: float) -> None:
    """A reach of more than a metre used to pass."""
    text = POSES.replace("0.5,0.1", f"{0.5 * scale},{0.1 * scale}").replace("0.5,0.2", f"{0.5 * scale},{0.2 * scale}")
    (folder / "poses.csv").write_text(text)
    load_dataset(folder)
    change(folder / "dataset.yaml", "poses: m}", "poses: mm}")
    with pytest.raises(DatasetError, match=r"look like m; correct units in dataset\.yaml to 'poses: m'"):
        load_dataset(folder)


def test_a_cloud_in_another_unit_than_stated_is_refused(folder: Path) -> None:
    change(folder / "dataset.yaml", "clouds: m,", "clouds: mm,")
    with pytest.raises(
        CloudError, match=r"a\.npz lie 0\.000\d+ m from the camera, as mm: they look like m; .* 'clouds: m'"
    ):
        load_dataset(folder).cloud("a")


def test_a_cloud_that_is_no_file_is_refused_by_name(folder: Path) -> None:
    (folder / "clouds" / "b.pcd").unlink()
    os.mkfifo(folder / "clouds" / "b.pcd")
    data = load_dataset(folder)
    assert set(data.clouds) == {"a"}
    assert "is a pipe" in dict(data.refused)["b"]


def test_half_a_quaternion_of_a_pair_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text(HEADER)
    rows = [f"{k},{0.1 * k},0.2,0.3,{0.1 * k},0.1,0.5,1,0,0" for k in range(5)]
    header = "id,base_x,base_y,base_z,camera_x,camera_y,camera_z,base_qw,base_qx,base_qz"
    (tmp_path / "pairs.csv").write_text("\n".join([header, *rows]))
    with pytest.raises(DatasetError, match="lacks base_qy of '0'"):
        load_dataset(tmp_path)


def test_a_link_to_no_file_is_no_missing_description(folder: Path) -> None:
    (folder / "dataset.yaml").unlink()
    load_dataset(folder)
    (folder / "dataset.yaml").symlink_to("gone.yaml")
    with pytest.raises(DatasetError, match="replace or remove the link"):
        load_dataset(folder)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_quaternion_of_huge_numbers_is_refused_by_its_length(folder: Path) -> None:
    change(
        folder / "dataset.yaml",
        "schema: 1",
        "schema: 1\nscanner_guess: {xyz: [0, 0, 1], wxyz: [1.0e+308, 0, 0, 0], radius_m: 0.1}",
    )
    with pytest.raises(DatasetError, match="length"):
        load_dataset(folder)
