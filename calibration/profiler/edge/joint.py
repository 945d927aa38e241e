"""Estimate X_FS from one straight edge in any poses: starts from 24 orientations, then one least-squares problem.

Every measured profile point is compared with where the edge crosses the scan plane, in units of its own sigma (sensor
and robot), with a Cauchy loss that keeps 95 % of what least squares would get. The covariance is the Cramer-Rao bound
over that share, where the stated sigmas are right.

The starts minimise the distance of a point to a line: it has no division by the angle between edge and scan plane, so
that this converges from any orientation, where the comparison above would not.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldcal.calibration.errors import DegenerateMotion, InconsistentData, TooFewTranslations
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.geometry.se3 import frames_along, skew
from weldcal.calibration.profiler.edge.model import (
    EdgeState,
    left_covariance,
    left_information,
    measurement_covariance,
    predicted,
    whitened,
)
from weldcal.calibration.profiler.motion import FlangePoses, Floats, checked_points, distinct, times_own, turned
from weldcal.calibration.profiler.result import ProfilerEstimate, refuse_open, worst_direction
from weldcal.calibration.profiler.sensor import SensorCorrection
from weldcal.models.errors import InputError

ITERATIONS = 60
START_SETTLED = 1e-6  # of the cost, in one step: the reprojection goes on from there
ROBUST = 2.5  # Cauchy scale in robust sigmas of the distances

MINIMUM_POSES = 6
STARTING_POSES = 60  # spread over all of them, are enough to find where to start
# sigmas of one coordinate: the constant that keeps 95 % of least squares' information in Gaussian noise
CAUCHY = 2.385
EFFICIENCY = 0.95  # of CAUCHY, see above
OUTLIER = 4.5  # in sigmas of a point: one of 25 000 good points lies beyond
SINGULAR = 1e-4  # least over largest singular value of the Jacobian with columns of unit length
RIVAL = 4.0  # sigmas: another optimum is excluded where it explains the points worse by more
CONSISTENT_SHARE = 0.7  # a choice: up to three in ten points may be bad, as in other solvers; more is no single edge
NEAR, SETTLED = 1e-2, 1e-7  # in sigmas of the unknowns: steps that end the descent, and the settling after it


def cube_rotations() -> Floats:
    """Return the 24 rotations (24, 3, 3) that bring a cube onto itself."""
    found = []
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[list(axes), range(3)] = signs
            if np.linalg.det(R) > 0.0:
                found.append(R)
    return np.array(found)


def edge_starts(poses: FlangePoses, p: Floats) -> list[EdgeState]:
    """Return the best different optima, best first."""
    R, t, point, e, cost = _point_to_line(poses, p)
    chosen = distinct(R, np.argsort(cost))
    return [EdgeState(R[k], t[k], point[k], e[k]) for k in chosen]


def _line(points: Floats) -> tuple[Floats, Floats]:
    """Mean (m, 3) and main direction (m, 3) of points (m, n, 3)."""
    mean = points.mean(axis=1)
    centred = points - mean[:, None]
    _, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    return mean, vectors[:, :, 2]


def _point_to_line(poses: FlangePoses, p: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Levenberg-Marquardt on 24 problems side by side; a Cauchy loss scaled by each problem's own median distance."""
    R = cube_rotations()
    m, n = len(R), len(p)
    p_S = np.column_stack([p[:, 0], np.zeros(n), p[:, 1]])
    t, damping = np.zeros((m, 3)), np.full(m, 1e-2)
    mean, e = _line(_in_base(poses, R, t, p_S))
    scale = _scale(_distances(_in_base(poses, R, t, p_S), mean, e))
    cost = np.full(m, np.inf)
    left = np.arange(m)  # those that have not settled
    for _ in range(ITERATIONS):
        R0, e0, mean0 = R[left], e[left], mean[left]
        r, J = _linearised(poses, R0, t[left], mean0, e0, p_S)
        scale[left] = s = np.minimum(scale[left], _scale(r))
        before = _start_costs(r, s)
        w = 1.0 / (1.0 + np.einsum("mni,mni->mn", r, r) / s[:, None] ** 2)
        J = J.reshape(len(left), -1, 10)
        Jw = np.swapaxes(np.repeat(w, 3, axis=1)[:, :, None] * J, 1, 2)
        H, g = Jw @ J, (Jw @ r.reshape(len(left), -1, 1))[:, :, 0]
        unit = np.sqrt(np.einsum("mii->mi", H)) + 1e-12
        A = H / (unit[:, :, None] * unit[:, None, :]) + damping[left][:, None, None] * np.eye(10)
        step = -np.linalg.solve(A, (g / unit)[:, :, None])[:, :, 0] / unit
        across = frames_along(e0)[:, :, :2]
        R1, t1 = turned(R0, step[:, :3]), t[left] + step[:, 3:6]
        mean1 = mean0 + np.einsum("mij,mj->mi", across, step[:, 6:8])
        e1 = e0 + np.einsum("mij,mj->mi", across, step[:, 8:10])
        e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
        after = _start_costs(_distances(_in_base(poses, R1, t1, p_S), mean1, e1), s)
        better = after < before
        k = left[better]
        R[k], t[k], mean[k], e[k] = R1[better], t1[better], mean1[better], e1[better]
        cost[left] = np.where(better, after, before)
        damping[left] = np.clip(np.where(better, 0.2, 10.0) * damping[left], 1e-12, 1e9)
        left = left[~((better & (before - after < START_SETTLED * before)) | (damping[left] > 1e8))]
        if not left.size:
            break
    # compared at one scale: a start that explains little must not look good by its own
    common = _distances(_in_base(poses, R, t, p_S), mean, e)
    return R, t, mean, e, _start_costs(common, np.full(m, max(float(scale.min()), 1e-9)))


