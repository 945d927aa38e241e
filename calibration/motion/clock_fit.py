"""Estimate X_BC and the scanner's clock together from frames in motion, with the variances of all that is random.

Model of frame k, with capture time t_k = nominal_k(offset, drift, rolling) + j_k and random j_k (variance sigma_j^2):

    X_BC p_C,k - p_BR(t_k) = e_k,    R_BC n_C,k - n_BR(t_k) = m_k.

j_k is eliminated, so that frame k has the covariance S_k + sigma_j^2 g_k g_k^T with g_k the rates of centre and normal.
The motion is linearised at each frame's own most probable capture time, not at the nominal one, since jitter takes a
frame past the ends of a move. The variances (a factor of the fit's own noise, a common spread of centres and of
normals, sigma_j) solve the equations of restricted maximum likelihood.

A scanner on the flange that sees a fixed target is the same with the inverted motion: X_FC p_C,k - X_FB(t_k) p_BT =
e_k. The target's centre p_BT and the two angles of its normal are then unknown, too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.geometry.se3 import exp_rotation, frames_along, skew
from weldcal.calibration.motion.observed import FrameClock, ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

_FLOOR = np.array([1e-6, 1e-14, 1e-14, 1e-14])  # factor, m^2, rad^2, s^2
_TOLD = 0.5  # residuals that a variance explains: with fewer it is not estimated
_MOST_JITTER_S = 0.2  # a choice: as two frames at 10 Hz; beyond, no clock can be fitted
FREE_S2 = 1.0  # variance of the time of a frame that is grossly late

_COUNT = 15  # unknowns at most
_GATE = 6.5  # sigma: only gross outliers go, as in the calibration at rest
_LATE = 8.0  # robust deviations of a frame's time: beyond, it says nothing of the mean offset
_LATE_FLOOR_S = 1e-3  # a choice: half of a robot's period (2 ms); a frame 8 times as late as this always counts
_GUARD = 4.0  # jitters that a frame must lie within the stream's data
_STEPS = 60
_GRID = np.linspace(-6.0, 6.0, 25)
_WIDEST = np.array(
    [10.0] * 3 + [10.0] * 3 + [1.0, 1.0, 1.0, 1e3] + [10.0] * 5
)  # steps in directions without information stay within: rad, m, s, s/s, s

OFFSET, DRIFT, ROLLING, EDGE = 6, 7, 8, 9
"""Indices of the clock's unknowns behind X_BC's six, and of the height of the edges found (in noises of the face)."""
TARGET = (10, 11, 12, 13, 14)
"""Indices of a fixed target's unknowns: its centre, and the rotations about its own x and y."""
_PRIOR = np.array([0.0] * 9 + [1.0 / 3.0**2] + [0.0] * 5)  # information: edges lie within some noises of the face


@dataclass(frozen=True, eq=False)
class Variances:
    """``factor`` of the fits' own covariances; ``spread`` m^2 and ``lean`` rad^2 beyond them, an axis.

    ``jitter`` s^2.
    """

    factor: float
    spread: float
    lean: float
    jitter: float

    @property
    def array(self) -> Array:
        """The four as an array."""
        return np.array([self.factor, self.spread, self.lean, self.jitter])


@dataclass(eq=False)
class LinearisedStream:
    """The model linearised at the frames' capture times.

    Residuals extrapolated to the nominal times y (N, 5), Jacobians J (N, 5, 15), rates g (N, 5) and the unit
    covariances of the three kinds of noise in 5 x 5.
    """

    y: Array
    J: Array
    g: Array
    own: Array
    own_lean: Array


def total_variances(linear: LinearisedStream, variances: Variances, keep: Flags) -> Array:
    """Mean variances of a centre and a normal, an axis, and of the time: what the weights follow from.

    The share of the fits' own noise in them converges slowly, and matters little.
    """
    own = np.einsum("nii->", linear.own[keep]) / (3.0 * np.count_nonzero(keep))
    lean = np.einsum("nii->", linear.own_lean[keep]) / (2.0 * np.count_nonzero(keep))
    return np.array(
        [variances.factor * own + variances.spread, variances.factor * lean + variances.lean, variances.jitter]
    )


