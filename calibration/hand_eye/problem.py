"""The equation F_i X G_i = Y H_i Z of every mounting, with residuals and analytic derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import IDENTITY, inverse, left_jacobian_inverse, log_rotation, moved, skew
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]
State = tuple[Array, Array, Array]
"""Poses X, Y, Z (4, 4) each."""

NAMES = ("X", "Y", "Z")


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
        """The same equation with some of the observations."""
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
        """The poses after a change (6 per free pose)."""
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
    by R_L^T R_F (a x R_X g + b); a change of Y or Z does so with the opposite sign and its own lever arm.
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
    """A problem whose observations are all full poses."""
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
