"""Solves one hand-eye problem: starts, outlier rejection, and the fit of poses and variance components."""

from dataclasses import dataclass
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.hand_eye.fit import EquationFit, descend, fit, noise_of
from weldcal.calibration.hand_eye.linearisation import Loss
from weldcal.calibration.hand_eye.problem import Problem, State, residuals
from weldcal.calibration.hand_eye.starts import closed_forms, grid
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

_GATE = 8.0  # sigma per axis, as in the eye-on-base solver: only gross outliers go
_AGREEING = 0.6  # share of the poses that a trimmed fit keeps: the others may be outliers
_SUSPECT = 2.0  # sigma per axis of a residual that makes a trimmed fit worth its time
_WORST_SHARE = 0.1  # of the extent: residuals beyond it are no calibration
_WORST_TURN_RAD = 0.2  # 11 degrees, a choice: a camera that turns so much is another convention; none measures so badly
_SUBSETS = 60


USUAL_DISCORD_RAD = 5e-3  # six pixels of the principal point over a focal length of 1,200 pixels
"""Angle, an axis, by which positions and rotations of usual cameras disagree: six pixels of the principal point at a
focal length of 1,200."""


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
    """The state of the poses that agree best, where some may be outliers: few outliers of few poses hide in the noise
    that they cause.

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
    """The start with the least cost after a descent from the most promising ones."""
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
