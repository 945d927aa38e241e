"""Solves one hand-eye problem: starts, outlier rejection, and the mean of several weightings of rotations against translations."""

from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.geometry.robust import t_quantile
from weldcal.calibration.geometry.se3 import exp_rotation, mean_of
from weldcal.calibration.hand_eye.fit import Fit, descend, fit, noise_of
from weldcal.calibration.hand_eye.linearisation import Loss
from weldcal.calibration.hand_eye.problem import Problem, State, residuals
from weldcal.calibration.hand_eye.starts import closed_forms, grid
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

_GATE = 8.0  # sigma per axis, as in the eye-on-base solver: only gross outliers go
_AGREEING = 0.6  # share of the poses that a trimmed fit keeps: the others may be outliers
_SUSPECT = 2.0  # sigma per axis of a residual that makes a trimmed fit worth its time
_WORST_SHARE = 0.1  # of the extent: residuals beyond it are no calibration
_WORST_TURN_RAD = 0.2
_SUBSETS = 60


@dataclass(frozen=True)
class Candidate:
    """A weighting of the observations: the loss, and how much less than estimated the translations count."""

    name: str
    loss: Loss
    ratio: float = 1.0


CANDIDATES = (
    Candidate("least squares", Loss.SQUARES),
    *(Candidate(f"translations / {r:g}", Loss.SQUARES, r) for r in (2.0, 4.0, 8.0, 16.0)),
    Candidate("rotations alone", Loss.SQUARES, 1e3),
    Candidate("Student's t, translations / 4", Loss.STUDENT, 4.0),
)
"""Weightings of poses whose rotations can be had without their translations: all are averaged, none is chosen (docs/hand_eye.md)."""
INSEPARABLE = (Candidate("least squares", Loss.SQUARES), Candidate("Student's t", Loss.STUDENT))
"""Weightings where they cannot: points, normals, three unknowns."""
_LEVEL = 0.01  # of all paired t tests together (Bonferroni) at which candidates count as different


@dataclass(frozen=True)
class Choice:
    """The answer, how it was found, and what the candidates reached: name -> (deg, length) rms of the held-out errors.

    ``covariance`` of the free poses, 6 each in the order X, Y, Z, in the tangent of se3.moved.
    """

    state: State
    covariance: Array
    fit: Fit
    method: str
    start: str
    scores: dict[str, tuple[float, float]]


def solve(
    problem: Problem,
    known: State,
    *,
    seed: int = 0,
    starts: tuple[State, ...] = (),
    max_outliers: float = 0.40,
    candidates: tuple[Candidate, ...] = CANDIDATES,
    pose_only: bool = False,
) -> Choice:
    """Solve one problem; ``known`` holds the poses that are not free. Deterministic for ``seed``.

    Where the rotations can be had without the translations the answer is the mean of all ``candidates`` on SE(3), each with the
    same weight. Where they cannot, it is the mean of those of INSEPARABLE whose held-out errors a paired test cannot tell
    apart. ``pose_only``: without covariance and scores, where only the poses are wanted. Raises InconsistentPoses where no rigid poses explain enough observations.
    """
    state, name = _start(problem, known, seed, starts)
    state = _concentrated(problem, state)
    w, d = residuals(problem, state)
    keep = _gate(problem, w, d)
    base: Fit | None = None
    tried_sets: set[bytes] = set()
    for _ in range(10):
        noise = noise_of(problem, w, d, keep) if base is None else base.noise
        base = fit(problem, state, noise=noise, loss=Loss.HUBER, keep=keep, tolerance=1e-2, leave_one_out=False)
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
            f"Only {int(keep.sum())} of {len(problem)} poses agree on one answer; check units, pose order, the quaternion"
            " order, and which pose is stated from which frame."
        )
    seen = bool((problem.full | problem.normal).any())
    turned = float(np.sqrt(base.noise.rotation)) if seen else 0.0
    if np.sqrt(base.noise.translation) > _WORST_SHARE * problem.extent or turned > _WORST_TURN_RAD:
        raise InconsistentPoses(
            f"The poses disagree by {np.degrees(turned):.1f} deg and "
            f"{100.0 * np.sqrt(base.noise.translation) / problem.extent:.0f} % of their own extent; check units, pose "
            "order, the quaternion order, and which pose is stated from which frame."
        )
    fits: dict[str, Fit] = {}
    # only full poses hold the rotation of X without their translations; three unknowns need what both know
    separable = bool(problem.full.all()) and not all(problem.free)
    tried = INSEPARABLE if candidates is CANDIDATES and not separable else candidates
    for c in tried:
        near = next((f for f in reversed(fits.values()) if f.loss is c.loss), next(iter(fits.values()), base))
        noise = replace(near.noise, ratio=c.ratio)
        # the first candidate finds the noise centre for all
        fits[c.name] = fit(
            problem,
            near.state,
            centre=near.centre,
            noise=noise,
            loss=c.loss,
            keep=keep,
            hold_centre=bool(fits),
            begin=near.lin if np.array_equal(near.keep, keep) else None,
            leave_one_out=not (pose_only and separable),
        )
    squares = _held_out(fits)
    agreed = list(fits) if separable else _alike(fits, squares)
    best = fits[agreed[0]]
    state, covariance = (
        best.state,
        best.scaled.V[: problem.size, : problem.size] if pose_only else best.scaled.covariance(),
    )
    if len(agreed) > 1:
        chosen = [fits[k] for k in agreed]
        parts = [mean_of([f.state[k] for f in chosen]) if problem.free[k] else known[k] for k in range(3)]
        state = parts[0], parts[0] if problem.tied else parts[1], parts[2]
        if pose_only:
            return Choice(state, covariance, best, _said(agreed), name, {})
        covariance = (
            sum((f.scaled.cross_covariance(o.scaled) for f in chosen for o in chosen), np.zeros_like(covariance))
            / len(chosen) ** 2
        )
    scores = {k: _rms(s) for k, s in squares.items()}
    return Choice(state, 0.5 * (covariance + covariance.T), best, _said(agreed), name, scores)


