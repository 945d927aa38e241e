"""weldcal profiler edge: the pose on the flange from points of one straight edge."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import InconsistentData
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import log_rotation
from weldcal.calibration.profiler.combined.scans import EXACT, EdgeScans, edge_scans
from weldcal.calibration.profiler.combined.solve import JointEstimate, solve_joint
from weldcal.calibration.profiler.depth_sign import WORDS, SignFit, beats, choose_sign, signs_to_try, with_sign
from weldcal.calibration.profiler.edge.features import Kind, extract_edge, near_face
from weldcal.calibration.profiler.edge.joint import OUTLIER, EdgeEstimate, edge_joint, with_sensor
from weldcal.calibration.profiler.edge.linear import edge_linear
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats, rotation_groups
from weldcal.calibration.profiler.plan import Field, plan_edge_poses, sample_edge_poses
from weldcal.calibration.profiler.reading_choice import edge_fit
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.result import believed_covariance
from weldcal.calibration.profiler.sensor import SensorCorrection
from weldcal.calibration.profiler.sphere.model import corrected
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.files import Measurements
from weldcal.tools.commands.profiler.result import (
    CANDIDATES,
    FileArgument,
    PlanOption,
    PosesOption,
    Sigmas,
    UnitOption,
    check_number,
    figures_of,
    finish,
    next_poses,
    outcome_of,
    read_measurements,
    stated_correction,
    widened,
    with_warnings,
)
from weldcal.tools.report.first_screen import check_limit

FAR_FROM_EDGE_MM = 1.0
FEATURES = ("bar", "step", "apex")
CORNERS = FEATURES[:2]  # whose point a break moves
STARTS = (1.0, 2.0, 4.0)  # times the usual sigmas, for noisier sensors
MOST = 6.0
SETTLED = 1.15  # residuals up to this many times the sigmas agree with them
FOLDS = 5
ALIKE = 0.9  # a choice: share of pairs of estimates of one pose that are closer

SIGMAS_MM = {"sigma-robot": 0.03, "sigma-x": 0.05, "sigma-z": 0.06}


@command(
    "profiler edge",
    keys=("robot-form", "set", "trial", "pitch", "side", "z", "sensor-correction", *SIGMAS_MM),
    short_help="Calibrate by one straight edge.",
)
def edge(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    poses: PosesOption = None,
    method: Annotated[str, option("--method", "M", "joint, or paper (the published linear method).")] = "joint",
    feature: Annotated[str, option("--feature", "KIND", "For raw profiles: bar, step or apex.")] = "",
    plan: PlanOption = 0,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by points of one straight edge, from any poses. Needs no initial
    guess."""
    check_limit(limit_mm)
    r, x, depth = (1e-3 * call.reading.get(key, usual) for key, usual in SIGMAS_MM.items())
    sigmas = Sigmas(r, x, depth, stated=any(key in call.reading for key in SIGMAS_MM))
    data = read_measurements(call, file, unit, poses)
    if not sigmas.stated and "sigma" in data.arrays:
        r, x, depth = (float(v) for v in data.arrays["sigma"])
        sigmas = Sigmas(r, x, depth)
    sensor = stated_correction(call, data.profiles or [data.arrays.get("points", np.empty((0, 2)))])
    shown = edge_shown(data, sigmas, feature, call.reading.get("side", "left"), call.reading.get("z", ""), sensor)
    record, found = calibrate_edge(shown, sigmas, method=method, plan=plan, seed=call.seed)
    data, held = shown.file, np.zeros(0)
    if "sigmas_mm" in found:  # the paper's method has no sigmas, and nothing is left out
        held = edge_held_out(*shown.seen(), found["sigmas_mm"])
    folder = call.folder("profiler", file.stem)
    made, summary = finish(record, with_warnings(data, found), shown.points, held, file.name, folder, limit_mm)
    return outcome_of(call, summary, made)


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeShown:
    """Points (n, 2) m of the edge, NaN where a profile shows none, in measurements with one reading of the poses.

    Attributes:
        lost: numbers of the profiles without the edge.
        fit: the estimate by these points with its sigmas, where the choice of the sign made one.
        words: values of the JSON object on the sign of z.
        sensor: the correction of the points, if there is one.
        feature, side: of raw profiles; an empty feature: the points are the file's own.
    """

    file: Measurements
    points: Floats
    lost: list[int] = field(default_factory=list)
    fit: tuple[EdgeEstimate, Sigmas] | None = None
    words: Mapping[str, str] = field(default_factory=dict)
    sensor: SensorCorrection | None = None
    feature: str = ""
    side: Literal["left", "right"] = "left"

    @property
    def keep(self) -> NDArray[np.bool_]:
        """Profiles (n,) that show the edge."""
        return np.asarray(np.isfinite(self.points).all(axis=1), bool)

    def seen(self) -> tuple[FlangePoses, Floats]:
        """Poses and corrected points (k, 2) m of the profiles that show the edge."""
        poses = cast(FlangePoses, self.file.poses())
        check_number(poses, self.points.shape, "profile points [x, z]", (2,))
        return poses[self.keep], self._corrected()

    def _corrected(self) -> Floats:
        p, sensor = self.points[self.keep], self.sensor
        return p if sensor is None else corrected(p, sensor.values, sensor.origin)[:, [0, 2]]

    def decided(self) -> "EdgeShown":
        """Return the same with the reading of the poses that the edge selects."""
        if len(self.file.readings) < 2 or self.points.shape != (len(self.file.readings[0].X), 2):
            return self
        keep, fit = self.keep, edge_fit(self._corrected())
        return replace(self, file=self.file.decided(lambda poses: fit(poses[keep]), "edge"))


