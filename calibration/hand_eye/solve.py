"""Solves AX = XB, AX = YB and AXB = YCZ, with covariance, held-out errors and unobservable directions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.errors import UndeterminedPoses
from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import IDENTITY, as_transform, difference, inverse
from weldcal.calibration.hand_eye.choice import USUAL_DISCORD_RAD, Choice, solve
from weldcal.calibration.hand_eye.determinacy import (
    Diversity,
    check_poses,
    determinacy,
    with_open_directions,
    without_drift,
)
from weldcal.calibration.hand_eye.problem import NAMES, Problem, State, full_problem, residuals
from weldcal.calibration.hand_eye.repeats import one_per_pose
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError

Flags = NDArray[np.bool_]

_SPARE = 2.5  # numbers per unknown below which an answer cannot be checked

_RIGID = 0.05  # deviation of a rotation from orthonormal that two printed decimals explain


@dataclass(frozen=True, kw_only=True)
class HandEyeConfig:
    """Settings.

    ``folds``: of the held-out errors (0: none). ``max_outliers``: share of gross ones to survive. ``allow_open``: give
    an answer even where more than one direction of translation stays open. ``join_repeats``: samples at one robot pose
    are one observation. ``usual_discord_rad``: angle by which rotations and positions of the camera disagree
    beforehand.
    """

    seed: int = 0
    folds: int = 5
    max_outliers: float = 0.40
    allow_coplanar: bool = False
    allow_open: bool = False
    usual_discord_rad: float = USUAL_DISCORD_RAD
    join_repeats: bool = True


@dataclass(frozen=True)
class HandEyeHeldOut:
    """Errors (n,) of each pose under a calibration that never saw its fold.

    Rotation rad, translation in the unit of the data; NaN where a fold could not be solved. rms over poses as the
    properties say.
    """

    rotation_rad: Array
    translation: Array

    @property
    def rms_deg(self) -> float:
        """Root mean square of the rotations in degrees; NaN where nothing was held out."""
        return _rms(np.degrees(self.rotation_rad))

    @property
    def rms_translation(self) -> float:
        """Root mean square of the translations."""
        return _rms(self.translation)


@dataclass(frozen=True, kw_only=True)
class CameraScale:
    """A factor of all camera distances that the robot's motion asks for.

    ``factor``: of the camera's positions, ``sigma`` its standard deviation, ``chance`` that a right scale looks as
    wrong. ``poses``: X, Y, Z with the positions multiplied by the factor.
    """

    factor: float
    sigma: float
    chance: float
    poses: dict[str, RigidTransform]

    @property
    def sentence(self) -> str:
        """What is wrong, by how much, and the camera's pose without it."""
        p = ", ".join(f"{1e3 * v:.1f}" for v in self.poses["X"].translation())
        off = 100.0 * (self.factor - 1.0)
        return (
            f"The camera's distances seem {abs(off):.1f} % (+- {100 * self.sigma:.1f}) too"
            f" {'short' if off > 0.0 else 'long'} for the robot's motion, which shifts the result. Check the target's"
            " size, the focal length and the robot's unit. With the camera's positions (or the target's stated"
            f" lengths) multiplied by {self.factor:.4f}, X is at ({p}) mm."
        )


@dataclass(frozen=True, kw_only=True)
class HandEyeResult:
    """The unknown poses with their covariances, residuals and held-out errors.

    ``poses``: X, Y, Z as far as they were unknown. ``covariance`` (6, 6) each, [rotation; translation]: X = (exp(a) R,
    p + b), a (rad) a rotation on the parent's side about the child's origin, b the displacement of that origin, both in
    the parent's axes. Open directions carry a standard deviation of ten (rad, or extents of the motion).
    ``joint_covariance`` (m, m): all of them, in the order of ``poses``. ``rotation_rad`` (n,) (NaN where none was seen)
    and ``translation`` (n,): residuals of all observations at the origin of the target. ``sigma_rotation_rad``,
    ``sigma_translation``: noise per axis beyond the observations' own; ``noise_centre`` (3,): the point of the target
    where it holds. ``observation`` (n,): the observation that each sample belongs to; repeats of a pose are one.
    ``discord_rad``: angle, an axis, by which rotations and displacements disagree. ``scale``: of the camera's distances
    where it is wrong. Lengths are in the unit of the data.
    """

    equation: str
    poses: dict[str, RigidTransform]
    covariance: dict[str, Array]
    joint_covariance: Array
    degrees_of_freedom: float
    rotation_rad: Array
    translation: Array
    inliers: Flags
    held_out: HandEyeHeldOut
    sigma_rotation_rad: float
    sigma_translation: float
    noise_centre: Array
    unobservable: tuple[str, ...]
    warnings: tuple[str, ...]
    condition: float
    method: str
    start: str
    diversity: Diversity
    extent: float
    observation: NDArray[np.int64]
    labels: dict[str, str] = field(default_factory=dict)
    scale: CameraScale | None = None
    discord_rad: float = 0.0

    @property
    def X(self) -> RigidTransform:
        return self.poses["X"]

    @property
    def Y(self) -> RigidTransform:
        return self.poses["Y"]

    @property
    def Z(self) -> RigidTransform:
        return self.poses["Z"]

    def normalised_error(self, name: str, truth: RigidTransform) -> float:
        """Squared error of a pose in units of its covariance (6 on average; NEES)."""
        e = pose_difference(self.poses[name], truth)
        return float(e @ np.linalg.solve(self.covariance[name], e))

    def region(self, share: float = 0.95) -> float:
        """Bound on ``normalised_error`` that holds the truth with this probability.

        Hotelling's, since the noise was estimated from as many residuals as ``degrees_of_freedom`` says.
        """
        return float(6.0 * f_quantile(share, 6.0, self.degrees_of_freedom))


