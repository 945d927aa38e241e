"""Solve the poses of several sensors with one target on one robot together, with the covariance between them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.geometry.se3 import IDENTITY, inverse, mean_pose, moved, skew
from weldcal.calibration.hand_eye.choice import USUAL_DISCORD_RAD
from weldcal.calibration.hand_eye.corners import poses_from_corners
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pictures.bundle import Bundle, board_terms
from weldcal.calibration.hand_eye.problem import Problem, full_problem, linearise, residuals
from weldcal.calibration.hand_eye.repeats import distinct_poses
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, fold_labels, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

_ROUNDS, _SETTLED = 10, 1e-3  # linearisations at most; steps in sigmas that change no answer
# Bounds of a standard deviation, rad or m, and px: beyond those of any calibration, near enough for double precision.
_LEAST, _MOST, _LEAST_PX, _MOST_PX = 1e-6, 0.1, 1e-3, 20.0
_LOOSE = 1e-3  # information of the logarithm of a standard deviation about its start: only bounds what is open
_DIFFERENT = 4.0  # a choice: so many times its own noise a sensor leaves beside the others where the targets differ
_START_PX = 0.2  # of a corner, where the search for its size begins
_STEP = 0.1  # sigma, of the differences that show what an error of a camera changes

SharedError = tuple[float, float]
"""Standard deviations per axis, rad and m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorPairs:
    """One sensor: its pairs, and its own solution of them with X and Y free.

    ``bundle``, ``free``: of pictures, the adjustment that gave ``pairs`` their camera and board, and the numbers of the
    camera that it estimated.
    """

    name: str
    pairs: PosePairs
    result: HandEyeResult
    bundle: Bundle | None = None
    free: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorsTogether:
    """Poses of N sensors that share target and robot.

    Attributes:
        names: of the sensors.
        X: poses (N, 4, 4) of the sensors, as in F X G = Y.
        Y: pose (4, 4) of the target.
        covariance: of X and Y (6 N + 6, 6 N + 6), each as (exp(a) R, p + b).
        noise: (N, 2) rad and m, per axis, of each sensor's own errors.
        common: rad and m, per axis, of the errors at a robot pose that all sensors share: the robot's.
        sizes: (N + 1, 2) the standard deviations of the model: the robot's rad and m, then each sensor's rad and m; of
            cameras with corners px and m.
        cameras: errors of the cameras, in standard deviations, as the solution has them.
        poses: distinct robot poses (N,) of each sensor.
        shared: distinct robot poses that more than one sensor measured.
        apart_m, together_m: rms distance between where two sensors find the target at a robot pose that neither
            solution used, with the sensors' own solutions and with this one; NaN where fewer than four are shared.
    """

    names: tuple[str, ...]
    X: Array
    Y: Array
    covariance: Array
    noise: Array
    common: SharedError
    sizes: Array
    cameras: Array
    poses: NDArray[np.int64]
    shared: int
    apart_m: float = float("nan")
    together_m: float = float("nan")

    def between(self, i: int, j: int) -> tuple[Array, Array]:
        """Pose (4, 4) of sensor j in sensor i, X_CiCj, and its covariance (6, 6) as (exp(a) R, p + b)."""
        X_ij = inverse(self.X[i]) @ self.X[j]
        R, lever = self.X[i][:3, :3].T, self.X[j][:3, 3] - self.X[i][:3, 3]
        J = np.zeros((6, 12))
        J[:3, :3], J[:3, 6:9], J[3:, 3:6], J[3:, 9:] = -R, R, -R, R
        J[3:, :3] = R @ skew(lever)
        rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        return X_ij, np.asarray(J @ self.covariance[np.ix_(rows, rows)] @ J.T)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Rows:
    """Observations of all sensors: numbers (n,) of the sensor, of its sample, and of the robot pose among all.

    ``shape`` (n, 2, 6, 6): covariances of its own error in units of the two variances of the sensor.
    """

    sensor: NDArray[np.int64]
    sample: NDArray[np.int64]
    place: NDArray[np.int64]
    shape: Array

    def pick(self, rows: NDArray[np.bool_]) -> "_Rows":
        return _Rows(sensor=self.sensor[rows], sample=self.sample[rows], place=self.place[rows], shape=self.shape[rows])

    @property
    def groups(self) -> list[NDArray[np.int64]]:
        """Rows (k, m) of the k poses that m sensors measured, for every m."""
        order = np.argsort(self.place, kind="stable")
        _, first, count = np.unique(self.place[order], return_index=True, return_counts=True)
        return [order[first[count == m][:, None] + np.arange(m)] for m in np.unique(count)]

    @property
    def shared(self) -> int:
        """How many poses more than one sensor measured."""
        return int((np.bincount(self.place) > 1).sum())


