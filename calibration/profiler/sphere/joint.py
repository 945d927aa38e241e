"""Estimates X_FS from raw profiles of a sphere in any poses, and from touches, in one least-squares problem.

Every profile point lies on the sphere, and so does the tip at every touch. The sensor's scale and shear in its plane
and, where the joint angles are given, the arm's offsets and sag may be estimated with it, each held by a prior.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import OptimizeResult

from weldcal.calibration.errors import DegenerateMotion, InconsistentData, TooFewTranslations
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.profiler.arm_errors import DhArm, ProfilerArmErrors
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.result import ProfilerEstimate, worst_direction
from weldcal.calibration.profiler.sphere.model import (
    ParameterLayout,
    SphereData,
    SphereProblem,
    SphereSigmas,
    corrected,
)
from weldcal.calibration.profiler.sphere.start import sphere_starts
from weldcal.models.errors import InputError

Model = Literal["rigid", "affine", "affine+joints"]
MINIMUM_POSES = 5
SINGULAR = 1e-5  # a choice between rounding and poor motions, of columns of unit length
WRONG_POSE = 5.0  # times the others' residual (its mean, or its rms) at which a scan is named
MOST_WRONG = 0.25  # of the scans may be excluded as wrong
RIVAL = 4.0  # sigmas: another optimum is excluded where it explains the points worse by more
APART_RAD, OPEN_RAD = np.radians(1.0), np.radians(5.0)


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
    """The pose of a profiler on the flange from profiles of a sphere, and touches of it where there are any.

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
    _refuse_open(estimate, about, rivals)
    wrong, n = estimate.wrong_poses, len(data.poses)
    if not wrong or len(wrong) > MOST_WRONG * n or n - len(wrong) < MINIMUM_POSES:
        return estimate
    return replace(sphere_joint(data.without(*wrong), model, sigmas, init=estimate), wrong_poses=wrong)


def sphere_optima(data: SphereData, sigmas: SphereSigmas) -> list[tuple[Floats, OptimizeResult]]:
    """The optima of the rigid model from the 24 orientations of a cube, best first: a rotation R_FS (3, 3), and the
    solution about it.

    Raises:
        InputError, TooFewTranslations: as sphere_joint.
    """
    _check(data, "rigid")
    layout = ParameterLayout(tip=data.touches is not None, affine=False, joints=False)
    problem = SphereProblem(data, layout, sigmas)
    starts = sphere_starts(data.poses, problem.profiles, data.radius_m)
    found = [problem.solved(R, t, np.concatenate([np.zeros(6), c, np.zeros(3 * layout.tip)])) for R, t, c in starts]
    return sorted(found, key=lambda one: float(one[1].cost))


def _started(init: SphereEstimate, data: SphereData, layout: ParameterLayout) -> Floats:
    """The unknowns of an estimate, but for its pose."""
    parts = [np.zeros(6), init.center]
    if layout.tip:
        parts.append(np.zeros(3) if init.tip is None or data.tip is None else init.tip - data.tip)
    if layout.affine:
        parts.append(init.affine)
    if layout.joints:
        parts.append(init.arm_errors.values)
    return np.concatenate(parts)


def _turned(R: Floats, x: Floats) -> Floats:
    return exp_rotation(x[:3]) @ R


def _refuse_open(estimate: SphereEstimate, best: Floats, rivals: list[Floats]) -> None:
    """What the covariance, which is local, does not tell: another mounting as good, or a turn hardly known at all."""
    sigma = float(np.sqrt(np.trace(estimate.covariance[:3, :3])))
    for other in rivals:
        angle = float(np.arccos(np.clip(0.5 * (np.trace(best.T @ other) - 1.0), -1.0, 1.0)))
        if angle > max(APART_RAD, 5.0 * sigma):
            raise DegenerateMotion(
                f"Two mountings of the profiler, {np.degrees(angle):.0f} deg apart, explain these scans alike: tilt the"
                " flange more, about two axes, and cut the sphere on both sides of its middle."
            )
    if sigma > OPEN_RAD:
        raise DegenerateMotion(
            f"These scans leave the rotation uncertain by {min(np.degrees(sigma), 180.0):.0f} deg: turn the flange"
            " further, about two axes, and cut the sphere on both sides of its middle."
        )


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
    spread = max(1.4826 * float(np.median(np.abs(mean))), 0.2 * problem.sigmas.robot_m)
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
        affine=np.asarray(affine),
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