def _concentrated(problem: Problem, state: State) -> State:
    """The state of the poses that agree best, where some may be outliers: few outliers of few poses hide in the noise that they cause.

    Least trimmed squares by concentration steps (Rousseeuw and Van Driessen 1999). Poses with less than three numbers for each unknown
    are not trimmed.
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
        state = fit(
            problem, state, noise=noise, loss=Loss.SQUARES, keep=keep, tolerance=1e-2, leave_one_out=False
        ).state
    return state


def _gate(problem: Problem, w: Array, d: Array) -> Flags:
    """Observations (n,) whose residuals lie within the gate, the noise taken from the medians."""
    everything = np.ones(len(problem), dtype=bool)
    if len(problem) <= 4:
        return everything
    noise = noise_of(problem, w, d, everything)
    return _inside(problem, w, d, noise.rotation, noise.translation)


def _within(problem: Problem, base: Fit) -> Flags:
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


def _held_out(fits: dict[str, Fit]) -> dict[str, Array]:
    """Squares (n, 2) of the held-out errors, rotation and displacement, all at the noise centre of the first fit."""
    centre = next(iter(fits.values())).centre
    out = {}
    for k, f in fits.items():
        w, d = f.left_w[f.keep], f.left_d[f.keep]
        d = d + np.where(f.scaled.full[:, None], (exp_rotation(w) - np.eye(3)) @ (centre - f.centre), 0.0)
        out[k] = np.column_stack([(w**2).sum(axis=1), (d**2).sum(axis=1)])
    return out


def _said(names: list[str]) -> str:
    return " + ".join(names) if len(names) < 3 else f"mean of {len(names)} weightings"


def _rms(squares: Array) -> tuple[float, float]:
    rms = np.sqrt(squares.mean(axis=0))
    return float(np.degrees(rms[0])), float(rms[1])


def _alike(fits: dict[str, Fit], squares: dict[str, Array]) -> list[str]:
    """The candidate with the least regret, and those whose held-out errors cannot be told apart from the best of either
    column (paired t test of the squares)."""
    means = {k: s.mean(axis=0) for k, s in squares.items()}
    least = np.maximum(np.min(list(means.values()), axis=0), 1e-300)
    order = sorted(fits, key=lambda k: (float(max(means[k] / least)), list(fits).index(k)))
    column_best = [list(means)[int(np.argmin([m[c] for m in means.values()]))] for c in range(2)]
    tests = 2.0 * max(len(fits) - 1, 1)
    limit = float(t_quantile(1.0 - 0.5 * _LEVEL / tests, max(len(squares[order[0]]) - 1, 1)))
    out = [order[0]]
    for k in order[1:]:
        apart = False
        for c in range(2):
            difference = squares[k][:, c] - squares[column_best[c]][:, c]
            error = float(difference.std(ddof=1)) / np.sqrt(len(difference))
            apart |= bool(float(difference.mean()) > limit * error)
        if not apart:
            out.append(k)
    return out
