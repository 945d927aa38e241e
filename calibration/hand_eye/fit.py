"""Robust weighted least squares on SE(3); variances of rotation and translation come from the residuals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.hand_eye.linearisation import TINY, Loss, Noise, Scaled, pull
from weldcal.calibration.hand_eye.problem import Linearised, Problem, State, gram, linearise, residuals
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

_NEAR = 1e-3  # changes (rad, or share of the extent) up to which derivatives taken once still predict
_MANY = 50  # observations from which on a prediction costs less than new derivatives
_FAR_APART = 1e-3  # how much smaller one kind of noise may start, rad against shares of the extent
_LONGEST = 0.5  # step (rad, or share of the extent): beyond it the derivatives say nothing
_STALE = 100.0  # steps (sigma) shorter than this many changes are decided by derivatives of the place itself
_HERE = 0.1  # share of the tolerance up to which derivatives are those of the place itself


@dataclass(frozen=True, kw_only=True)
class EquationFit:
    """A converged fit. ``w``, ``d`` (n, 3): residuals; ``scaled``, ``lin``: normal equations and derivatives of the
    observations kept."""

    state: State
    noise: Noise
    centre: Array
    loss: Loss
    keep: Flags
    scaled: Scaled
    lin: Linearised
    w: Array
    d: Array


def descend(problem: Problem, state: State, iterations: int = 30, tolerance: float = 1e-6) -> tuple[State, float]:
    """Levenberg-Marquardt from a rough start with a bounded loss; returns the state and its cost.

    Rotations in radians and lengths in units of the extent; each observation's square s costs s / (1 + s) (Geman and
    McClure), so that a few gross ones do not pull.
    """
    length = problem.extent
    zero = np.zeros(3)

    def squares(state: State) -> Array:
        w, d = residuals(problem, state, zero)
        return np.asarray(4.0 * (w**2).sum(axis=1) + 16.0 * (d**2).sum(axis=1) / length**2)

    s = squares(state)
    cost, damping = float((s / (1.0 + s)).sum()), 1e-3
    for _ in range(iterations):
        lin = linearise(problem, state, zero)
        k = 1.0 / (1.0 + s) ** 2
        N = gram(lin.Jw * np.sqrt(4.0 * k)[:, None, None]) + gram(lin.Jd * (4.0 / length * np.sqrt(k))[:, None, None])
        g = pull(lin.Jw, 4.0 * k, lin.w) + pull(lin.Jd, 16.0 * k / length**2, lin.d)
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
    floor = problem.extent**2 * TINY
    rows_w = keep & (problem.full | problem.normal)
    rotation = float(np.median((w[rows_w] ** 2).sum(axis=1))) / 2.366 if rows_w.any() else 1.0
    translation = float(np.median((d[keep] ** 2).sum(axis=1))) / 2.366
    if rows_w.any():
        # few poses fit one of the two kinds by chance: neither may start as if it were exact beside the other
        translation = max(translation, rotation * (_FAR_APART * problem.extent) ** 2)
        rotation = max(rotation, translation * (_FAR_APART / problem.extent) ** 2)
    return Noise(max(rotation, TINY), max(translation, floor))


def _with_centre(problem: Problem, lin: Linearised) -> Linearised:
    """Three more columns: the displacement (R_D - 1) c + t by the noise centre c."""
    extra = np.where(problem.full[:, None, None], exp_rotation(lin.w) - np.eye(3), 0.0)
    Jw = np.concatenate([lin.Jw, np.zeros_like(extra)], axis=2)
    return Linearised(lin.w, lin.d, Jw, np.concatenate([lin.Jd, extra], axis=2))


def fit(
    problem: Problem,
    state: State,
    *,
    noise: Noise,
    loss: Loss,
    keep: Flags,
    centre: Array | None = None,
    usual_discord: float = 0.0,
    begin: Linearised | None = None,
    iterations: int = 60,
    tolerance: float = 1e-6,
) -> EquationFit:
    """Newton's method on the robust cost from a good start; the variances are re-estimated at every step.

    Variances: Helmert's simplified estimator, each group's weighted squares over its own redundancy. The noise centre
    is an unknown like the others (starting at ``centre``, else at the target's origin): the point of the target whose
    displacement is least, since a camera errs about the middle of a board and not about the origin someone gave it; so
    the answer moves with any choice of frames. It stays zero where full poses are too few, or exact. ``usual_discord``:
    see Scaled. ``keep`` (n,): observations that count; the others get residuals only. ``begin``: the derivatives at the
    start, where known. ``tolerance``: of what is left, in standard deviations.
    """
    sub = problem if keep.all() else problem.pick(keep)
    floor = sub.extent**2 * TINY
    centre = np.zeros(3) if centre is None else centre
    # three more unknowns need some observations to spare
    loose = int(sub.full.sum()) >= 5 + len(sub.blocks)

    def taken(state: State, centre: Array) -> Linearised:
        lin = linearise(sub, state, centre)
        return _with_centre(sub, lin) if loose else lin

    lin = taken(state, centre) if begin is None else begin
    loose &= lin.Jw.shape[2] > sub.size
    s = Scaled(sub, lin, noise, loss, usual_discord)
    scale = np.append(np.tile(np.repeat([1.0, sub.extent], 3), len(sub.blocks)), np.full(3, sub.extent))
    near = _NEAR if len(sub) >= _MANY else 0.0
    before, drift, stale = tolerance, np.zeros(len(s.A)), 0.0
    for _ in range(iterations):
        change = s.step()
        change *= min(1.0, _LONGEST / max(float(np.abs(change / scale[: len(change)]).max()), 1e-300))
        size = float(np.sqrt(max(float(change @ s.A @ change), 0.0)))
        state = sub.step(state, change[: sub.size])
        if loose:
            centre = centre + change[sub.size :]
        # the same derivatives serve as long as little has changed since they were taken
        drift = drift + change
        far = float(np.abs(drift / scale[: len(drift)]).max())
        if far < near and (size > _STALE * far or far <= _HERE * tolerance):
            lin = lin.after(change)
        else:
            lin, drift, far = taken(state, centre), np.zeros(len(change)), 0.0
        new = s.variances(lin, noise, floor)
        settled = s.unsettled(new)
        exact = new.translation <= floor and new.rotation <= TINY
        # steps shrink at least as fast as they just did, so that the next one bounds what is left
        leap = max(size, settled)
        done = leap * min(1.0, leap / before) < tolerance or (size < 0.1 and exact)
        done = done and stale <= _HERE * tolerance  # the step was not one of derivatives from elsewhere
        stale = far
        noise = new
        if exact and loose:  # there is no noise to have a centre
            loose, centre = False, np.zeros(3)
            lin, drift = taken(state, centre), np.zeros(sub.size)
        s = Scaled(sub, lin, noise, loss, usual_discord)
        if done:
            break
        before = leap
    # every observation, at the same state
    w, d = (lin.w, lin.d) if sub is problem else residuals(problem, state, centre)
    return EquationFit(state=state, noise=noise, centre=centre, loss=loss, keep=keep, scaled=s, lin=lin, w=w, d=d)
