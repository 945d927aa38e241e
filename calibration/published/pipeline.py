"""The paper's calibration pipeline: segmentation, circle, Eq. (9)-(12), Algorithm 1 with the ICP of Eq. (13)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.rigid import fit_rigid
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.calibration.published.algorithm1 import (
    Algorithm1State,
    Cost,
    algorithm1_start,
    algorithm1_step,
    translation_cost,
)
from weldcal.calibration.published.circle import CircleParameters, PublishedCircle, search_circle
from weldcal.calibration.published.icp import FAILED, VerificationError, Verifier
from weldcal.calibration.published.segmentation import SegmentationParameters, segment_flange
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard, flange_mesh

Method = Literal["point_to_point", "point_to_plane"]


@dataclass(frozen=True, kw_only=True)
class PublishedParameters:
    """Parameters of the pipeline: segmentation, circle, and registration.

    Partners at most 1 mm apart, Open3D's iterations and its stop rule 1e-6 on numbers of ``unit_m`` (the authors' clouds
    are in mm, the AUBO's in m, which stops a thousand times earlier) and the program's point-to-plane or the
    point-to-point ICP that its figures for the AUBO agree with. The paper names no e_required; 0.28 mm is what it claims.
    """

    segmentation: SegmentationParameters = field(default_factory=SegmentationParameters)
    circle: CircleParameters = field(default_factory=CircleParameters)
    max_distance_m: float = 0.001
    method: Method = "point_to_point"
    unit_m: float = 0.001
    e_required: float = 2.8e-4
    k_max: int = 100


@dataclass(frozen=True, eq=False, kw_only=True)
class PublishedVerification:
    """Eq. (13): measured verification face (n, 3) m in C, the robot's X_BF there, and a CAD without chamfers: points
    (m, 3) m and normals (m, 3) in F. Called with X_BC it gives e_icp as the paper takes it, at the camera's origin in the camera's axes."""

    points_C: Array
    X_BF: RigidTransform
    model_F: Array
    normals_F: Array
    method: Method = "point_to_point"
    max_distance_m: float = 0.001
    unit_m: float = 0.001

    def __call__(self, X_BC: RigidTransform) -> VerificationError:
        """See published_icp."""
        return published_icp(X_BC, self)


def published_model(standard: FlangeStandard, n: int = 20_000, *, seed: int = 0) -> tuple[Array, Array]:
    """The ground-true cloud of Fig. 6 in F: points (m, 3) m of a CAD model with sharp edges, sampled evenly over the face and
    the first 2 mm of its walls, and normals (m, 3) estimated from 30 neighbours within 1 mm as in the authors' program
    (which makes them lean at every edge)."""
    import open3d as o3d  # slow to import

    mesh = flange_mesh(standard, chamfers=False)
    points, normals = mesh.sample(5 * n, np.random.default_rng(seed))
    near = (normals[:, 2] > -0.1) & (points[:, 2] > -0.002)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[near][:n]))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.001, max_nn=30))
    return np.asarray(cloud.points), np.asarray(cloud.normals)


def published_icp(X_BC: RigidTransform, verification: PublishedVerification) -> VerificationError:
    """Eq. (13): register the measured face to the CAD face that ``X_BC`` puts into the camera frame; e_icp = Cam'_Cam H.

    ``value`` is (roll, pitch, yaw; x, y, z) of e_icp, rad and m, at the camera's origin: a turn about a flange 0.4 m away
    enters the translation with that lever. Its failings are kept: partners within 1 mm only, no chamfer on the CAD, a
    stop rule that depends on the unit. One is not, for the paper itself says so: without a match the error is infinite, where the
    registration returns the identity.
    """
    import open3d as o3d  # slow to import

    X_CF = X_BC.InvertAndCompose(verification.X_BF)
    unit = verification.unit_m
    source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(verification.points_C / unit))
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector((X_CF @ verification.model_F.T).T / unit))
    registration = o3d.pipelines.registration
    target.normals = o3d.utility.Vector3dVector(verification.normals_F @ X_CF.rotation().matrix().T)
    estimation = (
        registration.TransformationEstimationPointToPlane()
        if verification.method == "point_to_plane"
        else registration.TransformationEstimationPointToPoint()
    )
    reach = verification.max_distance_m / unit
    result = registration.registration_icp(source, target, reach, np.eye(4), estimation)
    T = np.array(result.transformation)
    if result.fitness == 0.0 or not np.isfinite(T).all():
        return FAILED
    R = RotationMatrix.ProjectToRotationMatrix(T[:3, :3])
    e = RigidTransform(R, unit * T[:3, 3])
    value = np.concatenate([RollPitchYaw(R).vector(), e.translation()])
    return VerificationError(value, e, float(result.fitness), unit * float(result.inlier_rmse))


def find_centres(
    clouds_C: Mapping[str, Array],
    parameters: PublishedParameters | None = None,
    *,
    segmented: bool = False,
    seed: int = 0,
) -> tuple[dict[str, PublishedCircle], dict[str, Array], tuple[tuple[str, str], ...]]:
    """Circle and face points of each scan by id, and (id, reason) of those without; ``segmented`` clouds are faces already.

    Each scan draws from its own stream of ``seed``, so that adding one changes no other.
    """
    p = parameters or PublishedParameters()
    circles: dict[str, PublishedCircle] = {}
    faces: dict[str, Array] = {}
    refused: list[tuple[str, str]] = []
    for id, points in clouds_C.items():
        own = int(np.random.SeedSequence([seed, *id.encode()]).generate_state(1)[0] % 2**31)
        try:
            face = np.asarray(points, dtype=float).reshape(-1, 3)
            if not segmented:
                face = segment_flange(points, p.circle.R, p.segmentation, seed=own)
            circles[id] = search_circle(face, p.circle, seed=own)
            faces[id] = face[np.isfinite(face).all(axis=1)]
        except FlangeNotFound as e:
            refused.append((id, e.reason))
    return circles, faces, tuple(refused)


def published_pairs(circles: Mapping[str, PublishedCircle], poses: Mapping[str, RigidTransform]) -> list[Observation]:
    """Eq. (9): TCP of the controller and centre of the circle, scan by scan; the circle's centre is taken for the TCP."""
    return [Observation(id, poses[id], circle.center_C) for id, circle in circles.items()]


def all_pairs(pairs: Sequence[Observation]) -> RigidTransform:
    """Eq. (10)-(12) on every pair, without weights or outlier rejection: Table 1's calibration."""
    return fit_rigid(np.array([o.p_BR for o in pairs]), np.array([o.p_CR for o in pairs]))


def run_published(
    pairs: Sequence[Observation], verifier: Verifier, parameters: PublishedParameters, cost: Cost = translation_cost
) -> Algorithm1State:
    """Algorithm 1 over pairs in the order given, as printed (a new pair may replace more than one of the four)."""
    state = algorithm1_start(parameters.e_required, parameters.k_max)
    for o in pairs:
        state = algorithm1_step(state, o, verifier, cost, as_printed=True)
    return state


def at_flange(error: VerificationError, X_BC: RigidTransform, X_BF: RigidTransform) -> Array:
    """The paper's e_icp (camera origin) as (6,) rotation vector (rad) and displacement of the flange centre (m), both in
    axes of F: the same transform without the lever of the working distance. Infinite where the ICP failed."""
    if error.X_CpC is None:
        return np.full(6, np.inf)
    X_FC = X_BF.InvertAndCompose(X_BC)
    E_F = (X_FC @ error.X_CpC @ X_FC.inverse()).inverse()
    return np.concatenate([rotation_vector(E_F.rotation()), E_F.translation()])