def edge_shown(
    file: Measurements, sigmas: Sigmas, feature: str, side: str, z: str, sensor: SensorCorrection | None = None
) -> EdgeShown:
    """Return the points of the edge: the file's own, or those of the feature in its raw profiles.

    Of raw profiles each sign of z is tried that is not excluded by ``z``.
    """
    signs = signs_to_try(z)
    if not feature:
        why = "the edge's point [x, z] in each profile (with raw profiles, name --feature bar, step or apex)"
        return EdgeShown(file=file, points=file.needed("points", why), sensor=sensor).decided()
    if feature not in FEATURES:
        raise InputError(f"The feature is bar, step or apex, not '{feature}'.")
    if file.profiles is None:
        raise InputError("The file has no profiles to detect an edge in. Omit --feature.")
    near: Literal["left", "right"] = "right" if side == "right" else "left"
    total, other_side = len(file.profiles), "right" if side == "left" else "left"
    blank = EdgeShown(file=file, points=np.full((total, 2), np.nan), sensor=sensor, feature=feature, side=near)
    tried = {grows: _tried(blank, sigmas, feature, side, grows) for grows in signs}
    fits = {grows: fit for grows, (_, fit) in tried.items()}
    if total and not any(fit.shown for fit in fits.values()):
        other = ", ".join(f"--feature {kind}" for kind in FEATURES if kind != feature)
        raise InputError(
            f"None of the {total} profiles shows the feature {feature} with its near face on the {side}, with z"
            f" {' or '.join(WORDS[grows] for grows in signs)}. Try --as side={other_side}, or"
            f" {other}."
        )
    grows, reason = choose_sign(fits, total, feature, lambda: _alike([one.fit for one, _ in tried.values()]))
    if not z and feature != "apex":
        # one jump is the end of the near face with one sign and side, and that of the far face with both exchanged
        opposite = next(sign for sign in signs if sign != grows)
        twin, there = _tried(blank, sigmas, feature, other_side, opposite)
        if there.kept and not beats(fits[grows], there) and not _alike([tried[grows][0].fit, twin.fit]):
            raise InconsistentData(
                f"The profiles do not show which face of the {feature} is near. With the near face on the {side} and z"
                f" {WORDS[grows]}, {fits[grows].kept} of {total} agree on one edge. With it on the {other_side} and z"
                f" {WORDS[opposite]}, {there.kept} agree on another. State z: --as side={side} --as z={grows}, or"
                f" --as side={other_side} --as z={opposite}. Heights (Gocator, Keyence) grow towards the sensor."
            )
    return replace(tried[grows][0], words={"z_grows": WORDS[grows], "z_reason": reason})


