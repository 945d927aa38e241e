"""weldcal profiler edge: the pose on the flange from points of one straight edge."""

from collections.abc import Mapping
from typing import Annotated, Any, cast

import numpy as np

from weldcal.calibration.errors import FeatureNotFound, InconsistentData
from weldcal.calibration.profiler.edge.features import Kind, extract_edge
from weldcal.calibration.profiler.edge.joint import EdgeEstimate, edge_joint
from weldcal.calibration.profiler.edge.linear import edge_linear
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats, rotation_groups
from weldcal.calibration.profiler.plan import Field, plan_edge_poses, sample_edge_poses
from weldcal.calibration.profiler.reading_choice import edge_fit
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.files import Measurements, PosesStated, read_profiler_file
from weldcal.tools.commands.profiler.result import (
    CANDIDATES,
    ROBOT_SIGMA,
    Z_SIGMA,
    FileArgument,
    FormOption,
    PitchOption,
    PlanOption,
    PosesOption,
    SetOption,
    Sigmas,
    TrialOption,
    UnitOption,
    check_number,
    figures_of,
    finish,
    next_poses,
    outcome_of,
    widened,
    with_warnings,
)
from weldcal.tools.report.first_screen import check_limit

FAR_FROM_EDGE_MM = 1.0
FEATURES = ("bar", "step", "apex")
STARTS = (1.0, 2.0, 4.0)  # times the usual sigmas, for noisier sensors
MOST = 6.0
SETTLED = 1.15  # residuals up to this many times the sigmas agree with them
FOLDS = 5

ESTIMATED = "the file's, else estimated from the points, at least {}"