def solve_together(sensors: Sequence[SensorPairs], config: HandEyeConfig | None = None) -> SensorsTogether:
    """Solve F_i X_k G_ki = Y for the poses X_k of all sensors k and that of their one target.

    At a robot pose all sensors share one error of the robot, and each has its own, normal with one standard deviation
    for rotations and one for displacements of the target's middle. Where a camera's corners are given, an error of each
    corner takes the place of the rotations. The standard deviations follow from the restricted
    likelihood. Camera to camera is thus as good as the sensors are, however bad the robot. Cameras with corners have an
    unknown shift of the principal point, with the standard deviation USUAL_DISCORD_RAD. The covariance contains the
    discord of the own solution of sensors without, and the errors of camera and board of pictures. Observations
    that a sensor's own solution excluded are not used.

    Raises:
        InconsistentPoses: one of the sensors saw another target.
    """
    pairs, places = _per_pose(sensors)
    work = _Joint(sensors, pairs)
    rows = _Rows(
        sensor=np.repeat(np.arange(len(pairs)), [len(p) for p in places]),
        sample=np.concatenate([np.arange(len(p)) for p in places]),
        place=np.concatenate(places),
        shape=np.concatenate([work.shape(k) for k in range(len(pairs))]),
    )
    start = int(np.argmin([s.result.sigma_translation for s in sensors]))
    found = work.solved(rows, work.start(start))
    sizes = np.hypot(found.noise, np.asarray(found.common))
    own = np.array([[s.result.sigma_rotation_rad, s.result.sigma_translation] for s in sensors])
    worse = (sizes / np.maximum(own, 2.0 * _LEAST)).max(axis=1)
    if float(worse.max()) > _DIFFERENT:
        k = int(np.argmax(worse))
        raise InconsistentPoses(
            f"'{sensors[k].name}' and the other sensors do not show one target: beside them its poses scatter"
            f" {worse[k]:.0f} times as much as alone. Solve it by itself if it saw another target."
        )
    apart, together = _held_out(work, rows, config or HandEyeConfig(), found)
    return replace(found, apart_m=apart, together_m=together)


def _per_pose(sensors: Sequence[SensorPairs]) -> tuple[list[PosePairs], list[NDArray[np.int64]]]:
    """Pairs of each sensor with the mean of the samples at a robot pose, and the numbers of these poses over all."""
    used = [_picked(s.pairs, s.result.inliers) for s in sensors]
    F, G, H = (np.concatenate([getattr(p, part) for p in used]) for part in "FGH")
    place = distinct_poses(full_problem(F, G, H))
    joined, places = [], []
    for p, mine in zip(used, np.split(place, np.cumsum([len(p.robot) for p in used])[:-1]), strict=True):
        distinct, first, count = np.unique(mine, return_index=True, return_counts=True)
        means = _picked(p, first)
        for row in np.flatnonzero(count > 1):
            alike = mine == distinct[row]
            means.camera[row] = mean_pose(p.camera[alike])
            if means.img is not None and p.img is not None:
                means.img[row] = p.img[alike].mean(axis=0)
        joined.append(means)
        places.append(distinct)
    return joined, places


def _picked(p: PosePairs, rows: NDArray[np.bool_] | NDArray[np.int64]) -> PosePairs:
    """Return some of the pairs, in arrays of their own."""

    def of(part: Array | None) -> Array | None:
        return None if part is None else part[rows].copy()

    whole = replace(p, robot2=of(p.robot2), link=of(p.link), img=of(p.img))
    return replace(whole, robot=p.robot[rows].copy(), camera=p.camera[rows].copy())


@dataclass(frozen=True, eq=False)
class _At:
    """State of the solution: poses, errors of the cameras in sigmas, and logarithms of the standard deviations."""

    X: Array
    Y: Array
    cameras: Array
    logs: Array


