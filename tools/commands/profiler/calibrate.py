"""`weldcal profiler`: calibrates from a file by an edge or a sphere, maps a seam and writes the result."""

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.results import matrix4
from weldcal.calibration.errors import ArcNotFound, FeatureNotFound
from weldcal.calibration.profiler.arm_errors import DhArm
from weldcal.calibration.profiler.edge.features import Kind, extract_edge
from weldcal.calibration.profiler.edge.joint import EdgeEstimate
from weldcal.calibration.profiler.edge.linear import edge_linear
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats, rotation_groups
from weldcal.calibration.profiler.plan import (
    Field,
    plan_edge_poses,
    plan_sphere_poses,
    sample_edge_poses,
    sample_sphere_poses,
)
from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.calibration.profiler.result import ProfilerEstimate, believed_covariance
from weldcal.calibration.profiler.sphere.arc import find_arc, fit_circle
from weldcal.calibration.profiler.sphere.joint import Model, SphereEstimate, choose_model, sphere_joint
from weldcal.calibration.profiler.sphere.linear import (
    compensate,
    fit_touch_sphere,
    sphere_center,
    sphere_linear,
    wrong_sides,
)
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.calibration.profiler.sphere.radius import SCALE_SIGMAS, check_radius
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.commands.profiler.files import ProfilerFile
from weldcal.tools.commands.profiler.noise import Sigmas, edge_by_noise

CANDIDATES = 300
POORLY = 1.5  # reduced chi-square from which another convention of the poses is tried
FAR_FROM_EDGE_MM = 1.0
RADIUS_OFF_M = 0.1e-3
_LONGEST_TORCH_M = 10.0
ALL_ARC_M = 0.5e-3  # a profile off one circle by less holds the sphere only
Estimate = TypeVar("Estimate", EdgeEstimate, SphereEstimate)
MODELS = ("auto", "rigid", "affine", "affine+joints")
FEATURES = ("bar", "step", "apex")


def calibrate_edge(
    file: ProfilerFile,
    sigmas: Sigmas,
    *,
    method: str = "joint",
    feature: str = "",
    side: str = "left",
    plan: int = 0,
    seed: int = 0,
) -> tuple[ProfilerRecord, dict[str, Any]]:
    """X_FS from one straight edge: points, or raw profiles with the kind of edge that they show."""
    if method not in ("joint", "paper"):
        raise InputError(f"The method is joint or paper, not '{method}'.")
    if side not in ("left", "right"):
        raise InputError(f"The side is left or right, not '{side}'.")
    poses = cast(FlangePoses, file.poses())
    points, lost = edge_points(file, feature, side)
    keep = np.asarray(np.isfinite(points).all(axis=1), bool)
    check_number(poses, points.shape, "profile points [x, z]", (2,))
    poses, points = poses[keep], points[keep]
    found: dict[str, Any] = {"scans": len(keep), "without_feature": lost}
    if method == "paper":
        group = file.arrays["group"][keep] if "group" in file.arrays else rotation_groups(poses)
        linear = edge_linear(poses.rotation, poses.translation, points, group)
        found |= {"mean_distance_mm": 1e3 * float(linear.distances_m.mean())}
        if found["mean_distance_mm"] > FAR_FROM_EDGE_MM:
            found["warnings"] = [
                f"The points lie {found['mean_distance_mm']:.1f} mm from one edge on average. Scan one edge only, and check unit and poses."
            ]
        record = ProfilerRecord(
            method="edge, linear",
            rotation=linear.rotation,
            translation=linear.translation,
            figures=found,
            data_sha256=file.digest,
        )
        return record, found
    if not sigmas.stated and "sigma" in file.arrays:
        robot, x, z = (float(v) for v in file.arrays["sigma"])
        sigmas = Sigmas(robot, x, z)
    e, sigmas = edge_by_noise(poses, points, sigmas)
    e, xz = _widened(e), np.array([sigmas.x_m, sigmas.z_m])
    found["sigmas_mm"] = {"robot": 1e3 * sigmas.robot_m, "x": 1e3 * sigmas.x_m, "z": 1e3 * sigmas.z_m}
    found |= _figures(e) | {"outlier_scans": [int(k) for k in np.flatnonzero(keep)[~e.inliers]]}
    if plan:
        state = EdgeState(e.rotation, e.translation, e.point, e.direction)
        z = points[e.inliers, 1]
        field = Field(
            max(0.005, float(np.abs(points[e.inliers, 0]).max())), float(z.min()) - 1e-9, float(z.max()) + 2e-3
        )
        candidates = sample_edge_poses(state, CANDIDATES, seed, field)
        chosen = plan_edge_poses(
            state, poses[e.inliers], candidates, plan, sigma_robot_m=sigmas.robot_m, sigma_xz_m=xz, field=field
        )
        found["next_poses"] = _next(candidates, chosen.chosen, chosen.rms_m)
    return ProfilerRecord.of("edge, joint", e, found, file.digest), found


