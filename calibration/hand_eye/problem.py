"""The equation F_i X G_i = Y H_i Z of every mounting: residuals, derivatives, and the whitened normal equations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import IDENTITY, inverse, left_jacobian_inverse, log_rotation, moved, skew
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]
State = tuple[Array, Array, Array]
"""Poses X, Y, Z (4, 4) each."""

NAMES = ("X", "Y", "Z")

_HUBER = 2.0  # in sigma per axis
TINY = 1e-24  # of the squared extent: exact data have no noise to estimate
RANK = 1e-11  # eigenvalues below this share of the largest count as zero: a direction the observations do not fix
_LOG_SIGMA = 1.5  # standard deviation of the logarithm of the discord beforehand
_DISCORDS = np.exp(np.arange(-5.0, 5.01, 0.5))  # in units of the usual one, for sums over its posterior
_SLIGHT = 1e-9  # share of what displacements know of rotations that stays: it bounds the rounding
_VARIANCE_STEPS = 2
_SURE = 1e-7  # a matrix with no eigenvalue below this share needs no look at its eigenvalues


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Observations of one equation F_i X G_i = Y H_i Z (metres or any other unit of length).

    ``F``, ``H`` (n, 4, 4): poses the robots state; ``G`` (n, 4, 4): what the camera measured of the target. The
    residual of an observation is D_i = (Y H_i Z)^-1 F_i X G_i, seen in the frame of the target T: a rotation vector and
    the displacement of a point of the target. ``full`` (n,): all three rotations of G known; ``normal`` (n,): only the
    direction of the z axis of T; neither: only the point at the origin of T. ``covariance`` (n, 6, 6) [rotation;
    translation] in T of the measurement, or None. ``free``: which of X, Y, Z are unknown; the others stay at the
    start. ``tied``: Y is the same pose as X (AX = XB).
    """

    F: Array
    G: Array
    H: Array
    full: Flags
    normal: Flags
    covariance: Array | None = None
    free: tuple[bool, bool, bool] = (True, True, False)
    tied: bool = False

    def __len__(self) -> int:
        return len(self.F)

    @cached_property
    def extent(self) -> float:
        """A length that goes with the data: rms spread of what robots and camera state."""
        parts = [self.F[:, :3, 3], self.G[:, :3, 3], self.H[:, :3, 3]]
        return float(np.sqrt(sum((((p - p.mean(axis=0)) ** 2).sum(axis=1)).mean() for p in parts))) or 1.0

    @cached_property
    def numbers_w(self) -> Array:
        """How many numbers (n,) of each observation speak of rotation: 3, 2 or 0."""
        return np.where(self.full, 3.0, np.where(self.normal, 2.0, 0.0))

    @cached_property
    def all_full(self) -> bool:
        """Whether every observation is a full pose."""
        return bool(self.full.all())

    @property
    def size(self) -> int:
        """Number of unknown numbers."""
        return 6 * len(self.blocks)

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Indices (0 X, 1 Y, 2 Z) of the free poses, in the order of the unknowns."""
        return (0,) if self.tied else tuple(k for k in range(3) if self.free[k])

    def pick(self, rows: Flags | NDArray[np.int64]) -> Problem:
        """Return the same equation with some of the observations."""
        return replace(
            self,
            F=self.F[rows],
            G=self.G[rows],
            H=self.H[rows],
            full=self.full[rows],
            normal=self.normal[rows],
            covariance=None if self.covariance is None else self.covariance[rows],
        )

    def step(self, state: State, change: Array) -> State:
        """Return the poses after a change (6 per free pose)."""
        out = list(state)
        for row, k in enumerate(self.blocks):
            out[k] = moved(state[k], change[6 * row : 6 * row + 6])
        if self.tied:
            out[1] = out[0]
        return out[0], out[1], out[2]


@dataclass(frozen=True)
class Linearised:
    """Residuals and derivatives of all observations at one state.

    ``w`` (n, 3) rad: rotation vector of D (zero where unknown; two numbers where only a normal is known). ``d`` (n, 3):
    displacement of the noise centre (full poses) or of the measured point. ``Jw``, ``Jd`` (n, 3, m).
    """

    w: Array
    d: Array
    Jw: Array
    Jd: Array

    @cached_property
    def Gw(self) -> Array:
        """Products (m, m) of the derivatives of all rotations."""
        return gram(self.Jw)

    @cached_property
    def Gd(self) -> Array:
        """Products (m, m) of the derivatives of all displacements."""
        return gram(self.Jd)

    def after(self, change: Array) -> Linearised:
        """What these derivatives predict after a small change (m,) of the unknowns."""
        out = replace(self, w=self.w + self.Jw @ change, d=self.d + self.Jd @ change)
        # the derivatives are the same, and so are their products
        out.__dict__.update(Gw=self.Gw, Gd=self.Gd)
        return out


def residuals(problem: Problem, state: State, centre: Array | None = None) -> tuple[Array, Array]:
    """Rotations (n, 3) rad and displacements (n, 3) of all observations in the frame of the target."""
    w, d, *_ = _evaluate(problem, state, np.zeros(3) if centre is None else centre, slopes=False)
    return w, d


def linearise(problem: Problem, state: State, centre: Array) -> Linearised:
    """Residuals and analytic derivatives; ``centre`` (3,) in T is the point whose displacement a full pose reports.

    Derivation: with M = F X G, L = Y H Z, D = L^-1 M, a change (a, b) of X turns D by R_L^T R_F a and moves the point
    by R_L^T R_F (a x R_X g + b). A change of Y or Z does so with the opposite sign and its own lever arm.
    """
    w, d, point, RL, g, turn = _evaluate(problem, state, centre)
    X, Y, Z = state
    n = len(problem)
    RLt = np.swapaxes(RL, 1, 2)
    delta, shift = np.zeros((n, 3, problem.size)), np.zeros((n, 3, problem.size))
    for row, k in enumerate((0, 1) if problem.tied else problem.blocks):
        column = 0 if problem.tied else 6 * row
        rot, pos = slice(column, column + 3), slice(column + 3, column + 6)
        if k == 0:
            Q = RLt @ problem.F[:, :3, :3]
            delta[:, :, rot] += Q
            shift[:, :, rot] -= Q @ skew(g @ X[:3, :3].T)
            shift[:, :, pos] += Q
        elif k == 1:
            delta[:, :, rot] -= RLt
            shift[:, :, rot] += RLt @ skew(point - Y[:3, 3])
            shift[:, :, pos] -= RLt
        else:
            Q = RLt @ (Y[:3, :3] @ problem.H[:, :3, :3])
            origin = Y[:3, :3] @ problem.H[:, :3, 3].T
            v = point - origin.T - Y[:3, 3]  # from the frame that carries Z to the point
            local = (v[:, None, :] @ (Y[:3, :3] @ problem.H[:, :3, :3]))[:, 0] - Z[:3, 3]
            delta[:, :, rot] -= Q
            shift[:, :, rot] += Q @ skew(local)
            shift[:, :, pos] -= Q
    return Linearised(w, d, turn @ delta, shift)


def gram(J: Array) -> Array:
    """Products (m, m) of the columns of derivatives (n, 3, m)."""
    flat = J.reshape(-1, J.shape[2])
    return np.asarray(flat.T @ flat)


def _evaluate(
    problem: Problem, state: State, centre: Array, *, slopes: bool = True
) -> tuple[Array, Array, Array, Array, Array, Array]:
    X, Y, Z = state
    full, normal = problem.full, problem.normal
    everywhere = problem.all_full
    p = np.broadcast_to(centre, (len(problem), 3)) if everywhere else np.where(full[:, None], centre, 0.0)
    g = (problem.G[:, :3, :3] @ p[:, :, None])[:, :, 0] + problem.G[:, :3, 3]
    FX = problem.F @ X
    point = (FX[:, :3, :3] @ g[:, :, None])[:, :, 0] + FX[:, :3, 3]
    L = Y @ problem.H @ Z
    RL = L[:, :3, :3]
    d = ((point - L[:, :3, 3])[:, None, :] @ RL)[:, 0] - p
    RD = np.swapaxes(RL, 1, 2) @ (FX[:, :3, :3] @ problem.G[:, :3, :3])
    w = log_rotation(RD)
    turn = left_jacobian_inverse(w) if slopes else np.zeros_like(RD)
    if not everywhere:
        m = RD[:, :, 2]
        side = np.column_stack([-m[:, 1], m[:, 0], np.zeros(len(m))])
        sine = np.linalg.norm(side, axis=1)
        # a normal that points the other way must not look like one that fits
        grow = np.where(m[:, 2] > 0.0, 1.0, np.arctan2(sine, m[:, 2]) / np.maximum(sine, 1e-9))[:, None]
        tilt = np.zeros_like(turn)
        tilt[:, 0, 0] = tilt[:, 1, 1] = m[:, 2]
        tilt[:, 0, 2], tilt[:, 1, 2] = -m[:, 0], -m[:, 1]
        w = np.where(full[:, None], w, np.where(normal[:, None], side * grow, 0.0))
        # behind the horizon only the sense of the way back matters
        away = np.where((m[:, 2] > 0.0)[:, None, None], tilt, np.diag([1.0, 1.0, 0.0]))
        turn = np.where(full[:, None, None], turn, np.where(normal[:, None, None], away, 0.0))
    return w, d, point, RL, g, turn


def full_problem(
    F: Array,
    G: Array,
    H: Array | None = None,
    *,
    free: tuple[bool, bool, bool] = (True, True, False),
    tied: bool = False,
    covariance: Array | None = None,
) -> Problem:
    """Return a problem whose observations are all full poses."""
    n = len(F)
    H = np.broadcast_to(IDENTITY, (n, 4, 4)) if H is None else H
    return Problem(
        F=F,
        G=G,
        H=H,
        full=np.ones(n, dtype=bool),
        normal=np.zeros(n, dtype=bool),
        covariance=covariance,
        free=free,
        tied=tied,
    )


def predicted(problem: Problem, state: State) -> Array:
    """Poses (n, 4, 4) of the target in the camera that the unknowns predict."""
    X, Y, Z = state
    return inverse(problem.F @ X) @ (Y @ problem.H @ Z)


class Loss(Enum):
    """Robust loss of an observation's residual."""

    SQUARES = "least squares"
    HUBER = "Huber"