def pose_difference(estimate: RigidTransform, truth: RigidTransform) -> Array:
    """Change (6,) [rotation; translation] on the parent's side that moves the estimate to the truth."""
    return difference(np.asarray(estimate.GetAsMatrix4()), np.asarray(truth.GetAsMatrix4()))


def solve_ax_xb(A: ArrayLike, B: ArrayLike, config: HandEyeConfig | None = None) -> HandEyeResult:
    """A_k X = X B_k for motions (k, 4, 4) of hand and camera; at least two, about axes that are not parallel.

    For poses rather than motions use solve_ax_yb or solve_mounting: each pose then counts once and its noise is its
    own. Raises as solve_problem.
    """
    a, b = as_poses(A, "A"), as_poses(B, "B")
    _same_length(a, b)
    problem = full_problem(a, inverse(b), free=(True, False, False), tied=True)
    return solve_problem(problem, config=config, equation="AX = XB")


def solve_ax_yb(
    A: ArrayLike,
    B: ArrayLike,
    config: HandEyeConfig | None = None,
    *,
    covariance: ArrayLike | None = None,
    labels: dict[str, str] | None = None,
) -> HandEyeResult:
    """Solve A_i X = Y B_i for poses (n, 4, 4); B_i is measured, and residuals are in the child frame of B.

    With the paper's Eq. (4): A = X_BF, B = X_CM, X = X_FM, Y = X_BC. ``covariance`` (n, 6, 6) of B in its child's
    tangent, beyond which the noise is estimated. Raises as solve_problem.
    """
    a, b = as_poses(A, "A"), as_poses(B, "B")
    _same_length(a, b)
    # inv(A) Y B = X: the measured pose stands where the residual is seen
    problem = full_problem(inverse(a), b, covariance=_covariances(covariance, len(a)))
    result = solve_problem(problem, config=config, equation="AX = YB", labels=labels)
    return _renamed(result, {"X": "Y", "Y": "X"})


def solve_axb_ycz(
    A: ArrayLike,
    B: ArrayLike,
    C: ArrayLike,
    config: HandEyeConfig | None = None,
    *,
    covariance: ArrayLike | None = None,
    starts: Sequence[tuple[RigidTransform, RigidTransform, RigidTransform]] = (),
    labels: dict[str, str] | None = None,
) -> HandEyeResult:
    """A_i X B_i = Y C_i Z for poses (n, 4, 4); B_i is what was measured (paper, Eq. (5): co-manipulation).

    ``starts``: guesses of (X, Y, Z) to try besides the closed form. Raises as solve_problem.
    """
    a, b, c = as_poses(A, "A"), as_poses(B, "B"), as_poses(C, "C")
    _same_length(a, b)
    _same_length(a, c)
    problem = full_problem(a, b, c, free=(True, True, True), covariance=_covariances(covariance, len(a)))
    given = tuple(
        (np.asarray(x.GetAsMatrix4()), np.asarray(y.GetAsMatrix4()), np.asarray(z.GetAsMatrix4())) for x, y, z in starts
    )
    return solve_problem(problem, config=config, equation="AXB = YCZ", starts=given, labels=labels)


