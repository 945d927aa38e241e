"""Weighted least squares on SE(3): robust, rotation and translation each by the noise their own residuals admit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.handeye.problem import Linearised, Problem, State, linearise, residuals
from weldcal.calibration.handeye.se3 import exp_rotation

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_HUBER = 2.0  # in sigma per axis
_STUDENT = 5.0  # degrees of freedom of the heavy-tailed loss
_TINY = 1e-24  # of the squared extent: exact data have no noise to estimate
RANK = 1e-11  # eigenvalues below this share of the largest count as zero: a direction the sightings do not fix


class Loss(Enum):
    """How much a sighting's own residual may cost."""

    SQUARES = "least squares"
    HUBER = "Huber"
    STUDENT = "Student's t"


@dataclass(frozen=True)
class Noise:
    """Variances per axis beyond the sightings' own covariances: rotation rad^2 and translation of the noise centre.

    ``ratio``: factor on the translation's sigma in the weights only: > 1 lets the rotations decide the rotations.
    """

    rotation: float
    translation: float
    ratio: float = 1.0


@dataclass(frozen=True)
class Fit:
    """A converged fit. ``left_w``, ``left_d`` (n, 3): residuals of each sighting under the fit without it; ``w``, ``d``
    (n, 3): under the fit itself; ``scaled``: the normal equations of the sightings kept."""

    state: State
    noise: Noise
    centre: Array
    loss: Loss
    keep: Flags
    scaled: Scaled
    left_w: Array
    left_d: Array
    w: Array
    d: Array


def extent(problem: Problem) -> float:
    """A length that goes with the data: rms spread of what robots and camera state."""
    parts = [problem.F[:, :3, 3], problem.G[:, :3, 3], problem.H[:, :3, 3]]
    return float(np.sqrt(sum((((p - p.mean(axis=0)) ** 2).sum(axis=1)).mean() for p in parts))) or 1.0


def descend(problem: Problem, state: State, iterations: int = 30, tolerance: float = 1e-6) -> tuple[State, float]:
    """Levenberg-Marquardt from a rough start with a bounded loss; returns the state and its cost.

    Rotations in radians and lengths in units of the extent; each sighting's square s costs s / (1 + s) (Geman and
    McClure), so that a few gross ones do not pull.
    """
    length = extent(problem)
    zero = np.zeros(3)

    def squares(state: State) -> Array:
        w, d = residuals(problem, state, zero)
        return np.asarray(4.0 * (w**2).sum(axis=1) + 16.0 * (d**2).sum(axis=1) / length**2)

    s = squares(state)
    cost, damping = float((s / (1.0 + s)).sum()), 1e-3
    for _ in range(iterations):
        lin = linearise(problem, state, zero)
        k = 1.0 / (1.0 + s) ** 2
        N = _gram(lin.Jw * np.sqrt(4.0 * k)[:, None, None]) + _gram(lin.Jd * (4.0 / length * np.sqrt(k))[:, None, None])
        g = _pull(lin.Jw, 4.0 * k, lin.w) + _pull(lin.Jd, 16.0 * k / length**2, lin.d)
        improved = False
        for _ in range(8):
            change = -np.linalg.lstsq(N + damping * np.diag(np.diag(N) + 1e-12 * np.trace(N)), g, rcond=1e-12)[0]
            if float(np.abs(change).max()) > 1e3 * max(1.0, length):
                damping *= 10.0
                continue
            new = problem.step(state, np.asarray(change, dtype=np.float64))
            s_new = squares(new)
            cost_new = float((s_new / (1.0 + s_new)).sum())
            if cost_new < cost:
                improved = True
                break
            damping *= 6.0
        if not improved:
            break
        gain = cost - cost_new
        state, s, cost, damping = new, s_new, cost_new, max(damping / 6.0, 1e-9)
        if gain < tolerance * max(cost, 1e-300):
            break
    return state, cost


def noise_of(problem: Problem, w: Array, d: Array, keep: Flags) -> Noise:
    """Robust first guess of the noise from residuals: medians of squares over their value for a normal distribution."""
    floor = extent(problem) ** 2 * _TINY
    rows_w = keep & (problem.full | problem.normal)
    rotation = float(np.median((w[rows_w] ** 2).sum(axis=1))) / 2.366 if rows_w.any() else 1.0
    translation = float(np.median((d[keep] ** 2).sum(axis=1))) / 2.366
    return Noise(max(rotation, _TINY), max(translation, floor))


