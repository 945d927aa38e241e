"""Joints of separate solids in random sizes and orientation: each seam with its type and its ends, and no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from OCP.BRepBuilderAPI import BRepBuilderAPI_NurbsConvert

from tests.models.workpieces.random_joints import KINDS, found_in_mesh, mistakes, write_stl
from tests.worlds.parts.step_parts import assembly, box, cylinder, fused, less, write_step
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.joints import joints_of
from weldcal.models.workpieces.mesh_files import read_surface
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of


@pytest.mark.parametrize("kind", KINDS)
def test_every_seam_is_listed_and_nothing_else(kind: str) -> None:
    for seed in range(3):
        assert mistakes(kind, seed) == []


@pytest.mark.parametrize("kind", KINDS)
def test_the_triangles_of_the_same_solids_have_the_same_seams(kind: str) -> None:
    assert mistakes(kind, 0, found_in_mesh) == []


@pytest.mark.parametrize("gap", [0.0, 1.0, 2.5, -2.0])
@pytest.mark.parametrize("form", ["shuffled.obj", "merged.ply", "twice.stl"])
def test_a_mesh_of_two_boxes_is_a_t_in_every_form(gap: float, form: str, tmp_path: Path) -> None:
    solids = box((0, 0, -10), (200, 100, 10)), box((0, 46, gap), (200, 8, 60))
    write_stl([*solids, *(solids[:1] if form.startswith("twice") else [])], tmp_path / "twice.stl")
    soup = read_surface(tmp_path / "twice.stl", 1.0)  # its corners are merged across the bodies
    order = np.random.default_rng(0).permutation(len(soup.triangles)) if form.startswith("shuffled") else slice(None)
    mesh = TriMesh(soup.vertices, soup.triangles[order])
    if form.endswith("obj"):
        (tmp_path / form).write_text(mesh.to_obj())
    elif form.endswith("ply"):
        head = (
            f"ply\nformat ascii 1.0\nelement vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty"
            " float z\n"
        )
        rows = [*(" ".join(map(str, p)) for p in mesh.vertices), *("3 {} {} {}".format(*t) for t in mesh.triangles)]
        faces = f"element face {len(mesh.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
        (tmp_path / form).write_text(head + faces + "\n".join(rows) + "\n")
    shape = read_shape(tmp_path / form)
    assert shape.bodies == 2
    assert [(joint.type, joint.side) for joint in shape.joints] in (
        [("T", "left"), ("T", "right")],
        [("T", "right"), ("T", "left")],
    )
    for joint in shape.joints:
        assert joint.length_m == pytest.approx(0.2, abs=1e-6)
        assert joint.gap_m == pytest.approx(1e-3 * max(gap, 0.0), abs=1e-6)
        seam = seam_of(shape, SeamSource(edges=joint.edges), "fillet")
        assert np.abs(seam.points_P[:, 2]).max() < 1e-5


def test_one_shell_has_the_seams_of_its_creases(tmp_path: Path) -> None:
    """A pipe and a plate fused to one solid, and the same as triangles."""
    pipe = less(cylinder((0, 0, 0), 40, 80), cylinder((0, 0, -1), 34, 90))
    solid = fused(box((-100, -80, -10), (200, 160, 10)), pipe)
    write_stl([solid], tmp_path / "fused.stl")
    mesh = read_shape(tmp_path / "fused.stl").joints
    exact = joints_of(solid)
    assert len(mesh) == len(exact) == 2
    assert sorted(joint.type for joint in mesh) == sorted(chain[0].type for chain in exact) == ["pipe on plate"] * 2
    assert sorted(joint.length_m for joint in mesh) == pytest.approx([2e-3 * np.pi * r for r in (34, 40)], abs=1e-5)
    assert all(joint.closed for joint in mesh)


@pytest.mark.parametrize(("plate", "web"), [((300, 200, 12), 10), ((250, 100, 12), 4), ((500, 150, 12), 7)])
def test_both_sides_of_a_centred_web_are_listed(plate: tuple[int, int, int], web: int, tmp_path: Path) -> None:
    length, width, _ = plate
    solids = box((0, 0, 0), plate), box((0, (width - web) / 2, 12), (length, web, 100))
    write_step(assembly(*solids), tmp_path / "t.step")
    shape = read_shape(tmp_path / "t.step")
    assert [joint.type for joint in shape.joints] == ["T", "T"]
    assert {joint.side for joint in shape.joints} == {"left", "right"}
    assert sum(edge.kind == "concave" for edge in shape.edges) == 2


@pytest.mark.parametrize("gap", [2.5, -2.0])
def test_a_web_with_a_gap_or_drawn_into_its_plate_is_a_seam(gap: float, tmp_path: Path) -> None:
    write_step(assembly(box((0, 0, -10), (200, 100, 10)), box((20, 46, gap), (160, 8, 60))), tmp_path / "t.step")
    shape = read_shape(tmp_path / "t.step")
    (joint,) = shape.joints
    assert joint.closed
    assert len(joint.edges) == 4
    assert joint.length_m == pytest.approx(0.336, abs=1e-6)
    assert joint.gap_m == pytest.approx(1e-3 * max(gap, 0.0), abs=1e-6)
    for id in joint.edges:
        seam = seam_of(shape, SeamSource(edges=(id,)), "fillet")
        assert np.abs(seam.points_P[:, 2]).max() < 1e-5


def test_either_side_of_an_open_corner_is_its_own_edge(tmp_path: Path) -> None:
    write_step(assembly(box((0, -80, -8), (200, 80, 8)), box((0, 0, 0), (200, 8, 80))), tmp_path / "c.step")
    shape = read_shape(tmp_path / "c.step")
    assert {joint.side for joint in shape.joints} == {"inside", "outside"}
    for joint in shape.joints:
        seam = seam_of(shape, SeamSource(edges=joint.edges), "fillet")
        assert seam.up_P[5] == pytest.approx(joint.up_P, abs=1e-6)


def test_planes_and_cylinders_that_are_written_as_splines_have_the_same_seams(tmp_path: Path) -> None:
    plate = less(box((-60, -60, -10), (120, 120, 10)), cylinder((0, 30, -20), 5.1, 40))
    solids = plate, cylinder((0, -20, 0), 20, 50), cylinder((0, 30, -30), 5, 60), box((20, -50, 0), (8, 100, 40))
    for name, shape in (
        ("exact", assembly(*solids)),
        ("splines", BRepBuilderAPI_NurbsConvert(assembly(*solids)).Shape()),
    ):
        write_step(shape, tmp_path / f"{name}.step")
    exact, splines = (read_shape(tmp_path / f"{name}.step") for name in ("exact", "splines"))
    assert sorted(joint.type for joint in splines.joints) == sorted(joint.type for joint in exact.joints)
    for one, other in zip(splines.joints, exact.joints, strict=True):
        assert (one.type, one.closed) == (other.type, other.closed)
        assert one.length_m == pytest.approx(other.length_m, abs=1e-5)
        assert one.up_P == pytest.approx(other.up_P, abs=1e-4)
    assert any(joint.length_m == pytest.approx(2.0 * np.pi * 0.020, abs=1e-5) for joint in splines.joints)


@pytest.mark.parametrize("seed", [1114, 5017])
def test_a_saddle_whose_root_is_cut_into_short_stretches_is_one_seam(seed: int) -> None:
    assert mistakes("pipe_on_pipe", seed) == []


def test_a_seam_goes_on_only_where_the_bodies_meet(tmp_path: Path) -> None:
    """A branch with a slot of 20 mm in its foot: the saddle is open there."""
    run = cylinder((-150, 0, 0), 60, 300, (1, 0, 0))
    branch = less(cylinder((0, 0, 0), 40, 150), run, box((20, -10, 0), (40, 20, 80)))
    write_step(assembly(run, branch), tmp_path / "slot.step")
    shape = read_shape(tmp_path / "slot.step")
    points = np.concatenate([1e3 * shape.edge(id).points_P for joint in shape.joints for id in joint.edges])
    assert (points[:, 0] > 35.0).any()
    assert not ((points[:, 0] > 25.0) & (np.abs(points[:, 1]) < 9.5)).any()


def test_a_hole_beside_the_seam_leaves_its_type(tmp_path: Path) -> None:
    """A foot is a sheet on its plate: less high than deep, with and without a bolt's hole through both."""
    hole = cylinder((50, 30, -20), 6, 60)
    for name, cut in (("bare", cylinder((0, 0, 90), 1, 1)), ("bolt", hole)):
        plate, foot = less(box((0, 0, -10), (200, 100, 10)), cut), less(box((20, 10, 0), (60, 40, 20)), cut)
        write_step(assembly(plate, foot), tmp_path / f"{name}.step")
        (joint,) = read_shape(tmp_path / f"{name}.step").joints
        assert (joint.type, joint.closed, len(joint.edges)) == ("lap", True, 4)


