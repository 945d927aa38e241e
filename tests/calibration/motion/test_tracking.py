"""A link of the arm is tracked by its mesh and by a model fused from scans; a body that can slide along itself is
refused."""

import numpy as np
import open3d as o3d
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.motion.body import (
    BodyModel,
    BodyTracker,
    fused_model,
    link_motion,
    model_from_solids,
    observed_point,
)
from weldcal.models.arms.kinematics import link_frames, load_arm
from weldcal.models.arms.urdf import link_index, link_solids
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, merge, revolve

ARM = load_arm("ur5e")
LINK = link_index(ARM, "wrist_1_link")
WIDTH, HEIGHT, FOCAL, NOISE_M = 320, 240, 520.0, 3e-4


def scan(mesh: TriMesh, X_CL: RigidTransform, rng: np.random.Generator) -> Array:
    """An organised cloud (H, W, 3) m of a body, with noise along the rays."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 0.5 * WIDTH) / FOCAL, (v - 0.5 * HEIGHT) / FOCAL, np.ones(u.shape)], axis=-1)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
    )
    X = X_CL.inverse()
    origins = np.broadcast_to(X.translation(), rays.shape)
    cast = np.concatenate([origins, rays @ X.rotation().matrix().T], axis=-1).astype(np.float32)
    z = scene.cast_rays(o3d.core.Tensor.from_numpy(cast))["t_hit"].numpy().astype(float)
    z = np.where(np.isfinite(z), z + NOISE_M * rng.standard_normal(z.shape), np.nan)
    return np.asarray(rays * z[..., None])


def poses(n: int) -> list[RigidTransform]:
    """Poses X_CL of the link as it moves before the scanner, 0.6 m away."""
    first = RollPitchYaw(1.9, 0.3, 0.5).ToRotationMatrix()
    turns = [exp_rotation(np.array([0.1 * np.sin(k), 0.12 * np.cos(1.3 * k), 0.1 * np.sin(0.7 * k)])) for k in range(n)]
    return [
        RigidTransform(RotationMatrix(R) @ first, [0.03 * np.sin(k), 0.02 * np.cos(k), 0.6 + 0.02 * np.sin(1.7 * k)])
        for k, R in enumerate(turns)
    ]


@pytest.fixture(scope="module")
def whole() -> TriMesh:
    return merge(*link_solids(ARM, LINK))


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return model_from_solids(link_solids(ARM, LINK))


def errors(model: BodyModel, mesh: TriMesh, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors of the middle (n, 3) m along the camera's axes and their stated sigmas, each from a guess 15 mm off."""
    tracker, found, sigma = BodyTracker(model), [], []
    for X in poses(6):
        guess = RigidTransform(X.rotation(), X.translation() + np.array([0.009, -0.009, 0.008]))
        tracked = tracker.track(scan(mesh, X, rng), guess)
        assert tracked is not None
        found.append(tracked.X_CL @ model.middle - X @ model.middle)
        sigma.append(np.sqrt(np.diag(tracked.covariance)[3:]))
    return np.array(found), np.array(sigma)


def test_a_link_is_tracked_by_its_mesh(model: BodyModel, whole: TriMesh) -> None:
    e, sigma = errors(model, whole, np.random.default_rng(1))
    assert float(np.sqrt((e**2).sum(axis=1).mean())) < 1.2e-4
    assert float(np.median(np.abs(e) / sigma)) < 2.5


def test_a_link_is_tracked_by_a_model_fused_from_scans(whole: TriMesh) -> None:
    rng = np.random.default_rng(2)
    scans = [(scan(whole, X, rng), X.inverse()) for X in poses(14)]
    fused = fused_model(scans, np.array([0.0, 0.0, -0.01]), 0.1)
    assert len(fused.points) > 2000
    e, _ = errors(fused, whole, rng)
    assert float(np.sqrt((e**2).sum(axis=1).mean())) < 1.5e-4


def test_the_model_keeps_the_outer_surface_only(model: BodyModel) -> None:
    # no point inside the housing of radius r along z
    r, z = np.linalg.norm(model.points[:, :2], axis=1), model.points[:, 2]
    inside = (r < 0.03) & (np.abs(z + 0.01) < 0.02)
    assert not inside.any()
    assert np.linalg.norm(model.normals, axis=1) == pytest.approx(1.0)


def test_a_round_body_and_an_empty_scan_are_refused() -> None:
    rod = revolve(np.array([(0.0, -0.2), (0.04, -0.2), (0.04, 0.2), (0.0, 0.2)]), 96)
    X = RigidTransform(RollPitchYaw(1.57, 0.0, 0.0), [0.0, 0.0, 0.6])
    tracker = BodyTracker(model_from_solids([rod]))
    assert tracker.track(scan(rod, X, np.random.default_rng(3)), X) is None
    assert tracker.track(np.full((HEIGHT, WIDTH, 3), np.nan), X) is None
    with pytest.raises(InputError, match="fuse a model"):
        model_from_solids([])
    with pytest.raises(InputError, match="where the body should be"):
        fused_model([(np.full((4, 4, 3), np.nan), X)], np.zeros(3), 0.1)


def test_the_motion_of_a_link_follows_from_the_joints() -> None:
    t = np.arange(0.0, 0.4, 0.01)
    q = np.array([0.1, -1.2, 1.5, -0.4, 1.3, 0.2]) + 0.1 * np.sin(t)[:, None]
    flange = np.array([link_frames(ARM, row)[6].GetAsMatrix4() for row in q])
    motion = link_motion(RobotStream(t, flange, q, "ur5e"), ARM, LINK)
    assert motion.poses(t[20:21])[0] == pytest.approx(link_frames(ARM, q[20])[LINK].GetAsMatrix4(), abs=1e-6)
    with pytest.raises(InputError, match="joint angles"):
        link_motion(RobotStream(t, flange), ARM, LINK)


def test_the_observed_direction_points_to_the_scanner(model: BodyModel) -> None:
    X_CL = poses(1)[0]
    z = (X_CL @ observed_point(model, X_CL)).rotation().matrix()[:, 2]
    assert z @ (X_CL @ model.middle) == pytest.approx(-np.linalg.norm(X_CL @ model.middle))


def test_an_unknown_link_is_named() -> None:
    with pytest.raises(InputError, match="wrist_1_link"):
        link_index(ARM, "elbow")