def _in_base(poses: FlangePoses, R: Floats, t: Floats, p_S: Floats) -> Floats:
    """Profile points (n, 3) in B (m, n, 3) for m candidates."""
    p_F = p_S @ np.swapaxes(R, 1, 2) + t[:, None]
    return times_own(p_F, np.swapaxes(poses.rotation, 1, 2)) + poses.translation


def _distances(points: Floats, mean: Floats, e: Floats) -> Floats:
    off = points - mean[:, None]
    return np.asarray(off - np.einsum("mni,mi->mn", off, e)[:, :, None] * e[:, None])


def _scale(r: Floats) -> Floats:
    return np.asarray(np.maximum(ROBUST * MAD * np.median(np.linalg.norm(r, axis=2), axis=1), 1e-9))


def _start_costs(r: Floats, scale: Floats) -> Floats:
    return np.asarray(np.log1p(np.einsum("mni,mni->mn", r, r) / scale[:, None] ** 2).sum(axis=1) * scale**2)


def _linearised(
    poses: FlangePoses, R: Floats, t: Floats, mean: Floats, e: Floats, p_S: Floats
) -> tuple[Floats, Floats]:
    """Distances (m, n, 3) and their Jacobian (m, n, 3, 10) by [turn in S; p_FS.

    Line's point and direction across it].
    """
    m, n = len(R), len(p_S)
    points = _in_base(poses, R, t, p_S)
    off = points - mean[:, None]
    along = np.einsum("mni,mi->mn", off, e)
    r = off - along[:, :, None] * e[:, None]
    P = np.eye(3) - e[:, :, None] * e[:, None, :]
    across = frames_along(e)[:, :, :2]
    J = np.empty((m, n, 3, 10))
    turn = -np.einsum("nij,mjk,nkl->mnil", poses.rotation, R, skew(p_S), optimize=True)
    J[..., :3] = P[:, None] @ turn
    J[..., 3:6] = P[:, None] @ poses.rotation
    J[..., 6:8] = -across[:, None]
    # e changes: the part along the old line leaves, and what lies off it leans
    J[..., 8:10] = -along[:, :, None, None] * across[:, None]
    lean = np.einsum("mni,mik->mnk", r, across)
    J[..., 8:10] -= e[:, None, :, None] * lean[:, :, None, :]
    return r, J


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeEstimate(ProfilerEstimate):
    """X_FS and the edge itself: a point of it (3,) m and its unit direction (3,), in B."""

    point: Floats
    direction: Floats


def edge_joint(
    rotation: ArrayLike,
    translation: ArrayLike,
    points: ArrayLike,
    *,
    sigma_robot_m: float,
    sigma_xz_m: ArrayLike,
    init: EdgeState | None = None,
) -> EdgeEstimate:
    """Return the pose of a profiler on the flange, from points of one straight edge.

    Args:
        rotation: (n, 3, 3) R_BF; translation: (n, 3) p_BF m; points: (n, 2) profile points [x, z] m of the edge.
        sigma_robot_m: of the flange's position, per axis; sigma_xz_m: (2,) of the profile point.
        init: where to start; without it the 24 orientations of a cube are tried.

    Raises:
        InputError: shapes, numbers that are not finite, no rotation.
        TooFewTranslations: fewer than six poses.
        DegenerateMotion: these motions leave a direction open, which is named.
        InconsistentData: the points are not on one edge.

    Source: straight-edge paper, Eq. 1 and its closing wish for a single phase; docs/profiler.md.
    """
    poses = FlangePoses.checked(rotation, translation)
    p = checked_points(points, len(poses))
    sigmas = np.asarray(sigma_xz_m, float)
    if sigmas.shape != (2,) or not (sigmas > 0.0).all() or not sigma_robot_m >= 0.0:
        raise InputError(
            "The sigmas of a profile point [x, z] must be two positive numbers, and the robot's not negative."
        )
    fits = edge_optima(poses, p, sigma_robot_m, sigmas, init)
    state, cost = fits[0]
    estimate = _estimate(state, poses, p, sigma_robot_m, sigmas)
    rivals = [other.rotation for other, its in fits if CAUCHY**2 * (its - cost) < RIVAL**2]
    advice = "let the edge cross the laser line at different places."
    refuse_open(estimate.covariance, estimate.rotation, rivals, "points", advice)
    return estimate


