"""Parts as they lie: thin sheets, clamps, a positioner, several scans, two equal parts, by another ray caster."""

from __future__ import annotations

import numpy as np
import pytest

from tests.welding.locate.lying import REFUSED, SCENES, Lying, first_hit, judge, scene, triangles
from tests.welding.locate.lying import box as solid_box
from tests.welding.locate.lying import tube_on_plate as with_tube
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.welding.locate.part.registration import register_part
from weldcal.welding.locate.part.scan import prepare
from weldcal.welding.locate.planes import finite_points

KINDS = {f.__name__: k for k, f in enumerate([*SCENES, *REFUSED])}


def of(kind: str, seed: int) -> Lying:
    return scene(KINDS[kind], seed)


def test_the_ray_caster_meets_the_triangles_of_its_solids() -> None:
    """The truth is the same shape as the mesh that is registered: rays end on its triangles' planes, within a facet."""
    rng = np.random.default_rng(1)
    solids = with_tube(rng)
    d = rng.normal(size=(400, 3)) * [0.08, 0.05, 0.02] - [0.0, 0.0, 0.6]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    t, n, _ = first_hit(solids, np.array([0.0, 0.0, 0.6]), d)
    hit = np.isfinite(t)
    assert np.count_nonzero(hit) > 200
    assert (np.sum(d[hit] * n[hit], axis=1) < 0.0).all()
    mesh = TriMesh(*triangles(solids))
    p = t[hit, None] * d[hit] + [0.0, 0.0, 0.6]
    corner = mesh.vertices[mesh.triangles[:, 0]]
    off = np.abs(np.einsum("nij,ij->ni", p[:, None] - corner, mesh.normals)).min(axis=1)
    assert off.max() < 1e-4


def test_a_sheet_of_a_millimetre_is_no_part_of_its_table() -> None:
    s = of("flat", 7002)
    assert s.part[0].half[2] < 0.0009  # type: ignore[union-attr]
    ground = prepare(finite_points(s.scans[0]), s.X_BC[0][:3, 3], 250, 0).planes[0]
    assert abs(ground.level) < 1.5e-4
    assert ground.own_m < 2.0 * s.part[0].half[2]  # type: ignore[union-attr]
    assert judge(s).verdict == "right"


@pytest.mark.parametrize(
    ("kind", "seed"),
    [("thin", 7000), ("clamped", 7000), ("on_positioner", 7020), ("hidden", 7022), ("hidden", 7025), ("two", 7023)],
)
def test_a_part_is_found_as_it_lies(kind: str, seed: int) -> None:
    found = judge(of(kind, seed))
    assert found.verdict == "right", found


@pytest.mark.parametrize("seed", [7005, 7017])
def test_a_beam_of_three_scans_is_found(seed: int) -> None:
    """Its web shifts the search's height (7005); it meets 97 % of the rays turned by 180 deg too (7017)."""
    s = of("long_beam", seed)
    found = judge(s)
    assert found.verdict == "right", found
    mesh = TriMesh(*triangles(s.part))
    with pytest.raises(InputError, match="3 scans need a scanner position for each"):
        register_part(s.scans, mesh, eye_B=s.X_BC[0][:3, 3])


@pytest.mark.parametrize(
    ("kind", "seed"), [("two_unnamed", 7000), ("two_unnamed", 7020), ("fused_wrongly", 7000), ("middle_only", 7020)]
)
def test_a_refusal_names_its_cause(kind: str, seed: int) -> None:
    found = judge(of(kind, seed))
    assert found.verdict == "right", found


@pytest.mark.parametrize("seed", [7021, 7023])
def test_the_part_of_the_other_hand_is_refused(seed: int) -> None:
    """All but a few hundred of 9,000 rays agree with the drawing: its web and its gusset are at the wrong side."""
    found = judge(of("mirrored", seed))
    assert found.verdict == "right", found
    assert "mirror image fits better" in found.sentence


def test_of_two_equal_parts_the_one_nearer_to_the_guess_is_taken() -> None:
    found = judge(of("two", 7000))
    assert found.verdict == "right", found


def test_two_solids_of_a_beam_are_one_part() -> None:
    """The thickness of a part of two bodies that touch is that of the thinnest body."""
    from weldcal.welding.locate.part.model import PartModel

    solids = [solid_box((-0.1, 0.1), (-0.05, 0.05), (0, 0.0012)), solid_box((-0.05, 0.05), (0, 0.004), (0.0012, 0.04))]
    assert PartModel(TriMesh(*triangles(solids))).thickness_m == pytest.approx(0.0012, abs=1e-5)
