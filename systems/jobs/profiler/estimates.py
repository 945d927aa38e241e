"""Estimates of the profiler job from its profiles: X_FS by an edge, X_FS and the torch's tip by a sphere, a seam."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.profiler.depth_sign import with_sign
from weldcal.calibration.profiler.edge.features import extract_edge
from weldcal.calibration.profiler.edge.joint import EdgeEstimate, edge_joint
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.sphere.arc import find_arc
from weldcal.calibration.profiler.sphere.joint import Model, SphereEstimate, sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.jobs.profiler.config import ProfilerJob
from weldcal.systems.messages import Message
from weldcal.welding.seam.curve import SeamCurve

SMOOTHING_M = 0.004  # seam wavelengths below about six times this are treated as noise
FAR_SIGMAS = 4.0  # times the scatter about the smooth seam; points beyond it are rejected
TRIALS = 3  # rounds of outlier rejection
ARC_SIGMAS = 4.0  # largest distance of a sample that counts as part of the arc
# rms over 60 degrees to both sides: samples are noisy in z only, and an arc's normals are inclined to z
ARC_COSINE = 0.84
WINDOW_M = 0.012  # beyond the depth range and the sphere's radius; farther samples belong to another object
NEAREST_PERCENT = 3.0  # of a profile's depths; the share of spikes towards the sensor is smaller
WIDER_M = 0.5e-3  # noise may make a circle larger than the sphere


@dataclass(frozen=True, eq=False)
class TakenProfile(Message):
    """One profile with the joints (6,) rad that the controller reported at its capture time."""

    kind: str
    q: Array
    points: Array


@dataclass(frozen=True, eq=False)
class EdgeFound(Message):
    """X_FS from the edge; scans without an edge.

    Held-out scans: distance from the edge (n,) mm.
    """

    estimate: EdgeEstimate
    poses: FlangePoses
    points: Array
    lost: int
    held_out_mm: Array


@dataclass(frozen=True, eq=False)
class SphereFound(Message):
    """X_FS and the tip from the sphere.

    The selected model; held-out scans: rms distance (n,) mm of points from the sphere.
    """

    estimate: SphereEstimate
    data: SphereData
    model: str
    lost: int
    held_out_mm: Array


@dataclass(frozen=True, eq=False)
class SeamFound(Message):
    """Measured points of the groove's root (n, 3) m in B, the inlier mask (n,), and the smooth curve."""

    points_B: Array
    kept: NDArray[np.bool_]
    curve: SeamCurve
    lost: int


def flange_poses(arm: ArmModel, taken: list[Array]) -> FlangePoses:
    """X_BF of each joint vector, as arrays."""
    X = [forward_kinematics(arm, q) for q in taken]
    R, p = np.array([x.rotation().matrix() for x in X]), np.array([x.translation() for x in X])
    return FlangePoses(R.reshape(-1, 3, 3), p.reshape(-1, 3))


def feature_sigmas(p: RenderedProfiler, z_m: float) -> Array:
    """Sigma (2,) m of an edge point [x, z], from the sensor's data sheet."""
    x = float(np.hypot(p.pitch_m(z_m) / np.sqrt(12.0), 1e-3 * p.jitter_mm))
    few = np.sqrt(6e-3 / p.pitch_m(z_m))
    z = float(np.hypot(2e-3 * np.hypot(p.noise_mm, p.quantum_mm / np.sqrt(12.0)) / few, 1e-3 * p.jitter_mm))
    return np.array([x, z])


def sphere_sigmas(p: RenderedProfiler, job: ProfilerJob) -> SphereSigmas:
    """Prior sigmas of the sphere measurements; the error of a whole profile is added to the robot's error."""
    return SphereSigmas(
        sensor_m=1e-3 * ARC_COSINE * float(np.hypot(p.noise_mm, p.quantum_mm / np.sqrt(12.0))),
        # the error of a whole profile lies in its plane, and so do most of the normals
        robot_m=1e-3 * float(np.hypot(job.robot_sigma_mm, p.jitter_mm)),
        touch_m=1e-3 * job.robot_sigma_mm,
    )