def edge_optima(
    poses: FlangePoses, p: Floats, sigma_robot_m: float, sigmas: Floats, init: EdgeState | None = None
) -> list[tuple[EdgeState, float]]:
    """Find the optima of a robust loss, and their costs, best first.

    Starts are the 24 orientations of a cube, or ``init`` alone.

    Raises:
        TooFewTranslations: fewer than six poses.
    """
    if len(poses) < MINIMUM_POSES:
        raise TooFewTranslations(
            f"{len(poses)} poses of the edge are too few: take at least {MINIMUM_POSES}, all different."
        )
    some = np.unique(np.linspace(0, len(poses) - 1, STARTING_POSES).round().astype(int))
    starts = [init] if init is not None else edge_starts(poses[some], p[some])
    return sorted((_fitted(start, poses, p, sigma_robot_m, sigmas) for start in starts), key=lambda fit: fit[1])


def _system(
    state: EdgeState, poses: FlangePoses, p: Floats, sigma_robot_m: float, sigmas: Floats
) -> tuple[Floats, Floats, Floats]:
    """Residuals (n, 2) m, and both residuals and Jacobian (n, 2, 10) in sigmas."""
    predicted_p, J, by_robot = predicted(state, poses)
    covariance = measurement_covariance(by_robot, sigma_robot_m, sigmas)
    r, Jw = whitened(covariance, p - predicted_p, J)
    return p - predicted_p, r, Jw


def _fitted(
    state: EdgeState,
    poses: FlangePoses,
    p: Floats,
    sigma_robot_m: float,
    sigmas: Floats,
    inliers: NDArray[np.bool_] | None = None,
) -> tuple[EdgeState, float]:
    """Levenberg-Marquardt with a Cauchy loss on each coordinate, of all poses or of the inliers.

    The state and its cost.
    """
    damping = 1e-3
    _, r, J = _system(state, poses, p, sigma_robot_m, sigmas)
    cost = _cost(r, inliers)
    for _ in range(ITERATIONS):
        w = 1.0 / (1.0 + (r / CAUCHY) ** 2)
        if inliers is not None:
            w = w * inliers[:, None]
        Jw = (w[:, :, None] * J).reshape(-1, 10).T
        H, g = Jw @ J.reshape(-1, 10), Jw @ r.ravel()
        scale = np.sqrt(np.diag(H)) + 1e-300
        step = np.linalg.lstsq(H / np.outer(scale, scale) + damping * np.eye(10), g / scale, rcond=None)[0] / scale
        new = state.moved(step)
        _, r_new, J_new = _system(new, poses, p, sigma_robot_m, sigmas)
        cost_new = _cost(r_new, inliers)
        if not cost_new < cost:
            damping *= 8.0
            if damping > 1e8:
                break
            continue
        done = float(step @ H @ step) < NEAR**2 or cost - cost_new < 1e-13 * cost
        state, r, J, cost, damping = new, r_new, J_new, cost_new, max(0.1 * damping, 1e-12)
        if done:
            break
    return state, cost


def _settled(
    state: EdgeState, poses: FlangePoses, p: Floats, sigma_robot_m: float, sigmas: Floats, inliers: NDArray[np.bool_]
) -> EdgeState:
    """Where the weighted residuals balance: full steps, each with the covariances of the state before.

    The descent compares costs whose covariances change with the state, which favours states in which the robot's error
    looks large; the balance does not. Where the steps do not shrink (an open direction), the state is left as it was.
    """
    at, size = state, np.inf
    for _ in range(ITERATIONS):
        _, r, J = _system(at, poses, p, sigma_robot_m, sigmas)
        w = np.where(inliers[:, None], 1.0 / (1.0 + (r / CAUCHY) ** 2), 0.0)
        Jw = (w[:, :, None] * J).reshape(-1, 10).T
        H, g = Jw @ J.reshape(-1, 10), Jw @ r.ravel()
        scale = np.sqrt(np.diag(H)) + 1e-300
        step = np.linalg.lstsq(H / np.outer(scale, scale), g / scale, rcond=1e-12)[0] / scale
        before, size = size, float(np.sqrt(max(float(step @ H @ step), 0.0)))
        if not size < before:
            return at if size < NEAR else state
        at = at.moved(step)
        if size < SETTLED:
            return at
    return at


