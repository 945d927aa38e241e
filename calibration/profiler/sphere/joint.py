"""Estimate X_FS from raw profiles of a sphere in any poses, and from touches; check the sphere's stated radius.

Every profile point lies on the sphere, and so does the tip at every touch. The sensor's scale and shear in its plane
and, where the joint angles are given, the arm's offsets and sag may be estimated with it, each held by a prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import OptimizeResult

from weldcal.calibration.errors import DegenerateMotion, InconsistentData, RadiusError, TooFewTranslations
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.calibration.profiler.arm_errors import DhArm, ProfilerArmErrors
from weldcal.calibration.profiler.edge.joint import cube_rotations
from weldcal.calibration.profiler.motion import FlangePoses, Floats, distinct, times_own, turned
from weldcal.calibration.profiler.result import ProfilerEstimate, refuse_open, worst_direction
from weldcal.calibration.profiler.sphere.arc import fit_circle
from weldcal.calibration.profiler.sphere.model import (
    ParameterLayout,
    SphereData,
    SphereProblem,
    SphereSigmas,
    corrected,
)
from weldcal.models.errors import InputError

POINTS = 7  # of each profile
ITERATIONS = 80
WORSE = 3.0  # times the best one's mean distance: what explains the sphere so badly is not polished

Model = Literal["rigid", "affine", "affine+joints"]
MINIMUM_POSES = 5
SINGULAR = 1e-5  # a choice between rounding and poor motions, of columns of unit length
WRONG_POSE = 5.0  # times the others' residual (its mean, or its rms) at which a scan is named
MOST_WRONG = 0.25  # of the scans may be excluded as wrong
RIVAL = 4.0  # sigmas: another optimum is excluded where it explains the points worse by more

SCALE_SIGMAS = 3.0  # of the prior of the profiler's scale: what a sensor may be off, its radius may be
NOISE_SIGMAS = 4.0  # a choice: 6 in 100,000 normal draws lie beyond
KNOWN = 0.03  # one sigma of a radius, as a share of it, that is known at all
BETTER = 0.4  # what another radius must leave of chi-square, and below which it must then be
WORST_CHI2 = 100.0  # as sphere_joint has it: beyond it no sphere explains the profiles
NAMED = 0.05  # of a ratio of radii that is called the diameter
GOOD_CHI2 = 4.0  # of a fit whose sigmas are wrong by two at most
ROUNDS, SETTLED = 12, 1e-3
STARTS = (1.0, 0.5, 2.0)  # times the stated radius: as given, a diameter given, half of it given


def sphere_starts(
    poses: FlangePoses, profiles: Sequence[Floats], radius_m: float
) -> list[tuple[Floats, Floats, Floats]]:
    """Return the best different optima (R_FS, p_FS, centre in B), best first."""
    some = [p[np.linspace(0, len(p) - 1, POINTS).astype(int)] for p in profiles]
    p = np.vstack(some)
    of = np.repeat(np.arange(len(some)), POINTS)
    p_S = np.column_stack([p[:, 0], np.zeros(len(p)), p[:, 1]])
    R_BF, p_BF = poses.rotation[of], poses.translation[of]
    R = cube_rotations()
    m = len(R)
    t, c = _translations(poses, profiles, R, radius_m)
    damping = np.full(m, 1e-2)
    r, J = _linearised(R_BF, p_BF, R, t, c, p_S, radius_m)
    cost = _cost(r)
    for _ in range(ITERATIONS):
        w = 1.0 / np.sqrt(1.0 + (r / _scale(r)[:, None]) ** 2)
        Jw = np.swapaxes(w[:, :, None] * J, 1, 2)
        H, g = Jw @ J, (Jw @ r[:, :, None])[:, :, 0]
        unit = np.sqrt(np.einsum("mii->mi", H)) + 1e-12
        A = H / (unit[:, :, None] * unit[:, None, :]) + damping[:, None, None] * np.eye(9)
        step = -np.linalg.solve(A, (g / unit)[:, :, None])[:, :, 0] / unit
        R_new, t_new, c_new = turned(R, step[:, :3]), t + step[:, 3:6], c + step[:, 6:]
        r_new, J_new = _linearised(R_BF, p_BF, R_new, t_new, c_new, p_S, radius_m)
        cost_new = _cost(r_new)
        better = cost_new < cost
        settled = np.abs(cost - cost_new) < 1e-10 * cost
        R, t = np.where(better[:, None, None], R_new, R), np.where(better[:, None], t_new, t)
        c, cost = np.where(better[:, None], c_new, c), np.where(better, cost_new, cost)
        r, J = np.where(better[:, None], r_new, r), np.where(better[:, None, None], J_new, J)
        damping = np.clip(np.where(better, 0.2 * damping, 10.0 * damping), 1e-12, 1e9)
        if (settled | (damping > 1e8)).all():
            break
    order = np.argsort(cost)
    chosen = distinct(R, order[cost[order] <= WORSE * cost.min() + 1e-9])
    return [(R[k], t[k], c[k]) for k in chosen]


def _translations(poses: FlangePoses, profiles: Sequence[Floats], R: Floats, radius_m: float) -> tuple[Floats, Floats]:
    """p_FS (m, 3) and the sphere's centre in B (m, 3) for rotations R_FS (m, 3, 3), by linear least squares.

    The sphere's centre in S is taken as that of the profile's circle: its distance from the scan plane, unknown in
    sign, is left out. From p_FS = 0 the search ended in another optimum in up to half of the sets of six scans.
    """
    circles = np.array([fit_circle(p)[0] for p in profiles])
    means = np.array([p.mean(axis=0) for p in profiles])
    x, z = np.where(circles[:, 2:] < 1.05 * radius_m, circles[:, :2], means).T
    c_F = np.column_stack([x, np.zeros(len(x)), z]) @ np.swapaxes(R, 1, 2)
    moved = times_own(c_F, np.swapaxes(poses.rotation, 1, 2)) + poses.translation
    A = np.concatenate([poses.rotation, np.tile(-np.eye(3), (len(poses), 1, 1))], axis=2).reshape(-1, 6)
    found = -moved.reshape(len(R), -1) @ np.linalg.pinv(A).T
    return np.asarray(found[:, :3]), np.asarray(found[:, 3:])


def _scale(r: Floats) -> Floats:
    return np.asarray(np.maximum(3.0 * np.median(np.abs(r), axis=1), 1e-9))


def _cost(r: Floats) -> Floats:
    return np.asarray(np.abs(r).mean(axis=1))


def _linearised(
    R_BF: Floats, p_BF: Floats, R: Floats, t: Floats, c: Floats, p_S: Floats, radius_m: float
) -> tuple[Floats, Floats]:
    """Distances (m, n) to the sphere and their Jacobian (m, n, 9) by [turn in S; p_FS; centre]."""
    p_F = p_S @ np.swapaxes(R, 1, 2) + t[:, None]
    at = times_own(p_F, np.swapaxes(R_BF, 1, 2)) + p_BF - c[:, None]
    length = np.maximum(np.linalg.norm(at, axis=2), 1e-9)
    n_B = at / length[:, :, None]
    n_F = times_own(n_B, R_BF)
    turn = -times_own(n_F @ R, skew(p_S))
    return np.asarray(length - radius_m), np.concatenate([turn, n_F, -n_B], axis=2)


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereEstimate(ProfilerEstimate):
    """X_FS and what was estimated with it; its residuals (n,) m are distances to the sphere.

    Attributes:
        center: (3,) m in B; tip: (3,) m in F or None; affine: (3,) [x scale, z scale, shear] about `origin` (2,) m.
        arm_errors: of the arm's joints and table; zero where the model has them not.
        wrong_poses: scans whose points lie off the sphere together; the result, and its residuals, are without them.
        radius_change_m, radius_sigma_m: what a free radius would be more than the one given, to first order.
        whole: (m, m) covariance of all unknowns: pose, centre, tip, sensor, arm, as far as the model has them.
    """

    center: Floats = field(default_factory=lambda: np.zeros(3))
    tip: Floats | None = None
    affine: Floats = field(default_factory=lambda: np.zeros(3))
    origin: Floats = field(default_factory=lambda: np.zeros(2))
    arm_errors: ProfilerArmErrors = field(default_factory=ProfilerArmErrors.none)
    wrong_poses: tuple[int, ...] = ()
    radius_change_m: float = 0.0
    radius_sigma_m: float = float("nan")
    whole: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    def points_F(self, profile: ArrayLike) -> Floats:
        """Profile points (n, 2) m, corrected by the sensor's model, in F (n, 3)."""
        return np.asarray(
            corrected(np.asarray(profile, float), self.affine, self.origin) @ self.rotation.T + self.translation
        )

    def flange(self, arm: DhArm, q: Floats) -> FlangePoses:
        """Flange poses of the arm (as it is drawn) with the errors that were found, at joints (n, 6) rad."""
        return arm.with_errors(q, self.arm_errors, arm.loads(q))


