"""Estimate the poses of a mounting and the scanner's correction from circles at known joint angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection, correction_of, expected_factors
from weldcal.calibration.flange.base_circle import fit_base_circle
from weldcal.calibration.flange.fit import FlangeFit, FlangeFitConfig, FlangeGuess, fit_flange
from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import as_transform, skew
from weldcal.calibration.hand_eye.determinacy import check_poses, determinacy, with_open_directions
from weldcal.calibration.hand_eye.mountings import TargetObservation
from weldcal.calibration.hand_eye.problem import NAMES, Problem, State, inverse_information, linearise
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeHeldOut, HandEyeResult, fold_labels, solve_problem
from weldcal.calibration.planning.mounting_poses import MountingPose, work_point
from weldcal.calibration.planning.mounting_scene import LENGTH_M, MountingScene
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.flanges import FlangeStandard

_ORDER = 2  # of the correction: scale, gradient and bends
_FIELD_M = 0.03  # the face of a circle reaches so far about its centre
_REST = np.array([1.4e-4, 1.4e-4, 1.4e-5, 1.4e-5, 1.4e-5])  # rad, m per axis: what a correction leaves of a scanner
_WEIGHT = 6.0  # residuals that this expectation, and that of the arm's error, count as
_ROUNDS = 12
_FIT = FlangeFitConfig(
    min_coverage=0.85
)  # poses are chosen with the whole circle in view; an object before it spoils its edge
# Errors of the fits over their stated sigma (which assumes independent noise in a scan), rms in simulated scans
_FIT_SHARE = 1.25
_HUBER = 3.0  # root mean square residual of an observation, in sigma, beyond which its weight falls
_VAGUE = 0.7  # of a factor's usual error: what the scans leave of a factor that they do not determine
_FACTORS = ("scale", "gradient along x", "gradient along y", "bend in x", "twist", "bend in y")


@dataclass(frozen=True)
class Circle:
    """The circle to look for.

    Its dimensions, how far it may lie from its prediction (m), and whether it is the ring of the base mounting, whose
    far side is hidden by its column.
    """

    standard: FlangeStandard
    guess_radius_m: float
    foot: bool


@dataclass(frozen=True, eq=False)
class ObservedCircle:
    """One scan with the circle.

    The arms' joints and expected view, the observation, the visible share of the circle's edge, and the circle as
    found.
    """

    label: str
    pose: MountingPose
    observation: TargetObservation
    coverage: float
    fit: FlangeFit | None = None


@dataclass(frozen=True, kw_only=True)
class MountingResult(HandEyeResult):
    """The unknown poses, and the scanner's correction that goes with them.

    ``with_factors`` (m + 6, m + 6): covariance of the poses, in the order of ``joint_covariance``, and of the
    correction's factors. ``undetermined``: factors that the scans do not determine. ``arm_error_m``: rms error of the
    arm's flange that the residuals support.
    """

    correction: ScannerCorrection
    with_factors: Array
    undetermined: tuple[str, ...]
    arm_error_m: float

    def point_covariance(self, p_C: Array) -> Array:
        """Covariance (3, 3) m^2 of a scanned point, in the frame that carries the scanner.

        ``p_C`` (3,) m, as scanned.
        """
        return np.asarray(self.slopes(p_C) @ self.with_factors @ self.slopes(p_C).T)

    def place(self, p_C: Array) -> Array:
        """Return a scanned point (3,) m in the frame that carries the scanner."""
        return np.asarray(self.X @ self.correction.points(p_C))

    def slopes(self, p_C: Array) -> Array:
        """Derivatives (3, m + 6) of a scanned point's place by what ``with_factors`` is of."""
        R = self.X.rotation().matrix()
        J = np.zeros((3, len(self.with_factors)))
        J[:, :6] = np.hstack([-skew(R @ self.correction.points(p_C)), np.eye(3)])
        J[:, -TERMS[_ORDER] :] = np.outer(R @ p_C, self.correction.terms(p_C))
        return J