def edge_points(file: ProfilerFile, feature: str, side: str) -> tuple[Floats, list[int]]:
    """Points (n, 2) m, not finite where a profile shows no edge, and the numbers of those."""
    if not feature:
        return file.needed(
            "points", "the edge's point [x, z] in each profile (with raw profiles, name --feature bar, step or apex)"
        ), []
    if feature not in FEATURES:
        raise InputError(f"The feature is bar, step or apex, not '{feature}'.")
    if file.profiles is None:
        raise InputError("The file has no profiles to detect an edge in. Omit --feature.")
    points, lost = np.full((len(file.profiles), 2), np.nan), []
    for k, p in enumerate(file.profiles):
        try:
            points[k], _ = extract_edge(p, cast(Kind, feature), "left" if side == "left" else "right")
        except FeatureNotFound:
            lost.append(k)
    return points, lost


def sphere_data(
    file: ProfilerFile,
    *,
    radius_m: float | None,
    arm: str = "",
    tip_m: Floats | None = None,
    touches: ProfilerFile | None = None,
    lost: list[int] | None = None,
    seed: int = 0,
) -> SphereData:
    """A file's measurements of a sphere: the detected arcs, with touches and joints where there are any.

    Scans without an arc are not used and their numbers added to `lost`; without that list they are refused.
    """
    if file.profiles is None:
        raise InputError("The file has no 'profiles' of the sphere. Give (n, m, 2), or 'xz' with the lengths 'n'.")
    radius = radius_m if radius_m is not None else float(file.needed("radius", "the sphere's (or give --radius in mm)"))
    if not 1e-3 <= radius <= 1.0:
        raise InputError(f"A sphere of {1e3 * radius:.3g} mm radius cannot be used. Give --radius in mm.")
    felt = touches.poses() if touches is not None else file.poses("touch_")
    tip = tip_m if tip_m is not None else file.arrays.get("tip")
    if felt is not None and tip is None:
        raise InputError("There are touches but no tip. Give its position in the flange frame as --tip x,y,z in mm.")
    table = DhArm.of(load_arm(arm)) if arm else file.arm()
    poses = cast(FlangePoses, file.poses())
    check_number(poses, (len(file.profiles),), "profiles")
    profiles, kept = [], []
    for k, p in enumerate(file.profiles):
        try:
            profiles.append(_arc(p, radius, seed))
            kept.append(k)
        except ArcNotFound as e:
            if lost is None:
                raise ArcNotFound(f"Scan {k} shows no arc of the sphere. Remove it from the file.") from e
            lost.append(k)
    if not kept:
        raise ArcNotFound("No scan shows an arc of the sphere. Check the radius, the unit and which column is z.")
    q = file.arrays.get("q")
    if q is not None:
        check_number(poses, (len(q),), "joint vectors q")
    return SphereData(
        poses=poses[np.array(kept)],
        profiles=profiles,
        radius_m=radius,
        touches=felt,
        tip=tip if felt is not None else None,
        arm=table,
        q=None if q is None else q[kept],
        touch_q=file.arrays.get("touch_q"),
    )


def parse_tip(text: str) -> Floats | None:
    """The tip (3,) m of the option --tip, "x,y,z" in mm; None where it is empty.

    Raises:
        InputError: not three numbers.
    """
    if not text:
        return None
    try:
        x, y, z = (1e-3 * float(v) for v in text.split(","))
    except ValueError as e:
        raise InputError(f"The tip is three numbers in mm with commas between, as --tip 0,0,150, not '{text}'.") from e
    tip = np.array([x, y, z])
    if not (np.abs(tip) <= _LONGEST_TORCH_M).all():
        raise InputError(f"The tip lies within {1e3 * _LONGEST_TORCH_M:.0f} mm of the flange; '{text}' does not.")
    return tip


def check_number(poses: FlangePoses, shape: tuple[int, ...], what: str, each: tuple[int, ...] = ()) -> None:
    """Check that an array of this shape has an entry (of the shape ``each``) for every pose. Raises InputError."""
    if shape != (len(poses), *each):
        found = str(shape[0]) if len(shape) == 1 else f"an array of shape {shape}"
        raise InputError(f"{len(poses)} poses need {len(poses)} {what}, not {found}.")