@dataclass(frozen=True)
class ModelChoice:
    """The model taken, the rms (m) of held-out scans by each model, and the sentence that says why."""

    model: Model
    left_out_m: dict[Model, float]
    reason: str


def sphere_joint(
    data: SphereData, model: Model = "affine", sigmas: SphereSigmas | None = None, init: SphereEstimate | None = None
) -> SphereEstimate:
    """Return the pose of a profiler on the flange from profiles of a sphere, and touches of it where there are any.

    Without `init` the 24 orientations of a cube are tried.

    Raises:
        InputError: measurements that do not belong together, or joints asked for and not given.
        TooFewTranslations: fewer than five scans. DegenerateMotion: the motion leaves a direction open, which is named.
        InconsistentData: no sphere of this radius explains the profiles.
    """
    s = sigmas or SphereSigmas()
    _check(data, model)
    layout = ParameterLayout(tip=data.touches is not None, affine=model != "rigid", joints=model == "affine+joints")
    problem = SphereProblem(data, layout, s)
    rivals: list[Floats] = []
    if init is not None:
        R, result = problem.solved(init.rotation, init.translation, _started(init, data, layout))
        about = _turned(R, result.x)
    else:
        found = sphere_optima(data, s)
        R, result = found[0]
        about = _turned(R, result.x)
        # soft_l1's cost is half of chi-square where residuals are small; sigmas that are too small exaggerate
        # differences
        excess = max(1.0, 2.0 * float(result.cost) / max(len(result.fun) - len(result.x), 1))
        rivals = [
            _turned(one[0], one[1].x) for one in found if 2.0 * float(one[1].cost - result.cost) < RIVAL**2 * excess
        ]
        if layout.size > len(result.x):
            x = np.zeros(layout.size)
            x[: 9 + 3 * layout.tip] = result.x
            _, result = problem.solved(R, np.zeros(3), x)
    estimate = _estimate(problem, R, result.x)
    advice = "cut the sphere on both sides of its middle."
    refuse_open(estimate.covariance, about, rivals, "scans", advice)
    wrong, n = estimate.wrong_poses, len(data.poses)
    if not wrong or len(wrong) > MOST_WRONG * n or n - len(wrong) < MINIMUM_POSES:
        return estimate
    return replace(sphere_joint(data.without(*wrong), model, sigmas, init=estimate), wrong_poses=wrong)


