"""Tool files: the welding tool's own gives the same numbers, other tools are possible, and impossible ones are refused
by name."""

from __future__ import annotations

import dataclasses as dc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import ToolShape, WeldingTool
from weldcal.models.tools.enclosing import enclosing_capsule, shape_mesh
from weldcal.models.tools.loading import WELDING, LoadedTool, load_tool

NUMBERS = (
    *("tip_radius_m", "tip_modulus_Pa", "tip_mass_kg", "lateral_stiffness_N_per_m", "axial_stiffness_N_per_m"),
    *("damping_N_s_per_m", "tag_size_m", "tag_dictionary", "tag_id", "chord_m", "torch_height_m", "mass_kg", "ring"),
    *("centre_of_mass_m", "ring_height_m", "tip_reach_m", "tag_reach_m", "press_axial_m", "press_lateral_m"),
    *("finger_radius_m", "membrane_radius_m", "tag_plate_m", "groove_half_angle_rad"),
)
POSES = ("X_FT", "X_FR", "X_FK", "X_FM_rest", "X_KM_rest", "X_TM")


def changed(tmp_path: Path, *changes: tuple[str, Any]) -> Path:
    """The welding tool's file with other values; a value of None leaves the key out."""
    document = yaml.safe_load(WELDING.read_text())
    for dotted, value in changes:
        *path, last = dotted.split(".")
        part = document
        for key in path:
            part = part[key]
        if value is None:
            del part[last]
        else:
            part[last] = value
    file = tmp_path / "my_tool.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def test_the_welding_tools_file_gives_the_numbers_of_the_welding_tool_to_the_last_bit() -> None:
    own, read = WeldingTool(), load_tool(WELDING).tool
    for name in NUMBERS:
        assert getattr(read, name) == getattr(own, name), name
    for name in POSES:
        assert getattr(read, name).IsExactlyEqualTo(getattr(own, name)), name
    assert read.p_TW.tolist() == own.p_TW.tolist()
    for a, b in zip(read.capsules(), own.capsules(), strict=True):
        assert (a.p_start.tolist(), a.radius) == (b.p_start.tolist(), b.radius)
        assert a.p_end == pytest.approx(b.p_end, abs=1e-17)  # the product of two rotations leaves 2e-19
    for s, w in zip(read.drawn(), own.drawn(), strict=True):
        assert (s.name, s.kind, s.colour) == (w.name, w.kind, w.colour)
        assert s.size == pytest.approx(w.size, abs=1e-16)
        assert s.place.xyz_m == pytest.approx(w.place.xyz_m, abs=1e-16)
    assert dc.replace(read, press_axial_m=0.002).seat != read.seat


