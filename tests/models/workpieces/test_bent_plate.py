"""A plate bent over a cylinder: closed, as long as it was, its groove where the seam says and as wide as it was."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import FELT_EDGE_M, bend, divided, rolled
from weldcal.models.workpieces.plate import Workpiece, make_workpiece

R = 0.150
FLAT = {shape: make_workpiece(shape, length_m=0.200) for shape in ("s", "l")}


@pytest.fixture(scope="module", params=["s", "l"])
def pair(request: pytest.FixtureRequest) -> tuple[Workpiece, Workpiece]:
    flat = FLAT[request.param]
    return flat, bend(flat, R)


def test_both_its_meshes_are_closed_and_as_heavy_as_they_were(pair: tuple[Workpiece, Workpiece]) -> None:
    flat, bent = pair
    for before, after in ((flat.mesh, bent.mesh), (flat.groove_mesh, bent.groove_mesh)):
        assert after.watertight()
        v = after.vertices[after.triangles]
        volume = float(np.einsum("ij,ij->i", v[:, 0], np.cross(v[:, 1], v[:, 2])).sum()) / 6.0
        u = before.vertices[before.triangles]
        flat_volume = float(np.einsum("ij,ij->i", u[:, 0], np.cross(u[:, 1], u[:, 2])).sum()) / 6.0
        # Inside the top face lengths shrink by depth over radius: of a plate of 20 mm a fifteenth on average, of a band
        # less.
        assert 0.90 * flat_volume < volume < flat_volume


def test_no_edge_is_longer_than_was_asked_and_no_point_is_moved() -> None:
    mesh = FLAT["s"].groove_mesh
    fine = divided(mesh, FELT_EDGE_M)
    edges = fine.vertices[np.roll(fine.triangles, -1, axis=1)] - fine.vertices[fine.triangles]
    assert np.abs(edges[..., 0]).max() <= FELT_EDGE_M
    assert fine.area == pytest.approx(mesh.area, rel=1e-9)
    assert fine.watertight()
    assert np.array_equal(fine.vertices[: len(mesh.vertices)], mesh.vertices)


def test_the_root_runs_on_a_cylinder_of_its_own_depth(pair: tuple[Workpiece, Workpiece]) -> None:
    flat, bent = pair
    assert np.hypot(bent.seam_P[:, 0], bent.seam_P[:, 2] + R) == pytest.approx(R - flat.depth_m, abs=1e-12)
    assert np.array_equal(bent.seam_P[:, 1], flat.seam_P[:, 1])
    steps = np.gradient(bent.seam_P, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    assert np.sum(steps * bent.tangents_P, axis=1).min() > 1.0 - 1e-4
    assert np.abs(np.sum(bent.tangents_P * bent.up_P, axis=1)).max() < 1e-9


def test_the_tips_line_is_that_far_above_the_root_along_the_surfaces_normal(pair: tuple[Workpiece, Workpiece]) -> None:
    _, bent = pair
    gap = bent.tip_height(0.0025) * bent.up_P
    assert np.linalg.norm(gap, axis=1) == pytest.approx(bent.tip_height(0.0025), abs=1e-12)
    assert np.sum(gap * bent.tangents_P, axis=1) == pytest.approx(0.0, abs=1e-12)


def test_the_walls_meet_in_the_root(pair: tuple[Workpiece, Workpiece]) -> None:
    """The contact mesh is a polygon: between its stations the root is as far off as an arc is from its chord."""
    flat, bent = pair
    depth = rolled(np.array([[0.0, 0.0, -flat.depth_m]]), R)[0, 2]
    corners = bent.groove_mesh.vertices
    roots = corners[np.abs(np.hypot(corners[:, 0], corners[:, 2] + R) - (R + depth)) < 1e-9]
    assert len(roots) > 50
    for point in roots[5:-5:7]:
        assert np.linalg.norm(bent.seam_P - point, axis=1).min() < 0.3e-3  # seam points are 0.5 mm apart


@pytest.mark.parametrize(
    ("radius", "said"), [(0.05, "at least 100 mm"), (0.101, "does not go over"), (np.nan, "at least")]
)
def test_what_cannot_be_bent_is_refused(radius: float, said: str) -> None:
    with pytest.raises(InputError, match=said):
        bend(make_workpiece("straight", length_m=0.300), radius)