def sphere_optima(data: SphereData, sigmas: SphereSigmas) -> list[tuple[Floats, OptimizeResult]]:
    """Return the optima of the rigid model from the 24 orientations of a cube, best first.

    A rotation R_FS (3, 3), and the solution about it.

    Raises:
        InputError, TooFewTranslations: as sphere_joint.
    """
    _check(data, "rigid")
    layout = ParameterLayout(tip=data.touches is not None, affine=False, joints=False)
    problem = SphereProblem(data, layout, sigmas)
    starts = sphere_starts(data.poses, problem.corrected_profiles, data.radius_m)
    found = [problem.solved(R, t, np.concatenate([np.zeros(6), c, np.zeros(3 * layout.tip)])) for R, t, c in starts]
    return sorted(found, key=lambda one: float(one[1].cost))


def _started(init: SphereEstimate, data: SphereData, layout: ParameterLayout) -> Floats:
    """Return the unknowns of an estimate, but for its pose."""
    parts = [np.zeros(6), init.center]
    if layout.tip:
        parts.append(np.zeros(3) if init.tip is None or data.tip is None else init.tip - data.tip)
    if layout.affine:
        parts.append(init.affine - (0.0 if data.sensor is None else data.sensor.values))
    if layout.joints:
        parts.append(init.arm_errors.values)
    return np.concatenate(parts)


