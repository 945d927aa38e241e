"""Adds torch, profiler, straightedge and sphere to the simulated world of a profiler cell, at their true poses."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import AddContactMaterial, Box, Cylinder, GeometryId, Mesh, ProximityProperties, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, SpatialInertia, UnitInertia

from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh, revolve
from weldcal.systems.jobs.profiler.config import ProfilerJob
from weldcal.systems.messages import Message

TIP_RADIUS_M = 2e-5  # of the contact point: 0.01 mm is below the resolution of every reported figure
POST_RADIUS_M = 0.006  # a choice: thinner than the nominal sphere that it carries; no reported figure depends on it
BEVEL_M = 0.007  # thickness of the straightedge, bevelled under 45 degrees so that its side is hidden from above
MASS_KG = 0.9  # a choice: a torch and a small profiler together; it only loads the simulated joint servos


@dataclass(frozen=True, eq=False)
class ProfilerTruth(Message):
    """Ground truth of the simulation.

    X_FS, the torch's tip in F, the edge (point, direction) and the sphere's centre in B.
    """

    X_FS: RigidTransform
    p_FTip: Array
    edge_point: Array
    edge_direction: Array
    center: Array
    radius_m: float


@dataclass(frozen=True, eq=False)
class ProfilerFixture(Message):
    """Ground truth and job, the straightedge's pose, and the ray-cast objects: (mesh in B, darkness 0 to 1) each."""

    truth: ProfilerTruth
    X_BE: RigidTransform
    job: ProfilerJob
    meshes: tuple[tuple[TriMesh, float], ...]
    time_step_s: float = 0.004  # of the plant: nothing in it is more compliant than the arm's servos


def straightedge_mesh(length_m: float, width_m: float) -> TriMesh:
    """Return a bar with its top in the plane z = 0, from its edge at y = 0 (along x) to y = width, bevelled inwards."""
    section = np.array([[0.0, 0.0], [width_m, 0.0], [width_m - BEVEL_M, -BEVEL_M], [BEVEL_M, -BEVEL_M]])
    ends = [np.column_stack([np.full(4, x), section]) for x in (-0.5 * length_m, 0.5 * length_m)]
    triangles = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]]
    for k in range(4):
        a, b = k, (k + 1) % 4
        triangles += [[a, b, b + 4], [a, b + 4, a + 4]]
    return TriMesh(np.vstack(ends), np.array(triangles))


def post_mesh(top: Array, table_z_m: float) -> TriMesh:
    height = float(top[2]) - table_z_m
    profile = np.array([[0.0, -height], [POST_RADIUS_M, -height], [POST_RADIUS_M, 0.0], [0.0, 0.0]])
    return revolve(profile, 24).transformed(RigidTransform(top))


def under_straightedge(X_BE: RigidTransform, width_m: float) -> Array:
    """Return the upper end of the straightedge's post: the middle of the straightedge's underside."""
    return np.asarray(X_BE.multiply(np.array([0.0, 0.5 * width_m, -BEVEL_M])))


