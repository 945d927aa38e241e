"""The flange standard as data and as geometry, against its own rules and against a vendor's CAD."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import open3d
import pytest

from tests.calibration.flange.face import face_points
from tests.places import SHARED_DATA, needs
from weldcal.models.errors import InputError
from weldcal.models.flanges import PAPER_RADIUS_M, STANDARDS, flange_mesh, flange_ring, get_flange

DATA = SHARED_DATA / "flange/cad"


def test_the_cobot_flange_has_the_dimensions_of_the_standard() -> None:
    f = get_flange("ISO 9409-1-50-4-M6".replace("ISO ", "iso"))
    assert (f.pitch_circle_m, f.outer_m, f.bore_m, f.n_holes, f.thread, f.pin_m) == (
        0.05,
        0.063,
        0.0315,
        4,
        "M6",
        0.006,
    )
    np.testing.assert_allclose(np.degrees(f.hole_angles_rad), [45, 135, 225, 315])
    assert math.degrees(f.pin_angle_rad) == pytest.approx(90)


# ISO 9409-1:2004, Table 1 (mm): d1, N, thread, d2, d3, d5; and the second number of holes that is sold on 63
TABLE = (
    (31.5, 4, "M5", 40, 20, 5),
    (40, 4, "M6", 50, 25, 6),
    (50, 4, "M6", 63, 31.5, 6),
    (63, 4, "M6", 80, 40, 6),
    (63, 6, "M6", 80, 40, 6),
    (80, 6, "M8", 100, 50, 8),
    (100, 6, "M8", 125, 63, 8),
    (125, 6, "M10", 160, 80, 10),
    (160, 6, "M10", 200, 100, 10),
)


def test_the_flanges_are_those_of_the_standard() -> None:
    iso = [f for f in STANDARDS.values() if f.n_holes]
    rows = [(f.pitch_circle_m, f.n_holes, f.thread, f.outer_m, f.bore_m, f.pin_m) for f in iso]
    assert [row[1:3] for row in rows] == [row[1:3] for row in TABLE]
    for found, wanted in zip(rows, TABLE, strict=True):
        assert [1e3 * found[k] for k in (0, 3, 4, 5)] == pytest.approx([wanted[k] for k in (0, 3, 4, 5)])


def test_names_holes_and_dowel_of_a_flange_agree() -> None:
    for f in (f for f in STANDARDS.values() if f.n_holes):
        pitch, n, thread = f.designation.removeprefix("iso9409-1-").split("-")
        assert (float(pitch) * 1e-3, int(n), thread.upper()) == (f.pitch_circle_m, f.n_holes, f.thread)
        assert f.hole_m == pytest.approx(1e-3 * int(thread[1:]))
        assert f.pin_m <= f.hole_m
        # the outside is two steps of R10 above the pitch circle, the bore is half the outside rounded to the series
        assert f.outer_m / f.pitch_circle_m == pytest.approx(10**0.1, rel=0.02)
        assert f.bore_m / f.outer_m == pytest.approx(0.5, rel=0.01)
        # even holes, the dowel hole midway between two of them: 45 degrees off of four, 30 off of six
        off = np.degrees(np.array(f.hole_angles_rad) - f.pin_angle_rad) % 360.0
        np.testing.assert_allclose(np.sort(off), (np.arange(n := f.n_holes) + 0.5) * 360.0 / n)


def test_the_paper_radius_lies_in_the_middle_of_the_chamfer() -> None:
    f = get_flange("iso9409-1-50-4-m6")
    assert pytest.approx(0.5 * (f.face_outer_radius_m + f.outer_radius_m), abs=1e-12) == PAPER_RADIUS_M


def test_an_unknown_flange_is_answered_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="iso9409-1-50-4-m6"):
        get_flange("iso9409-1-51-4-m6")


def test_the_dowel_hole_can_be_moved() -> None:
    moved = get_flange("iso9409-1-50-4-m6", pin_angle_rad=math.pi)
    x, y, _ = moved.openings()[-1]
    np.testing.assert_allclose([x, y], [-0.025, 0.0], atol=1e-15)


def test_a_flange_whose_holes_leave_the_face_is_refused() -> None:
    with pytest.raises(InputError, match="pitch circle"):
        replace(get_flange("iso9409-1-50-4-m6"), pitch_circle_m=0.06)
    with pytest.raises(InputError, match="flat face"):
        flange_ring(0.063, 0.062)


@pytest.mark.parametrize("name", STANDARDS)
@pytest.mark.parametrize("chamfers", [True, False])
def test_every_flange_is_a_closed_solid_with_its_face_at_zero(name: str, chamfers: bool) -> None:
    f = get_flange(name)
    mesh = flange_mesh(f, 0.012, chamfers=chamfers)
    assert mesh.watertight()
    np.testing.assert_allclose(mesh.bounds[:, 2], [-0.012, 0.0], atol=1e-15)
    face = np.isclose(mesh.vertices[:, 2], 0.0)
    reach = np.hypot(*mesh.vertices[face, :2].T)
    c = f.chamfer_m if chamfers else 0.0
    assert reach.max() == pytest.approx(f.outer_radius_m - c, abs=1e-12)
    assert reach.min() == pytest.approx(f.bore_radius_m + c, abs=1e-12)


def test_the_volume_is_that_of_the_turned_and_drilled_part() -> None:
    f = get_flange("iso9409-1-50-4-m6")
    R, r, c, t = f.outer_radius_m, f.bore_radius_m, f.chamfer_m, 0.012
    outer_chamfer = math.pi * R**2 * c - math.pi * c / 3 * (R**2 + R * (R - c) + (R - c) ** 2)
    inner_chamfer = math.pi * c / 3 * (r**2 + r * (r + c) + (r + c) ** 2) - math.pi * r**2 * c
    holes = sum(math.pi * radius**2 * f.hole_depth_m for _, _, radius in f.openings())
    expected = math.pi * R**2 * t - math.pi * r**2 * f.bore_depth_m - outer_chamfer - inner_chamfer - holes
    # Circles of 256 and of about 48 facets enclose 1e-4 and 3e-3 less area; the holes are 4 % of the volume.
    assert flange_mesh(f, t).volume == pytest.approx(expected, rel=3e-4)


def test_chords_stay_within_a_hundredth_of_a_millimetre_of_the_circle() -> None:
    mesh = flange_mesh(get_flange("iso9409-1-50-4-m6"))
    rim = mesh.vertices[np.hypot(*mesh.vertices[:, :2].T) > 0.0314]
    angle = np.sort(np.unique(np.round(np.arctan2(rim[:, 1], rim[:, 0]), 9)))
    sagitta = 0.0315 * (1 - np.cos(0.5 * np.diff(angle).max()))
    assert sagitta < 1e-5


def test_face_points_fill_the_flat_face_and_nothing_else() -> None:
    f = get_flange("iso9409-1-50-4-m6")
    spacing = 0.0004
    p = face_points(f, spacing)
    reach = np.hypot(p[:, 0], p[:, 1])
    assert reach.min() >= f.face_inner_radius_m
    assert reach.max() <= f.face_outer_radius_m
    assert all(np.hypot(p[:, 0] - x, p[:, 1] - y).min() >= r for x, y, r in f.openings())
    area = math.pi * (f.face_outer_radius_m**2 - f.face_inner_radius_m**2) - sum(
        math.pi * r**2 for *_, r in f.openings()
    )
    # A hexagonal lattice has one point per spacing^2 sqrt(3)/2; the boundary is uncertain by a few points per diameter.
    assert len(p) == pytest.approx(area / (spacing**2 * math.sqrt(0.75)), rel=0.01)


@needs(DATA)
def test_the_holes_lie_where_a_vendor_drew_them() -> None:
    p = np.asarray(open3d.io.read_point_cloud(str(DATA / "cad_flange_aubo_i5_sampled_m.pcd")).points)
    p = p[np.isfinite(p).all(axis=1)]
    face = p[np.abs(p[:, 2] + 0.006) < 1e-4][:, :2]
    f = get_flange("iso9409-1-50-4-m6")
    # The drawing breaks its edges by 0.4 mm, the part by 1 mm: the drawn face ends between our face and our outside.
    reach = np.hypot(*face.T)
    assert f.face_outer_radius_m < reach.max() < f.outer_radius_m
    assert f.bore_radius_m < reach.min() < f.face_inner_radius_m
    # The CAD looks along -z: mirrored in x, which maps this hole pattern on to itself. Threads are drawn as the 5 mm
    # tap drill, 1 mm under the nominal diameter; the samples are 0.2 mm apart.
    for x, y, r in f.openings():
        assert np.hypot(face[:, 0] + x, face[:, 1] - y).min() == pytest.approx(r, abs=0.0007)
    at_other_angles = [(0.025 * math.cos(a), 0.025 * math.sin(a)) for a in np.radians([0, 180, 270])]
    assert all(np.hypot(face[:, 0] - x, face[:, 1] - y).min() < 0.0005 for x, y in at_other_angles)