@dataclass(eq=False, kw_only=True)
class _Fit:
    """The present estimate: poses, change of the factors, errors of the links in units of their prior, spreads."""

    state: State
    factors: Array
    links: Array
    noise: Array = field(
        default_factory=_REST.copy
    )  # (5,) spreads beyond an observation's own: normal (rad), position (m)
    arm: float = 1.0  # error of the arm over the one expected
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of poses, factors, links
    free: float = 1.0


def see_circle(
    points_C: Array, belief: MountingScene, label: str, q: Array, q_2: Array | None, circle: Circle
) -> ObservedCircle:
    """Find the circle in a cloud, (H, W, 3) or (N, 3) m, near its predicted place.

    Raises FlangeNotFound with the reason.
    """
    X_CR = belief.seen(q, q_2)
    R = X_CR.rotation().matrix()
    guess = FlangeGuess(X_CR.translation(), circle.guess_radius_m + 0.5 * circle.standard.outer_m, R[:, 2])
    fit = (
        fit_base_circle(points_C, circle.standard, guess)
        if circle.foot
        else fit_flange(points_C, circle.standard, guess=guess, config=_FIT)
    )
    own = block_diag(fit.normal_sigma**2 * np.eye(3), R.T @ fit.center_covariance @ R)  # for an arc it is not isotropic
    observation = belief.observation(q, q_2, fit.center_C, fit.normal_C, _FIT_SHARE**2 * own)
    return ObservedCircle(label, MountingPose(q, q_2, X_CR), observation, fit.coverage, fit)


def off_prediction(
    belief: MountingScene, seen: ObservedCircle, correction: ScannerCorrection | None
) -> tuple[float, float]:
    """Return distance (m) and angle (rad) of an observed circle from where a calibration expects it."""
    p, n = seen.observation.p_CM, seen.observation.n_CM
    assert n is not None
    if correction is not None:
        p, n = correction.points(p), correction.normals(p, n)
    X_CR = belief.seen(seen.pose.q, seen.pose.q_2)
    cosine = float(np.clip(X_CR.rotation().matrix()[:, 2] @ n, -1.0, 1.0))
    return float(np.linalg.norm(X_CR.translation() - p)), float(np.arccos(cosine))


def fewest(scene: MountingScene) -> int:
    """Smallest number of observations to solve: six position equations more than unknowns, to estimate the noise."""
    return 2 + 2 * (len(scene.mounting.unknowns) - len(scene.known))