@pytest.mark.parametrize("slot", [False, True])
def test_the_rim_of_a_hole_or_a_slot_through_both_bodies_is_no_seam(slot: bool, tmp_path: Path) -> None:
    at = [(60, 50), (140, 50)]
    cuts = [box((x - 20, y - 6, -20), (40, 12, 60)) if slot else cylinder((x, y, -20), 6, 60) for x, y in at]
    plates = [less(box((0, 0, z), (200, 100, t)), *cuts) for z, t in ((-10, 10), (0, 8))]
    write_step(assembly(*plates), tmp_path / "plates.step")
    joints = read_shape(tmp_path / "plates.step").joints
    assert {joint.type for joint in joints} == {"edge"}
    assert sum(joint.length_m for joint in joints) == pytest.approx(0.6, abs=1e-6)


def test_a_screw_that_fills_a_hole_leaves_no_seam_inside(tmp_path: Path) -> None:
    """A thin ring on a plate, and the screw through both: the rims of their holes are flush."""
    hole = cylinder((0, 0, -50), 8.5, 100)
    plate = less(box((-60, -60, -10), (120, 120, 10)), hole)
    ring = less(cylinder((0, 0, 0), 14, 8), hole)
    write_step(assembly(plate, ring, cylinder((0, 0, -40), 8, 80)), tmp_path / "screw.step")
    joints = read_shape(tmp_path / "screw.step").joints
    assert any(joint.length_m == pytest.approx(2.0 * np.pi * 0.014, abs=1e-5) for joint in joints)
    assert all(joint.angle_rad == pytest.approx(0.5 * np.pi) for joint in joints)


def test_a_pipe_through_a_ring_may_be_drawn_from_either_end() -> None:
    ring = less(cylinder((0, 0, 30), 60, 10), cylinder((0, 0, 0), 31, 90))
    for at, axis in (((0, 0, 0), (0, 0, 1)), ((0, 0, 90), (0, 0, -1))):
        pipe = less(cylinder(at, 30, 90, axis), cylinder(at, 26, 90, axis))
        found = joints_of(assembly(pipe, ring))
        assert [chain[0].type for chain in found] == ["flange on pipe", "flange on pipe"]
