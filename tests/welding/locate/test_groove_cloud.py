"""A V-groove is measured from the cloud alone, with a sigma that holds; what is no groove is refused by name.

Accuracy on poses that no figure was set on is what `./tools/run figures seam-planning` is for.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial import cKDTree

from tests.worlds.parts.scans import Scene, box, looking_at, scan_part, sideways, table
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import cast, get_scanner
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.welding.locate.groove.extract import extract_groove
from weldcal.welding.locate.groove.seam import GrooveNotFound, GrooveSeam, GrooveTooNarrow, SeveralGrooves

SCANNER = get_scanner("phoxi_m", 618, 462)
COARSE = get_scanner("phoxi_m", 412, 308)
X_BP = RigidTransform(RollPitchYaw(0.02, 0.03, 0.5), [0.6, 0.0, 0.03])


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    """One scan of each shape, in a random pose with up to 5 degrees of tilt."""
    return {
        shape: scan_part(make_workpiece(shape), SCANNER, 2000 + k, tilt_rad=math.radians(5.0))
        for k, shape in enumerate(("straight", "s", "l"))
    }


@pytest.fixture(scope="module")
def grooves(scenes: dict[str, Scene]) -> dict[str, GrooveSeam]:
    return {shape: extract_groove(scene.cloud_B) for shape, scene in scenes.items()}


@pytest.mark.parametrize("shape", ["straight", "s", "l"])
def test_the_root_is_found_within_a_fraction_of_the_pixel_pitch(
    shape: str, scenes: dict[str, Scene], grooves: dict[str, GrooveSeam]
) -> None:
    scene, groove = scenes[shape], grooves[shape]
    side, height = sideways(groove.root, scene.part, scene.X_BP)
    # Points 1.3 mm apart with 0.2 mm of noise along the ray, 0.5 mm on walls this steep.
    assert np.sqrt(np.mean(side**2)) < 0.15e-3
    assert np.abs(side).max() < 0.6e-3
    assert np.sqrt(np.mean(height**2)) < 0.3e-3
    # Edge to edge, of which up to a pixel may be lost at each end.
    assert groove.s[-1] == pytest.approx(scene.part.length_m, abs=2.6e-3)
    assert np.degrees(2.0 * groove.half_angle) == pytest.approx(45.0, abs=1.5)
    assert np.median(groove.depth) == pytest.approx(8e-3, abs=0.2e-3)
    assert groove.width == pytest.approx(2.0 * scene.part.half_width_m, abs=0.2e-3)
    assert groove.ends_seen == (True, True)
    assert groove.gaps == ()


def test_the_sigma_stated_is_that_of_the_errors(scenes: dict[str, Scene], grooves: dict[str, GrooveSeam]) -> None:
    z = np.concatenate([sideways(g.root, scenes[k].part, scenes[k].X_BP)[0] / g.sigma for k, g in grooves.items()])
    # About 60 independent stretches in all; a factor of two either way would be a wrong statement.
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6
    assert np.mean(np.abs(z) < 2.0) > 0.85


def test_the_seam_starts_at_the_end_nearest_to_the_robot_or_to_the_point_given(
    scenes: dict[str, Scene], grooves: dict[str, GrooveSeam]
) -> None:
    groove = grooves["straight"]
    assert np.linalg.norm(groove.root[0]) < np.linalg.norm(groove.root[-1])
    assert "the robot" in groove.start
    # Neither the order of the points nor the direction of travel changes what is there.
    points = np.random.default_rng(0).permutation(scenes["straight"].cloud_B.reshape(-1, 3))
    back = extract_groove(points, start_A=groove.root[-1])
    assert back.root[0] == pytest.approx(groove.root[-1], abs=1e-3)
    assert sideways(back.root, scenes["straight"].part, scenes["straight"].X_BP)[0] == pytest.approx(0.0, abs=0.6e-3)
    # What was left as one travels is right on the way back.
    assert np.median(cKDTree(back.left).query(groove.right)[0]) < 0.8e-3
    left = np.cross(groove.curve.frame(0.1).up, groove.curve.frame(0.1).tangent)
    assert (groove.left[100] - groove.root[100]) @ left > 0.002


def _field(path: np.ndarray, length: float, width: float) -> TriMesh:
    """A plate with a V cut along a path (N,2) as a pointed cutter would: depth 8 mm, 45 degrees, corners sharp."""
    x, y = np.arange(-0.5 * length, 0.5 * length, 7e-4), np.arange(-0.5 * width, 0.5 * width, 7e-4)
    X, Y = np.meshgrid(x, y)
    away = cKDTree(path).query(np.column_stack([X.ravel(), Y.ravel()]))[0]
    z = np.minimum(0.0, away / math.tan(math.radians(22.5)) - 0.008)
    k = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    triangles = np.vstack(
        [np.column_stack([k, k + 1, k + len(x)]), np.column_stack([k + 1, k + len(x) + 1, k + len(x)])]
    )
    return TriMesh(np.column_stack([X.ravel(), Y.ravel(), z]), triangles)


def _seen(mesh: TriMesh, *others: TriMesh, scanner: object = SCANNER) -> np.ndarray:
    eye = np.array([0.62, 0.03, 0.93])
    X_BC = looking_at(eye, np.array([0.6, 0.0, 0.02]))
    return cast([mesh, table(), *others], X_BC, scanner, seed=7)  # type: ignore[arg-type]


def test_a_sharp_corner_is_where_its_two_sides_meet() -> None:
    legs = np.array([(-0.12, -0.02), (0.03, -0.02), (0.03, 0.1)])
    path = np.vstack([np.linspace(a, b, 1500) for a, b in pairwise(legs)])
    groove = extract_groove(_seen(_field(path, 0.24, 0.2).transformed(X_BP)))
    assert len(groove.corners) == 1
    apex = (groove.apexes[0] - X_BP.translation()) @ X_BP.rotation().matrix()
    assert apex[:2] == pytest.approx([0.03, -0.02], abs=0.6e-3)
    root = (groove.root - X_BP.translation()) @ X_BP.rotation().matrix()
    assert cKDTree(path).query(root[:, :2])[0].max() < 0.6e-3


def test_a_ring_is_a_closed_seam_of_the_right_length() -> None:
    turn = np.linspace(0.0, 2.0 * math.pi, 4000)
    path = 0.06 * np.column_stack([np.cos(turn), np.sin(turn)])
    groove = extract_groove(_seen(_field(path, 0.2, 0.18).transformed(X_BP)))
    assert groove.closed
    assert groove.s[-1] == pytest.approx(2.0 * math.pi * 0.06, abs=1e-3)
    root = (groove.root - X_BP.translation()) @ X_BP.rotation().matrix()
    assert np.abs(np.linalg.norm(root[:, :2], axis=1) - 0.06).max() < 0.5e-3


def test_an_arm_over_a_third_of_the_part_leaves_a_shorter_seam_that_says_so() -> None:
    part = make_workpiece("s")
    bare = scan_part(part, SCANNER, 2010)
    arm = box(0.12, 0.5, 0.09).transformed(bare.X_BP @ RigidTransform(RollPitchYaw(0, 0, 0.3), [0.04, 0.19, 0.15]))
    scene = scan_part(part, SCANNER, 2010, others=[arm])
    groove = extract_groove(scene.cloud_B)
    assert groove.s[-1] < 0.25
    assert groove.ends_seen.count(False) == 1
    assert "out of view" in groove.summary
    side, _ = sideways(groove.root, part, scene.X_BP)
    assert np.abs(side).max() < 0.6e-3
    assert np.sqrt(np.mean((side / groove.sigma) ** 2)) < 1.7


def test_a_thin_bar_over_the_groove_is_a_named_gap_and_a_broad_one_ends_what_is_planned() -> None:
    part = make_workpiece("straight")
    bare = scan_part(part, SCANNER, 2011)
    across = bare.X_BP @ RigidTransform([0.06, 0.0, 0.12])
    scene = scan_part(part, SCANNER, 2011, others=[box(0.02, 0.5, 0.02).transformed(across)])
    groove = extract_groove(scene.cloud_B)
    (a, b), *rest = groove.gaps
    assert not rest
    assert 0.018 < b - a < 0.035
    assert groove.s[-1] == pytest.approx(part.length_m, abs=2.6e-3)
    side, _ = sideways(groove.root, part, scene.X_BP)
    assert np.abs(side).max() < 0.6e-3
    assert f"from {1e3 * a:.0f} to {1e3 * b:.0f} mm" in groove.summary


def test_of_two_grooves_a_point_near_it_chooses_and_without_it_neither_is_taken() -> None:
    part = make_workpiece("straight", length_m=0.15, width_m=0.1)
    places = [RigidTransform([0.6, y, 0.02]) for y in (-0.09, 0.09)]
    cloud = _seen(part.mesh.transformed(places[0]), part.mesh.transformed(places[1]))
    with pytest.raises(SeveralGrooves, match="2 grooves are in view"):
        extract_groove(cloud)
    chosen = extract_groove(cloud, hint_A=[0.55, 0.1, 0.0])
    assert chosen.root[:, 1] == pytest.approx(0.09, abs=0.5e-3)


def test_a_scanner_too_coarse_for_the_groove_is_told_by_how_much() -> None:
    scene = scan_part(make_workpiece("straight"), get_scanner("phoxi_m", 310, 232), 2012)
    with pytest.raises(GrooveTooNarrow, match=r"points are 2\.\d mm apart: 2\.\d of the 3 point distances"):
        extract_groove(scene.cloud_B)


def test_a_plain_plate_and_a_gap_between_two_are_not_grooves() -> None:
    plain = box(0.2, 0.15, 0.02).transformed(RigidTransform([0.6, 0.0, 0.0]))
    with pytest.raises(GrooveNotFound, match="No groove in any face"):
        extract_groove(_seen(plain, scanner=COARSE))
    halves = [box(0.2, 0.07, 0.02).transformed(RigidTransform([0.6, y, 0.0])) for y in (-0.039, 0.039)]
    with pytest.raises(GrooveNotFound, match="not a V-groove"):
        extract_groove(_seen(*halves, scanner=COARSE))


def test_a_cloud_of_the_wrong_shape_or_size_is_bad_input() -> None:
    with pytest.raises(InputError, match="shape"):
        extract_groove(np.zeros((5, 4)))
    with pytest.raises(GrooveNotFound, match="only 0 points"):
        extract_groove(np.full((20, 20, 3), np.nan))