def _centre_columns(problem: Problem, lin: Linearised) -> Array:
    """Derivative (n, 3, 3) of the displacement (R_D - 1) c + t by the centre c."""
    return np.where(problem.full[:, None, None], exp_rotation(lin.w) - np.eye(3), 0.0)


def fit(
    problem: Problem,
    state: State,
    *,
    noise: Noise,
    loss: Loss,
    keep: Flags,
    centre: Array | None = None,
    hold_centre: bool = False,
    iterations: int = 60,
    tolerance: float = 1e-6,
) -> Fit:
    """Newton's method on the robust cost from a good start; the variances are re-estimated at every step.

    Variances: Helmert's simplified estimator, each group's weighted squares over its own redundancy. The noise centre is
    an unknown like the others (starting at ``centre``, else at the target's origin): the point of the target whose
    displacement is least, since a camera errs about the middle of a board and not about the origin someone gave it; so the
    answer moves with any choice of frames. It stays zero where full poses are too few, or exact. ``hold_centre``: keep it,
    and count it only as something else that is uncertain. ``keep`` (n,): sightings that count; the others get residuals
    only. ``tolerance``: of the last step, in standard deviations.
    """
    sub = problem if keep.all() else problem.pick(keep)
    floor = extent(sub) ** 2 * _TINY
    centre = np.zeros(3) if centre is None else centre
    # three more unknowns need some sightings to spare
    loose = int(sub.full.sum()) >= 5 + len(sub.blocks)
    lin = linearise(sub, state, centre)
    s = Scaled(sub, lin, noise, loss, _centre_columns(sub, lin) if loose else None)
    before = np.inf
    for _ in range(iterations):
        moving = sub.size if hold_centre else len(s.g)
        change = -s.newton(moving) @ s.g[:moving]
        size = float(np.sqrt(max(float(change @ s.A[:moving, :moving] @ change), 0.0)))
        state = sub.step(state, change[: sub.size])
        if loose and not hold_centre:
            centre = centre + change[sub.size :]
        lin = linearise(sub, state, centre)
        new = s.variances(lin, noise, floor)
        settled = abs(new.rotation / noise.rotation - 1.0) + abs(new.translation / noise.translation - 1.0)
        noise = new
        exact = noise.translation <= floor and noise.rotation <= _TINY
        if exact and loose:  # there is no noise to have a centre
            loose, centre = False, np.zeros(3)
            lin = linearise(sub, state, centre)
        s = Scaled(sub, lin, noise, loss, _centre_columns(sub, lin) if loose else None)
        if size < tolerance and settled < tolerance:
            break
        if size < 0.1 and exact:
            break
        if size < 1e-7 and settled < 1e-7 and size >= 0.5 * before:  # rounding: nothing left to gain
            break
        before = size
    w, d = residuals(problem, state, centre)
    left_w, left_d = w.copy(), d.copy()
    left_w[keep], left_d[keep] = s.leave_one_out(lin)
    return Fit(state, noise, centre, loss, keep, s, left_w, left_d, w, d)