@dataclass(frozen=True)
class Noise:
    """Variances per axis beyond the observations' own covariances.

    Rotation rad^2 and translation of the noise centre.
    """

    rotation: float
    translation: float


class Scaled:
    """The observations of a linearisation, weighed.

    ``lin`` may hold three more columns than the problem has unknowns: those of the noise centre.

    ``usual_discord`` (rad, 0: none): the displacements are those of a camera that is turned by a rotation vector with
    the same variance per axis against the camera of the rotations. Its size has a log-normal prior about
    ``usual_discord`` and the restricted likelihood (REML). The answer is the mean over the posterior; ``discord`` has
    the information that is the mean over the likelihood.
    """

    def __init__(self, problem: Problem, lin: Linearised, noise: Noise, loss: Loss, usual_discord: float = 0.0) -> None:
        self.size, self.full = problem.size, problem.full
        n = len(problem)
        self.loss, self.noise, self.n = loss, noise, n
        self.numbers_w = problem.numbers_w
        self.total_w, self.total_d = float(self.numbers_w.sum()), 3.0 * n
        self.m_w = np.maximum(self.numbers_w, 1.0)
        self.root: Array | None = None
        self.share_w: Array | float = 1.0  # how much of each observation's variance is the common one
        self.share_d: Array | float = 1.0
        if problem.covariance is None:
            self._unit, self._a, self._b = lin, 1.0 / noise.rotation, 1.0 / noise.translation
        else:
            self.root = np.linalg.inv(np.linalg.cholesky(_total(problem, noise)))
            own = np.diagonal(problem.covariance, axis1=1, axis2=2)
            self.share_w = noise.rotation / (noise.rotation + own[:, :3].mean(axis=1))
            self.share_d = noise.translation / (noise.translation + own[:, 3:].mean(axis=1))
            e, J = self._whiten(lin)
            self._unit, self._a, self._b = Linearised(e[:, :3], e[:, 3:], J[:, :3], J[:, 3:]), 1.0, 1.0
        unit = self._unit
        self.qw = self._a * np.einsum("ij,ij->i", unit.w, unit.w)
        self.qd = self._b * np.einsum("ij,ij->i", unit.d, unit.d)
        ww, slope_w = weigh(self.qw, self.m_w, loss)
        wd, slope_d = weigh(self.qd, np.full(n, 3.0), loss)
        self.ww, self.wd = np.where(self.numbers_w > 0.0, ww, 0.0), wd
        self.slope_w = float(slope_w @ self.numbers_w) / max(self.total_w, 1.0)
        self.slope_d = float(slope_d.mean())
        self.Gw, self.Gd = self._a * unit.Gw, self._b * unit.Gd
        self._Aw, self._Ad = self.slope_w * self.Gw, self.slope_d * self.Gd
        self.A = self._Aw + self._Ad
        self.V = inverse_information(self.A)
        self.gw, self.gd = pull(unit.Jw, self._a * self.ww, unit.w), pull(unit.Jd, self._b * self.wd, unit.d)
        self.discord, self._by_w, self._by_d = 0.0, self.V, self.V
        if usual_discord:
            self.discord, self._by_w, self._by_d = self._marginal(usual_discord)
        taken_w, taken_d = float((self._by_w * self._Aw).sum()), float((self._by_d * self._Ad).sum())
        self.free_w, self.free_d = max(self.total_w - taken_w, 0.3), max(self.total_d - taken_d, 0.3)

    def step(self) -> Array:
        """Change (m,) of the unknowns.

        Without discord: Newton's, with the exact second derivative of the robust cost.
        """
        if self.discord or self.loss is Loss.SQUARES:
            return -(self._by_w @ self.gw + self._by_d @ self.gd)
        return np.asarray(-self._newton() @ (self.gw + self.gd))

    def _marginal(self, usual: float) -> tuple[float, Array, Array]:
        """Return the discord whose information is the mean over its likelihood, with means over that likelihood.

        They are of what the gradients (m,) of rotations and of displacements move (m, m).

        At one discord the rotations follow from both, as far as it lets the displacements know them. The positions are
        the best for these rotations and the displacements as measured: so they predict them best.
        """
        Ad, V, k = self._Ad, self.V, len(self.A)
        own = Ad[:3]
        values, axes = np.linalg.eigh(own[:, :3] - own @ V @ own.T)
        score = axes.T @ (self.gd[:3] - own @ V @ (self.gw + self.gd))
        good = values > RANK * float(np.trace(own[:, :3]))
        x = (usual * _DISCORDS[:, None]) ** 2 * values[good]
        cost = (np.log1p(x) + score[good] ** 2 / values[good] / (1.0 + x)).sum(axis=1)
        free = cost.copy()  # the covariance follows the data alone, as with ideal cameras, too
        cost += (np.log(_DISCORDS) / _LOG_SIGMA) ** 2
        weight = np.exp(-0.5 * (cost - cost.min()))
        weight /= weight.sum()
        turned = np.arange(k) % 6 < 3
        turned[self.size :] = False
        by_w, by_d = np.zeros((2, k, k))
        for discord, w in zip(usual * _DISCORDS, weight, strict=True):
            if w < _SLIGHT:
                continue
            less = Ad[:, :3] @ np.linalg.inv(own[:, :3] * (1.0 + _SLIGHT) + np.eye(3) / discord**2)
            B = np.where(turned[:, None], w * inverse_information(self.A - less @ own), 0.0)
            by_w += B
            by_d += B
            by_d[:, :3] -= B @ less
        places = np.zeros((k, k))
        places[np.ix_(~turned, ~turned)] = inverse_information(Ad[np.ix_(~turned, ~turned)])
        flat = np.exp(-0.5 * (free - free.min()))
        likely = usual / float(np.sqrt((flat / flat.sum()) @ _DISCORDS**-2.0))
        return likely, by_w - places @ Ad @ by_w, by_d + places - places @ Ad @ by_d

    def _newton(self) -> Array:
        """Inverse of the exact second derivative; that of the mean slope where it is not positive."""
        N = np.zeros_like(self.A)
        unit = self._unit
        for J, e, q, m, w, own in (
            (unit.Jw, unit.w, self.qw, self.m_w, self.ww, self._a),
            (unit.Jd, unit.d, self.qd, 3.0, self.wd, self._b),
        ):
            N += gram(J * np.sqrt(w * own)[:, None, None])
            bend = np.where(q > m * _HUBER**2, w / np.maximum(q, 1e-300), 0.0)
            along = (e * (own * np.sqrt(bend))[:, None])[:, None, :] @ J
            along = along[:, 0]
            N -= along.T @ along
        s = 1.0 / np.sqrt(np.maximum(np.diag(self.A), 1e-300))
        scaled = N * s[:, None] * s
        if _sure_inverse(scaled) is None and float(np.linalg.eigvalsh(scaled)[0]) < -RANK:
            return self.V
        return inverse_information(N)

    def _whiten(self, lin: Linearised) -> tuple[Array, Array]:
        assert self.root is not None
        e = (self.root @ np.concatenate([lin.w, lin.d], axis=1)[:, :, None])[:, :, 0]
        return e, self.root @ np.concatenate([lin.Jw, lin.Jd], axis=1)

    def variances(self, lin: Linearised, noise: Noise, floor: float) -> Noise:
        """Return the variances that make each group's weighted squares equal to its redundancy.

        One Newton step in the log.
        """
        if self.root is None:
            qw = np.einsum("ij,ij->i", lin.w, lin.w) / noise.rotation
            qd = np.einsum("ij,ij->i", lin.d, lin.d) / noise.translation
        else:
            e = (self.root @ np.concatenate([lin.w, lin.d], axis=1)[:, :, None])[:, :, 0]
            qw, qd = (e[:, :3] ** 2).sum(axis=1), (e[:, 3:] ** 2).sum(axis=1)
        rotation, translation = noise.rotation, noise.translation
        if self.total_w:
            qw = np.where(self.numbers_w > 0.0, qw, 0.0)
        # squares of whitened residuals follow a variance in proportion only where it is all there is
        for _ in range(1 if self.root is not None else _VARIANCE_STEPS):
            a, b = rotation / noise.rotation, translation / noise.translation
            if self.total_w:
                more = _growth(qw / a, self.m_w, self.loss, self.free_w, self.share_w)
                rotation = max(rotation * more, TINY)
            also = _growth(qd / b, np.full(self.n, 3.0), self.loss, self.free_d, self.share_d)
            translation = max(translation * also, floor)
            if self.loss is Loss.SQUARES or abs(also - 1.0) + (abs(more - 1.0) if self.total_w else 0.0) < 1e-9:
                break
        return replace(noise, rotation=rotation, translation=translation)

    def unconverged(self, new: Noise) -> float:
        """How much of the observations' variances would change, as a share of them, with other common ones."""
        change_w = abs(new.rotation / self.noise.rotation - 1.0) * float(np.mean(self.share_w))
        return change_w + abs(new.translation / self.noise.translation - 1.0) * float(np.mean(self.share_d))

    def covariance(self) -> Array:
        """Covariance of the unknowns for the weights used (Huber 1981, 6.3, one factor per group of residuals)."""
        spread_w = float((self.ww**2 * self.qw).sum()) / self.free_w * self.Gw
        spread_d = float((self.wd**2 * self.qd).sum()) / self.free_d * self.Gd
        spread_d += self.discord**2 * (self._Ad[:, :3] @ self._Ad[:3])
        out = self._by_w @ spread_w @ self._by_w.T + self._by_d @ spread_d @ self._by_d.T
        return np.asarray(out[: self.size, : self.size])

    def information(self) -> Array:
        """Information of the unknowns alone, unweighted by the loss, the noise centre marginalised out."""
        N, m = self.Gw + self.Gd, self.size
        if len(N) == m:
            return N
        return np.asarray(N[:m, :m] - N[:m, m:] @ np.linalg.pinv(N[m:, m:], rcond=1e-10, hermitian=True) @ N[m:, :m])