def solve_mounting(scene: MountingScene, seen: Sequence[ObservedCircle], *, folds: int = 0) -> MountingResult:
    """Solve for the unknown poses and the scanner's correction with all observations.

    Maximum a posteriori. Unknown poses have no prior. Factors of the correction are held to what scanners are usually
    off, errors of the arm's links to ``scene.arm_error_m``. The spread of observations, and the size of the arm's
    error, follow from the residuals (Helmert), with the expected ones as prior. The poses are those that go with the
    arm as its controller reports it; the covariance contains errors of arm and scanner. Held-out errors are predictions
    with the reported poses. Raises as solve_problem.
    """
    problem = scene.problem([s.observation for s in seen])
    start = solve_problem(
        problem,
        scene.state,
        config=HandEyeConfig(folds=0),
        equation=scene.mounting.equation,
        starts=(scene.state,),
        labels=scene.mounting.labels,
    )
    keep = start.inliers
    data = _data(scene, seen)
    fit = _fitted(data.pick(keep), _state(start, scene.state), scene)
    correction = correction_of(fit.factors, data.field)
    e = _rows(data, fit.state, correction)[0]
    held = HandEyeHeldOut(*np.full((2, len(seen)), np.nan))
    label = fold_labels(len(seen), folds) if folds else np.zeros(0)
    for k in range(min(folds, len(seen))):
        try:
            check_poses(problem.pick(keep & (label != k)))
        except WeldcalError:
            continue
        without = _fitted(data.pick(keep & (label != k)), fit.state, None)
        off = _rows(data.pick(label == k), without.state, correction_of(without.factors, data.field))[0]
        held.rotation_rad[label == k] = np.linalg.norm(off[:, :2], axis=1)
        held.translation[label == k] = np.linalg.norm(off[:, 2:], axis=1)
    m, K = problem.size, TERMS[_ORDER]
    joint = fit.covariance[: m + K, : m + K]
    used = problem.pick(keep)
    found = determinacy(
        used,
        fit.state,
        np.asarray(np.linalg.pinv(joint[:m, :m], hermitian=True), dtype=np.float64),
        joint[:m, :m],
        start.extent,
        float(fit.noise[0]),
        start.labels,
    )
    poses = with_open_directions(joint[:m, :m], found, start.extent)
    joint = joint.copy()
    joint[:m, :m] = poses
    blocks = {NAMES[k]: slice(6 * i, 6 * i + 6) for i, k in enumerate(problem.blocks)}
    known = np.sqrt(np.diag(joint)[m:]) / data.usual
    changed = {
        "poses": {name: as_transform(fit.state[NAMES.index(name)]) for name in blocks},
        "covariance": {name: poses[b, b] for name, b in blocks.items()},
        "joint_covariance": poses,
        "degrees_of_freedom": fit.free,
        "rotation_rad": np.linalg.norm(e[:, :2], axis=1),
        "translation": np.linalg.norm(e[:, 2:], axis=1),
        "held_out": held,
        "sigma_rotation_rad": float(fit.noise[0]),
        "sigma_translation": float(fit.noise[2]),
        "unobservable": tuple(dict.fromkeys((*start.unobservable, *found.names))),
        "method": "maximum a posteriori, with the errors of scanner and arm",
    }
    return MountingResult(
        **{f.name: changed.get(f.name, getattr(start, f.name)) for f in fields(HandEyeResult)},
        correction=correction,
        with_factors=joint,
        undetermined=tuple(name for name, share in zip(_FACTORS, known, strict=True) if share > _VAGUE),
        arm_error_m=fit.arm * scene.arm_error_m,
    )


def _state(result: HandEyeResult, given: State) -> State:
    X, Y, Z = (
        np.asarray(result.poses[name].GetAsMatrix4()) if name in result.poses else given[i]
        for i, name in enumerate(NAMES)
    )
    return X, Y, Z


@dataclass(eq=False, kw_only=True)
class _Data:
    """Observations (n) of a circle.

    Problem, centres and normals as measured, their stated covariance (n, 5, 5), derivatives (n, 5, k) by errors of
    links and covariance (n, 5, 5) of stops (both follow from the state), usual factors, and field of the correction.
    """

    problem: Problem
    p: Array
    normal: Array
    own: Array
    links: Array
    stops: Array
    poses: tuple[MountingPose, ...]
    usual: Array
    field: tuple[float, float, float, float]

    def pick(self, rows: NDArray[np.bool_]) -> _Data:
        """Some of the observations."""
        return replace(
            self,
            problem=self.problem.pick(rows),
            poses=tuple(q for q, use in zip(self.poses, rows, strict=True) if use),
            **{name: getattr(self, name)[rows] for name in ("p", "normal", "own", "links", "stops")},
        )


def _data(scene: MountingScene, seen: Sequence[ObservedCircle]) -> _Data:
    p = np.array([s.observation.p_CM for s in seen])
    low, high = p.min(axis=0) - _FIELD_M - scene.radius_m, p.max(axis=0) + _FIELD_M + scene.radius_m
    poses = tuple(s.pose for s in seen)
    links, stops = _links(scene, poses, scene.state)
    return _Data(
        problem=scene.problem([s.observation for s in seen]),
        p=p,
        normal=np.array([s.observation.n_CM for s in seen]),
        own=np.array([_own(s) for s in seen]),
        links=links,
        stops=stops,
        poses=poses,
        usual=expected_factors(TERMS[_ORDER], float(np.median(p[:, 2]))),
        field=(low[0], high[0], low[1], high[1]),
    )


