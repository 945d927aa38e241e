"""Depth images become points by the intrinsics that dataset.yaml or a file of the camera states; else a sentence asks
for them."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from weldcal.calibration.data.camera_file import read_camera
from weldcal.calibration.data.clouds import CloudError, read_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.errors import DatasetError

W, H = 40, 30
FX, FY, CX, CY = 210.0, 205.0, 19.0, 15.5
V, U = np.mgrid[:H, :W]
DEPTH = np.round(700.0 + 2.0 * U - 3.0 * V)  # mm
DEPTH[:6, :9] = 0.0
TRUTH = 1e-3 * np.stack([(U - CX) * DEPTH / FX, (V - CY) * DEPTH / FY, DEPTH], axis=-1)
TRUTH[DEPTH == 0.0] = np.nan
POSES = "id,x,y,z,qw,qx,qy,qz\na,0.5,0,0.4,1,0,0,0\nb,0.5,0.2,0.4,0,1,0,0\n"
STATED = f"intrinsics: {{fx: {FX}, fy: {FY}, cx: {CX}, cy: {CY}}}\n"


def image(path: Path, pixels: np.ndarray) -> None:
    if path.suffix == ".npy":
        np.save(path, pixels)
    else:
        path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())


def dataset(folder: Path, name: str = "{}.png", place: str = "clouds", pixels: np.ndarray | None = None) -> Path:
    """Two poses, and the depth image of each."""
    (folder / place).mkdir(parents=True)
    (folder / "poses.csv").write_text(POSES)
    for k, id in enumerate("ab"):
        content = (DEPTH.astype(np.uint16) if pixels is None else pixels).copy()
        content[-1, -1] += k
        image(folder / place / name.format(id), content)
    return folder


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("{}.png", DEPTH.astype(np.uint16)),
        ("{}.tif", DEPTH.astype(np.uint16)),
        ("{}.tiff", DEPTH.astype(np.float32)),
        ("{}.npy", DEPTH.astype(np.uint16)),
        ("{}.npy", 1e-3 * DEPTH),
        ("{}.npy", np.where(DEPTH > 0.0, 1e-3 * DEPTH, np.nan).astype(np.float32)),
        ("{}.png", np.where(DEPTH > 0.0, DEPTH, 65535).astype(np.uint16)),
    ],
)
@pytest.mark.parametrize("place", ["clouds", "depth"])
def test_the_advice_on_intrinsics_leads_on(tmp_path: Path, name: str, pixels: np.ndarray, place: str) -> None:
    """Nothing but what the sentence says is written into dataset.yaml, which was not there."""
    folder = dataset(tmp_path / "scans", name, place, pixels)
    with pytest.raises(CloudError) as refusal:
        load_dataset(folder).cloud("a")
    advice = re.search(r"write '(.*)' \(pixels\) into dataset\.yaml", refusal.value.reason)
    assert advice is not None, refusal.value.reason
    text = advice[1]
    for value in (FX, FY, CX, CY):
        text = text.replace("...", str(value), 1)
    (folder / "dataset.yaml").write_text(text + "\n")
    data = load_dataset(folder)
    assert np.allclose(data.cloud("a"), TRUTH, atol=1e-6, equal_nan=True)
    assert any("intrinsics of dataset.yaml: fx 210" in note for note in data.notes)


K = [FX, 0.0, CX, 0.0, FY, CY, 0.0, 0.0, 1.0]
LISTED = ", ".join(map(str, K))
FILES = {
    "camera_info.yaml": (
        f"image_width: {W}\nimage_height: {H}\ncamera_name: depth\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data:"
        f" [{LISTED}]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0,"
        " 0, 0]\n"
    ),
    "camera_info.yml": (
        f"header: {{frame_id: depth}}\nheight: {H}\nwidth: {W}\ndistortion_model: plumb_bob\nd: [0.0, 0.0, 0.0, 0.0,"
        f" 0.0]\nk: [{LISTED}]\nr: [1.0, 0, 0, 0, 1, 0, 0, 0, 1]\n"
    ),
    "camera.yml": (
        f"%YAML:1.0\n---\nimage_width: {W}\nimage_height: {H}\nCamera_Matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        f"   dt: d\n   data: [ {LISTED} ]\n"
    ),
    "camera.xml": (
        '<?xml version="1.0"?>\n<opencv_storage>\n<camera_matrix type_id="opencv-matrix">\n  <rows>3</rows>\n '
        " <cols>3</cols>\n"
        f"  <dt>d</dt>\n  <data>\n    {LISTED.replace(',', '')}</data></camera_matrix>\n</opencv_storage>\n"
    ),
    "camchain.yaml": (
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  intrinsics: [{FX}, {FY}, {CX},"
        f" {CY}]\n  resolution: [{W}, {H}]\n"
    ),
    "camera_intrinsic.json": json.dumps(
        {"width": W, "height": H, "intrinsic_matrix": np.reshape(K, (3, 3)).T.ravel().tolist()}
    ),
    "camera.json": json.dumps({"cx": CX, "cy": CY, "depth_scale": 1.0, "fx": FX, "fy": FY, "height": H, "width": W}),
    "scene_camera.json": json.dumps({"1": {"cam_K": K, "depth_scale": 1.0}, "2": {"cam_K": K, "depth_scale": 1.0}}),
    "intrinsics.json": json.dumps(
        {"depth": {"width": W, "height": H, "fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "coeffs": [0.0] * 5}}
    ),
    "camera-intrinsics.txt": f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n",
    "intrinsic_depth.txt": f"{FX} 0 {CX} 0\n0 {FY} {CY} 0\n0 0 1 0\n0 0 0 1\n",
    "camera_matrix.csv": f"{FX}, 0, {CX}\n0, {FY}, {CY}\n0, 0, 1\n",
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("beside", [True, False])
def test_a_file_of_the_camera_beside_the_images_is_read(tmp_path: Path, name: str, beside: bool) -> None:
    folder = dataset(tmp_path / "scans", place="depth")
    (folder / "depth" / name if beside else folder / name).write_text(FILES[name])
    data = load_dataset(folder)
    assert np.allclose(data.cloud("a"), TRUTH, atol=1e-6, equal_nan=True)
    assert any(name in key for key in data.hashes)


@pytest.mark.parametrize("name", FILES)
def test_pictures_take_the_camera_of_the_same_files(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FILES[name])
    found = read_camera(tmp_path / name)
    assert found.K.tolist() == np.reshape(K, (3, 3)).tolist()
    assert not found.distortion.any()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (FILES["camera_info.yaml"].replace("0, 0, 0, 0, 0", "0.1, 0, 0, 0, 0"), "lens distortion"),
        (FILES["camera_info.yaml"].replace(f"width: {W}", "width: 1280"), "states a camera of 1280 x 30"),
        (FILES["camera_info.yaml"].replace(f"[{FX}", "[-1.0"), "not usable"),
        ("fx: [", "cannot be read"),
        ("name: a camera\n", "intrinsics of its camera are missing"),
    ],
)
def test_a_camera_that_does_not_fit_is_refused_until_dataset_yaml_states_one(
    tmp_path: Path, text: str, sentence: str
) -> None:
    folder = dataset(tmp_path / "scans")
    (folder / "camera_info.yaml").write_text(text)
    with pytest.raises(CloudError, match=sentence):
        load_dataset(folder).cloud("a")
    (folder / "dataset.yaml").write_text(STATED)
    assert np.allclose(load_dataset(folder).cloud("a"), TRUTH, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize(("scale", "unit"), [(0.0002, ""), (0.0002, "units: {clouds: mm}\n"), (0.0001, "")])
def test_depth_scale_is_the_metres_of_one_unit(tmp_path: Path, scale: float, unit: str) -> None:
    folder = dataset(tmp_path / "scans", pixels=np.round(1e-3 * DEPTH / scale).astype(np.uint16))
    (folder / "dataset.yaml").write_text(f"{STATED}depth_scale: {scale}\n{unit}")
    assert np.allclose(load_dataset(folder).cloud("a"), TRUTH, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("depth_scale: 5000", r"metres of one unit .* 0\.0002 for 5000 units a metre"),
        ("intrinsics: {fx: 0, fy: 1, cx: 1, cy: 1}", "focal lengths are positive"),
        ("viewpoint: base", "write sensor or world"),
    ],
)
def test_stated_values_that_cannot_be_are_refused(tmp_path: Path, line: str, sentence: str) -> None:
    folder = dataset(tmp_path / "scans")
    (folder / "dataset.yaml").write_text(line + "\n")
    with pytest.raises(DatasetError, match=sentence):
        load_dataset(folder)


def test_pictures_are_no_depth_images(tmp_path: Path) -> None:
    """A colour picture beside each cloud is passed over; alone it is refused by a sentence."""
    folder = dataset(tmp_path / "scans", "{}_depth.png", "images")
    for id in "ab":
        image(folder / "images" / f"{id}_colour.png", np.zeros((H, W, 3), np.uint8))
    (folder / "poses.csv").write_text(POSES.replace("a,", "a_depth,").replace("b,", "b_depth,"))
    (folder / "dataset.yaml").write_text(STATED)
    assert list(load_dataset(folder).clouds) == ["a_depth", "b_depth"]
    points = TRUTH[~np.isnan(TRUTH[..., 2])]
    for id in "ab":
        np.save(folder / "images" / f"{id}_depth.npy", points)
    assert load_dataset(folder).clouds["a_depth"].suffix == ".npy"
    with pytest.raises(CloudError, match="3 channels, and a depth image has one"):
        read_cloud(folder / "images" / "a_colour.png")
    image(tmp_path / "grey.png", np.zeros((H, W), np.uint8))
    with pytest.raises(CloudError, match="8 bits a pixel"):
        read_cloud(tmp_path / "grey.png")


def test_an_image_that_promises_too_many_pixels_is_refused(tmp_path: Path) -> None:
    image(tmp_path / "a.tif", DEPTH.astype(np.uint16))
    content = bytearray((tmp_path / "a.tif").read_bytes())
    at = int.from_bytes(content[4:8], "little") + 2
    for k in range(int.from_bytes(content[at - 2 : at], "little")):
        entry = at + 12 * k
        if int.from_bytes(content[entry : entry + 2], "little") in (256, 257):
            content[entry + 2 : entry + 4] = (4).to_bytes(2, "little")
            content[entry + 8 : entry + 12] = (60_000).to_bytes(4, "little")
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(CloudError, match="60000 by 60000 pixels, more than"):
        read_cloud(tmp_path / "a.tif")


def test_a_png_whose_bytes_cannot_hold_its_pixels_is_refused_at_once(tmp_path: Path) -> None:
    image(tmp_path / "a.png", DEPTH.astype(np.uint16))
    content = (tmp_path / "a.png").read_bytes()
    chunk = b"IHDR" + (9_000).to_bytes(4, "big") + (9_000).to_bytes(4, "big") + content[24:29]
    (tmp_path / "a.png").write_bytes(content[:12] + chunk + zlib.crc32(chunk).to_bytes(4, "big") + content[33:])
    with pytest.raises(CloudError, match=r"promises 9000 by 9000 pixels, more than \d+ bytes can hold"):
        read_cloud(tmp_path / "a.png")
    long = content.replace(content[33:37], b"\x7f" + content[34:37], 1)
    (tmp_path / "a.png").write_bytes(long)
    with pytest.raises(CloudError, match="is damaged"):
        read_cloud(tmp_path / "a.png")