def _turned(R: Floats, x: Floats) -> Floats:
    return exp_rotation(x[:3]) @ R


def leave_one_out_m(data: SphereData, model: Model, sigmas: SphereSigmas | None = None) -> Floats:
    """Rms distance (n,) m of each scan's points to the sphere, by the calibration that did not see it."""
    errors = []
    whole = sphere_joint(data, model, sigmas)
    for k in range(len(data.poses)):
        estimate = sphere_joint(data.without(k), model, sigmas, init=whole)
        poses, p = data.poses, data.profiles[k]
        if data.arm is not None and data.q is not None:
            poses = estimate.flange(data.arm, data.q)
        at = estimate.points_F(p[np.isfinite(p).all(axis=1)]) @ poses.rotation[k].T + poses.translation[k]
        distance = np.linalg.norm(at - estimate.center, axis=1) - data.radius_m
        errors.append(np.sqrt(np.mean(distance**2)))
    return np.array(errors)


def choose_model(data: SphereData, sigmas: SphereSigmas | None = None) -> ModelChoice:
    """The model that held-out scans ask for, by the one-standard-error rule on paired squared errors of the same scans.

    Rigid or affine: the simpler one, unless affine predicts held-out scans better by more than one standard error of
    the differences. The arm's own errors: their priors are what is known of the arm, so that leaving them out is the
    assumption (an exact arm), and scans of one sphere hardly show them though they move the flange elsewhere. The model
    that has them is taken, unless it predicts held-out scans worse by more than one standard error.

    Source: one standard error, Breiman, Friedman, Olshen and Stone, "Classification and Regression Trees", 1984, 3.4.3.
    """
    names: list[Model] = ["rigid", "affine"]
    if data.arm is not None:
        names.append("affine+joints")
    each = {name: leave_one_out_m(data, name, sigmas) for name in names}
    # no model predicts a wrong scan
    usual = each["rigid"] < WRONG_POSE * np.median(each["rigid"])
    square = {name: e[usual] ** 2 for name, e in each.items()}
    errors = {name: float(np.sqrt(np.mean(e))) for name, e in square.items()}
    chosen: Model = "affine" if _clearly_less(square["affine"], square["rigid"]) else "rigid"
    why = f"affine is {'' if chosen == 'affine' else 'not '}clearly better than rigid"
    if "affine+joints" in square:
        if _clearly_less(square[chosen], square["affine+joints"]):
            why += f", and affine+joints is clearly worse than {chosen}"
        else:
            why = (
                f"affine+joints is not clearly worse than {chosen}: scans of one sphere hardly show the arm's errors,"
                " and to leave them out is to call the arm exact"
            )
            chosen = "affine+joints"
    figures = ", ".join(f"{name} {1e3 * v:.4f} mm" for name, v in errors.items())
    return ModelChoice(chosen, errors, f"Held-out scans: {figures}; {why} (by one standard error of the differences).")


def _clearly_less(a: Floats, b: Floats) -> bool:
    """Whether paired values (n,) a are less than b on average, by more than one standard error of their differences."""
    d = b - a
    return bool(d.mean() > d.std(ddof=1) / np.sqrt(len(d))) if len(d) > 1 else False


def _check(data: SphereData, model: Model) -> None:
    n = len(data.poses)
    if len(data.profiles) != n:
        raise InputError(f"{n} poses need {n} profiles, not {len(data.profiles)}.")
    if n < MINIMUM_POSES:
        raise TooFewTranslations(
            f"{n} scans of the sphere are too few: take {MINIMUM_POSES} or more, in different orientations."
        )
    if (data.touches is None) != (data.tip is None):
        raise InputError("Touches need the tip's place in the flange frame, and the tip needs touches.")
    no_joints = data.arm is None or data.q is None or (data.touches is not None and data.touch_q is None)
    if model == "affine+joints" and no_joints:
        raise InputError("The model with joints needs the arm's table and its joints at every scan and touch.")
    for k, p in enumerate(data.profiles):
        if p.ndim != 2 or p.shape[1] != 2 or np.isfinite(p).all(axis=1).sum() < 5:
            raise InputError(f"Profile {k} has fewer than five points of the sphere: exclude that scan.")