@command("profiler edge", short_help="Calibrate by one straight edge.")
def edge(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    poses: PosesOption = None,
    robot_form: FormOption = "",
    pitch: PitchOption = None,
    method: Annotated[str, option("--method", "M", "joint, or paper (the published linear method).")] = "joint",
    feature: Annotated[str, option("--feature", "KIND", "For raw profiles: bar, step or apex.")] = "",
    side: Annotated[str, option("--side", "S", "End of the near face: left or right.")] = "left",
    sigma_robot: Annotated[
        float | None, option("--sigma-robot", "MM", ROBOT_SIGMA, show_default=ESTIMATED.format(0.03))
    ] = None,
    sigma_x: Annotated[
        float | None,
        option(
            "--sigma-x",
            "MM",
            "Standard deviation of a point along the laser line.",
            show_default=ESTIMATED.format(0.05),
        ),
    ] = None,
    sigma_z: Annotated[float | None, option("--sigma-z", "MM", Z_SIGMA, show_default=ESTIMATED.format(0.06))] = None,
    plan: PlanOption = 0,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by points of one straight edge, from any poses. Needs no initial
    guess."""
    check_limit(limit_mm)
    given, usual = (sigma_robot, sigma_x, sigma_z), (0.03, 0.05, 0.06)
    robot, x, z = (1e-3 * (u if v is None else v) for v, u in zip(given, usual, strict=True))
    sigmas = Sigmas(robot, x, z, stated=any(v is not None for v in given))
    data = read_profiler_file(
        file, unit=unit, dataset=dataset, trial=trial, stated=PosesStated(poses, robot_form, pitch)
    )
    data = _decided(data, feature, side)
    record, found = calibrate_edge(data, sigmas, method=method, feature=feature, side=side, plan=plan, seed=call.seed)
    points, _ = edge_points(data, feature, side)
    keep = np.asarray(np.isfinite(points).all(axis=1), bool)
    held = np.zeros(0)
    if "sigmas_mm" in found:  # the paper's method has no sigmas, and nothing is left out
        held = edge_held_out(cast(FlangePoses, data.poses())[keep], points[keep], found["sigmas_mm"])
    folder = call.folder("profiler", file.stem)
    made, summary = finish(record, with_warnings(data, found), points[keep], held, file.name, folder, limit_mm)
    return outcome_of(call, summary, made)


def _decided(data: Measurements, feature: str, side: str) -> Measurements:
    """Return the measurements with the reading of the poses that the edge selects."""
    if len(data.readings) < 2:
        return data
    points, _ = edge_points(data, feature, side)
    keep = np.asarray(np.isfinite(points).all(axis=1), bool)
    if points.shape != (len(data.readings[0].X), 2):
        return data
    fit = edge_fit(points[keep])
    return data.decided(lambda poses: fit(poses[keep]), "edge")


def calibrate_edge(
    file: Measurements,
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
    if feature and len(keep) and not keep.any():
        other = ", ".join(f"--feature {kind}" for kind in FEATURES if kind != feature)
        raise InputError(
            f"None of the {len(keep)} profiles shows the feature {feature} with its near face on the {side}. "
            f"Try --side {'right' if side == 'left' else 'left'}, or {other}."
        )
    check_number(poses, points.shape, "profile points [x, z]", (2,))
    poses, points = poses[keep], points[keep]
    found: dict[str, Any] = {"scans": len(keep), "without_feature": lost}
    if method == "paper":
        group = file.arrays["group"][keep] if "group" in file.arrays else rotation_groups(poses)
        linear = edge_linear(poses.rotation, poses.translation, points, group)
        found |= {"mean_distance_mm": 1e3 * float(linear.distances_m.mean())}
        if found["mean_distance_mm"] > FAR_FROM_EDGE_MM:
            found["warnings"] = [
                f"The points lie {found['mean_distance_mm']:.1f} mm from one edge on average. Scan one edge only, and"
                " check unit and poses."
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
    e, xz = widened(e), np.array([sigmas.x_m, sigmas.z_m])
    found["sigmas_mm"] = {"robot": 1e3 * sigmas.robot_m, "x": 1e3 * sigmas.x_m, "z": 1e3 * sigmas.z_m}
    found |= figures_of(e) | {"outlier_scans": [int(k) for k in np.flatnonzero(keep)[~e.inliers]]}
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
        found["next_poses"] = next_poses(candidates, chosen.chosen, chosen.rms_m)
    return ProfilerRecord.of("edge, joint", e, found, file.digest), found


def edge_points(file: Measurements, feature: str, side: str) -> tuple[Floats, list[int]]:
    """Points (n, 2) m, not finite where a profile shows no edge, and the numbers of those."""
    if not feature:
        return (
            file.needed(
                "points",
                "the edge's point [x, z] in each profile (with raw profiles, name --feature bar, step or apex)",
            ),
            [],
        )
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


def edge_by_noise(poses: FlangePoses, points: Floats, sigmas: Sigmas) -> tuple[EdgeEstimate, Sigmas]:
    """Return the joint estimate, and the sigmas that it uses.

    Where none are stated, the usual ones are scaled up together until they agree with the residuals: otherwise good
    points of a noisier sensor would be rejected as outliers, which biases the estimate and makes its sigma too small. A
    larger scale is kept only if no inlier is lost.

    Raises:
        InconsistentData: the points lie on no edge, with the enlarged sigmas either; others as edge_joint.
    """

    def fit(factor: float) -> EdgeEstimate:
        s = sigmas.times(factor)
        return edge_joint(
            poses.rotation, poses.translation, points, sigma_robot_m=s.robot_m, sigma_xz_m=np.array([s.x_m, s.z_m])
        )

    if sigmas.stated:
        return fit(1.0), sigmas
    refused: InconsistentData | None = None
    for factor in STARTS:
        try:
            e = fit(factor)
            break
        except InconsistentData as problem:
            refused = refused or problem
    else:
        assert refused is not None
        raise refused
    for _ in range(8):
        larger = factor * float(np.sqrt(e.reduced_chi2))
        if not SETTLED * factor < larger < MOST:
            break
        try:
            other = fit(larger)
        except WeldcalError:
            break
        if other.inliers.sum() < e.inliers.sum():
            break
        e, factor = other, larger
    return e, sigmas.times(factor)


def edge_held_out(poses: FlangePoses, points: Floats, sigmas_mm: Mapping[str, float]) -> Floats:
    """Compute distances (n,) mm of points (n, 2) m from the edge of a calibration without their scans; NaN: none.

    A fifth of the scans is left out at a time.
    """
    found, n = np.full(len(points), np.nan), len(points)
    for fold in range(FOLDS):
        out = np.arange(n) % FOLDS == fold
        try:
            e = edge_joint(
                poses.rotation[~out],
                poses.translation[~out],
                points[~out],
                sigma_robot_m=1e-3 * sigmas_mm["robot"],
                sigma_xz_m=1e-3 * np.array([sigmas_mm["x"], sigmas_mm["z"]]),
            )
        except WeldcalError:  # the others do not determine the pose
            continue
        p_S = np.column_stack([points[out, 0], np.zeros(out.sum()), points[out, 1]])
        p_F = p_S @ e.rotation.T + e.translation
        away = np.einsum("nij,nj->ni", poses.rotation[out], p_F) + poses.translation[out] - e.point
        away -= np.outer(away @ e.direction, e.direction)
        found[out] = 1e3 * np.linalg.norm(away, axis=1)
    return found