def test_a_tool_may_point_anywhere(tmp_path: Path) -> None:
    file = changed(
        tmp_path, ("ring", None), ("tip.xyz_mm", [40.0, 10.0, 150.0]), ("tip.axis", [1.0, 0.0, 1.0]),
        ("torch.xyz_mm", [0.0, 60.0, 140.0]), ("tag.xyz_mm", [0.0, 10.0, 110.0]), ("tag.rpy_deg", [180.0, 45.0, 0.0]),
        ("finger_camera.xyz_mm", [-28.0, 10.0, 82.0]), ("finger_camera.rpy_deg", [0.0, 45.0, 0.0]), ("keep_clear", None),
        ("mass_kg", 0.8),
    )  # fmt: skip
    loaded = load_tool(file)
    tool = loaded.tool
    # z of the tip's frame is against the finger, x from the torch to the tip, and the torch lies where it was put
    axis = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    assert tool.X_FT.rotation().matrix()[:, 2] == pytest.approx(-axis)
    assert tool.X_FT @ tool.p_TW == pytest.approx([0.0, 0.060, 0.140])
    assert tool.p_TW[1] == 0.0
    assert tool.p_TW[0] == pytest.approx(-np.linalg.norm(np.cross(axis, [0.04, -0.05, 0.01])))
    assert tool.ring is None
    with pytest.raises(InputError, match=r"no ring: write calibration\.feature: flange"):
        _ = tool.X_FR
    # every capsule that was made encloses its shape
    for shape, capsule in zip(tool.drawn(), tool.capsules(), strict=False):
        points = corners(shape)
        along = capsule.p_end - capsule.p_start
        t = np.clip((points - capsule.p_start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        away = np.linalg.norm(points - capsule.p_start - t[:, None] * along, axis=1)
        assert away.max() <= capsule.radius + 1e-9, shape.name


def corners(shape: ToolShape) -> np.ndarray:
    """Points of a box's or a cylinder's surface (N, 3) in F."""
    if shape.kind == "box":
        points = 0.5 * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * np.array(shape.size)
    else:
        r, length = shape.size
        a = np.linspace(0.0, 2.0 * np.pi, 37)
        ends = [np.column_stack([r * np.cos(a), r * np.sin(a), np.full(37, z)]) for z in (-length / 2, length / 2)]
        points = np.vstack(ends)
    return np.asarray((shape.place.pose @ points.T).T)


REFUSED = [
    ([("tip.radius_mm", 0.0)], "tip.radius_mm must be positive, and it is 0"),
    ([("tip.radius", 2.5)], "tip.radius is not a known key: did you mean radius_mm"),
    ([("torche", {})], "torche is not a known key: did you mean torch"),
    ([("tip.xyz_mm", [0.0, 0.0])], "tip.xyz_mm must be 3 numbers"),
    ([("tag.id", 1.5)], "tag.id must be a whole number"),
    ([("tag.dictionary", 4)], "tag.dictionary must be a text"),
    (
        [("torch.xyz_mm", [-5.0, 0.0, 171.5])],
        "must trail the tip by 10 mm or more across the finger, and it is 5.0 mm away",
    ),
    ([("tip.mass_kg", 1.5)], "less than mass_kg of the whole tool"),
    ([("tip", None)], "lacks tip: see docs/tool.md"),
    ([("tag.xyz_mm", None)], r"lacks tag\.xyz_mm, its place in the flange frame"),
    ([("tag.xyz_mm", [0.0, 0.0, 60.0])], "the tag is behind the finger camera"),
    ([("tag.rpy_deg", [0.0, 0.0, 0.0])], "does not face the finger camera"),
    ([("tag.xyz_mm", [40.0, 0.0, 110.0])], "the tag is not whole in the finger camera's picture of 400 x 300 px"),
    ([("ring.standard", None)], "ring needs a standard, or outer_mm and a smaller bore_mm"),
    ([("shapes", [{"name": "arm"}])], r"shapes\[0\] \(arm\) must have one of box_mm"),
    ([("shapes", [{"sphere_mm": 3.0, "colour": "pink"}])], "colour must be one of dark, steel"),
    ([("shapes", [{"mesh": "none.stl"}])], "there is no file"),
    ([("finger_camera.calibration", "none.yaml")], "none.yaml"),
    ([("tip.xyz_mm", [0.0, 0.0, 17000.0])], "17000 mm from the flange; give millimetres"),
    ([("torch.axis", [0.0, 0.0, 0.0])], "torch.axis must be a direction"),
]


@pytest.mark.parametrize(("changes", "said"), REFUSED, ids=[said[:30] for _, said in REFUSED])
def test_a_tool_that_cannot_be_is_refused_by_its_key(tmp_path: Path, changes: list[tuple[str, Any]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_tool(changed(tmp_path, *changes))


def test_a_mesh_and_a_finger_calibration_are_read_beside_the_file(tmp_path: Path) -> None:
    box = TriMesh(
        np.array([[0, 0, 0], [100, 0, 0], [0, 20, 0], [0, 0, 10]], dtype=float),
        np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    )
    (tmp_path / "body.obj").write_text(box.to_obj())
    camera = {"width": 640, "height": 480, "fx": 700.0, "fy": 701.0, "cx": 320.0, "cy": 240.0, "distortion": [0.0] * 5}
    (tmp_path / "finger.yaml").write_text(yaml.safe_dump({"schema": 1, "camera": camera, "tag": {"size_mm": 9.91}}))
    file = changed(
        tmp_path, ("shapes", [{"mesh": "body.obj", "xyz_mm": [10.0, 0.0, 0.0]}]), ("keep_clear", None),
        ("finger_camera.calibration", "finger.yaml"),
    )  # fmt: skip
    loaded: LoadedTool = load_tool(file)
    (shape,) = loaded.tool.drawn()
    assert shape_mesh(shape).vertices.max(axis=0) == pytest.approx([0.1, 0.02, 0.01])
    capsule = enclosing_capsule(shape)
    points = shape.place.pose @ shape_mesh(shape).vertices.T
    line = np.cross(points.T - capsule.p_start, [1.0, 0.0, 0.0])
    assert np.linalg.norm(line, axis=1).max() <= capsule.radius + 1e-9
    assert (capsule.p_start[0], capsule.p_end[0]) == pytest.approx((0.01, 0.11), abs=0.012)
    assert loaded.tool.tag_size_m == pytest.approx(0.00991)
    assert loaded.camera.width == 640
    assert loaded.camera.focal_px == pytest.approx(700.5)
    assert RigidTransform([0.01, 0.0, 0.0]).IsExactlyEqualTo(shape.place.pose)