class Scaled:
    """One linearisation in units of its noise: normal equations, robust weights, covariance, errors left out."""

    def __init__(self, problem: Problem, lin: Linearised, noise: Noise, loss: Loss, extra: Array | None = None) -> None:
        self.size, self.full = problem.size, problem.full
        if extra is not None:  # columns of the noise centre, which only displaces
            Jw = np.concatenate([lin.Jw, np.zeros_like(extra)], axis=2)
            lin = Linearised(lin.w, lin.d, Jw, np.concatenate([lin.Jd, extra], axis=2))
        n = len(problem)
        self.loss, self.noise, self.n = loss, noise, n
        self.numbers_w = np.where(problem.full, 3.0, np.where(problem.normal, 2.0, 0.0))
        self.total_w, self.total_d = float(self.numbers_w.sum()), 3.0 * n
        self.m_w = np.maximum(self.numbers_w, 1.0)
        self.inflate = noise.ratio**2
        self.root: Array | None = None
        if problem.covariance is None:
            a, b = 1.0 / np.sqrt(noise.rotation), 1.0 / np.sqrt(noise.translation)
            self.ew, self.Jw, self.ed, self.Jd = lin.w * a, lin.Jw * a, lin.d * b, lin.Jd * b
        else:
            self.root = np.linalg.inv(np.linalg.cholesky(_total(problem, noise)))
            e, J = self._whiten(lin)
            self.ew, self.ed, self.Jw, self.Jd = e[:, :3], e[:, 3:], J[:, :3], J[:, 3:]
        self.qw, self.qd = (self.ew**2).sum(axis=1), (self.ed**2).sum(axis=1)
        ww, slope_w = weigh(self.qw, self.m_w, loss)
        wd, slope_d = weigh(self.qd, np.full(n, 3.0), loss)
        self.ww, self.wd = np.where(self.numbers_w > 0.0, ww, 0.0), wd
        self.slope_w = float((slope_w * self.numbers_w).sum()) / max(self.total_w, 1.0)
        self.slope_d = float(slope_d.mean())
        self.Gw, self.Gd = _gram(self.Jw), _gram(self.Jd)
        self.A = self.slope_w * self.Gw + (self.slope_d / self.inflate) * self.Gd
        self.V = inverse_information(self.A)
        self.g = _pull(self.Jw, self.ww, self.ew) + _pull(self.Jd, self.wd / self.inflate, self.ed)
        taken_w = self.slope_w * float(np.einsum("ij,ji->", self.V, self.Gw))
        taken_d = self.slope_d / self.inflate * float(np.einsum("ij,ji->", self.V, self.Gd))
        self.free_w, self.free_d = max(self.total_w - taken_w, 0.3), max(self.total_d - taken_d, 0.3)

    def newton(self, moving: int) -> Array:
        """Inverse of the exact second derivative of the robust cost (Gauss-Newton in the residuals) by the first
        ``moving`` unknowns; that of the mean slope where the exact one is not positive."""
        mean = self.V if moving == len(self.V) else inverse_information(self.A[:moving, :moving])
        if self.loss is Loss.SQUARES:
            return mean
        N = np.zeros_like(self.A)
        for J, e, q, m, w, inflate in (
            (self.Jw, self.ew, self.qw, self.m_w, self.ww, 1.0),
            (self.Jd, self.ed, self.qd, 3.0, self.wd, self.inflate),
        ):
            N += _gram(J * np.sqrt(w / inflate)[:, None, None])
            outside = np.where(q > m * _HUBER**2, w / np.maximum(q, 1e-300), 0.0)
            bend = 2.0 * w / (_STUDENT + q) if self.loss is Loss.STUDENT else outside
            along = (np.swapaxes(J, 1, 2) @ e[:, :, None])[:, :, 0] * np.sqrt(bend / inflate)[:, None]
            N -= along.T @ along
        s = 1.0 / np.sqrt(np.maximum(np.diag(self.A), 1e-300))
        if float(np.linalg.eigvalsh(N * s[:, None] * s)[0]) < -RANK:
            return mean
        return inverse_information(N[:moving, :moving])

    def _whiten(self, lin: Linearised) -> tuple[Array, Array]:
        assert self.root is not None
        e = (self.root @ np.concatenate([lin.w, lin.d], axis=1)[:, :, None])[:, :, 0]
        return e, self.root @ np.concatenate([lin.Jw, lin.Jd], axis=1)

    def variances(self, lin: Linearised, noise: Noise, floor: float) -> Noise:
        """The variances that make each group's weighted squares equal to its redundancy (one Newton step in the log)."""
        if self.root is None:
            qw, qd = (lin.w**2).sum(axis=1) / noise.rotation, (lin.d**2).sum(axis=1) / noise.translation
        else:
            e, _ = self._whiten(lin)
            qw, qd = (e[:, :3] ** 2).sum(axis=1), (e[:, 3:] ** 2).sum(axis=1)
        rotation = noise.rotation
        if self.total_w:
            some = self.numbers_w > 0.0
            rotation = max(rotation * _growth(qw[some], self.m_w[some], self.loss, self.free_w), _TINY)
        translation = max(noise.translation * _growth(qd, np.full(self.n, 3.0), self.loss, self.free_d), floor)
        return replace(noise, rotation=rotation, translation=translation)

    def covariance(self) -> Array:
        """Covariance of the unknowns for the weights used (Huber 1981, 6.3, one factor per group of residuals)."""
        return self.cross_covariance(self)

    def cross_covariance(self, other: Scaled) -> Array:
        """Covariance between the unknowns of two fits of the same sightings, each with its own weights."""
        cross_w = float((self.ww * other.ww * (self.ew * other.ew).sum(axis=1)).sum()) / self.free_w
        cross_d = float((self.wd * other.wd * (self.ed * other.ed).sum(axis=1)).sum()) / self.free_d
        k, m = self.Jw.shape[2], other.Jw.shape[2]
        middle = cross_w * self.Jw.reshape(-1, k).T @ other.Jw.reshape(-1, m)
        middle += cross_d / (self.inflate * other.inflate) * self.Jd.reshape(-1, k).T @ other.Jd.reshape(-1, m)
        return np.asarray((self.V @ middle @ other.V)[: self.size, : self.size])

    def information(self) -> Array:
        """Information of the unknowns alone, unweighted by the loss, the noise centre marginalised out."""
        N, m = self.Gw + self.Gd, self.size
        if len(N) == m:
            return N
        return np.asarray(N[:m, :m] - N[:m, m:] @ np.linalg.pinv(N[m:, m:], rcond=1e-10, hermitian=True) @ N[m:, :m])

    def leave_one_out(self, lin: Linearised) -> tuple[Array, Array]:
        """Residuals (n, 3), (n, 3) of each sighting under the fit without it (exact where linear: PRESS, Allen 1974)."""
        J = np.concatenate([self.Jw, self.Jd], axis=1)
        m = self.size
        u = np.repeat(np.column_stack([self.ww, self.wd / self.inflate]), 3, axis=1)
        hat = (J @ (self.V @ np.swapaxes(J, 1, 2))) * u[:, None, :]
        e = np.concatenate([self.ew, self.ed], axis=1)
        eased = np.linalg.solve(np.eye(6) * (1.0 + 1e-9) - hat, e[:, :, None])
        change = self.V @ (np.swapaxes(J, 1, 2) @ (u[:, :, None] * eased))
        out = np.concatenate([lin.w, lin.d], axis=1)
        out = out + (np.concatenate([lin.Jw, lin.Jd], axis=1) @ change[:, :m])[:, :, 0]
        return out[:, :3], out[:, 3:]