def find_edge(arm: ArmModel, p: RenderedProfiler, job: ProfilerJob, taken: tuple[TakenProfile, ...]) -> EdgeFound:
    """Estimate X_FS from the scans of kind `scan`, and its errors at those of kind `held_out`.

    Raises:
        WeldcalError: the scans do not show one edge, or are not informative enough; see edge_joint.
    """
    sigmas = feature_sigmas(p, 0.5e-3 * (job.near_mm + job.far_mm))
    robot, width = 1e-3 * job.robot_sigma_mm, 1e-3 * job.straightedge.width_mm
    seen: dict[str, tuple[list[Array], list[Array]]] = {"scan": ([], []), "held_out": ([], [])}
    lost = 0
    for one in taken:
        try:
            point, _ = extract_edge(_one_background(one.points, width), "bar", "left")
        except FeatureNotFound:
            lost += 1
            continue
        seen[one.kind][0].append(one.q)
        seen[one.kind][1].append(point)
    turned = [_one_background(one.points * [1.0, -1.0], width) for one in taken]
    shown = len(taken) - lost
    if (heights := len(with_sign(turned, lambda p: extract_edge(p, "bar", "left")[0], "away")[0])) > 2 * shown:
        raise FeatureNotFound(
            f"z of the profiles grows towards the sensor: {heights} of {len(taken)} profiles show the straightedge so,"
            f" and {shown} with z away from it. Set profiler.heights_from_mm to the sensor's distance at z = 0."
        )
    _enough(len(seen["scan"][1]), taken, "the straightedge's edge")
    poses, points = flange_poses(arm, seen["scan"][0]), np.array(seen["scan"][1])
    e = edge_joint(poses.rotation, poses.translation, points, sigma_robot_m=robot, sigma_xz_m=sigmas)
    others = flange_poses(arm, seen["held_out"][0])
    held_out = np.array(seen["held_out"][1]).reshape(-1, 2)
    at = np.einsum("nij,nj->ni", others.rotation, _in_flange(e, held_out)) + others.translation
    away = at - e.point
    away -= np.outer(away @ e.direction, e.direction)
    return EdgeFound(e, poses, points, lost, 1e3 * np.linalg.norm(away, axis=1))


def _enough(found: int, taken: tuple[TakenProfile, ...], what: str) -> None:
    wanted = sum(one.kind == "scan" for one in taken)
    if found < 0.5 * wanted:
        raise FeatureNotFound(
            f"Only {found} of {wanted} profiles show {what}: check its position and the profiler's mounting."
        )


def _one_background(points: Array, behind_m: float) -> Array:
    """Return the profile with all samples far behind its nearest face at one depth: post and table have no edges."""
    p = points[np.isfinite(points).all(axis=1)]
    if not len(p):
        return p
    nearest = float(np.percentile(p[:, 1], NEAREST_PERCENT))
    return np.column_stack([p[:, 0], np.minimum(p[:, 1], nearest + behind_m)])


def _in_flange(e: EdgeEstimate, points: Array) -> Array:
    return np.asarray(
        np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]) @ e.rotation.T + e.translation
    )


def find_sphere(
    arm: ArmModel,
    p: RenderedProfiler,
    job: ProfilerJob,
    taken: tuple[TakenProfile, ...],
    touches: tuple[Array, ...] = (),
    tip: Array | None = None,
    first: SphereEstimate | None = None,
) -> SphereFound:
    """Estimate X_FS from the sphere's profiles; with touches (joints (6,) each) also the torch's tip.

    Raises:
        WeldcalError: the scans do not show the sphere, or are not informative enough; see sphere_joint.
    """
    radius, sigmas = 1e-3 * job.ball.radius_mm, sphere_sigmas(p, job)
    arcs: dict[str, tuple[list[Array], list[Array]]] = {"scan": ([], []), "held_out": ([], [])}
    lost = 0
    for one in taken:
        window = one.points[one.points[:, 1] < 1e-3 * job.far_mm + radius + WINDOW_M]  # without the background
        try:
            mask, circle, _ = find_arc(window, radius, tolerance_m=ARC_SIGMAS * sigmas.sensor_m)
        except FeatureNotFound:
            lost += 1
            continue
        # a run of samples that is not a section of this sphere: a face, or an edge of another object
        if circle[2] > radius + WIDER_M:
            lost += 1
            continue
        arcs[one.kind][0].append(one.q)
        arcs[one.kind][1].append(window[mask])
    _enough(len(arcs["scan"][1]), taken, "an arc of the sphere")
    felt = flange_poses(arm, list(touches)) if touches else None
    data = SphereData(
        poses=flange_poses(arm, arcs["scan"][0]),
        profiles=arcs["scan"][1],
        radius_m=radius,
        touches=felt,
        tip=tip if touches else None,
    )
    model: Model = "rigid"
    e = sphere_joint(data, model, sigmas, first)
    if touches:
        model, e = _better_model(data, sigmas, e)
    others = flange_poses(arm, arcs["held_out"][0])
    rms = []
    for R, t, arc in zip(others.rotation, others.translation, arcs["held_out"][1], strict=True):
        distance = np.linalg.norm(e.points_F(arc) @ R.T + t - e.center, axis=1) - radius
        rms.append(1e3 * float(np.sqrt(np.mean(distance**2))))
    return SphereFound(e, data, model, lost, np.array(rms))