def _fitted(data: _Data, state: State, scene: MountingScene | None) -> _Fit:
    """Solve by Gauss-Newton over poses, factors and links, and estimate the spreads between steps.

    ``scene`` renews links and stops of ``data``.
    """
    n, m, K, own = len(data.p), data.problem.size, TERMS[_ORDER], data.own
    fit = _Fit(state=state, factors=np.zeros(K), links=np.zeros(data.links.shape[2]))
    w, more = np.ones(n), np.ones(5)
    for count in range(_ROUNDS):
        if scene is not None and count in (0, 2):
            data.links, data.stops = _links(scene, data.poses, fit.state)
        e, J = _rows(data, fit.state, correction_of(fit.factors, data.field))
        J, e = np.concatenate([J, data.links], axis=2), e + data.links @ fit.links
        prior = np.concatenate([np.zeros(m), 1.0 / data.usual, np.full(len(fit.links), 1.0 / fit.arm)]) ** 2
        common = (data.stops + np.diag(_REST**2)) * more[:, None] * more
        W = np.linalg.inv(own + common)
        JW = np.swapaxes(J, 1, 2) @ W * w[:, None, None]
        V = inverse_information((JW @ J).sum(axis=0) + np.diag(prior))
        pull = (JW @ e[:, :, None]).sum(axis=0)[:, 0] + prior * np.concatenate([np.zeros(m), fit.factors, fit.links])
        step = -V @ pull
        fit.state = data.problem.step(fit.state, step[:m])
        fit.factors, fit.links = fit.factors + step[m : m + K], fit.links + step[m + K :]
        fit.covariance = V
        left = e + J @ step
        square = np.einsum("ni,nij,nj->n", left, W, left)
        w = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(square / 5.0, 1e-12)))
        taken = np.einsum("nij,jk,nik->ni", J, V, J)  # variance of the fitted part of each number
        part = np.diagonal(common, axis1=1, axis2=2)
        total = part + np.diagonal(own, axis1=1, axis2=2)
        for group in (slice(0, 2), slice(2, 5)):
            # the square of a residual is expected to be its variance, less that of the fitted part
            weight = w[:, None] * (part / total)[:, group]
            ratio = (weight * left[:, group] ** 2 / total[:, group]).sum() + _WEIGHT / more[group][0] ** 2
            more[group] *= np.sqrt(
                ratio / ((weight * (1.0 - taken[:, group] / total[:, group]).clip(0.0)).sum() + _WEIGHT)
            )
        fit.noise = np.sqrt(part.mean(axis=0))
        redundancy = (1.0 - np.diag(V)[m + K :] / fit.arm**2).clip(0.0)
        fit.arm = float(np.sqrt((fit.links @ fit.links + _WEIGHT) / (redundancy.sum() + _WEIGHT)))
        fit.free = 5.0 * n - m + _WEIGHT
    return fit


def _own(seen: ObservedCircle) -> Array:
    """Covariance (5, 5) that the fit of a circle states: normal, centre."""
    C = seen.observation.covariance
    return np.zeros((5, 5)) if C is None else C[np.ix_([0, 1, 3, 4, 5], [0, 1, 3, 4, 5])]


