"""Model the surface of a body, track it in scans by ICP, and give its poses as observations."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.motion_dataset import FrameTime, MotionDataset, RobotStream
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.geometry.se3 import as_transform, frames_along
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, o3d

_SAMPLES_PER_M2 = 6e5  # one in 1.3 mm
_INSIDE_M = 1e-4  # a choice: above the rounding of float32 at 1 m (1e-7), below any gap between links
_VOXEL_M = 0.0015  # a choice: about the samples of a mesh (1.3 mm); half leaves voxels empty, twice rounds edges
_LEAST_OF_FRAMES, _LEAST_FRAMES = (
    0.5,
    4,
)  # of the frames a voxel must be seen in: what moves otherwise is not of the body
_PITCHES = 1.5  # point pitches of a voxel, a choice: at one, many voxels stay empty
_NORMAL_VOXELS = 4.0  # radius of the neighbours that tell a normal
_SAMPLE = 2000
_FEWEST_SURFELS = 300

_STAGES = ((0.03, 12), (0.008, 12), (0.0025, 25))  # largest distance of a pair (m) and iterations
_POINTS = 5000  # of a scan that are registered
_MARGIN_M = 0.03  # how far the first stage pairs points (_STAGES)
_FEWEST = 250
_LEAST_SHARE = 0.5  # of the points at the end of the first stage that must stay in the last
_LEAST_HELD = 2e-4  # mean square of what the surface moves along its normals, of the move that it holds least
_WORST_RMS_M = 1.5e-3  # 2.5 mm / sqrt(3): what pairs of the last stage (_STAGES) leave on any surface
_CORRELATED = 4.0  # pixels that share their noise


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body's surface in its own frame L.

    Points (n, 3) m, outward unit normals (n, 3), and the middle (3,) m of the points.
    """

    points: Array
    normals: Array

    @property
    def middle(self) -> Array:
        """Centroid (3,) m."""
        return np.asarray(self.points.mean(axis=0))

    @property
    def radius_m(self) -> float:
        """Largest distance of a point from the middle, m."""
        return float(np.linalg.norm(self.points - self.middle, axis=1).max())


def model_from_solids(solids: Sequence[TriMesh], *, seed: int = 0) -> BodyModel:
    """Sample the outer surface of closed solids that may overlap; what lies inside another one is left out.

    Raises InputError without a solid.
    """
    if not solids:
        raise InputError("This link has no solids: fuse a model from the scans instead.")
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for k, mesh in enumerate(solids):
        p, n = mesh.sample(max(int(_SAMPLES_PER_M2 * mesh.area), 10), rng)
        probe = o3d.core.Tensor.from_numpy((p + _INSIDE_M * n).astype(np.float32))
        outside = np.ones(len(p), dtype=bool)
        for j, other in enumerate(solids):
            if j != k:
                outside &= other.scene.compute_signed_distance(probe).numpy() > 0.0
        points.append(p[outside])
        normals.append(n[outside])
    return BodyModel(np.concatenate(points), np.concatenate(normals))