def noise_covariances(linear: LinearisedStream, variances: Variances) -> Array:
    """Covariances (N, 5, 5) without the jitter."""
    P = variances.factor * (linear.own + linear.own_lean)
    P[:, range(3), range(3)] += variances.spread
    P[:, range(3, 5), range(3, 5)] += variances.lean
    return P


def frame_weights(linear: LinearisedStream, variances: Variances, late: Flags) -> Array:
    """Inverse covariances (N, 5, 5) with the jitter."""
    j = np.where(late, FREE_S2, variances.jitter)
    V = noise_covariances(linear, variances) + j[:, None, None] * linear.g[:, :, None] * linear.g[:, None, :]
    V[~np.isfinite(V[:, 0, 0])] = np.eye(5)
    return np.asarray(np.linalg.inv(V))


def new_variances(
    linear: LinearisedStream,
    variances: Variances,
    W: Array,
    information: Array,
    keep: Flags,
    late: Flags,
    index: NDArray[np.int64],
) -> Variances:
    """One step of the equations q_g = tr(P V_g) of restricted maximum likelihood (Patterson and Thompson 1971)."""
    w, J = W[keep], linear.J[keep][:, :, index]
    y = linear.y[keep]
    wy = np.einsum("nij,nj->ni", w, y)
    wJ = w @ J
    d = np.sqrt(np.maximum(np.diag(information), 1e-30))
    inverse = np.linalg.pinv(information / np.outer(d, d), rcond=1e-11, hermitian=True) / np.outer(d, d)
    g = linear.g[keep] * np.where(late[keep], 0.0, 1.0)[:, None]
    kinds = [
        linear.own[keep] + linear.own_lean[keep],
        np.broadcast_to(np.diag([1.0, 1.0, 1.0, 0.0, 0.0]), (len(y), 5, 5)),
        np.broadcast_to(np.diag([0.0, 0.0, 0.0, 1.0, 1.0]), (len(y), 5, 5)),
        g[:, :, None] * g[:, None, :],
    ]
    values = variances.array
    for k, V in enumerate(kinds):
        q = float(np.einsum("ni,nij,nj->", wy, V, wy))
        t = float(np.einsum("nij,nji->", w, V)) - float(
            np.einsum("jk,nij,nil,nlk->", inverse, wJ, V, wJ, optimize=True)
        )
        # what no frame tells stays as it is: an arm at rest says nothing of the jitter
        if t * values[k] > _TOLD:
            values[k] *= np.clip(q / t, 0.05, 20.0)
    factor, spread, lean, jitter = np.maximum(values, _FLOOR)
    # the fit's own covariance and the common spread are told apart only where it differs from frame to frame
    return Variances(min(float(factor), 1.0), float(spread), float(lean), min(float(jitter), _MOST_JITTER_S**2))


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockFit:
    """Result of the joint fit of N frames.

    ``X_BC``. ``offset`` s and ``drift`` of the FrameClock's nominal times, ``rolling`` s, ``edge`` height of the edges
    found over the face's noise. ``free`` indices of the unknowns that were estimated (0..5: X_BC, rotation then
    translation on the base side about ``pivot``). ``information`` (K, K) of those. ``keep`` (N,) frames used. ``late``
    (N,) frames whose time was left free. ``capture`` (N,) s most probable capture times and ``nominal`` (N,) s.
    ``centre`` (N, 3) m residuals at the capture times and ``lean`` (N, 2) rad those of the normals. ``rates`` (N, 3)
    m/s of the centre. ``jitters`` (N,) s as each frame alone tells it, and their variances ``jitter_variance`` (N,)
    s^2. ``weighted`` (N, K) scores. ``X_FR``: the feature on what moves; where TARGET is free, X_BT as estimated.
    """

    X_BC: RigidTransform
    offset: float
    drift: float
    rolling: float
    edge: float
    free: tuple[int, ...]
    pivot: Array
    information: Array
    variances: Variances
    keep: Flags
    late: Flags
    capture: Array
    nominal: Array
    centre: Array
    lean: Array
    rates: Array
    jacobian: Array
    weights: Array
    X_FR: RigidTransform | None = None


