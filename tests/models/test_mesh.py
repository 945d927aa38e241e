"""Meshes are closed, face outward and keep the volume of what they stand for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import ReadObjToTriangleSurfaceMesh
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, circle, extrude, grid, inside_loops, merge, revolve, triangulate_polygon


def _square(side: float, per_edge: int) -> np.ndarray:
    corners = 0.5 * side * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return np.concatenate([np.linspace(corners[k], corners[(k + 1) % 4], per_edge, endpoint=False) for k in range(4)])


def _polygon_area(radius: float, n: int) -> float:
    return 0.5 * n * radius**2 * math.sin(2.0 * math.pi / n)


def test_a_prism_with_a_hole_is_closed_and_has_the_volume_of_its_polygons() -> None:
    mesh = extrude(_square(0.1, 20), -0.02, 0.03, holes=[circle(0.02, 64)])
    assert mesh.watertight()
    # Exact for the polygons, so only rounding remains.
    assert mesh.volume == pytest.approx((0.01 - _polygon_area(0.02, 64)) * 0.05, rel=1e-12)
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.05, -0.02], [0.05, 0.05, 0.03]], atol=1e-15)


def test_the_direction_in_which_loops_are_given_does_not_matter() -> None:
    forward = extrude(_square(0.1, 20), 0.0, 0.01, holes=[circle(0.02, 64)])
    backward = extrude(_square(0.1, 20)[::-1], 0.0, 0.01, holes=[circle(0.02, 64)[::-1]])
    assert backward.watertight()
    assert backward.volume == pytest.approx(forward.volume, rel=1e-12)


def test_an_outline_too_coarse_to_triangulate_is_refused_with_advice() -> None:
    # Two slits side by side: the long edge between them cannot be a Delaunay edge, so near are the other's corners.
    slit = np.array([(-0.5, 0.0), (0.5, 0.0), (0.5, 0.001), (-0.5, 0.001)])
    with pytest.raises(InputError, match="more finely"):
        triangulate_polygon(_square(2.0, 20), [slit, 0.2 * slit + (0.0, 0.002)])


def test_a_revolved_rectangle_is_a_closed_cylinder() -> None:
    mesh = revolve(np.array([(0.0, 0.0), (0.1, 0.0), (0.1, 0.2), (0.0, 0.2)]), 90)
    assert mesh.watertight()
    assert mesh.volume == pytest.approx(_polygon_area(0.1, 90) * 0.2, rel=1e-12)


def test_a_closed_profile_makes_a_closed_ring() -> None:
    mesh = revolve(np.array([(0.1, 0.0), (0.2, 0.0), (0.2, 0.1), (0.1, 0.1), (0.1, 0.0)]), 90)
    assert mesh.watertight()
    assert mesh.volume == pytest.approx((_polygon_area(0.2, 90) - _polygon_area(0.1, 90)) * 0.1, rel=1e-12)


def test_a_mesh_with_a_missing_or_a_reversed_triangle_is_not_watertight() -> None:
    mesh = revolve(np.array([(0.0, 0.0), (0.1, 0.0), (0.0, 0.2)]), 12)
    assert mesh.watertight()
    assert not TriMesh(mesh.vertices, mesh.triangles[1:]).watertight()
    turned = mesh.triangles.copy()
    turned[3] = turned[3, ::-1]
    assert not TriMesh(mesh.vertices, turned).watertight()


def test_moving_a_mesh_keeps_its_volume_and_flipping_negates_it() -> None:
    mesh = extrude(_square(0.1, 2), 0.0, 0.05)
    moved = mesh.transformed(RigidTransform(RollPitchYaw(0.3, -0.4, 1.1), np.array([1.0, 2.0, 3.0])))
    # Volumes are sums over coordinates of metres: rounding of 1e-16 x 10 m^3 against 5e-4 m^3.
    assert moved.volume == pytest.approx(mesh.volume, rel=1e-10)
    assert mesh.flipped().volume == pytest.approx(-mesh.volume, rel=1e-12)


def test_samples_lie_on_the_surface_and_cover_it_by_area() -> None:
    mesh = extrude(_square(1.0, 2), 0.0, 1.0)
    points, normals = mesh.sample(6000, np.random.default_rng(3))
    # On a unit cube the normal of each sample names the coordinate that sits on a face.
    axis = np.argmax(np.abs(normals), axis=1)
    coordinate = (points + np.array([0.5, 0.5, 0.0]))[np.arange(len(points)), axis]
    np.testing.assert_allclose(coordinate, (normals[np.arange(len(points)), axis] > 0).astype(float), atol=1e-12)
    # Six equal faces: 1000 each, with a binomial standard deviation of 29.
    assert np.all(np.abs(np.bincount(axis, minlength=3) - 2000) < 5 * math.sqrt(6000 / 3 * 2 / 3))


def test_grids_face_along_rows_cross_columns() -> None:
    points = np.stack([*np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij"), np.zeros((2, 2))], axis=-1)
    np.testing.assert_allclose(grid(points).normals, [[0, 0, 1], [0, 0, 1]])


def test_inside_a_polygon_means_outside_its_holes() -> None:
    loops = [_square(2.0, 1), circle(0.5, 200)]
    np.testing.assert_array_equal(
        inside_loops(np.array([(0.9, 0.9), (0.0, 0.1), (1.1, 0.0)]), loops), [True, False, False]
    )


def test_merging_with_a_tolerance_joins_equal_points() -> None:
    a = TriMesh(np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0)]), np.array([(0, 1, 2)]))
    b = TriMesh(np.array([(1.0, 0, 0), (1, 1, 0), (0, 1, 0)]), np.array([(0, 1, 2)]))
    assert len(merge(a, b).vertices) == 6
    assert len(merge(a, b, tolerance_m=1e-9).vertices) == 4


def test_drake_reads_the_mesh_with_its_faces_as_they_are(tmp_path: Path) -> None:
    mesh = extrude(_square(0.1, 4), 0.0, 0.05)
    (tmp_path / "block.obj").write_text(mesh.to_obj())
    surface = ReadObjToTriangleSurfaceMesh(tmp_path / "block.obj")
    assert surface.num_triangles() == len(mesh.triangles)
    # The text carries nine digits.
    assert surface.total_area() == pytest.approx(mesh.area, rel=1e-7)
    assert mesh.to_drake("block").GetConvexHull().num_vertices() == 8


@pytest.mark.parametrize(
    ("vertices", "triangles"), [([[0, 0, math.nan]] * 3, [[0, 1, 2]]), ([[0, 0, 0]] * 3, [[0, 1, 3]])]
)
def test_nonsense_meshes_are_refused(vertices: list[list[float]], triangles: list[list[int]]) -> None:
    with pytest.raises(InputError):
        TriMesh(np.array(vertices), np.array(triangles))