def _estimate(problem: SphereProblem, R0: Floats, x: Floats) -> SphereEstimate:
    """The result with its covariance, and whether it may be believed."""
    # linearised about itself: a large rotation vector's own covariance is not that of a turn in F
    R = exp_rotation(x[:3]) @ R0
    problem.linearise_about(R)
    x = np.concatenate([np.zeros(3), x[3:]])
    pose, c, tip, affine, arm = problem.layout.unpack(x)
    problem.share_robot_error(x)
    J, r = problem.derivatives(x), problem.residual(x)
    unit = np.linalg.norm(J, axis=0)
    singular = np.linalg.svd(J / np.where(unit > 0, unit, 1.0), compute_uv=False)
    H = J.T @ J
    condition = float(singular[-1] / singular[0])
    if condition < SINGULAR:
        of_pose = H[:6, :6] - H[:6, 6:] @ np.linalg.pinv(H[6:, 6:]) @ H[6:, :6]
        raise DegenerateMotion(
            f"These scans leave the {worst_direction(of_pose)} open: turn the flange about two different axes between"
            " them."
        )
    m = len(problem.p)
    distance = np.linalg.norm(problem.off(x)[0], axis=1) - problem.data.radius_m
    freedom = max(len(r) - len(x), 1)
    chi2 = float(np.median(np.abs(r[:m])) / 0.6745) ** 2
    felt = r[m : m + (0 if problem.data.touches is None else len(problem.data.touches))]
    if max(chi2, float(np.median(np.abs(felt)) / 0.6745) ** 2 if felt.size else 0.0) > 100.0:
        touched = (
            f" and touches {1e3 * problem.sigmas.touch_m * float(np.median(np.abs(felt))):.2f} mm" if felt.size else ""
        )
        raise InconsistentData(
            f"Profiles lie {1e3 * float(np.median(np.abs(distance))):.2f} mm{touched} off any sphere of"
            f" {1e3 * problem.data.radius_m:.2f} mm: check the radius, the poses and that only the sphere is in the"
            " profiles."
        )
    every = [distance[problem.of == k] for k in range(len(problem.count))]
    mean, rms = np.array([d.mean() for d in every]), np.array([np.sqrt(np.mean(d**2)) for d in every])
    spread = max(MAD * float(np.median(np.abs(mean))), 0.2 * problem.sigmas.robot_m)
    off = (np.abs(mean) > WRONG_POSE * spread) | (rms > WRONG_POSE * np.median(rms) + problem.sigmas.robot_m)
    wrong = tuple(int(k) for k in np.flatnonzero(off))
    by_radius = problem.by_radius()
    step, sigma = last_step(np.column_stack([J, by_radius]), r)
    whole = np.asarray(np.linalg.inv(H))
    return SphereEstimate(
        rotation=R,
        translation=np.asarray(pose[3:]),
        covariance=whole[:6, :6],
        whole=whole,
        residuals=np.asarray(distance),
        inliers=np.abs(r[:m]) < 5.0,
        rms_m=float(np.sqrt(np.mean(distance**2))),
        reduced_chi2=float(r @ r / freedom),
        scans_chi2=(problem.shared(r) + float(r[m:] @ r[m:])) / max(3 * len(problem.count) + len(felt) - 9, 1),
        condition=condition,
        center=np.asarray(c),
        tip=None if problem.data.tip is None else problem.data.tip + tip,
        affine=problem.affine + affine,
        origin=problem.origin,
        arm_errors=ProfilerArmErrors.of(arm),
        wrong_poses=wrong,
        radius_change_m=step,
        radius_sigma_m=sigma * float(np.sqrt(max(1.0, float(r @ r) / freedom))),
    )