class _Joint:
    """The linear problem of all sensors at a state.

    Unknowns: X of each sensor and Y, 6 each; then errors of each camera with corners, in standard deviations: the shift
    of its principal point, or of pictures what their adjustment left of camera and board.
    """

    def __init__(self, sensors: Sequence[SensorPairs], pairs: Sequence[PosePairs]) -> None:
        self.sensors, self.pairs = sensors, pairs
        self.problems = [full_problem(p.F, p.G, p.H) for p in pairs]
        n = len(sensors)
        self.corners = np.array([_has_corners(p) for p in pairs])
        self.errors = [_errors(s) if corners else _NO_ERRORS for s, corners in zip(sensors, self.corners, strict=True)]
        self.core = 6 * n + 6
        last = self.core + np.cumsum([one.size for one in self.errors])
        self.columns = [slice(int(end) - one.size, int(end)) for end, one in zip(last, self.errors, strict=True)]
        self.size = int(last[-1])
        self.centre = np.asarray(np.mean([s.result.noise_centre for s in sensors], axis=0))
        self.bounds = np.tile([_LEAST, _MOST], (n + 1, 2, 1))
        self.bounds[1:, 0][self.corners] = _LEAST_PX, _MOST_PX

    def start(self, k: int) -> _At:
        """The sensors' own solutions, with the target of sensor ``k``."""
        results = [s.result for s in self.sensors]
        X = np.array([np.asarray(r.X.GetAsMatrix4()) for r in results])
        own = np.array([[r.sigma_rotation_rad, r.sigma_translation] for r in results])
        logs = np.log(np.maximum(np.vstack([0.5 * own.min(axis=0), own]), 2.0 * _LEAST))
        logs[1:, 0] = np.where(self.corners, np.log(_START_PX), logs[1:, 0])
        return _At(X, np.asarray(results[k].Y.GetAsMatrix4()), np.zeros(self.size - self.core), logs.ravel())

    def shape(self, k: int) -> Array:
        """Covariances (n, 2, 6, 6) of the errors of sensor ``k``, in units of its two variances.

        Of rotations and of displacements alike in all directions; with corners, what a pixel's error in each corner
        does to the board's pose takes the place of the former.
        """
        p = self.pairs[k]
        out = np.zeros((len(p.robot), 2, 6, 6))
        out[:, 0, :3, :3] = out[:, 1, 3:, 3:] = np.eye(3)
        if self.corners[k]:
            assert p.img is not None
            assert p.obj is not None
            assert p.K is not None
            dist = np.zeros(5) if p.dist is None else p.dist
            for i, X in enumerate(poses_from_corners(p, np.zeros(2))):
                seen = np.isfinite(p.img[i]).all(axis=1)
                arm = p.obj[seen] - self.centre
                _, jac = cv2.projectPoints(p.obj[seen], cv2.Rodrigues(X[:3, :3])[0], X[:3, 3], p.K, dist)
                by_point = np.asarray(jac, dtype=float).reshape(len(arm), 2, -1)[:, :, 3:6] @ X[:3, :3]
                J = np.concatenate([-by_point @ skew(arm), by_point], axis=2).reshape(-1, 6)
                out[i, 0] = np.linalg.inv(J.T @ J)
        return out

    def measured(self, k: int, at: _At, more: Array | float = 0.0) -> Problem:
        """The equation of sensor ``k`` with the errors of its camera, and ``more``, taken off."""
        p, one, columns = self.pairs[k], self.errors[k], self.columns[k]
        if not one.size:
            return self.problems[k]
        assert p.K is not None
        assert p.obj is not None
        x = at.cameras[columns.start - self.core : columns.stop - self.core] + more
        f = len(one.free)
        c = np.r_[p.K[0, 0], p.K[1, 1], p.K[:2, 2], np.zeros(5) if p.dist is None else p.dist]
        c[one.free] += one.root @ x[:f]
        K = np.array([[c[0], 0.0, c[2]], [0.0, c[1], c[3]], [0.0, 0.0, 1.0]])
        obj = p.obj + board_terms(p.obj)[0] @ (one.board * x[f:]) if one.size > f else p.obj
        return replace(self.problems[k], G=poses_from_corners(replace(p, K=K, dist=c[4:], obj=obj), np.zeros(2)))

    def lines(self, rows: _Rows, at: _At) -> tuple[Array, Array]:
        """Residuals (n, 6) and derivatives (n, 6, m)."""
        n = len(self.sensors)
        e, J = np.zeros((len(rows.sample), 6)), np.zeros((len(rows.sample), 6, self.size))
        for k in range(n):
            mine = rows.sensor == k
            sample = rows.sample[mine]
            state = (at.X[k], at.Y, IDENTITY)
            lin = linearise(self.measured(k, at).pick(sample), state, self.centre)
            e[mine] = np.concatenate([lin.w, lin.d], axis=1)
            by = np.concatenate([lin.Jw, lin.Jd], axis=1)
            J[mine, :, 6 * k : 6 * k + 6], J[mine, :, 6 * n : 6 * n + 6] = by[:, :, :6], by[:, :, 6:12]
            for column, step in enumerate(_STEP * np.eye(self.errors[k].size), self.columns[k].start):
                up, down = (
                    np.concatenate(residuals(self.measured(k, at, s).pick(sample), state, self.centre), axis=1)
                    for s in (step, -step)
                )
                J[mine, :, column] = (up - down) / (2.0 * _STEP)
        return e, J

    def turned(self, k: int, rows: _Rows, at: _At) -> Array:
        """Derivatives (n, 6, 3) by a turn of the displacements of sensor ``k`` alone."""
        mine = rows.sensor == k
        out = np.zeros((len(rows.sample), 6, 3))
        problem = self.problems[k].pick(rows.sample[mine])
        out[mine, 3:] = linearise(problem, (at.X[k], at.Y, IDENTITY), self.centre).Jd[:, :, :3]
        return out

    def solved(self, rows: _Rows, at: _At) -> SensorsTogether:
        """Alternate between the restricted likelihood of the standard deviations and a step of the unknowns."""
        n, groups, shared, begin = len(self.sensors), rows.groups, rows.shared, at.logs
        for _ in range(_ROUNDS):
            e, J = self.lines(rows, at)
            information, off = np.zeros(self.size), np.zeros(self.size)
            information[self.core :], off[self.core :] = 1.0, at.cameras
            total = partial(_summed, rows, groups, e, J, information, off)
            logs = _likeliest(total, at.logs, begin, self.bounds.reshape(-1, 2), common=shared > 1)
            N, b, *_ = total(np.exp(logs))
            S = np.asarray(np.linalg.inv(N), dtype=float)
            step = -S @ b
            X = np.array([moved(X, step[6 * k : 6 * k + 6]) for k, X in enumerate(at.X)])
            at = _At(X, moved(at.Y, step[6 * n : self.core]), at.cameras + step[self.core :], logs)
            if float(step @ N @ step) < _SETTLED**2:
                break
        for k in np.flatnonzero(~self.corners):
            # the displacements may be those of a camera that is turned: not solved for, and so still uncertain
            pulled = S @ _pulled(rows, groups, np.exp(logs), J, self.turned(int(k), rows, at))
            S = S + self.sensors[int(k)].result.discord_rad ** 2 * pulled @ pulled.T
        sizes = np.exp(at.logs).reshape(-1, 2)
        mean = np.einsum("nv,nvii->ni", sizes[1 + rows.sensor] ** 2, rows.shape)
        noise = np.array([mean[rows.sensor == k].mean(axis=0).reshape(2, 3).mean(axis=1) for k in range(n)])
        return SensorsTogether(
            names=tuple(s.name for s in self.sensors),
            X=at.X,
            Y=at.Y,
            covariance=S[: self.core, : self.core],
            noise=np.sqrt(noise),
            sizes=sizes,
            common=(float(sizes[0, 0]), float(sizes[0, 1])) if shared > 1 else (0.0, 0.0),
            cameras=at.cameras,
            poses=np.bincount(rows.sensor, minlength=n),
            shared=shared,
        )