def weigh(q: Array, m: Array, loss: Loss) -> tuple[Array, Array]:
    """Weight of squares q (n,) of m numbers each, and the mean slope of weight times residual per number."""
    if loss is Loss.SQUARES:
        return np.ones_like(q), np.ones_like(q)
    if loss is Loss.STUDENT:
        w = (_STUDENT + m) / (_STUDENT + q)
        return w, w * (1.0 - 2.0 * q / (m * (_STUDENT + q)))
    r = np.sqrt(np.maximum(q / m, 1e-300))
    w = np.minimum(1.0, _HUBER / r)
    return w, np.where(r > _HUBER, w * (1.0 - 1.0 / m), 1.0)


def _growth(q: Array, m: Array, loss: Loss, redundancy: float) -> float:
    """Factor on a variance: squares over redundancy, to the power that makes the step a Newton step."""
    w, _ = weigh(q, m, loss)
    total = float((w * q).sum())
    if loss is Loss.STUDENT:
        power = float((w * q * _STUDENT / (_STUDENT + q)).sum())
    elif loss is Loss.HUBER:
        power = float((w * q * np.where(w < 1.0, 0.5, 1.0)).sum())
    else:
        power = total
    ratio = max(total / redundancy, 1e-12)
    return float(np.clip(ratio ** (1.0 / max(power / max(total, 1e-300), 0.3)), 1e-4, 1e4))


def _total(problem: Problem, noise: Noise) -> Array:
    """Covariances (n, 6, 6): the sightings' own plus the common ones; numbers that are not known stand alone."""
    C = np.array(problem.covariance)
    unknown = np.zeros((len(problem), 6), dtype=bool)
    unknown[:, :3] = ~problem.full[:, None]
    unknown[problem.normal, :2] = False
    C[unknown[:, :, None] | unknown[:, None, :]] = 0.0
    k = np.arange(3)
    C[:, k, k] += noise.rotation
    C[:, k + 3, k + 3] += noise.translation
    return np.asarray(C)


def _gram(J: Array) -> Array:
    flat = J.reshape(-1, J.shape[2])
    return np.asarray(flat.T @ flat)


def _pull(J: Array, u: Array, e: Array) -> Array:
    return np.asarray(J.reshape(-1, J.shape[2]).T @ (u[:, None] * e).reshape(-1))


def inverse_information(N: Array) -> Array:
    """Inverse of an information matrix; directions without information get none (pseudo-inverse in scaled units)."""
    s = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    values, vectors = np.linalg.eigh(N * s[:, None] * s)
    good = values > RANK * values[-1]
    half = vectors[:, good] / np.sqrt(values[good])
    return np.asarray((half @ half.T) * s[:, None] * s)