def last_step(J: Floats, r: Floats) -> tuple[float, float]:
    """(step, sigma): how far the last unknown would go in one step of least squares, and its sigma."""
    unit = np.linalg.norm(J, axis=0)
    C = np.linalg.pinv((J / unit).T @ (J / unit))
    return float(-(C @ ((J / unit).T @ r))[-1] / unit[-1]), float(np.sqrt(C[-1, -1]) / unit[-1])


@dataclass(frozen=True)
class FreeRadius:
    """The radius that profiles show, its sigma, both in m, and the reduced chi-square of the fit with it."""

    radius_m: float
    sigma_m: float
    reduced_chi2: float


def free_radius(data: SphereData, start_m: float, sigmas: SphereSigmas) -> FreeRadius | None:
    """Return the radius by the scans alone (rigid sensor, no touches), from a start; None where it does not settle.

    Gauss-Newton in the radius, all other unknowns solved at each step.
    """
    scans, radius = data.scans(start_m), start_m
    layout = ParameterLayout(tip=False, affine=False, joints=False)
    problem = SphereProblem(scans, layout, sigmas)
    starts = sphere_starts(data.poses, problem.corrected_profiles, start_m)
    if not starts:
        return None
    R, x = starts[0][0], np.concatenate([np.zeros(3), starts[0][1], starts[0][2]])
    for _ in range(ROUNDS):
        problem = SphereProblem(replace(scans, radius_m=radius), layout, sigmas)
        _, found = problem.solved(R, np.zeros(3), x)
        x = np.asarray(found.x)
        r = problem.residual(x)
        step, sigma = last_step(np.column_stack([problem.derivatives(x), problem.by_radius()]), r)
        if abs(step) < SETTLED * radius:
            chi2 = float(r @ r) / max(len(r) - len(x) - 1, 1)
            return FreeRadius(radius + step, sigma * float(np.sqrt(max(1.0, chi2))), chi2)
        radius = float(np.clip(radius + step, 0.6 * radius, 1.6 * radius))
    return None


def check_radius(data: SphereData, sigmas: SphereSigmas, stated: SphereEstimate | None) -> None:
    """Refuse a stated radius that the profiles contradict; `stated`: the rigid fit with it, None where there is none.

    A profiler's scale error shows as another radius: up to three sigmas of its prior is its error, more is another
    sphere.

    Raises:
        RadiusError: the profiles determine the radius, and it is another one.
    """
    R = data.radius_m
    allowed = SCALE_SIGMAS * sigmas.affine * R
    # what a poor fit says of the radius, to first order, says nothing
    near = stated is not None and abs(stated.radius_change_m) <= allowed + NOISE_SIGMAS * stated.radius_sigma_m
    if stated is not None and near and stated.reduced_chi2 < GOOD_CHI2:
        return
    tried = [one for k in STARTS if (one := free_radius(data, k * R, sigmas)) is not None]
    known = [one for one in tried if one.sigma_m < KNOWN * one.radius_m and one.reduced_chi2 < WORST_CHI2]
    best = min(known, key=lambda one: one.reduced_chi2, default=None)
    if best is None:
        if stated is None or near:
            return  # whatever the fit itself refuses for
        raise RadiusError(
            f"The profiles contradict a sphere of {1e3 * R:.2f} mm radius and show no other one. Check the radius, the"
            " poses and that only the sphere is in the profiles."
        )
    worse = np.inf if stated is None else stated.reduced_chi2
    if abs(best.radius_m - R) <= allowed + NOISE_SIGMAS * best.sigma_m or best.reduced_chi2 > BETTER * worse:
        return
    said = f"The profiles show a sphere of {1e3 * best.radius_m:.2f} mm radius, and {1e3 * R:.2f} mm is stated"
    if abs(2.0 * best.radius_m / R - 1.0) < NAMED:
        raise RadiusError(f"{said}: that is its diameter. Give the radius, {1e3 * R / 2:.5g} mm.")
    if abs(best.radius_m / (2.0 * R) - 1.0) < NAMED:
        raise RadiusError(f"{said}: that is half of it. Give the radius, {2e3 * R:.5g} mm.")
    raise RadiusError(f"{said}. Check the radius and the unit.")
