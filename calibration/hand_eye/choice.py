"""Solve one hand-eye problem: starts, outlier rejection, robust least squares on SE(3) with variance components."""

from dataclasses import dataclass
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.hand_eye.problem import (
    TINY,
    Linearised,
    Loss,
    Noise,
    Problem,
    Scaled,
    State,
    gram,
    linearise,
    pull,
    residuals,
)
from weldcal.calibration.hand_eye.starts import closed_forms, grid
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

_NEAR = 1e-3  # changes (rad, or share of the extent) up to which derivatives taken once still predict
_MANY = 50  # observations from which on a prediction costs less than new derivatives
_FAR_APART = 1e-3  # how much smaller one kind of noise may start, rad against shares of the extent
_LONGEST = 0.5  # step (rad, or share of the extent): beyond it the derivatives say nothing
_STALE = 100.0  # steps (sigma) shorter than this many changes are decided by derivatives of the place itself
_HERE = 0.1  # share of the tolerance up to which derivatives are those of the place itself

_GATE = 8.0  # sigma per axis, as in the eye-on-base solver: only gross outliers go
_AGREEING = 0.6  # share of the poses that a trimmed fit keeps: the others may be outliers
_SUSPECT = 2.0  # sigma per axis of a residual that makes a trimmed fit worth its time
_WORST_SHARE = 0.1  # of the extent: residuals beyond it are no calibration
_WORST_TURN_RAD = 0.2  # 11 degrees, a choice: a camera that turns so much is another convention; none measures so badly
_SUBSETS = 60


USUAL_DISCORD_RAD = 5e-3  # six pixels of the principal point over a focal length of 1,200 pixels
"""Angle, an axis, by which positions and rotations of usual cameras disagree: six pixels of the principal point at a
focal length of 1,200."""