def _tried(blank: EdgeShown, sigmas: Sigmas, feature: str, side: str, grows: str) -> tuple[EdgeShown, SignFit]:
    """Return what the profiles show with one sign of z, and how far one edge explains it."""
    at, lost = with_sign(blank.file.profiles or (), partial(point_of_edge, feature, side), grows)
    points = blank.points.copy()
    points[np.setdiff1d(np.arange(len(points)), lost)] = np.array(at).reshape(-1, 2)
    one = replace(blank, points=points, lost=lost)
    try:
        one = one.decided()
        e, s = edge_by_noise(*one.seen(), sigmas)
        believed_covariance(e)  # refuses what is too vague to compare
    except WeldcalError as error:
        return one, SignFit(shown=len(at), error=error)
    kept, free = int(e.inliers.sum()), 2 * len(at) - 10
    square = (2 * kept - 10) * e.reduced_chi2 + (len(at) - kept) * OUTLIER**2
    variance = square / free * (s.x_m / sigmas.x_m) ** 2
    return replace(one, fit=(e, s)), SignFit(shown=len(at), kept=kept, variance=variance, freedom=free)


def edge_part(
    shown: EdgeShown, e: EdgeEstimate, sigmas: Sigmas, origin: Floats, affine: Floats | None = None
) -> EdgeScans:
    """Return the scans of an edge about an estimate, without outliers; a break where raw profiles show a corner.

    ``origin`` (2,) m and ``affine`` (3,): of the sensor's correction, where the points are not corrected.
    """
    poses, points = shown.seen()
    faces, away = None, -1.0 if shown.words.get("z_grows") == WORDS["towards"] else 1.0
    if shown.feature in CORNERS:
        profiles = [p for p, kept in zip(shown.file.profiles or (), shown.keep, strict=True) if kept]
        pairs = zip(profiles, shown.points[shown.keep], strict=True)
        faces = np.array([near_face(p, at, shown.side) for p, at in pairs])[e.inliers]
    # sigmas that nobody stated are those that the residuals show
    scale = 1.0 if sigmas.stated else min(1.0, float(np.sqrt(e.reduced_chi2)))
    return edge_scans(
        poses[e.inliers],
        points[e.inliers] if affine is None else straightened(points[e.inliers], affine, origin),
        EdgeState(e.rotation, e.translation, e.point, e.direction),
        sigma_xz_m=scale * np.array([sigmas.x_m, sigmas.z_m]),
        origin=origin,
        faces=faces,
        away=away,
    )


def break_figures(e: JointEstimate) -> dict[str, float]:
    """Return the radius of an edge's break and its sigma, mm, and the arm's error, for the JSON object."""
    radius = zip(("edge_radius_mm", "edge_radius_sigma_mm"), e.edge_radius_m or (), strict=False)
    return {"arm_mm": 1e3 * e.arm_m} | {key: 1e3 * value for key, value in radius}


def straightened(p: Floats, affine: Floats, origin: Floats) -> Floats:
    """Return a profile (n, 2) m as a sensor correction corrects it."""
    return corrected(p, affine, origin)[:, [0, 2]]


def point_of_edge(feature: str, side: str, profile: Floats) -> Floats:
    """Return the edge's point (2,) [x, z] m of a profile. Raises FeatureNotFound."""
    return extract_edge(profile, cast(Kind, feature), "left" if side == "left" else "right")[0]


def _alike(fits: Sequence[tuple[EdgeEstimate, Sigmas] | None]) -> bool:
    """Test whether two estimates are one pose, by their covariances."""
    (a, _), (b, _) = (cast(tuple[EdgeEstimate, Sigmas], fit) for fit in fits)
    turn = log_rotation((a.rotation @ b.rotation.T)[None])[0]
    d = np.concatenate([turn, a.translation - b.translation])
    C = believed_covariance(a) + believed_covariance(b)
    return bool(d @ np.linalg.solve(C, d) < chi2_quantile(ALIKE, 6))