def fused_model(frames: Iterable[tuple[Array, RigidTransform]], middle: Array, radius_m: float) -> BodyModel:
    """Fuse scans to the surface of what moves with a frame L.

    ``frames`` are clouds (N, 3) or (H, W, 3) m in C with the pose X_LC by calibration and robot. Only points within
    ``radius_m`` of ``middle`` (3,) m in L count.

    A surfel is the mean of all points in a voxel of 1.5 mm (or 1.5 pixels) that half of the frames saw: what stands
    still or belongs to another link sweeps through the voxels. Raises InputError where too little is left.
    """
    keys: list[Array] = []
    sums: list[Array] = []
    eyes, count, voxel = [], 0, _VOXEL_M
    for cloud, X_LC in frames:
        p = cloud.reshape(-1, 3)
        p = p[np.isfinite(p).all(axis=1)] @ X_LC.rotation().matrix().T + X_LC.translation()
        p = p[np.linalg.norm(p - middle, axis=1) < radius_m]
        count += 1
        eyes.append(X_LC.translation())
        if len(p) > 1:
            if not keys:  # wider than the pixels are apart, or voxels stay empty
                apart = np.asarray(cKDTree(p).query(p[:: 1 + len(p) // _SAMPLE], [2])[0])
                voxel = max(_VOXEL_M, _PITCHES * float(np.median(apart)))
            cell, index, size = np.unique(
                np.floor(p / voxel).astype(np.int64), axis=0, return_inverse=True, return_counts=True
            )
            mean = np.stack([np.bincount(index.ravel(), p[:, k]) for k in range(3)], axis=1) / size[:, None]
            keys.append(cell)
            sums.append(mean)
    if not keys:
        raise InputError("No scan shows anything where the body should be.")
    cell, index, seen = np.unique(np.concatenate(keys), axis=0, return_inverse=True, return_counts=True)
    flat = np.concatenate(sums)
    points = np.stack([np.bincount(index.ravel(), flat[:, k]) for k in range(3)], axis=1) / seen[:, None]
    points = points[seen >= max(_LEAST_FRAMES, _LEAST_OF_FRAMES * count)]
    if len(points) < _FEWEST_SURFELS:
        raise InputError(f"Only {len(points)} surface points move with this body; show more of it, or another body.")
    surface = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    surface.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(_NORMAL_VOXELS * voxel))
    surface.orient_normals_towards_camera_location(np.mean(eyes, axis=0))
    normals = np.asarray(surface.normals)
    # a lone point has no neighbours to tell its plane from
    near = np.asarray(cKDTree(points).query(points, [8])[0])[:, 0] < _NORMAL_VOXELS * voxel
    return BodyModel(points[near], normals[near])


@dataclass(frozen=True, eq=False)
class TrackedBody:
    """Pose X_CL of a body in a scan, its covariance (6, 6) [rotation.

    Translation] in axes of C about the body's middle, the rms distance (m) and the number of the points on its surface.
    """

    X_CL: RigidTransform
    covariance: Array
    rms_m: float
    count: int


class BodyTracker:
    """Registers scans to a body's surface: point to plane, Tukey's weights, from coarse to fine (Open3D)."""

    def __init__(self, model: BodyModel) -> None:
        self.model = model
        self._target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model.points))
        self._target.normals = o3d.utility.Vector3dVector(model.normals)
        self._tree = o3d.geometry.KDTreeFlann(self._target)
        self._middle, self._radius = model.middle, model.radius_m

    def track(self, cloud: Array, guess: RigidTransform, *, coarse: bool = True) -> TrackedBody | None:
        """The body in a cloud (N, 3) or (H, W, 3) m near the pose ``guess`` X_CL; None where too little of it shows.

        ``coarse``: begin with pairs 30 mm apart; else with 8 mm. Deterministic.
        """
        p = cloud.reshape(-1, 3)
        with np.errstate(invalid="ignore"):
            p = p[np.linalg.norm(p - guess @ self._middle, axis=1) < self._radius + _MARGIN_M]
        if len(p) < _FEWEST:
            return None
        p = p[:: max(1, len(p) // _POINTS)].astype(float)
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p))
        X_LC = guess.inverse().GetAsMatrix4()
        first = 0
        for reach, steps in _STAGES[0 if coarse else 1 :]:
            pairs = o3d.pipelines.registration
            kernel = pairs.TukeyLoss(k=reach)
            found = pairs.registration_icp(
                source,
                self._target,
                reach,
                X_LC,
                pairs.TransformationEstimationPointToPlane(kernel),
                pairs.ICPConvergenceCriteria(1e-9, 1e-9, steps),
            )
            X_LC = found.transformation
            first = first or len(found.correspondence_set)
        match = np.asarray(found.correspondence_set)
        if len(match) < max(_FEWEST, _LEAST_SHARE * first):
            return None
        return self._result(p[match[:, 0]], match[:, 1], X_LC)

    def _result(self, p_C: Array, index: Array, X_LC: Array) -> TrackedBody | None:
        q = p_C @ X_LC[:3, :3].T + X_LC[:3, 3]
        n = self.model.normals[index]
        e = ((q - self.model.points[index]) * n).sum(axis=1)
        limit = 3.0 * MAD * float(np.median(np.abs(e))) + 1e-5
        good = np.abs(e) < limit
        rms = float(np.sqrt(np.mean(e[good] ** 2)))
        if rms > _WORST_RMS_M:
            return None
        J = np.hstack([np.cross(q[good] - self._middle, n[good]), n[good]])
        N = J.T @ J
        lengths = np.repeat([self._radius, 1.0], 3)
        if np.linalg.eigvalsh(N / np.outer(lengths, lengths) / len(J))[0] < _LEAST_HELD:
            return None  # a surface that slides along itself
        R = X_LC[:3, :3].T
        turn = np.kron(np.eye(2), R)
        covariance = turn @ (np.linalg.inv(N) * rms**2 * _CORRELATED) @ turn.T
        return TrackedBody(as_transform(X_LC).inverse(), covariance, rms, int(good.sum()))