def weigh(q: Array, m: Array, loss: Loss) -> tuple[Array, Array]:
    """Weight of squares q (n,) of m numbers each, and the mean slope of weight times residual per number."""
    if loss is Loss.SQUARES:
        return np.ones_like(q), np.ones_like(q)
    r = np.sqrt(np.maximum(q / m, 1e-300))
    w = np.minimum(1.0, _HUBER / r)
    return w, np.where(r > _HUBER, w * (1.0 - 1.0 / m), 1.0)


def _growth(q: Array, m: Array, loss: Loss, redundancy: float, share: Array | float) -> float:
    """Factor on a variance: squares over redundancy, to the power that makes the step a Newton step.

    ``share`` (n,): how much of each observation's variance it is.
    """
    w, _ = weigh(q, m, loss)
    total = float((w * q).sum())
    power = float((w * q * share * np.where(w < 1.0, 0.5, 1.0)).sum())
    ratio = max(total / redundancy, 1e-12)
    least = 0.3 if isinstance(share, float) else 0.1
    return float(np.clip(ratio ** (1.0 / max(power / max(total, 1e-300), least)), 1e-4, 1e4))


def _total(problem: Problem, noise: Noise) -> Array:
    """Covariances (n, 6, 6): the observations' own plus the common ones; numbers that are not known stand alone."""
    C = np.array(problem.covariance)
    unknown = np.zeros((len(problem), 6), dtype=bool)
    unknown[:, :3] = ~problem.full[:, None]
    unknown[problem.normal, :2] = False
    C[unknown[:, :, None] | unknown[:, None, :]] = 0.0
    k = np.arange(3)
    C[:, k, k] += noise.rotation
    C[:, k + 3, k + 3] += noise.translation
    return np.asarray(C)


