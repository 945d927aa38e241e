"""A bent plate is found in its scan, by its drawing and from the cloud alone; a part bent otherwise is refused by
name."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.worlds.parts.scans import Scene, scan_part, sideways
from weldcal.models.scanners import get_scanner
from weldcal.models.workpieces.part import bend, rolled
from weldcal.models.workpieces.plate import Workpiece, make_workpiece
from weldcal.welding.locate.bent_face import BentFace, find_bent_faces
from weldcal.welding.locate.find_workpiece import find_workpiece
from weldcal.welding.locate.groove.extract import extract_groove
from weldcal.welding.locate.planning import PlanningMethod, plan_root
from weldcal.welding.locate.registration import WorkpieceNotFound, register_workpiece

RADIUS_M = 0.200
SCANNER = get_scanner("phoxi_m", 618, 462)  # pixels of 1.3 mm at this distance
FLAT = make_workpiece("s", length_m=0.200)
PART = bend(FLAT, RADIUS_M)
ERROR = RigidTransform(RollPitchYaw(0.03, -0.02, 0.08), [0.012, -0.008, 0.006])


def seen(part: Workpiece, seed: int) -> Scene:
    return scan_part(part, SCANNER, seed, tilt_rad=math.radians(5.0), spread_m=0.03)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return seen(PART, 3001)


def root_errors(X_BP: RigidTransform, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    root = scene.part.seam_P @ X_BP.rotation().matrix().T + X_BP.translation()
    return sideways(root, scene.part, scene.X_BP)


@pytest.mark.parametrize("radius", [0.15, -0.3])
def test_unrolled_and_rolled_again_a_point_is_where_it_was(radius: float) -> None:
    face = BentFace(RigidTransform(RollPitchYaw(0.2, -0.3, 1.0), [0.5, 0.1, 0.2]), radius)
    u = np.random.default_rng(0).uniform([-0.15, -0.1, -0.02], [0.15, 0.1, 0.02], (50, 3))
    assert face.unrolled(face.rolled(u)) == pytest.approx(u, abs=1e-12)
    # Height over the face is measured along its normal.
    foot = face.rolled(u * [1.0, 1.0, 0.0])
    assert face.rolled(u) - foot == pytest.approx(u[:, 2:] * face.up(u), abs=1e-12)


def test_the_unrolled_cylinder_is_the_one_that_plates_are_bent_over() -> None:
    u = np.random.default_rng(1).uniform(-0.02, 0.1, (30, 3))
    assert BentFace(RigidTransform(), RADIUS_M).rolled(u) == pytest.approx(rolled(u, RADIUS_M), abs=1e-12)


def test_the_cylinder_is_found_in_the_whole_scan_with_its_radius(scene: Scene) -> None:
    points = scene.cloud_B.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    (face,) = find_bent_faces(points, (0.1, 1.0), np.random.default_rng(0), hollow=True)
    # 0.2 mm of noise over a plate that sags by 20 mm.
    assert face.radius_m == pytest.approx(RADIUS_M, rel=0.01)


def test_a_bend_without_any_noise_is_found_beside_a_table_as_exact() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-0.3, 0.3, 0.001), np.arange(-0.1, 0.1, 0.001)))
    z = np.where(np.abs(x) < 0.07, np.sqrt(0.2**2 - np.minimum(np.abs(x), 0.07) ** 2) - 0.15, 0.0)
    (face,) = find_bent_faces(np.column_stack([x, y, z]), (0.1, 1.0), np.random.default_rng(0))
    assert face.radius_m == pytest.approx(0.2, abs=1e-4)


def test_the_bent_plate_is_found_near_the_guess_and_anywhere(scene: Scene) -> None:
    near = register_workpiece(scene.cloud_B, PART, scene.X_BP @ ERROR, eye_B=scene.eye_B)
    heading = RollPitchYaw(scene.X_BP.rotation()).yaw_angle()
    anywhere = find_workpiece(scene.cloud_B, PART, turn_hint_rad=heading + 1.2, eye_B=scene.eye_B)
    for found in (near, anywhere.registration):
        side, height = root_errors(found.X_BP, scene)
        assert np.sqrt(np.mean(side**2)) < 2.0 * found.seam_sigma_m
        assert found.seam_sigma_m < 0.15e-3
        assert np.abs(height).max() < 0.15e-3
        assert found.confidence > 0.9


def test_its_sigma_covers_its_errors_over_poses_and_noise() -> None:
    chi = []
    for seed in range(3010, 3014):
        scene = seen(PART, seed)
        found = register_workpiece(scene.cloud_B, PART, scene.X_BP @ ERROR, eye_B=scene.eye_B)
        side, _ = root_errors(found.X_BP, scene)
        chi.append(np.sqrt(np.mean(side**2)) / found.seam_sigma_m)
    # Four draws: all within three sigma, their mean square no more than a chi square of four allows at 1 in 1000.
    assert max(chi) < 3.0
    assert np.mean(np.square(chi)) < 18.5 / 4.0


@pytest.mark.parametrize("drawn_m", [0.170, 0.230])
def test_a_plate_bent_over_another_radius_is_refused_by_both_radii(scene: Scene, drawn_m: float) -> None:
    with pytest.raises(WorkpieceNotFound, match=f"bent over {1e3 * drawn_m:.0f} mm|drawing has {1e3 * drawn_m:.0f} mm"):
        register_workpiece(scene.cloud_B, bend(FLAT, drawn_m), scene.X_BP @ ERROR)


def test_a_flat_plate_is_not_taken_for_a_bent_one() -> None:
    with pytest.raises(WorkpieceNotFound, match="no face bent over 200 mm"):
        find_workpiece(seen(FLAT, 3002).cloud_B, PART)


def test_from_the_cloud_alone_the_root_follows_the_bend_and_its_normals_turn_with_it(scene: Scene) -> None:
    groove = extract_groove(scene.cloud_B)
    side, height = sideways(groove.root, scene.part, scene.X_BP)
    assert np.mean(np.abs(side) < 2.0 * groove.sigma) > 0.9
    assert np.sqrt(np.mean(side**2)) < 0.15e-3
    assert np.sqrt(np.mean(height**2)) < 0.3e-3
    assert groove.bend_radius == pytest.approx(RADIUS_M, rel=0.01)
    assert "bent over a radius of 200 mm" in groove.summary or "bent over a radius of 199 mm" in groove.summary
    plan = plan_root(scene.cloud_B, PART, scene.X_BP, PlanningMethod(method="cloud"))
    turn = math.acos(float(plan.up[0] @ plan.up[-1]))
    expected = math.acos(float(PART.up_P[0] @ PART.up_P[-1]))
    assert turn == pytest.approx(expected, abs=0.06)  # of 0.89 rad; some millimetres are not seen at its ends