def _arc(profile: Floats, radius_m: float, seed: int) -> Floats:
    """The sphere's points of a profile: all of them where they form one arc, else those detected."""
    p = profile[np.isfinite(profile).all(axis=1)]
    if len(p) >= 5:
        circle, rms = fit_circle(p)
        if rms < ALL_ARC_M and circle[2] < 1.05 * radius_m and len(np.unique(p[:, 1] < circle[1])) == 1:
            return p
    return np.asarray(profile[find_arc(profile, radius_m, seed=seed)[0]])


def calibrate_sphere(
    data: SphereData, digest: str, sigmas: Sigmas, *, model: str = "auto", plan: int = 0, seed: int = 0
) -> tuple[ProfilerRecord, dict[str, Any]]:
    """X_FS from a sphere in any poses, by the model with the smallest held-out error (or the one named)."""
    if model not in MODELS:
        raise InputError(f"The model is one of {', '.join(MODELS)}, not '{model}'.")
    s = SphereSigmas(sensor_m=sigmas.z_m, robot_m=sigmas.robot_m)
    found: dict[str, Any] = {"scans": len(data.poses), "touches": 0 if data.touches is None else len(data.touches)}
    scans = SphereData(poses=data.poses, profiles=data.profiles, radius_m=data.radius_m)
    rigid = _rigid(scans, s)
    check_radius(scans, s, rigid)
    _refuse_inverse_poses(scans, rigid, s)
    chosen = cast(Model, model)
    if model == "auto":
        full = data.arm is not None and data.q is not None and (data.touches is None or data.touch_q is not None)
        choice = choose_model(data if full else _without_arm(data), s)
        chosen = choice.model
        found["left_out_rms_mm"] = {name: 1e3 * v for name, v in choice.left_out_m.items()}
        found["model_reason"] = choice.reason
    e = _widened(sphere_joint(data, chosen, s))
    found |= {"model": chosen} | _figures(e)
    found["wrong_scans"] = list(e.wrong_poses)
    # to first order, and so only where it is near the stated one
    known = abs(e.radius_change_m) <= SCALE_SIGMAS * s.affine * data.radius_m
    found["radius_of_profiles_mm"] = 1e3 * (data.radius_m + e.radius_change_m) if known else None
    found["warnings"] = _warnings(e, data, s)
    if plan:
        if np.median([fit_circle(p)[0][1] - np.median(p[:, 1]) for p in data.profiles]) < 0.0:
            raise InputError(
                "Planning needs z pointing away from the sensor. Change the sign of z, and of x to keep the frame right-handed, in the file."
            )
        seen = np.vstack(data.profiles)
        near, far = (float(v) for v in np.percentile(seen[:, 1], [1.0, 99.0]))
        field = Field(float(np.percentile(np.abs(seen[:, 0]), 99.0)), near, max(far, near + 5e-3))
        candidates = sample_sphere_poses(e.rotation, e.translation, e.center, data.radius_m, CANDIDATES, seed, field)
        best = plan_sphere_poses(
            e.rotation, e.translation, e.center, data.radius_m, data.poses, candidates, plan, sigmas=s, field=field
        )
        found["next_poses"] = _next(candidates, best.chosen, best.rms_m)
    arm = data.arm if chosen == "affine+joints" else None
    return ProfilerRecord.of(f"sphere, {chosen}", e, found, digest, arm), found


def _widened(e: Estimate) -> Estimate:
    return replace(e, covariance=believed_covariance(e))


def _refuse_inverse_poses(scans: SphereData, rigid: SphereEstimate | None, s: SphereSigmas) -> None:
    """Refuses poses of the base in the flange instead of the flange in the base.

    Raises:
        InputError: the inverse poses fit the profiles far better.
    """
    chi2 = float("inf") if rigid is None else rigid.reduced_chi2
    if chi2 < POORLY:
        return
    R, p = scans.poses.rotation, scans.poses.translation
    inverse = FlangePoses(np.swapaxes(R, 1, 2), -np.einsum("nji,nj->ni", R, p))
    other = _rigid(replace(scans, poses=inverse), s)
    if other is not None and other.reduced_chi2 < 0.4 * chi2:
        raise InputError(
            "The inverses of the poses fit the profiles. Give the flange in the base, not the base in the flange."
        )


def _rigid(scans: SphereData, s: SphereSigmas) -> SphereEstimate | None:
    """The rigid model's estimate; None where it refuses."""
    try:
        return sphere_joint(scans, "rigid", s)
    except WeldcalError:
        return None