def _better_model(data: SphereData, sigmas: SphereSigmas, rigid: SphereEstimate) -> tuple[Model, SphereEstimate]:
    """Select the model, rigid or affine, with its estimate.

    The affine one is taken where it predicts held-out scans better by more than 2 %.
    """
    names: tuple[Model, ...] = ("rigid", "affine")
    estimates = {name: sphere_joint(data, name, sigmas, rigid) for name in names}
    errors = {}
    for name in names:
        off = []
        for k, arc in enumerate(data.profiles):
            e = sphere_joint(data.without(k), name, sigmas, estimates[name])
            at = e.points_F(arc) @ data.poses.rotation[k].T + data.poses.translation[k] - e.center
            off.append(float(np.mean((np.linalg.norm(at, axis=1) - data.radius_m) ** 2)))
        errors[name] = float(np.sqrt(np.mean(off)))
    best: Model = "affine" if errors["affine"] < 0.98 * errors["rigid"] else "rigid"
    return best, estimates[best]


def find_seam(
    arm: ArmModel, estimate: SphereEstimate, drawn: SeamCurve, taken: tuple[TakenProfile, ...], every_m: float
) -> SeamFound:
    """Measure the groove's root in B with the calibration.

    Points of all passes, merged along the nominal seam and smoothed.

    Points far from their neighbours are rejected.

    Raises:
        WeldcalError: too few profiles show a groove.
    """
    points, lost = [], 0
    for one in taken:
        try:
            root = groove_features(one.points).points[1:2]
        except FeatureNotFound:
            lost += 1
            continue
        points.append(forward_kinematics(arm, one.q).multiply(estimate.points_F(root)[0]))
    if len(points) < max(8, 0.5 * len(taken)):
        raise FeatureNotFound(
            f"Only {len(points)} of {len(taken)} profiles show the groove: check the workpiece's pose."
        )
    p = np.array(points)
    place = np.round(drawn.project(p) / every_m).astype(int)
    up = drawn.ups[0]
    smoothing = SMOOTHING_M**4 / every_m
    kept = np.ones(len(p), bool)
    curve = SeamCurve.from_points(_means(p, place), up, smoothing)
    for _ in range(TRIALS):
        s = curve.project(p)
        off = np.linalg.norm(p - curve.position(s), axis=1)
        limit = FAR_SIGMAS * 1.2 * float(np.median(off))  # median of a Rayleigh distance is 1.18 sigma
        new = off < max(limit, 1e-4)
        if (new == kept).all():
            break
        kept = new
        curve = SeamCurve.from_points(_means(p[kept], place[kept]), up, smoothing)
    return SeamFound(p, kept, curve, lost)


def _means(p: Array, place: NDArray[np.int_]) -> Array:
    """Return the mean point (m, 3) of each place, in the order of the places."""
    return np.array([p[place == k].mean(axis=0) for k in np.unique(place)])


def pose_sigmas(error: RigidTransform, covariance: Array) -> tuple[Array, float]:
    """Return an error exp(w), t (estimate to truth, in F) in sigmas of the prediction.

    Each of its six parts, and w^T C^-1 w of all.
    """
    angle = error.rotation().ToAngleAxis()
    e = np.concatenate([angle.angle() * np.asarray(angle.axis()), error.translation()])
    return e / np.sqrt(np.diag(covariance)), float(e @ np.linalg.solve(covariance, e))