def _square(r: Floats) -> Floats:
    return np.asarray(np.einsum("na,na->n", r, r))


def _cost(r: Floats, inliers: NDArray[np.bool_] | None) -> float:
    return float(np.sum(np.log1p((r if inliers is None else r[inliers]) ** 2 / CAUCHY**2)))


def _estimate(state: EdgeState, poses: FlangePoses, p: Floats, sigma_robot_m: float, sigmas: Floats) -> EdgeEstimate:
    """From the robust optimum: outliers named, the fit without them, its covariance, and whether it may be believed."""
    residual, r, J = _system(state, poses, p, sigma_robot_m, sigmas)
    inliers = _square(r) < OUTLIER**2
    for _ in range(10):
        if inliers.sum() < MINIMUM_POSES:
            break
        state, _ = _fitted(state, poses, p, sigma_robot_m, sigmas, inliers)
        state = _settled(state, poses, p, sigma_robot_m, sigmas, inliers)
        residual, r, J = _system(state, poses, p, sigma_robot_m, sigmas)
        before, inliers = inliers, _square(r) < OUTLIER**2
        if (before == inliers).all():
            break
    kept = max(int(inliers.sum()), 1)
    chi2_all = float(np.median(_square(r)) / (2.0 * np.log(2.0)))  # the median of chi-square with 2 degrees is 2 ln 2
    if kept < MINIMUM_POSES or (kept < CONSISTENT_SHARE * len(poses) and chi2_all > 1.0):
        text = (
            f"Only {kept} of {len(poses)} points lie on one edge: scan one edge only, state the sigmas of robot and"
            " scanner, and check unit and convention of the poses."
        )
        raise InconsistentData(text)
    Ji = J[inliers].reshape(-1, 10)
    scale = np.linalg.norm(Ji, axis=0)
    singular = np.linalg.svd(Ji / np.where(scale > 0.0, scale, 1.0), compute_uv=False)
    H = Ji.T @ Ji
    condition = float(singular[-1] / singular[0])
    if condition < SINGULAR or not (scale > 0.0).all():
        of_pose = H[:6, :6] - H[:6, 6:] @ np.linalg.pinv(H[6:, 6:]) @ H[6:, :6]
        raise DegenerateMotion(
            f"These motions leave the {worst_direction(left_information(state.rotation, of_pose))} open: "
            "turn the flange about two different axes, in three orientations or more."
        )
    freedom = 2 * kept - 10
    return EdgeEstimate(
        rotation=state.rotation,
        translation=state.translation,
        covariance=left_covariance(state.rotation, np.asarray(np.linalg.inv(H)) / EFFICIENCY),
        residuals=residual,
        inliers=inliers,
        rms_m=float(np.sqrt(np.mean(residual[inliers] ** 2))),
        reduced_chi2=float(_square(r[inliers]).sum() / freedom) if freedom > 0 else float("nan"),
        condition=condition,
        point=state.point,
        direction=state.direction,
    )


def with_sensor(
    e: EdgeEstimate,
    sensor: SensorCorrection,
    poses: FlangePoses,
    p: Floats,
    *,
    sigma_robot_m: float,
    sigma_xz_m: ArrayLike,
) -> Floats:
    """Covariance (6, 6) of an estimate by points that a sensor correction corrected, with what that leaves open.

    Args:
        e: the estimate; sensor: the correction; poses: of the scans.
        p: (n, 2) m, the points as they were measured; sigma_robot_m, sigma_xz_m: as for edge_joint.
    """
    predicted_p, J, by_robot = predicted(EdgeState(e.rotation, e.translation, e.point, e.direction), poses)
    x, z = (p - sensor.origin).T
    by_sensor = np.stack([np.column_stack([x, 0 * x, z]), np.column_stack([0 * x, z, x])], axis=1)
    covariance = measurement_covariance(by_robot, sigma_robot_m, np.asarray(sigma_xz_m, float))
    _, both = whitened(covariance, predicted_p, np.concatenate([J, by_sensor], axis=2))
    both = both[e.inliers].reshape(-1, 13)
    G = np.linalg.lstsq(both[:, :10], both[:, 10:], rcond=None)[0]
    return np.asarray(e.covariance + left_covariance(e.rotation, G @ sensor.covariance @ G.T))