def _rows(data: _Data, state: State, correction: ScannerCorrection) -> tuple[Array, Array]:
    """Residuals (n, 5) of normals (rad) and centres (m) in the circle's axes, and their derivatives (n, 5, m + 6)."""
    p = data.p
    problem = _corrected(data.problem, correction.points(p), correction.normals(p, data.normal))
    lin = linearise(problem, state, np.zeros(3))
    L = state[1] @ problem.H @ state[2]
    R = np.swapaxes(L[:, :3, :3], 1, 2) @ problem.F[:, :3, :3] @ state[0][:3, :3]
    terms, slopes = correction.terms(p), correction.slopes(p)
    shift = (R @ p[:, :, None]) * terms[:, None, :]
    lean = np.zeros((len(p), 3, terms.shape[1]))
    lean[:, :2] = -np.swapaxes(slopes, 1, 2) * (p * data.normal).sum(axis=1)[:, None, None]
    lean = R @ lean
    factors = np.concatenate([np.stack([-lean[:, 1], lean[:, 0]], axis=1), shift], axis=1)
    poses = np.concatenate([lin.Jw[:, :2], lin.Jd], axis=1)
    return np.concatenate([lin.w[:, :2], lin.d], axis=1), np.concatenate([poses, factors], axis=2)


def _corrected(problem: Problem, p: Array, normal: Array) -> Problem:
    """Return the problem with other centres (n, 3) and normals (n, 3) as measured."""
    G = problem.G.copy()
    G[:, :3, 3] = p
    x = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    G[:, :3, :3] = np.stack([x, np.cross(normal, x), normal], axis=2)
    return replace(problem, G=G)


def _links(scene: MountingScene, poses: Sequence[MountingPose], state: State) -> tuple[Array, Array]:
    """Return derivatives (n, 5, links) by errors of the links between circle and scanner.

    Each is in units of its expected size. Also returns the covariance (n, 5, 5) that the arm's repeatability gives.
    """
    belief = scene.believing(
        {name: as_transform(X) for name, X in zip(NAMES, state, strict=True) if name not in scene.known}
    )
    columns, spread = [], []
    for pose in poses:
        X_BR = belief.circle(belief.frames(pose.q), pose.q_2)
        R_T, P = X_BR.rotation().matrix().T, X_BR.translation()
        each, stops = [], []
        for link in belief.carried(pose.q, pose.q_2):
            R, axis = link.X_before.rotation().matrix(), link.X.rotation().matrix()[:, 2]
            turn, lever = R_T @ R, P - link.X_before.translation()
            move = R_T @ np.hstack([-skew(lever) @ R, LENGTH_M * R])
            each.append(link.sign * link.error_rad * np.vstack([np.hstack([turn, np.zeros((3, 3))])[:2], move]))
            swing = R_T @ np.cross(axis, P - link.X.translation())
            stops.append(link.spread_rad * np.concatenate([(R_T @ axis)[:2], swing]))
        columns.append(np.hstack(each))
        spread.append(np.array(stops).T @ np.array(stops))
    return np.array(columns), np.array(spread)


def expected_error(scene: MountingScene, result: MountingResult) -> tuple[float, float]:
    """Expected error (m) of a scanned point at the scanner's best distance.

    Rms, and the bound that it keeps with 95 %.
    """
    S = result.point_covariance(work_point(scene))
    return float(np.sqrt(np.trace(S))), radius_95(S)


def expected_after(
    scene: MountingScene, result: MountingResult, seen: Sequence[ObservedCircle], left: Sequence[MountingPose]
) -> Array:
    """Expected errors (k,) m, rms, of a point at the best distance after one more scan at each of k poses."""
    state, own = _state(result, scene.state), np.median([_own(s) for s in seen], axis=0)
    views = [scene.observation(p.q, p.q_2, p.X_CR.translation(), p.X_CR.rotation().matrix()[:, 2]) for p in left]
    data = _data(scene, [ObservedCircle("", pose, view, 1.0) for pose, view in zip(left, views, strict=True)])
    links, stops = _links(scene, left, state)
    J = _rows(data, state, result.correction)[1]
    W = np.linalg.inv(own + stops + np.diag(_REST**2) + links @ np.swapaxes(links, 1, 2))
    J_work, before = result.slopes(work_point(scene)), inverse_information(result.with_factors)
    after = [inverse_information(before + J[i].T @ W[i] @ J[i]) for i in range(len(left))]
    return np.array([float(np.sqrt(np.trace(J_work @ V @ J_work.T))) for V in after])
