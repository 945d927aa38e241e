"""Judge a camera's pose on pairs of poses: how far it is off, and whether a new solution is better than chance."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.optimize import brentq
from scipy.special import fdtrc, ncfdtr

from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import (
    IDENTITY,
    angle_of,
    difference,
    inverse,
    log_rotation,
    nearest_rotation,
    skew,
)
from weldcal.calibration.hand_eye.problem import Flags, Problem, residuals
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, fold_labels, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

FALSE_ALARM = 0.01  # the usual level of a test
"""Chance that a right pose is called worse than a new solution."""
POWER = 0.95  # the usual level of a region; at 0.8 the shown error is a fifth smaller
"""Chance that an error of the size ``shown_mm`` is found."""
SHOWN_MM = 2.0  # a choice; a limit that is stated takes its place
"""Error at the target that the pairs must be able to show, where no limit is stated."""
SMALL = 0.5  # sqrt(1 + 0.5^2) = 1.12
"""Share of one pose's held-out error below which an error of the camera's pose adds less than 12 % to it."""
_PRINTED = 1e-5  # rad and m: a pose with five digits is not off by what it was rounded
_ANGLE_OFF, _METRES_OFF = 0.09, 0.01  # within which another form of the pose fits
_SHARE_OFF = 0.2  # of the stated pose's own error
_OPTICAL = np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)  # axes of the optical frame in a body frame with x forward


@dataclass(frozen=True, eq=False, kw_only=True)
class Judgement:
    """A stated pose X against n pairs.

    Attributes:
        X: the stated pose (4, 4).
        rotation_rad, translation_m: residuals (n) of F X G = Y with the best Y for this X; NaN nowhere.
        held_rotation_rad, held_translation_m: the same where Y comes from the other folds.
        used: poses (n) that agree with the others.
        new: the solution of these pairs alone; None where there is none, and ``missing`` says why.
        off_mm: displacement (rms) of the target in the frame that Y has, from the new solution to the stated pose.
        off_deg: angle between both.
        uncertain_mm: 95 % region of ``off_mm`` along its longest axis.
        shown_mm: the displacement that these pairs show with the probability POWER, whatever its direction.
        statistic, critical: squared error in units of its covariance over six, and its quantile for FALSE_ALARM.
        chance: probability of a larger statistic where the stated pose is right.
        other: another form of the pose that fits, in words, and its displacement in mm.
    """

    X: Array
    rotation_rad: Array
    translation_m: Array
    held_rotation_rad: Array
    held_translation_m: Array
    used: Flags
    new: HandEyeResult | None = None
    missing: str = ""
    off_mm: float = float("nan")
    off_deg: float = float("nan")
    uncertain_mm: float = float("nan")
    shown_mm: float = float("inf")
    statistic: float = float("nan")
    critical: float = float("nan")
    chance: float = float("nan")
    other: tuple[str, float] | None = None

    @property
    def rejected(self) -> bool:
        """Whether the new solution is better than chance."""
        return bool(self.statistic > self.critical)

    @property
    def near(self) -> bool:
        """Whether the pose, or another form of it, is that of the new solution up to a usual error of calibrations."""
        close = self.off_mm < 1e3 * _METRES_OFF and np.radians(self.off_deg) < _ANGLE_OFF
        return self.new is not None and (not self.rejected or self.other is not None or bool(close))

    @property
    def held_out_mm(self) -> float:
        """Rms held-out error of the stated pose, mm, of the poses that agree with the others."""
        return 1e3 * float(np.sqrt((self.held_translation_m[self.used] ** 2).mean()))

    @property
    def held_out_deg(self) -> float:
        """Rms held-out rotation of the stated pose, degrees."""
        return float(np.degrees(np.sqrt((self.held_rotation_rad[self.used] ** 2).mean())))

    @property
    def new_held_out_mm(self) -> float:
        """Rms held-out error of the new solution, mm, of the same poses; NaN without one."""
        if self.new is None:
            return float("nan")
        held = self.new.held_out.translation[self.used]
        held = held[np.isfinite(held)]
        return 1e3 * float(np.sqrt((held**2).mean())) if len(held) else float("nan")


def judge_pose(
    problem: Problem,
    forms: list[Array],
    covariance: Array | None = None,
    config: HandEyeConfig | None = None,
    new: HandEyeResult | None = None,
) -> tuple[int, Judgement]:
    """Judge a stated X of F X G = Y; of several readings of one pose, the one that the pairs contradict least.

    With X fixed, Y is the mean of F X G. The new solution has X and Y free; its X and the stated one differ by e with
    the covariance C of the new solution (plus the stated one). If the stated pose is right, e' C^-1 e / 6 has the
    distribution F(6, degrees of freedom): for a linear problem it is the F test of the six more unknowns. The pairs
    show an error of six numbers with the probability POWER where its non-centrality is that of the non-central F
    distribution. The longest displacement of the target with this non-centrality is ``shown_mm``.

    Args:
        problem: full poses, X and Y free.
        forms: readings (4, 4) of the stated X in metres, the usual one first.
        covariance: (6, 6) of the stated pose, or None.
        new: the solution of these pairs, where more is known than their poses; else it is solved from them.

    Returns:
        Index of the reading, and its judgement.
    """
    try:
        new = new or solve_problem(problem, config=config)
    except WeldcalError as problem_:
        k = min(range(len(forms)), key=lambda k: _spread(problem, forms[k]))
        return k, _residuals_only(problem, forms[k], np.ones(len(problem), dtype=bool), str(problem_))
    measure = _Measure(problem, new, covariance)
    k = min(range(len(forms)), key=lambda k: (measure.statistic(forms[k]), k))
    if k and measure.statistic(forms[0]) <= measure.critical:
        k = 0
    X = forms[k]
    base = _residuals_only(problem, X, new.inliers, "")
    T = measure.statistic(X)
    e = difference(measure.X, X)
    other = measure.other(X) if measure.critical < T else None
    return k, Judgement(
        X=X,
        rotation_rad=base.rotation_rad,
        translation_m=base.translation_m,
        held_rotation_rad=base.held_rotation_rad,
        held_translation_m=base.held_translation_m,
        used=base.used,
        new=new,
        off_mm=1e3 * measure.size(e),
        off_deg=float(np.degrees(np.linalg.norm(e[:3]))),
        uncertain_mm=1e3 * measure.uncertain,
        shown_mm=1e3 * measure.shown,
        statistic=T,
        critical=measure.critical,
        chance=float(fdtrc(6.0, measure.freedom, T)),
        other=other,
    )


class _Measure:
    """Errors of a stated X against a new solution: in units of its covariance, and as displacement of the target."""

    def __init__(self, problem: Problem, new: HandEyeResult, covariance: Array | None) -> None:
        self.new, self.X = new, np.asarray(new.X.GetAsMatrix4())
        self.freedom = float(new.degrees_of_freedom)
        self.C = new.covariance["X"] + _PRINTED**2 * np.eye(6) + (0.0 if covariance is None else covariance)
        self.critical = f_quantile(1.0 - FALSE_ALARM, 6.0, self.freedom)
        arms = (problem.G[new.inliers][:, :3, 3] @ self.X[:3, :3].T)[:, :, None]
        J = np.concatenate([-skew(arms[:, :, 0]), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=2)
        self.M = np.einsum("nij,nik->jk", J, J) / len(J)
        L = np.linalg.cholesky(self.C)
        longest = float(np.linalg.eigvalsh(L.T @ self.M @ L)[-1])
        self.uncertain = float(np.sqrt(6.0 * f_quantile(0.95, 6.0, self.freedom) * longest))
        self.shown = float(np.sqrt(_noncentrality(self.critical, self.freedom) * longest))

    def statistic(self, X: Array) -> float:
        """Squared error in units of its covariance, over six."""
        e = difference(self.X, X)
        return float(e @ np.linalg.solve(self.C, e)) / 6.0

    def size(self, e: Array) -> float:
        """Rms displacement of the target, m."""
        return float(np.sqrt(max(e @ self.M @ e, 0.0)))

    def other(self, X: Array) -> tuple[str, float] | None:
        """Return the other form of X that fits, in words, with its displacement in mm; None where none does."""
        own = self.size(difference(self.X, X))
        near = []
        for words, form in _other_forms(X):
            e = difference(self.X, form)
            size = self.size(e)
            if (
                float(np.linalg.norm(e[:3])) < _ANGLE_OFF
                and size < max(_METRES_OFF, 2.0 * self.uncertain)
                and size < _SHARE_OFF * own
            ):
                near.append((size, words))
        Y = np.asarray(self.new.Y.GetAsMatrix4())
        for words, form in (
            ("RESULT as the pose of the target", X),
            ("the inverse of RESULT as the pose of the target", inverse(X)),
        ):
            e = difference(Y, form)
            size = float(np.linalg.norm(e[3:]))
            if float(np.linalg.norm(e[:3])) < _ANGLE_OFF and size < _METRES_OFF and size < _SHARE_OFF * own:
                near.append((size, words))
        if not near:
            return None
        size, words = min(near)
        return words, 1e3 * size


def _other_forms(X: Array) -> Iterator[tuple[str, Array]]:
    """Other poses that the same numbers may mean.

    Inverted, another unit, transposed, axes of camera or of its parent turned.
    """
    yield "the inverse of RESULT", inverse(X)
    for words, scale in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254), ("metres", 1e3)):
        scaled = X.copy()
        scaled[:3, 3] *= scale
        yield f"RESULT with its lengths in {words}", scaled
    turned = X.copy()
    turned[:3, :3] = X[:3, :3].T
    yield "RESULT with its rotation transposed", turned
    for R in _axes():
        Q = np.eye(4)
        Q[:3, :3] = R
        words = "RESULT with the camera's axes turned"
        if np.array_equal(R, _OPTICAL):
            words = "RESULT with the axes of the optical frame (RESULT has x forward)"
        elif np.array_equal(R, np.diag([1.0, -1.0, -1.0])):
            words = "RESULT with the camera's y and z axes reversed (OpenGL)"
        yield words, X @ Q
        yield f"RESULT with the axes of the frame that carries the camera turned by {_turn(R)}", Q @ X


def _turn(R: Array) -> str:
    angle = np.degrees(angle_of(R))
    w = np.abs(log_rotation(R[None])[0])
    name = "xyz"[int(np.argmax(w))] if np.count_nonzero(w > 0.1) == 1 else "a diagonal"
    return f"{angle:.0f} degrees about {name}"


def _axes() -> list[Array]:
    """The 23 turns that map axes to axes, without the identity."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        R = np.zeros((3, 3))
        R[range(3), order] = signs
        if np.linalg.det(R) > 0.0 and not np.array_equal(R, np.eye(3)):
            found.append(R)
    return found