def _roots(rows: _Rows, group: NDArray[np.int64], sizes: Array) -> Array:
    """Cholesky factors (k, 6 m, 6 m) of the covariances of k groups of m observations at one pose each."""
    k, m = group.shape
    V = np.zeros((k, m, 6, m, 6))
    variances = sizes.reshape(-1, 2) ** 2
    V[:, :, np.arange(6), :, np.arange(6)] = np.repeat(variances[0], 3)[:, None, None, None]
    for a in range(m):
        mine = group[:, a]
        V[:, a, :, a, :] += np.einsum("nv,nvij->nij", variances[1 + rows.sensor[mine]], rows.shape[mine])
    return np.asarray(np.linalg.cholesky(V.reshape(k, 6 * m, 6 * m)))


def _likeliest(
    total: Callable[[Array], tuple[Array, Array, float, float]],
    logs: Array,
    begin: Array,
    bounds: Array,
    *,
    common: bool,
) -> Array:
    """Logarithms of the standard deviations that maximise the restricted likelihood, the common ones where asked."""
    free = slice(0 if common else 2, None)
    whole = logs.copy()
    if not common:
        whole[:2] = -np.inf

    def deviance(some: Array) -> float:
        whole[free] = some
        N, b, square, log = total(np.exp(whole))
        unit = 1.0 / np.sqrt(np.diag(N))
        L = np.linalg.cholesky(N * unit[:, None] * unit)
        x = np.linalg.solve(L, unit * b)
        log += 2.0 * float(np.log(np.diag(L) / unit).sum())
        return float(square - x @ x + log + _LOOSE * ((some - begin[free]) ** 2).sum())

    limits = [(float(low), float(high)) for low, high in np.log(bounds[free])]
    whole[free] = minimize(deviance, logs[free], method="L-BFGS-B", bounds=limits).x
    return whole