def solve_problem(
    problem: Problem,
    known: State = (IDENTITY, IDENTITY, IDENTITY),
    *,
    config: HandEyeConfig | None = None,
    equation: str = "F X G = Y H Z",
    starts: tuple[State, ...] = (),
    labels: dict[str, str] | None = None,
) -> HandEyeResult:
    """Solve F_i X G_i = Y H_i Z for the free poses; ``known`` holds the others (Y and Z may carry a known feature).

    Repeats of a robot pose are one observation; residuals and held-out errors are of every sample.

    Raises TooFewPoses, RepeatedPoses, PureTranslation, CoplanarPoses before any work, InconsistentPoses where no rigid
    poses explain the observations, and UndeterminedPoses where more than one translation or any rotation of the camera
    stays open (unless ``config.allow_open``).
    """
    config = config or HandEyeConfig()
    labels = labels or {}
    diverse = check_poses(problem, allow_coplanar=config.allow_coplanar)
    samples, repeats = problem, one_per_pose(problem, known, join=config.join_repeats)
    problem, observation = repeats.problem, repeats.observation
    choice = _choice(problem, known, config, starts)
    keep = choice.fit.keep
    used = problem if keep.all() else problem.pick(keep)
    if not keep.all():
        check_poses(used, allow_coplanar=config.allow_coplanar)
    length = problem.extent
    s = choice.fit.scaled
    noise = choice.fit.noise
    found = determinacy(
        used,
        choice.state,
        s.information(),
        s.V[: problem.size, : problem.size],
        length,
        float(np.sqrt(noise.rotation)),
        labels,
    )
    _refuse_open(problem, found.directions, found.names, config)
    state = without_drift(used, choice.state, found)
    covariance = with_open_directions(choice.covariance, found, length)
    w, d = residuals(samples, state)
    seen = samples.full | samples.normal
    inliers = keep[observation] & repeats.agrees
    warnings = list(found.warnings)
    numbers = float(used.numbers_w.sum()) + 3.0 * len(used)
    if numbers < _SPARE * problem.size:
        warnings.append(
            f"{len(used)} {'motions' if problem.tied else 'poses'} are {numbers:.0f} numbers for {problem.size}"
            " unknowns: a wrong sample or convention is hard to detect; add samples before you rely on the result."
        )
    if not inliers.all():
        names = ", ".join(str(i) for i in np.nonzero(~inliers)[0])
        warnings.insert(
            0, f"{int((~inliers).sum())} of {len(inliers)} poses disagree with the rest and were excluded: {names}."
        )
    blocks = {NAMES[k]: slice(6 * row, 6 * row + 6) for row, k in enumerate(problem.blocks)}
    return HandEyeResult(
        equation=equation,
        poses={name: as_transform(state[NAMES.index(name)]) for name in blocks},
        covariance={name: covariance[b, b] for name, b in blocks.items()},
        joint_covariance=covariance,
        degrees_of_freedom=min(s.free_w, s.free_d) if s.total_w else s.free_d,
        rotation_rad=np.where(seen, np.linalg.norm(w, axis=1), np.nan),
        translation=np.linalg.norm(d, axis=1),
        inliers=inliers,
        held_out=(
            _held_out(samples, problem, observation, known, config=config, starts=starts)
            if config.folds
            else _nothing(len(samples))
        ),
        sigma_rotation_rad=float(np.sqrt(noise.rotation)) if s.total_w else float("nan"),
        sigma_translation=float(np.sqrt(noise.translation)),
        noise_centre=choice.fit.centre,
        unobservable=found.names,
        warnings=tuple(warnings),
        condition=found.condition,
        method=choice.method,
        start=choice.start,
        diversity=diverse,
        extent=length,
        observation=observation,
        labels=labels,
        discord_rad=s.discord,
    )


def _choice(problem: Problem, known: State, config: HandEyeConfig, starts: tuple[State, ...]) -> Choice:
    outliers, discord = config.max_outliers, config.usual_discord_rad
    return solve(problem, known, seed=config.seed, starts=starts, max_outliers=outliers, usual_discord=discord)


def _refuse_open(
    problem: Problem, directions: tuple[Array, ...], names: tuple[str, ...], config: HandEyeConfig
) -> None:
    if config.allow_open:
        return
    camera = [v[:6] for v in directions if float(np.abs(v[:6]).max()) > 1e-3 * float(np.abs(v).max())]
    if len(camera) > 1:
        raise UndeterminedPoses(
            f"The motion leaves {len(camera)} directions of the camera's pose open ({'; '.join(names)}); turn the hand "
            "about at least two axes that are not parallel."
        )


def fold_labels(n: int, folds: int = 5) -> NDArray[np.int64]:
    """Fold (n,) of each pose: a seeded permutation modulo the number of folds."""
    return np.asarray(np.random.default_rng(0).permutation(n) % folds)