def _noncentrality(critical: float, freedom: float) -> float:
    """Return the non-centrality at which F(6, freedom) exceeds ``critical`` with the probability POWER."""

    def lacking(value: float) -> float:
        return float(ncfdtr(6.0, freedom, value, critical)) - (1.0 - POWER)

    high = 10.0
    while lacking(high) > 0.0 and high < 1e9:
        high *= 4.0
    return float(brentq(lacking, 0.0, high)) if high < 1e9 else float("inf")


def _target(problem: Problem, X: Array, rows: Flags) -> Array:
    """Return the best Y (4, 4) for X: the mean of F X G."""
    P = (problem.F @ X @ problem.G)[rows]
    Y = np.eye(4)
    Y[:3, :3] = nearest_rotation(P[:, :3, :3].sum(axis=0)[None])[0]
    Y[:3, 3] = P[:, :3, 3].mean(axis=0)
    return Y


def _spread(problem: Problem, X: Array) -> float:
    """Rms residual, rad and shares of the extent together."""
    w, d = residuals(problem, (X, _target(problem, X, np.ones(len(problem), dtype=bool)), IDENTITY))
    return float((w**2).mean() + (d**2).mean() / problem.extent**2)


def _residuals_only(problem: Problem, X: Array, used: Flags, missing: str) -> Judgement:
    n = len(problem)
    w, d = residuals(problem, (X, _target(problem, X, used), IDENTITY))
    held_w, held_d = w.copy(), d.copy()
    label = fold_labels(n, min(5, n))
    for k in np.unique(label):
        others = used & (label != k)
        if others.any():
            rest = label == k
            held_w[rest], held_d[rest] = residuals(problem.pick(rest), (X, _target(problem, X, others), IDENTITY))
    return Judgement(
        X=X,
        rotation_rad=np.linalg.norm(w, axis=1),
        translation_m=np.linalg.norm(d, axis=1),
        held_rotation_rad=np.linalg.norm(held_w, axis=1),
        held_translation_m=np.linalg.norm(held_d, axis=1),
        used=used,
        missing=missing,
    )