def box_mesh(center: list[float], size: list[float]) -> TriMesh:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
             [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return TriMesh(corners * size + center, np.array(faces))


def rig_points(tip_F: Array, X_FS: RigidTransform) -> tuple[Array, Array]:
    """Spheres that bound torch and profiler for clearance checks: centres (n, 3) m in F, and radii (n,) m."""
    along = np.linspace(0.15, 1.0, 11)[:, None]  # as far as the tip, which is nearest to a touched sphere
    torch = along * tip_F
    radii = np.minimum(0.008, 0.2 * np.linalg.norm(tip_F - torch, axis=1) + 0.001)
    body = np.array([[x, y, z] for x in (-0.04, 0.0, 0.04) for y in (-0.018, 0.018) for z in (-0.025, 0.0)])
    housing = X_FS.multiply(body.T).T
    return np.vstack([torch, housing]), np.concatenate([radii, np.full(len(housing), 0.004)])


def add_fixture(
    plant: MultibodyPlant, arm: ModelInstanceIndex, fixture: ProfilerFixture, table_z_m: float
) -> frozenset[GeometryId]:
    """Add the fixture to a plant that is not finalised; only the tip and the sphere have contact geometry.

    Returns these two geometries.
    """
    truth, job = fixture.truth, fixture.job
    rig = plant.AddModelInstance("profiler_rig")
    inertia = SpatialInertia(MASS_KG, np.zeros(3), UnitInertia.SolidBox(0.16, 0.07, 0.12))
    plate = plant.AddRigidBody("profiler_plate", rig, inertia)
    plant.WeldFrames(plant.GetFrameByName("flange", arm), plate.body_frame())
    ground = plant.world_body()
    steel, dark, red, copper = (
        (0.62, 0.64, 0.67, 1.0),
        (0.16, 0.18, 0.21, 1.0),
        (0.9, 0.15, 0.1, 0.35),
        (0.8, 0.45, 0.2, 1.0),
    )

    def show(body: object, X: RigidTransform, shape: Shape, name: str, rgba: tuple[float, ...]) -> None:
        plant.RegisterVisualGeometry(body, X, shape, name, np.array(rgba))

    x = float(truth.X_FS.translation()[0])
    show(plate, RigidTransform([0.5 * x, 0.0, 0.006]), Box(abs(x) + 0.07, 0.064, 0.012), "profiler_mount", dark)
    show(plate, truth.X_FS @ RigidTransform([0.0, 0.0, -0.0175]), Box(0.08, 0.036, 0.035), "profiler_body", steel)
    show(plate, truth.X_FS @ RigidTransform([0.0, 0.0, 0.045]), Box(0.034, 0.0004, 0.09), "plane_of_light", red)
    _show_torch(show, plate, truth.p_FTip, copper)
    show(
        ground,
        fixture.X_BE,
        _shape(straightedge_mesh(1e-3 * job.straightedge.length_mm, 1e-3 * job.straightedge.width_mm)),
        "straightedge",
        steel,
    )
    for k, top in enumerate((under_straightedge(fixture.X_BE, 1e-3 * job.straightedge.width_mm), truth.center)):
        height = float(top[2]) - table_z_m
        show(ground, RigidTransform(top - [0.0, 0.0, 0.5 * height]), Cylinder(POST_RADIUS_M, height), f"post{k}", dark)
    show(ground, RigidTransform(truth.center), Sphere(truth.radius_m), "ball", steel)
    touching = ProximityProperties()
    AddContactMaterial(dissipation=1.0, friction=CoulombFriction(0.1, 0.1), properties=touching)
    tip = plant.RegisterCollisionGeometry(
        plate, RigidTransform(truth.p_FTip), Sphere(TIP_RADIUS_M), "torch_tip", touching
    )
    ball = plant.RegisterCollisionGeometry(
        ground, RigidTransform(truth.center), Sphere(truth.radius_m), "ball_contact", touching
    )
    return frozenset((tip, ball))


def _show_torch(show: object, plate: object, tip: Array, rgba: tuple[float, ...]) -> None:
    """Show a tube that ends near the tip, then a needle, both along the line from the flange's centre to the tip."""
    assert callable(show)
    length = float(np.linalg.norm(tip))
    d = tip / length
    R = RollPitchYaw(0.0, float(np.arctan2(np.hypot(d[0], d[1]), d[2])), 0.0).ToRotationMatrix()
    R = RollPitchYaw(0.0, 0.0, float(np.arctan2(d[1], d[0]))).ToRotationMatrix() @ R
    for name, start, end, radius in (
        ("torch_body", 0.0, length - 0.02, 0.008),
        ("torch_needle", length - 0.02, length, 0.0008),
    ):
        show(plate, RigidTransform(R, 0.5 * (start + end) * d), Cylinder(radius, end - start), name, rgba)


def _shape(mesh: TriMesh) -> Mesh:
    return mesh.to_drake("straightedge")