def link_motion(stream: RobotStream, arm: ArmModel, link: int) -> ContinuousMotion:
    """Continuous motion of a link (its index in ``arm.link_names``) from a stream of joints.

    Of the last link also from poses.

    Raises InputError: the stream has no joints, and the link is not the last.
    """
    if link == len(arm.link_names) - 1:
        return ContinuousMotion(stream)
    if stream.joints is None:
        raise InputError(
            f"The stream holds flange poses, which do not say where the {arm.link_names[link]} is; record joint angles"
            " (q1,...,q6)."
        )
    poses = np.array([link_frames(arm, q)[link].GetAsMatrix4() for q in stream.joints])
    return ContinuousMotion(RobotStream(stream.time, poses, None, stream.robot))


def observed_point(model: BodyModel, X_CL: RigidTransform) -> RigidTransform:
    """Pose X_LR of the point that is observed on a body: its middle, z towards a scanner that sees the body at X_CL."""
    z = X_CL.inverse().translation() - model.middle
    return RigidTransform(RotationMatrix(frames_along(z / np.linalg.norm(z))), model.middle)


def see_body(
    data: MotionDataset,
    model: BodyModel,
    motion: ContinuousMotion,
    X_BC: RigidTransform,
    delay_s: float,
    *,
    tell: Callable[[float], None] = lambda fraction: None,
) -> tuple[ObservedFrames, RigidTransform, list[tuple[str, str]]]:
    """Track a body through a recording.

    Its middle and one of its directions as observations, their place X_LR on the body, and (id, reason) of frames
    without it.

    ``motion`` is the body's by the robot; ``delay_s`` is about how long before its arrival a frame was captured. The
    next frame is looked for where the robot and the frame before say. Raises InputError where no frame shows the body.
    """
    tracker = BodyTracker(model)
    X_LR: RigidTransform | None = None
    found: list[tuple[FrameTime, TrackedBody]] = []
    refused = list(data.refused)
    last: tuple[RigidTransform, RigidTransform] | None = None  # predicted and tracked
    for k, frame in enumerate(data.frames):
        tell(k / len(data.frames))
        X_BL = motion.poses(np.array([frame.arrival - delay_s]))[0]
        if not np.isfinite(X_BL).all():
            refused.append((frame.id, "The robot's stream has no data at its capture."))
            continue
        predicted = X_BC.inverse() @ as_transform(X_BL)
        guess = (
            predicted
            if last is None
            else RigidTransform(
                predicted.rotation(), predicted.translation() + last[1].translation() - last[0].translation()
            )
        )
        try:
            cloud = data.cloud(frame.id)
        except CloudError as e:
            refused.append((frame.id, e.reason))
            continue
        tracked = tracker.track(cloud, guess)
        if tracked is None:
            refused.append((frame.id, "Too little of the body shows."))
            continue
        last = predicted, tracked.X_CL
        X_LR = X_LR or observed_point(model, tracked.X_CL)
        found.append((frame, tracked))
    if X_LR is None:
        raise InputError("No frame shows the body where robot and calibration say it is.")
    return _observed(found, X_LR), X_LR, refused


def _observed(found: Sequence[tuple[FrameTime, TrackedBody]], X_LR: RigidTransform) -> ObservedFrames:
    frames = [f for f, _ in found]
    poses = [t.X_CL @ X_LR for _, t in found]
    device = np.array([np.nan if f.device is None else f.device for f in frames])
    return ObservedFrames(
        ids=tuple(f.id for f in frames),
        arrival=np.array([f.arrival for f in frames]),
        device=device if np.isfinite(device).any() else None,
        p_C=np.array([X.translation() for X in poses]),
        n_C=np.array([X.rotation().matrix()[:, 2] for X in poses]),
        covariance=np.array([t.covariance[3:, 3:] for _, t in found]),
        normal_sigma=np.array([float(np.sqrt(np.trace(t.covariance[:3, :3]) / 3.0)) for _, t in found]),
    )
