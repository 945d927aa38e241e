"""The paper's calibration pipeline on segmented faces: circle, Eq. (9)-(12), Algorithm 1 with the ICP of Eq. (13)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import fit_rigid
from weldcal.calibration.published.algorithm1 import FAILED, Method, VerificationError, registered
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_mesh

SAMPLE_SIZE = 3
_BLOCK = 64  # circles judged at once: keeps the distances of a 20 000-point face within a few megabytes


@dataclass(frozen=True)
class CircleParameters:
    """Section 3.2.2: R = 31 mm, e_d = 0.3 mm, e_r = 1 mm, k_max = 10 000; m."""

    R: float = 0.031
    e_d: float = 0.0003
    e_r: float = 0.001
    k_max: int = 10_000

    def __post_init__(self) -> None:
        if not (0.0 < self.e_r < self.R and self.e_d > 0.0 and self.k_max > 0):
            raise InputError("The circle search needs 0 < e_r < R, e_d > 0 and k_max > 0.")


@dataclass(frozen=True)
class PublishedCircle:
    """The circle of a face by the paper's search.

    Centre (3,) m in C, radius m, points within e_d of it, and how many of the k_max triples passed the model check.
    """

    center_C: Array
    radius: float
    n_inliers: int
    n_verified: int


def search_circle(points_C: Array, parameters: CircleParameters | None = None, *, seed: int = 0) -> PublishedCircle:
    """Circle through three random points of a segmented face (N, 3) m that has the most points at its radius.

    Source: paper, section 2.1.4, second step, numbers of section 3.2.2. As published: no plane is fitted, "on the
    circle" is a distance from the centre within e_d of the radius (a shell), the winner is not refined, and inner
    points of the face draw as often as points of its edge. The authors' search has no seed: the centre it gives for the
    same cloud repeats to a few tenths of a millimetre only, which ``seed`` hides but does not correct. Raises
    FlangeNotFound when no triple passes the check of the radius.
    """
    p = parameters or CircleParameters()
    points = np.asarray(points_C, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < SAMPLE_SIZE:
        raise FlangeNotFound("The published circle search needs at least three points.")
    rng = np.random.default_rng(seed)
    triples = points[rng.integers(len(points), size=(p.k_max, SAMPLE_SIZE))]
    centers, radii = circumcircles(triples)
    smallest, largest = p.R - p.e_r, p.R + p.e_r
    good = np.isfinite(radii) & (radii >= smallest) & (radii <= largest)
    centers, radii = centers[good], radii[good]
    if len(radii) == 0:
        raise FlangeNotFound(
            f"None of {p.k_max} random circles has a radius from {1e3 * smallest:.0f} to {1e3 * largest:.0f} mm."
        )
    # |p - c| from the expanded square: one product of matrices, after moving the origin near to lose no digits
    origin = points.mean(axis=0)
    near, c = points - origin, centers - origin
    square = (near**2).sum(axis=1)
    counts = np.empty(len(c), dtype=int)
    for k in range(0, len(c), _BLOCK):
        block = slice(k, k + _BLOCK)
        d2 = square - 2.0 * c[block] @ near.T + (c[block] ** 2).sum(axis=1)[:, None]
        d = np.sqrt(np.maximum(d2, 0.0))
        counts[block] = (np.abs(d - radii[block, None]) < p.e_d).sum(axis=1)
    best = int(np.argmax(counts))
    return PublishedCircle(centers[best], float(radii[best]), int(counts[best]), len(radii))


def circumcircles(triples: Array) -> tuple[Array, Array]:
    """Centres (k, 3) and radii (k,) of the circles through point triples (k, 3, 3).

    Radius NaN where the points are collinear or repeated.
    """
    A, u, v = triples[:, 0], triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    w = np.cross(u, v)
    uu, vv, ww = ((x * x).sum(axis=1) for x in (u, v, w))
    flat = ww <= 1e-18 * uu * vv
    ww = np.where(flat, 1.0, ww)
    to_center = (np.cross(w, u) * vv[:, None] + np.cross(v, w) * uu[:, None]) / (2.0 * ww[:, None])
    radii = np.where(flat, np.nan, np.linalg.norm(to_center, axis=1))
    return A + to_center, radii


@dataclass(frozen=True, kw_only=True)
class PublishedParameters:
    """Parameters of the pipeline: circle and registration.

    Partners at most 1 mm apart, Open3D's iterations and its stop rule 1e-6 on numbers of ``unit_m`` (the authors'
    clouds are in mm, the AUBO's in m, which stops a thousand times earlier) and the program's point-to-plane or the
    point-to-point ICP that its figures for the AUBO agree with. The paper names no e_required; 0.28 mm is what it
    claims.
    """

    circle: CircleParameters = field(default_factory=CircleParameters)
    max_distance_m: float = 0.001
    method: Method = "point_to_point"
    unit_m: float = 0.001
    e_required: float = 2.8e-4
    k_max: int = 100


@dataclass(frozen=True, eq=False, kw_only=True)
class PublishedVerification:
    """Eq. (13): measured verification face (n, 3) m in C, the robot's X_BF there, and a CAD without chamfers.

    Points (m, 3) m and normals (m, 3) in F. Called with X_BC it gives e_icp as the paper takes it, at the camera's
    origin in the camera's axes.
    """

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
    """Return the ground-true cloud of Fig. 6 in F.

    Points (m, 3) m of a CAD model with sharp edges, sampled evenly over the face and the first 2 mm of its walls, and
    normals (m, 3) estimated from 30 neighbours within 1 mm as in the authors' program (which makes them lean at every
    edge).
    """
    import open3d as o3d  # slow to import

    mesh = flange_mesh(standard, chamfers=False)
    points, normals = mesh.sample(5 * n, np.random.default_rng(seed))
    near = (normals[:, 2] > -0.1) & (points[:, 2] > -0.002)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[near][:n]))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.001, max_nn=30))
    return np.asarray(cloud.points), np.asarray(cloud.normals)


def published_icp(X_BC: RigidTransform, verification: PublishedVerification) -> VerificationError:
    """Eq. (13): register the measured face to the CAD face that ``X_BC`` puts into the camera frame.

    E_icp = Cam'_Cam H.

    ``value`` is (roll, pitch, yaw; x, y, z) of e_icp, rad and m, at the camera's origin: a turn about a flange 0.4 m
    away enters the translation with that lever. Its failings are kept: partners within 1 mm only, no chamfer on the
    CAD, a stop rule that depends on the unit. One is not, for the paper itself says so: without a match the error is
    infinite, where the registration returns the identity.
    """
    X_CF = X_BC.InvertAndCompose(verification.X_BF)
    unit = verification.unit_m
    result = registered(
        verification.points_C / unit,
        (X_CF @ verification.model_F.T).T / unit,
        verification.normals_F @ X_CF.rotation().matrix().T,
        verification.max_distance_m / unit,
        verification.method,
    )
    T = np.array(result.transformation)
    if result.fitness == 0.0 or not np.isfinite(T).all():
        return FAILED
    R = RotationMatrix.ProjectToRotationMatrix(T[:3, :3])
    e = RigidTransform(R, unit * T[:3, 3])
    value = np.concatenate([RollPitchYaw(R).vector(), e.translation()])
    return VerificationError(value, e, float(result.fitness))


def find_centres(
    clouds_C: Mapping[str, Array], parameters: PublishedParameters | None = None, *, seed: int = 0
) -> tuple[dict[str, PublishedCircle], dict[str, Array], tuple[tuple[str, str], ...]]:
    """Circle and face points of each scan by id, and (id, reason) of those without.

    The clouds are faces: segmented scans.

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
            circles[id] = search_circle(face, p.circle, seed=own)
            faces[id] = face[np.isfinite(face).all(axis=1)]
        except FlangeNotFound as e:
            refused.append((id, e.reason))
    return circles, faces, tuple(refused)


def published_pairs(circles: Mapping[str, PublishedCircle], poses: Mapping[str, RigidTransform]) -> list[Observation]:
    """Eq. (9): TCP of the controller and centre of the circle, scan by scan.

    The circle's centre is taken for the TCP.
    """
    return [Observation(id, poses[id], circle.center_C) for id, circle in circles.items()]


def all_pairs(pairs: Sequence[Observation]) -> RigidTransform:
    """Eq. (10)-(12) on every pair, without weights or outlier rejection: Table 1's calibration."""
    return fit_rigid(np.array([o.p_BR for o in pairs]), np.array([o.p_CR for o in pairs]))