@dataclass(frozen=True, kw_only=True)
class EquationFit:
    """A converged fit.

    ``w``, ``d`` (n, 3): residuals; ``scaled``, ``lin``: normal equations and derivatives of the observations kept.
    """

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
    is an unknown like the others (starting at ``centre``, else at the target's origin). It is the point of the target
    whose displacement is least, since a camera errs about the middle of a board and not about its origin. The answer
    thus moves with any choice of frames. It stays zero where full poses are too few, or exact. ``usual_discord``:
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
        settled = s.unconverged(new)
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


@dataclass(frozen=True)
class Choice:
    """The answer and how it was found.

    ``covariance`` of the free poses, 6 each in the order X, Y, Z, in the tangent of se3.moved.
    """

    state: State
    covariance: Array
    fit: EquationFit
    method: str
    start: str


def solve(
    problem: Problem,
    known: State,
    *,
    seed: int = 0,
    starts: tuple[State, ...] = (),
    max_outliers: float = 0.40,
    usual_discord: float = USUAL_DISCORD_RAD,
) -> Choice:
    """Solve one problem; ``known`` holds the poses that are not free. Deterministic for ``seed``.

    Where the rotations can be had without the translations, a discord between both is estimated (see Scaled) whose size
    is ``usual_discord`` (rad) beforehand; 0: least squares, without discord. Raises InconsistentPoses where no rigid
    poses explain enough observations.
    """
    state, name = _start(problem, known, seed, starts)
    state = _concentrated(problem, state)
    w, d = residuals(problem, state)
    keep = _gate(problem, w, d)
    base: EquationFit | None = None
    tried_sets: set[bytes] = set()
    for _ in range(10):
        noise = noise_of(problem, w, d, keep) if base is None else base.noise
        base = fit(problem, state, noise=noise, loss=Loss.HUBER, keep=keep, tolerance=1e-2)
        state = base.state
        tried_sets.add(keep.tobytes())
        new = _within(problem, base)
        if new.tobytes() in tried_sets or int(new.sum()) < 4:
            break
        keep = new
    assert base is not None
    need = max(3, int(np.ceil((1.0 - max_outliers) * len(problem) - 1e-9)))
    if int(keep.sum()) < need and len(problem) > 4:
        raise InconsistentPoses(
            f"Only {int(keep.sum())} of {len(problem)} poses agree on one answer; check units, pose order, the"
            " quaternion order, and which pose is stated from which frame."
        )
    seen = bool((problem.full | problem.normal).any())
    turned = float(np.sqrt(base.noise.rotation)) if seen else 0.0
    if np.sqrt(base.noise.translation) > _WORST_SHARE * problem.extent or turned > _WORST_TURN_RAD:
        raise InconsistentPoses(
            f"The poses disagree by {np.degrees(turned):.1f} deg and "
            f"{100.0 * np.sqrt(base.noise.translation) / problem.extent:.0f} % of their own extent; check units, pose "
            "order, the quaternion order, and which pose is stated from which frame."
        )
    # only full poses hold the rotation of X without their translations; three unknowns need what both know
    separable = bool(problem.full.all()) and not all(problem.free)
    best = fit(
        problem,
        base.state,
        centre=base.centre,
        noise=base.noise,
        loss=Loss.HUBER if usual_discord else Loss.SQUARES,
        keep=keep,
        usual_discord=usual_discord if separable else 0.0,
        begin=base.lin if np.array_equal(base.keep, keep) else None,
    )
    s = best.scaled
    said = f"variance components, discord {np.degrees(s.discord):.2g} deg" if s.discord else "variance components"
    covariance = s.covariance()
    return Choice(best.state, 0.5 * (covariance + covariance.T), best, said, name)


def _concentrated(problem: Problem, state: State) -> State:
    """Return the state of the poses that agree best, where some may be outliers.

    Few outliers of few poses hide in the noise that they cause.

    Least trimmed squares by concentration steps (Rousseeuw and Van Driessen 1999). Poses with less than three numbers
    for each unknown are not trimmed.
    """
    n, kept, begin, least = len(problem), None, state, np.inf
    most = int(np.ceil(_AGREEING * n))
    if not problem.all_full or problem.tied or 6 * most < 3 * problem.size:
        return state
    for _ in range(10):
        w, d = residuals(problem, state)
        noise = noise_of(problem, w, d, np.ones(n, dtype=bool))
        size = np.column_stack([(w**2).sum(axis=1) / noise.rotation, (d**2).sum(axis=1) / noise.translation])
        if kept is None and (size < 3.0 * _SUSPECT**2).all():
            return state
        # the median of all poses must fall, or the start was the better one
        spread = noise.rotation * noise.translation
        if kept is not None and spread > least:
            return begin
        least = spread if kept is None else least
        rows = np.sort(np.argsort(size.sum(axis=1), kind="stable")[:most])
        if kept is not None and np.array_equal(rows, kept):
            break
        kept = rows
        keep = np.isin(np.arange(n), rows)
        state = fit(problem, state, noise=noise, loss=Loss.SQUARES, keep=keep, tolerance=1e-2).state
    return state


def _gate(problem: Problem, w: Array, d: Array) -> Flags:
    """Observations (n,) whose residuals lie within the gate, the noise taken from the medians."""
    everything = np.ones(len(problem), dtype=bool)
    if len(problem) <= 4:
        return everything
    noise = noise_of(problem, w, d, everything)
    return _inside(problem, w, d, noise.rotation, noise.translation)


def _within(problem: Problem, base: EquationFit) -> Flags:
    if len(problem) <= 4:
        return np.ones(len(problem), dtype=bool)
    return _inside(problem, base.w, base.d, base.noise.rotation, base.noise.translation)


def _inside(problem: Problem, w: Array, d: Array, rotation: float, translation: float) -> Flags:
    own_w, own_d = 0.0, 0.0
    if problem.covariance is not None:
        diagonal = np.diagonal(problem.covariance, axis1=1, axis2=2)
        own_w, own_d = diagonal[:, :3].max(axis=1), diagonal[:, 3:].max(axis=1)
    square = np.maximum((w**2).sum(axis=1) / (rotation + own_w), (d**2).sum(axis=1) / (translation + own_d))
    return np.asarray(square < 3.0 * _GATE**2)


def _start(problem: Problem, known: State, seed: int, starts: tuple[State, ...]) -> tuple[State, str]:
    rng = np.random.default_rng(seed)
    best: State | None = None
    cost, name = np.inf, ""
    # a closed form that fits well needs no second opinion
    for found in chain([[("given", s) for s in starts]], ([form] for form in closed_forms(problem, known))):
        state, new, given = most_promising(problem, found, 2)
        if state is not None and new < cost:
            best, cost, name = state, new, given
            if _clean(problem, best):
                return best, name
    # gross outliers or a closed form that failed: minimal sets, then turns of the cube
    size = 8 if all(problem.free) else 3 if problem.full.all() else 5
    subsets: list[tuple[str, State]] = []
    if len(problem) > size + 1:
        for _ in range(_SUBSETS):
            rows = rng.choice(len(problem), size, replace=False)
            forms = islice(closed_forms(problem.pick(rows), known), 2)
            subsets += [(f"minimal sets, {n}", s) for n, s in forms]
    other, other_cost, other_name = most_promising(problem, subsets + grid(problem, known, rng), 6)
    if best is None or (other is not None and other_cost < cost * (1.0 - 1e-6)):
        best, cost, name = other, other_cost, other_name
    if best is None:
        raise InconsistentPoses("No rigid poses explain the measurements; check units, pose order and frames.")
    return best, name


def most_promising(problem: Problem, pool: list[tuple[str, State]], tries: int) -> tuple[State | None, float, str]:
    """Return the start with the least cost after a descent from the most promising ones."""
    if not pool:
        return None, np.inf, ""
    length = problem.extent
    ranked: list[tuple[float, int, str, State]] = []
    for name, state in pool:
        if not all(np.isfinite(X).all() for X in state):
            continue
        w, d = residuals(problem, state)
        s = 4.0 * (w**2).sum(axis=1) + 16.0 * (d**2).sum(axis=1) / length**2
        ranked.append((float((s / (1.0 + s)).sum()), len(ranked), name, state))
    ranked.sort(key=lambda r: r[:2])
    best: tuple[State | None, float, str] = (None, np.inf, "")
    for _, _, name, state in ranked[:tries]:
        state, cost = descend(problem, state, tolerance=1e-4)
        if cost < best[1] * (1.0 - 1e-3):
            best = (state, cost, name)
        elif cost < best[1] * (1.0 + 1e-3):
            break  # the same valley from another start
    return best


def _clean(problem: Problem, state: State) -> bool:
    w, d = residuals(problem, state)
    noise = noise_of(problem, w, d, np.ones(len(problem), dtype=bool))
    turned = np.sqrt(noise.rotation) if (problem.full | problem.normal).any() else 0.0
    few = int((~_gate(problem, w, d)).sum()) <= max(0.02 * len(problem), 1)
    return few and np.sqrt(noise.translation) < 0.05 * problem.extent and bool(turned < 0.1)