def pull(J: Array, u: Array, e: Array) -> Array:
    """Sum (m,) of derivatives (n, 3, m) times residuals (n, 3) times weights (n,)."""
    return np.asarray(J.reshape(-1, J.shape[2]).T @ (u[:, None] * e).reshape(-1))


def inverse_information(N: Array) -> Array:
    """Inverse of an information matrix; directions without information get none (pseudo-inverse in scaled units)."""
    s = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    scaled = N * s[:, None] * s
    sure = _sure_inverse(scaled)
    if sure is not None:
        return np.asarray(sure * s[:, None] * s)
    values, vectors = np.linalg.eigh(scaled)
    good = values > RANK * values[-1]
    half = vectors[:, good] / np.sqrt(values[good])
    return np.asarray((half @ half.T) * s[:, None] * s)


def _sure_inverse(N: Array) -> Array | None:
    """Inverse of a matrix that is plainly positive definite, by its Cholesky factor.

    None where eigenvalues must decide.
    """
    try:
        L = np.linalg.cholesky(N)
    except np.linalg.LinAlgError:
        return None
    half = np.linalg.inv(L)
    inverse = half.T @ half
    # the traces bound the largest eigenvalue from above and the least one from below
    return inverse if float(np.trace(inverse)) * float(np.trace(N)) < 1.0 / _SURE else None
