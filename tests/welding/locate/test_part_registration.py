"""Registration of any part to a scan: the pose within its covariance, or a refusal that names why."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial.transform import Rotation

from tests.worlds.parts.scans import PartScene, block, box, looking_at, scan_scene, table
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import cast, get_scanner
from weldcal.welding.locate.part.fit import fine_fit
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.registration import register_part
from weldcal.welding.locate.part.result import AmbiguousPart, PartConfig, PartNotFound
from weldcal.welding.locate.part.rivals import same_set
from weldcal.welding.locate.part.scan import prepare
from weldcal.welding.locate.planes import finite_points

SCANNER = get_scanner("phoxi_m", 412)
QUICK = PartConfig(turn_step_rad=math.radians(12.0), cell_m=0.006)
FOUR_SIGMA = 33.0  # of the squared error in units of the covariance, six degrees of freedom


def error(found: RigidTransform, true: RigidTransform) -> np.ndarray:
    """(6,) rotation rad and translation m from the pose found to the true one, in P."""
    E = found.InvertAndCompose(true)
    return np.concatenate([Rotation.from_matrix(E.rotation().matrix()).as_rotvec(), E.translation()])


def scene(seed: int, there: TriMesh | None = None, **options: object) -> PartScene:
    return scan_scene(block() if there is None else there, SCANNER, seed, **{"fingers": 0, "objects": 4, **options})  # type: ignore[arg-type]


def test_a_part_among_others_is_found_without_a_guess_and_knows_how_well() -> None:
    s = scene(61)
    found = register_part(s.cloud_B, block(), eye_B=s.eye_B, config=QUICK)
    xi = error(found.X_BP, s.X_BP)
    assert np.linalg.norm(xi[3:]) < 0.0005
    assert xi @ np.linalg.solve(found.covariance, xi) < FOUR_SIGMA
    assert np.sqrt(np.trace(found.covariance[3:, 3:])) < 0.0005
    assert found.confidence > 0.8


def test_a_guess_narrows_the_search_and_a_wrong_one_is_said() -> None:
    s = scene(63)
    near = s.X_BP @ RigidTransform(RollPitchYaw(0.03, -0.02, 0.05), [0.008, -0.006, 0.004])
    found = register_part(s.cloud_B, block(), near, s.eye_B)
    assert np.linalg.norm(error(found.X_BP, s.X_BP)[3:]) < 0.0005
    with pytest.raises(PartNotFound):
        register_part(s.cloud_B, block(), RigidTransform([0.0, 0.12, 0.0]) @ near, s.eye_B)


def test_a_plate_that_looks_the_same_turned_is_refused_until_a_hint_decides() -> None:
    plate = box(0.2, 0.12, 0.02)
    s = scene(64, plate)
    with pytest.raises(AmbiguousPart, match=r"turning it about its [xyz] axis by 180 deg"):
        register_part(s.cloud_B, plate, eye_B=s.eye_B, config=QUICK)
    found = register_part(s.cloud_B, plate, eye_B=s.eye_B, X_BP_hint=s.X_BP, config=QUICK)
    assert np.linalg.norm(error(found.X_BP, s.X_BP)[3:]) < 0.001
    # A turn that leaves the points that matter where they are is no reason to refuse.
    middle = np.linspace([-0.1, 0.0, 0.01], [0.1, 0.0, 0.01], 41)
    assert same_set(middle, RigidTransform(RollPitchYaw(0.0, 0.0, math.pi), np.zeros(3)))
    assert not same_set(
        middle + np.array([0.0, 0.01, 0.0]), RigidTransform(RollPitchYaw(0.0, 0.0, math.pi), np.zeros(3))
    )


def test_two_alike_another_part_and_another_unit_are_refused_by_name() -> None:
    two = scene(65, twice=True, spread_m=0.02)
    with pytest.raises(AmbiguousPart, match="Two places in the scan"):
        register_part(two.cloud_B, block(), eye_B=two.eye_B, config=QUICK)
    one = scene(66)
    larger = TriMesh(block().vertices * 1.2, block().triangles)
    with pytest.raises(PartNotFound, match=r"[Cc]heck which part|fits the part"):
        register_part(one.cloud_B, larger, eye_B=one.eye_B, config=QUICK)
    inches = TriMesh(block().vertices * 25.4, block().triangles)
    with pytest.raises(PartNotFound, match="unit"):
        register_part(one.cloud_B, inches, eye_B=one.eye_B, config=QUICK)
    with pytest.raises(InputError, match="shape"):
        register_part(np.zeros((4, 2)), block())


def plate_beside(
    wall: TriMesh | None, shift: float = 0.0, width: int = 412
) -> tuple[np.ndarray, np.ndarray, RigidTransform, TriMesh]:
    """A scan of a plate, 2 cm thick, with a wall beside it; the scanner's position, the plate's pose and the plate."""
    plate = box(0.16, 0.1, 0.02)
    X = RigidTransform(RollPitchYaw(0.0, 0.0, 0.3), [0.6, 0.0, 0.0003])
    eye = np.array([0.45, 0.1, 0.85])
    meshes = [plate.transformed(X), table()]
    if wall is not None:
        meshes.append(wall.transformed(X @ RigidTransform([0.0, shift, 0.0])))
    return cast(meshes, looking_at(eye, X.translation()), get_scanner("phoxi_m", width), 5), eye, X, plate


def test_a_rim_that_something_hides_does_not_count() -> None:
    """A wall higher than the plate stands 0.5 mm beside it, on the scanner's side, and hides a strip of its top."""
    cloud, eye, X, plate = plate_beside(box(0.18, 0.01, 0.05), 0.0555)
    scan = prepare(finite_points(cloud), eye, 250, 0)
    fit = fine_fit(scan, PartModel(plate), X)
    assert fit is not None
    xi = error(fit.X_BP, X)
    assert abs(xi[4]) < 0.0005
    assert xi @ np.linalg.solve(fit.covariance, xi) < FOUR_SIGMA


def test_a_start_some_millimetres_off_along_a_face_ends_at_the_same_pose() -> None:
    cloud, eye, X, plate = plate_beside(None, width=824)
    scan = prepare(finite_points(cloud), eye, 250, 0)
    model = PartModel(plate)
    fits = [fine_fit(scan, model, X @ RigidTransform([dx, 0.0, 0.0])) for dx in (-0.007, 0.0, 0.007)]
    at = np.array([fit.X_BP.translation() for fit in fits if fit is not None])
    assert len(at) == 3
    assert np.ptp(at, axis=0).max() < 1e-4


def test_the_noise_of_a_mesh_does_not_tilt_its_normals() -> None:
    rng = np.random.default_rng(3)
    n = 60
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    corners = np.column_stack([0.002 * x.ravel(), 0.002 * y.ravel(), rng.normal(0.0, 5e-5, n * n)])
    i = (x[:-1, :-1] * n + y[:-1, :-1]).ravel()
    mesh = TriMesh(corners, np.vstack([np.column_stack([i, i + n, i + n + 1]), np.column_stack([i, i + n + 1, i + 1])]))
    tilt = np.arccos(np.clip(PartModel(mesh).smooth_normals[:, 2], -1.0, 1.0))
    raw = np.arccos(np.clip(mesh.normals[:, 2], -1.0, 1.0))
    assert float(np.median(raw)) > math.radians(1.0)
    assert float(np.median(tilt)) < 0.35 * float(np.median(raw))


def test_an_edge_between_two_faces_stays_sharp() -> None:
    normals = PartModel(box(0.02, 0.02, 0.02)).smooth_normals
    assert np.abs(normals).max(axis=1).min() > 1.0 - 1e-9