def _warnings(e: SphereEstimate, data: SphereData, s: SphereSigmas) -> list[str]:
    said = []
    known = abs(e.radius_change_m) <= SCALE_SIGMAS * s.affine * data.radius_m
    if known and abs(e.radius_change_m) > max(4.0 * e.radius_sigma_m, RADIUS_OFF_M):
        said.append(
            f"The profiles show a sphere of {1e3 * (data.radius_m + e.radius_change_m):.2f} mm instead of "
            f"{1e3 * data.radius_m:.2f}. Check the radius and the profiler's scale."
        )
    if e.tip is not None and data.tip is not None and np.linalg.norm(e.tip - data.tip) > 3.0 * s.tip_m:
        said.append(
            f"The touches put the tip {1e3 * float(np.linalg.norm(e.tip - data.tip)):.0f} mm from its given position. Check --tip."
        )
    return said


def _without_arm(data: SphereData) -> SphereData:
    return SphereData(
        poses=data.poses, profiles=data.profiles, radius_m=data.radius_m, touches=data.touches, tip=data.tip
    )


def calibrate_compensate(
    file: ProfilerFile, data: SphereData, *, solve_tip: bool = False
) -> tuple[ProfilerRecord, dict[str, Any]]:
    """The sphere paper's method: centres on the sides given in the file, two linear steps, compensation by touches."""
    sign = file.needed(
        "sign", "on which side (+1 or -1, along y) of the scan plane each scan has the centre; 'sphere' needs none"
    )
    if data.touches is None or data.tip is None:
        raise InputError(
            "The compensation needs touches. Give 'touch_T' and 'tip' in the file, or --touches and --tip."
        )
    check_number(data.poses, sign.shape, "signs")
    check_radius(data, SphereSigmas(), None)
    if "translated" in file.arrays:
        translated = file.arrays["translated"] > 0.5
    else:
        group = rotation_groups(data.poses)
        translated = np.asarray(group == np.bincount(group).argmax(), bool)
    centers = np.array(
        [sphere_center(fit_circle(p)[0], data.radius_m, s) for p, s in zip(data.profiles, sign, strict=True)]
    )
    R, t = data.poses.rotation, data.poses.translation
    linear = sphere_linear(R, t, centers, translated)
    felt = fit_touch_sphere(
        data.touches.rotation, data.touches.translation, data.tip, data.radius_m, solve_tip=solve_tip
    )
    best = compensate(linear, R, t, centers, felt.center)

    def off(rotation: Floats, translation: Floats) -> float:
        at = np.einsum("nij,nj->ni", R, centers @ rotation.T + translation) + t
        return 1e3 * float(np.linalg.norm(at - felt.center, axis=1).mean())

    found = {
        "scans": len(R),
        "touches": len(data.touches),
        "touch_rms_mm": 1e3 * felt.rms_m,
        "centre_before_mm": off(linear.rotation, linear.translation),
        "centre_after_mm": off(best.rotation, best.translation),
        "wrong_sides": list(wrong_sides(R, t, centers, translated)),
    }
    record = ProfilerRecord(
        method="sphere, linear and compensated",
        rotation=best.rotation,
        translation=best.translation,
        tip=felt.tip,
        figures=found,
        data_sha256=file.digest,
    )
    return record, found


def _figures(e: ProfilerEstimate) -> dict[str, Any]:
    turn, shift = np.trace(e.covariance[:3, :3]), np.trace(e.covariance[3:, 3:])
    figures: dict[str, Any] = {
        "sigma_rotation_deg": float(np.degrees(np.sqrt(turn))),
        "sigma_translation_mm": 1e3 * float(np.sqrt(shift)),
        "rms_mm": 1e3 * e.rms_m,
        "reduced_chi2": e.reduced_chi2,
        "condition": e.condition,
    }
    if isinstance(e, EdgeEstimate):
        figures["inliers"] = int(e.inliers.sum())
    return figures


def _next(candidates: FlangePoses, chosen: tuple[int, ...], rms_m: Floats) -> dict[str, Any]:
    turns = Rotation.from_matrix(candidates.rotation).as_rotvec()
    return {
        "poses": [[float(v) for v in (*candidates.translation[k], *turns[k])] for k in chosen],
        "rms_before_and_after_each_mm": [1e3 * float(v) for v in rms_m],
    }


def write_calibration(record: ProfilerRecord, folder: Path) -> dict[str, Any]:
    """Writes profiler.yaml and X_FS.json; returns the pose for the JSON object."""
    save_record(record, folder)
    return {
        "X_FS": matrix4(RigidTransform(RotationMatrix.ProjectToRotationMatrix(record.rotation), record.translation))
    }