def _held_out(
    samples: Problem,
    problem: Problem,
    observation: NDArray[np.int64],
    known: State,
    *,
    config: HandEyeConfig,
    starts: tuple[State, ...],
) -> HandEyeHeldOut:
    label = fold_labels(len(problem), config.folds)
    out = _nothing(len(samples))
    for k in range(config.folds):
        train, test = label != k, (label == k)[observation]
        if not test.any():
            continue
        try:
            check_poses(problem.pick(train), allow_coplanar=config.allow_coplanar)
            choice = _choice(problem.pick(train), known, config, starts)
        except WeldcalError:
            continue
        rest = samples.pick(test)
        w, d = residuals(rest, choice.state)
        out.rotation_rad[test] = np.where(rest.full | rest.normal, np.linalg.norm(w, axis=1), np.nan)
        out.translation[test] = np.linalg.norm(d, axis=1)
    return out


def as_poses(value: ArrayLike | Sequence[RigidTransform], name: str) -> Array:
    """Return a stack (n, 4, 4) of rigid poses, checked; RigidTransforms are welcome.

    Raises InputError naming the first bad one.
    """
    if isinstance(value, (list, tuple)) and value and isinstance(value[0], RigidTransform):
        value = [X.GetAsMatrix4() for X in value]
    M = np.array(value, dtype=float)
    if M.ndim != 3 or M.shape[1:] != (4, 4):
        raise InputError(f"'{name}' must be a stack of 4 x 4 matrices, not an array of shape {M.shape}.")
    bad = ~np.isfinite(M).all(axis=(1, 2))
    if bad.any():
        raise InputError(f"'{name}' holds numbers that are not finite, first in pose {int(np.argmax(bad))}.")
    R = M[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = (off > _RIGID) | (np.linalg.det(R) < 0.0) | (np.abs(M[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) > 1e-9)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise InputError(f"Pose {k} of '{name}' is not a rigid pose: {_why_not_rigid(M[k])}")
    # printed matrices are rounded: take the rotation they stand for, but leave exact ones as they are
    rounded = off > 1e-12
    if rounded.any():
        U, _, Vt = np.linalg.svd(R[rounded])
        M[rounded, :3, :3] = U @ Vt
    return M


def _why_not_rigid(M: Array) -> str:
    R = M[:3, :3]
    if float(np.abs(M[3] - [0.0, 0.0, 0.0, 1.0]).max()) > 1e-9:
        if float(np.abs(M[:, 3] - [0.0, 0.0, 0.0, 1.0]).max()) < 1e-9:
            return "its position is in the last row; exchange rows and columns of each matrix."
        return "its last row is not 0 0 0 1."
    if float(np.abs(R @ R.T - np.eye(3)).max()) <= _RIGID:
        return "its rotation is mirrored (determinant -1); turn the sign of one axis of that frame in all poses."
    return "the columns of its 3 x 3 part must have length 1 and be at right angles."


def _renamed(result: HandEyeResult, names: dict[str, str]) -> HandEyeResult:
    def swap(name: str) -> str:
        return names.get(name, name)

    order = sorted(result.poses, key=swap)
    index = np.concatenate([6 * list(result.poses).index(k) + np.arange(6) for k in order])
    return replace(
        result,
        poses={swap(k): result.poses[k] for k in order},
        covariance={swap(k): result.covariance[k] for k in order},
        joint_covariance=result.joint_covariance[np.ix_(index, index)],
    )


def _covariances(value: ArrayLike | None, n: int) -> Array | None:
    if value is None:
        return None
    C = np.array(value, dtype=float)
    C = np.broadcast_to(C, (n, 6, 6)) if C.shape == (6, 6) else C
    if (
        C.shape != (n, 6, 6)
        or not np.isfinite(C).all()
        or float(np.linalg.eigvalsh(C).min()) < -1e-12 * np.abs(C).max()
    ):
        raise InputError(f"The covariance must be ({n}, 6, 6), finite and positive semi-definite.")
    return np.array(C)


def _same_length(a: Array, b: Array) -> None:
    if len(a) != len(b):
        raise InputError(f"There are {len(a)} robot poses and {len(b)} camera poses; give one of each per sample.")


def _nothing(n: int) -> HandEyeHeldOut:
    return HandEyeHeldOut(np.full(n, np.nan), np.full(n, np.nan))


def _rms(e: Array) -> float:
    good = e[np.isfinite(e)]
    return float(np.sqrt((good**2).mean())) if len(good) else float("nan")