def _summed(
    rows: _Rows, groups: Sequence[NDArray[np.int64]], e: Array, J: Array, information: Array, off: Array, sizes: Array
) -> tuple[Array, Array, float, float]:
    """Information (m, m), gradient (m,), sum of squares in sigmas, and logarithm of the covariances' determinant.

    With the information (m,) of the unknowns before the data, and their distances ``off`` (m,) from its mean.
    """
    g = J.shape[2]
    N, b, square, log = np.diag(information), information * off, float(information @ off**2), 0.0
    for group in groups:
        L, k = _roots(rows, group, sizes), len(group)
        both = np.concatenate([J[group].reshape(k, -1, g), e[group].reshape(k, -1, 1)], axis=2)
        white = np.linalg.solve(L, both).reshape(-1, g + 1)
        A = white.T @ white
        N, b, square = N + A[:g, :g], b + A[:g, g], square + float(A[g, g])
        log += 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
    return N, b, square, log


def _pulled(rows: _Rows, groups: Sequence[NDArray[np.int64]], sizes: Array, J: Array, by: Array) -> Array:
    """J^T V^-1 ``by``, (m, 3)."""
    out = np.zeros((J.shape[2], by.shape[2]))
    for group in groups:
        L, k = _roots(rows, group, sizes), len(group)
        one, other = (np.linalg.solve(L, part[group].reshape(k, -1, part.shape[2])) for part in (J, by))
        out += np.einsum("nki,nkj->ij", one, other)
    return out


@dataclass(frozen=True, eq=False)
class _CameraErrors:
    """Numbers of the camera that may be off, a root (f, f) of their covariance, and sigmas (0 or 6,) of board terms."""

    free: NDArray[np.int64]
    root: Array
    board: Array

    @property
    def size(self) -> int:
        return len(self.free) + len(self.board)


_NO_ERRORS = _CameraErrors(np.zeros(0, dtype=np.int64), np.zeros((0, 0)), np.zeros(0))


def _errors(s: SensorPairs) -> _CameraErrors:
    """What may be off in the camera of a sensor with corners."""
    assert s.pairs.K is not None
    shift = USUAL_DISCORD_RAD * float(s.pairs.K[0, 0]) * np.eye(2)
    if s.bundle is None or s.free is None:
        return _CameraErrors(np.array([2, 3]), shift, np.zeros(0))
    if not len(s.free):
        return _CameraErrors(np.array([2, 3]), shift, s.bundle.terms_sigma)
    root = np.asarray(np.linalg.cholesky(s.bundle.camera_covariance), dtype=float)
    return _CameraErrors(s.free, root, s.bundle.terms_sigma)


def _has_corners(pairs: PosePairs) -> bool:
    """Whether the board's pose follows from the corners of every picture."""
    if not pairs.has_corners:
        return False
    try:
        poses_from_corners(pairs, np.zeros(2))
    except WeldcalError:
        return False
    return True


def _held_out(work: _Joint, rows: _Rows, config: HandEyeConfig, found: SensorsTogether) -> tuple[float, float]:
    """Return the rms distances between where two sensors find the target at left-out poses: apart and together."""
    places = np.unique(rows.place)
    label = np.zeros(int(places.max()) + 1, dtype=np.int64)
    label[places] = fold_labels(len(places))
    squares: list[tuple[float, float]] = []
    start = _At(found.X, found.Y, found.cameras, np.log(np.maximum(found.sizes, _LEAST).ravel()))
    for fold in range(5):
        out = label[rows.place] == fold
        test = rows.pick(out)
        if not test.shared:
            continue
        train = rows.pick(~out)
        try:
            own = [
                solve_problem(p.pick(train.sample[train.sensor == k]), config=replace(config, folds=0))
                for k, p in enumerate(work.problems)
            ]
        except WeldcalError:
            continue
        joint = work.solved(train, start)
        X = np.array([np.asarray(r.X.GetAsMatrix4()) for r in own])
        apart = replace(start, X=X, cameras=np.zeros_like(start.cameras))
        joined = replace(start, X=joint.X, cameras=joint.cameras)
        rest = [work.lines(test, at)[0][:, 3:] for at in (apart, joined)]
        for group in test.groups:
            for i, j in combinations(range(group.shape[1]), 2):
                gaps = [((d[group[:, i]] - d[group[:, j]]) ** 2).sum(axis=1) for d in rest]
                squares += list(zip(*gaps, strict=True))
    if len(squares) < 4:
        return float("nan"), float("nan")
    rms = np.sqrt(np.mean(squares, axis=0))
    return float(rms[0]), float(rms[1])