class MotionProblem:
    """Frames, clock and motion of one fit, with the state that it moves."""

    def __init__(
        self, frames: ObservedFrames, clock: FrameClock, motion: ContinuousMotion, X_FR: RigidTransform | None
    ) -> None:
        self.frames, self.clock, self.motion, self.X_FR = frames, clock, motion, X_FR
        self.row = frames.p_C[:, 1] / frames.p_C[:, 2]
        self.slide = np.zeros_like(frames.p_C) if frames.slide is None else frames.slide

    def move_target(self, delta: Array) -> None:
        """Move the target by its five unknowns (5,) m, rad."""
        X = self.X_FR or RigidTransform()
        turn = RotationMatrix(exp_rotation(np.array([delta[3], delta[4], 0.0])))
        self.X_FR = RigidTransform(X.rotation() @ turn, X.translation() + delta[:3])

    def nominal(self, offset: float, drift: float, rolling: float) -> Array:
        return self.clock.nominal(offset, drift) + rolling * self.row

    def residuals(
        self, X: RigidTransform, t: Array, rolling: float, edge: float
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Return residuals e (N, 3) and m (N, 2), rates v (N, 3) and turn (N, 2) at times t.

        Also returns the tangents A (N, 3, 2) of the normal.
        """
        f = self.frames
        at = self.motion.feature(t, self.X_FR)
        R = X.rotation().matrix()
        e = (f.p_C + edge * self.slide) @ R.T + X.translation() - at.p
        n = f.n_C @ R.T
        if rolling:
            # rows exposed at different times shear the face and lean its normal
            n = n + (rolling / f.p_C[:, 2] * (at.v * at.n).sum(axis=1))[:, None] * R[:, 1]
        A = frames_along(at.n)[:, :, :2]
        m = np.einsum("nij,ni->nj", A, n - at.n)
        return e, m, at.v, np.einsum("nij,ni->nj", A, at.turn), A


def fit_clock(
    frames: ObservedFrames,
    clock: FrameClock,
    motion: ContinuousMotion,
    X_BC: RigidTransform,
    offset: float,
    *,
    X_FR: RigidTransform | None = None,
    free: tuple[int, ...] = (0, 1, 2, 3, 4, 5, OFFSET),
    keep: Flags | None = None,
    after: ClockFit | None = None,
) -> ClockFit:
    """Fit X_BC and the clock from a start that is right to some millimetres and tens of milliseconds.

    ``offset`` s is that of ``clock``; ``free``: which unknowns to estimate. ``keep`` (N,) limits the frames, for
    cross-validation. ``after``: a fit of the same frames whose drift, rolling time, variances and capture times begin
    this one. Gauss-Newton with the pivot of rotations at the middle of the feature's places; frames with gross errors
    are left out.
    """
    problem = MotionProblem(frames, clock, motion, X_FR)
    moving_target = TARGET[0] in free
    allowed = np.isfinite(clock.base) if keep is None else keep & np.isfinite(clock.base)
    drift, rolling, edge = (0.0, 0.0, 0.0) if after is None else (after.drift, after.rolling, after.edge)
    nominal = problem.nominal(offset, drift, rolling)
    allowed = allowed & motion.known(nominal)
    if after is None:
        variances, first = _first_variances(problem, X_BC, nominal, allowed)
        kept = allowed & first
        late = np.zeros(len(frames), dtype=bool)
        capture = _searched_capture(problem, X_BC, nominal, variances, rolling, edge, allowed)
    else:
        variances, kept, late, capture = after.variances, allowed & after.keep, after.late.copy(), after.capture
    if np.count_nonzero(kept) < 4:
        raise TooFewPoses(f"Only {np.count_nonzero(kept)} of {len(frames)} frames agree with one pose of the scanner.")
    pivot = motion.feature(nominal[kept], X_FR).p.mean(axis=0)
    index = np.array(free)
    linear, information, W = None, np.eye(len(free)), np.zeros((len(frames), 5, 5))
    for step_number in range(_STEPS):
        capture = _polished_capture(problem, X_BC, nominal, capture, variances, rolling, edge, late)
        linear = linearised(problem, X_BC, nominal, capture, rolling, edge, pivot)
        reach = _GUARD * float(np.sqrt(variances.jitter))
        inside = motion.known(nominal - reach) & motion.known(nominal + reach) & np.isfinite(linear.y[:, 0])
        W = frame_weights(linear, variances, late)
        kept, late, settled_sets = _sorted_frames(linear, variances, W, allowed & inside, kept, late, step_number)
        W = frame_weights(linear, variances, late)
        J = linear.J[kept][:, :, index]
        WJ = W[kept] @ J
        information = np.einsum("nij,nik->jk", J, WJ) + np.diag(_PRIOR[index])
        score = np.einsum("nij,ni->j", WJ, linear.y[kept])
        score += np.where(index == EDGE, edge * _PRIOR[index], 0.0)
        delta = np.zeros(_COUNT)
        delta[index] = -_solved(information + np.diag(1.0 / _WIDEST[index] ** 2), score)
        R = exp_rotation(delta[:3]) @ X_BC.rotation().matrix()
        p = exp_rotation(delta[:3]) @ (X_BC.translation() - pivot) + pivot + delta[3:6]
        X_BC = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
        offset, drift = offset + delta[OFFSET], drift + delta[DRIFT]
        rolling, edge = rolling + delta[ROLLING], edge + delta[EDGE]
        if moving_target:
            problem.move_target(delta[10:])
        nominal = problem.nominal(offset, drift, rolling)
        linear.y[kept] += linear.J[kept] @ delta
        new = new_variances(linear, variances, W, information, kept, late, index)
        change = float(
            np.abs(np.log(total_variances(linear, new, kept) / total_variances(linear, variances, kept))).max()
        )
        variances = new
        if step_number == 3 and after is None:
            capture = _searched_capture(problem, X_BC, nominal, variances, rolling, edge, allowed)
        small = np.sqrt(np.maximum(delta[index] @ information @ delta[index], 0.0)) < 1e-2
        if step_number > (6 if after is None else 3) and small and change < 3e-3 and settled_sets:
            break
    assert linear is not None
    e, m, v, _, _ = problem.residuals(X_BC, capture, rolling, edge)
    return ClockFit(
        X_BC=X_BC,
        offset=float(offset),
        drift=float(drift),
        rolling=float(rolling),
        edge=float(edge),
        free=free,
        pivot=pivot,
        information=information,
        variances=variances,
        keep=kept,
        late=late,
        capture=capture,
        nominal=nominal,
        centre=e,
        lean=m,
        rates=v,
        jacobian=linear.J[:, :, index],
        weights=W,
        X_FR=problem.X_FR,
    )


def _solved(N: Array, b: Array) -> Array:
    """Solution of N x = b with N scaled to a unit diagonal; directions without information stay where they are."""
    d = np.sqrt(np.maximum(np.diag(N), 1e-30))
    return np.asarray(np.linalg.pinv(N / np.outer(d, d), rcond=1e-11, hermitian=True) @ (b / d) / d)


def _first_variances(
    problem: MotionProblem, X: RigidTransform, nominal: Array, allowed: Flags
) -> tuple[Variances, Flags]:
    """Take variances from medians of the start's residuals, and the frames that agree with them.

    The residuals are across and along the motion.
    """
    e, m, v, _, _ = problem.residuals(X, nominal, 0.0, 0.0)
    speed = np.linalg.norm(v, axis=1)
    fast = allowed & (speed > 0.3 * float(np.nanmax(np.where(allowed, speed, 0.0), initial=0.0))) & (speed > 1e-3)
    u = v / np.maximum(speed, 1e-9)[:, None]
    along = (e * u).sum(axis=1)
    across = np.sqrt(np.maximum((e * e).sum(axis=1) - np.where(speed > 1e-3, along**2, 0.0), 0.0) / 2.0)
    s_p = 1.5 * float(np.median(across[allowed])) + 1e-5
    s_n = 1.5 * float(np.median(np.linalg.norm(m, axis=1)[allowed])) / np.sqrt(2.0) + 1e-5
    s_j = 1.5 * float(np.median(np.abs(along[fast]) / speed[fast])) + 1e-4 if fast.any() else 1e-3
    agree = (across < 8.0 * s_p) & (np.linalg.norm(m, axis=1) < 12.0 * s_n)
    return Variances(1.0, s_p**2, s_n**2, s_j**2), allowed & agree


def _precision(problem: MotionProblem, X: RigidTransform, variances: Variances) -> tuple[Array, Array]:
    """Inverse covariances (N, 3, 3) of centres in the base frame, and (N,) of normals."""
    R = X.rotation().matrix()
    f = problem.frames
    own = variances.factor * (R @ f.covariance @ R.T) + variances.spread * np.eye(3)
    return np.linalg.inv(own), 1.0 / (variances.factor * f.normal_sigma**2 + variances.lean)


def _searched_capture(
    problem: MotionProblem,
    X: RigidTransform,
    nominal: Array,
    variances: Variances,
    rolling: float,
    edge: float,
    allowed: Flags,
) -> Array:
    """Most probable capture times (N,) on a grid: a move's end or a turn gives more than one local optimum."""
    s = float(np.sqrt(variances.jitter))
    Wp, wn = _precision(problem, X, variances)
    best, chosen = np.full(len(nominal), np.inf), nominal.copy()
    for k in _GRID:
        t = nominal + k * s
        e, m, _, _, _ = problem.residuals(X, t, rolling, edge)
        cost = np.einsum("ni,nij,nj->n", e, Wp, e) + wn * (m * m).sum(axis=1) + k * k
        better = np.where(np.isfinite(cost), cost, np.inf) < best
        best, chosen = np.where(better, cost, best), np.where(better, t, chosen)
    return np.where(allowed, chosen, nominal)


def _polished_capture(
    problem: MotionProblem,
    X: RigidTransform,
    nominal: Array,
    capture: Array,
    variances: Variances,
    rolling: float,
    edge: float,
    late: Flags,
) -> Array:
    """Capture times (N,) after two Gauss-Newton steps on each frame's own time."""
    prior = 1.0 / np.where(late, FREE_S2, variances.jitter)
    Wp, wn = _precision(problem, X, variances)
    limit = 3.0 * float(np.sqrt(variances.jitter)) + 1e-4
    for _ in range(2):
        e, m, v, turn, _ = problem.residuals(X, capture, rolling, edge)
        Wv = np.einsum("nij,nj->ni", Wp, v)
        slope = (Wv * e).sum(axis=1) + wn * (turn * m).sum(axis=1) - prior * (capture - nominal)
        bend = (Wv * v).sum(axis=1) + wn * (turn * turn).sum(axis=1) + prior
        step = np.clip(np.nan_to_num(slope / bend), -limit, limit)
        moved = capture + step
        capture = np.where(problem.motion.known(moved), moved, capture)
    return capture


def linearised(
    problem: MotionProblem, X: RigidTransform, nominal: Array, capture: Array, rolling: float, edge: float, pivot: Array
) -> LinearisedStream:
    """Return the model at capture times (N,) s.

    Residuals extrapolated to the nominal times, and their derivatives by all unknowns. ``rolling`` s, ``edge`` in
    noises of the face, rotations about ``pivot`` (3,) m.
    """
    f = problem.frames
    e, m, v, turn, A = problem.residuals(X, capture, rolling, edge)
    R = X.rotation().matrix()
    n = len(f)
    g = np.concatenate([v, turn], axis=1)
    y = np.concatenate([e, m], axis=1) + g * (capture - nominal)[:, None]
    J = np.zeros((n, 5, _COUNT))
    J[:, :3, :3] = -skew((f.p_C + edge * problem.slide) @ R.T + X.translation() - pivot)
    J[:, :3, 3:6] = np.eye(3)
    At = np.swapaxes(A, 1, 2)
    J[:, 3:, :3] = -At @ skew(f.n_C @ R.T)
    clock = problem.clock
    times = np.stack([np.full(n, clock.sign), clock.base - clock.reference, problem.row], axis=1)
    J[:, :, OFFSET:EDGE] = -g[:, :, None] * times[:, None, :]
    leaning = (v * problem.motion.feature(capture, problem.X_FR).n).sum(axis=1) / f.p_C[:, 2]
    J[:, :3, EDGE] = problem.slide @ R.T
    J[:, 3:, ROLLING] += leaning[:, None] * (At @ R[:, 1])
    R_FB = problem.motion.poses(capture)[:, :3, :3]
    target = (problem.X_FR or RigidTransform()).rotation().matrix()
    J[:, :3, 10:13] = -R_FB
    J[:, 3:, 13:] = -At @ R_FB @ np.column_stack([-target[:, 1], target[:, 0]])
    own, own_lean = np.zeros((n, 5, 5)), np.zeros((n, 5, 5))
    own[:, :3, :3] = R @ f.covariance @ R.T
    own_lean[:, 3, 3] = own_lean[:, 4, 4] = f.normal_sigma**2
    bad = ~np.isfinite(y).all(axis=1)
    for array in (y, J, g):
        array[bad] = np.nan
    return LinearisedStream(y, J, g, own, own_lean)


def _sorted_frames(
    linear: LinearisedStream, variances: Variances, W: Array, allowed: Flags, kept: Flags, late: Flags, step: int
) -> tuple[Flags, Flags, bool]:
    """Frames to use and frames whose time is grossly late, from the present residuals; whether both sets stayed."""
    if step < 2 or step > 25:
        return kept & allowed, late & allowed, step > 25 and bool((kept <= allowed).all())
    P = noise_covariances(linear, variances)
    Wy = np.einsum("nij,nj->ni", W, np.nan_to_num(linear.y))
    geometric = np.einsum("ni,nij,nj->n", Wy, np.nan_to_num(P), Wy)
    new = allowed & (geometric < _GATE**2)
    if np.count_nonzero(new) < 4:
        new = kept & allowed
    Pg = np.linalg.solve(np.where(np.isfinite(P), P, np.eye(5)), np.nan_to_num(linear.g)[:, :, None])[:, :, 0]
    a = (np.nan_to_num(linear.g) * Pg).sum(axis=1)
    told = new & (a * variances.jitter > 1.0)
    new_late = np.zeros_like(late)
    if np.count_nonzero(told) > 8:
        j = (Pg * np.nan_to_num(linear.y)).sum(axis=1) / np.maximum(a, 1e-12)
        low, middle, high = np.percentile(j[told], [15.87, 50.0, 84.13])
        new_late = told & (np.abs(j - middle) > _LATE * max(0.5 * (high - low), _LATE_FLOOR_S))
    return new, new_late, bool((new == kept).all() and (new_late == late).all())