def calibrate_edge(
    shown: EdgeShown, sigmas: Sigmas, *, method: str = "joint", plan: int = 0, seed: int = 0
) -> tuple[ProfilerRecord, dict[str, Any]]:
    """X_FS from the points of one straight edge."""
    if method not in ("joint", "paper"):
        raise InputError(f"The method is joint or paper, not '{method}'.")
    file, keep = shown.file, shown.keep
    poses, points = shown.seen()
    found: dict[str, Any] = {"scans": len(keep), "without_feature": shown.lost, **shown.words}
    if method == "paper":
        group = file.arrays["group"][keep] if "group" in file.arrays else rotation_groups(poses)
        linear = edge_linear(poses.rotation, poses.translation, points, group)
        found |= {"mean_distance_mm": 1e3 * float(linear.distances_m.mean())}
        if found["mean_distance_mm"] > FAR_FROM_EDGE_MM:
            found["warnings"] = [
                f"The points lie {found['mean_distance_mm']:.1f} mm from one edge on average. Scan one edge only, and"
                " check unit and poses."
            ]
        if shown.sensor is not None:
            raise InputError("The paper's method states no covariance and takes no sensor correction: omit it.")
        record = ProfilerRecord(
            method="edge, linear",
            rotation=linear.rotation,
            translation=linear.translation,
            figures=found,
            data_sha256=file.digest,
        )
        return record, found
    e, sigmas = shown.fit or edge_by_noise(poses, points, sigmas)
    e, xz, sensor = widened(e), np.array([sigmas.x_m, sigmas.z_m]), shown.sensor
    if sensor is not None:
        C = with_sensor(e, sensor, poses, shown.points[keep], sigma_robot_m=sigmas.robot_m, sigma_xz_m=xz)
        e, found["sensor_correction"] = replace(e, covariance=C), sensor.data_sha256
    found["sigmas_mm"] = {"robot": 1e3 * sigmas.robot_m, "x": 1e3 * sigmas.x_m, "z": 1e3 * sigmas.z_m}
    origin, S = points.mean(axis=0), EXACT**2 * np.eye(3)
    if sensor is not None:
        origin, S = sensor.origin, sensor.covariance
    whole = solve_joint([edge_part(shown, e, sigmas, origin)], S)
    if shown.feature in CORNERS:
        e = replace(e, rotation=whole.rotation, translation=whole.translation, covariance=whole.covariance)
    else:
        e = replace(e, covariance=e.covariance + whole.by_arm)
    found |= break_figures(whole)
    found |= figures_of(e) | {"outlier_scans": [int(k) for k in np.flatnonzero(keep)[~e.inliers]]}
    if plan:
        # the side of the near face changes with the direction of the laser line: as in the scans so far
        across = (poses[e.inliers].rotation @ e.rotation)[:, :, 0].mean(axis=0)
        along = e.direction if np.cross(e.direction, [0.0, 0.0, -1.0]) @ across > 0.0 else -e.direction
        state = EdgeState(e.rotation, e.translation, e.point, along)
        z = points[e.inliers, 1]
        field = Field(
            max(0.005, float(np.abs(points[e.inliers, 0]).max())), float(z.min()) - 1e-9, float(z.max()) + 2e-3
        )
        candidates = sample_edge_poses(state, CANDIDATES, seed, field)
        chosen = plan_edge_poses(
            state, poses[e.inliers], candidates, plan, sigma_robot_m=sigmas.robot_m, sigma_xz_m=xz, field=field
        )
        found["next_poses"] = next_poses(candidates, chosen.chosen, chosen.rms_m)
    record = ProfilerRecord.of("edge, joint", e, found, file.digest)
    return record if sensor is None else replace(record, affine=sensor.values, origin=sensor.origin), found


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
