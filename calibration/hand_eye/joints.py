"""Estimates joint offsets and link errors together with the camera, applied where held-out errors fall."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.adjustment import Kind, Observed, Unknowns, adjust, helmert, plain
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import IDENTITY, flange_poses, inverse, log_rotation, mean_pose
from weldcal.calibration.hand_eye.mountings import chain as mounted
from weldcal.calibration.hand_eye.mountings import get_mounting
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import (
    NAMES,
    TINY,
    Problem,
    State,
    full_problem,
    inverse_information,
    linearise,
    residuals,
)
from weldcal.calibration.hand_eye.solve import (
    HandEyeConfig,
    HandEyeHeldOut,
    HandEyeResult,
    fold_labels,
    solve_ax_yb,
    solve_problem,
)
from weldcal.models.arms.kinematics import Chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError

KINDS = ("joints", "links")
_STEP = 1e-3  # of the prior's standard deviation, for the differences by the robot's errors
_STEPS = 25
_SAME_M, _SAME_RAD = 5e-3, float(np.radians(0.5))  # a factory calibration moves the flange by no more
_CHANCE = 2.6  # standard errors by which held-out errors must fall: 1 in 200 by chance
_COLUMN_LOSS = 0.01  # how much worse one column may get while the other gets better
_SHOWN = 0.8  # of the prior: below it the poses have said something


@dataclass(frozen=True)
class JointPrior:
    """Prior of a robot's errors.

    Standard deviations of the zero of a joint, of the turn of a joint's axis, and of its place.
    """

    offset_rad: float = float(np.radians(0.3))
    turn_rad: float = float(np.radians(0.1))
    length_m: float = 1e-3


@dataclass(frozen=True)
class JointRefinement:
    """Result of the refinement by joint angles.

    ``names``, ``values``, ``sigma`` (k,): errors of the robot (rad or m) with their standard deviations; ``accepted``:
    applied in ``result`` (else ``result`` is that of the poses as given); ``sentence``: why.
    """

    names: tuple[str, ...]
    values: Array
    sigma: Array
    accepted: bool
    result: HandEyeResult
    sentence: str


@dataclass(frozen=True, kw_only=True)
class _Robot:
    """Stated poses (n, 4, 4) and what becomes of them under errors u (k,) in units of the prior."""

    stated: Array
    arm: Chain
    q: Array
    tool: Array
    mode: str
    which: NDArray[np.int64]
    scale: Array
    camera: Array

    def problem(self, u: Array) -> Problem:
        """Return the equation of one robot's poses with these errors."""
        errors = np.zeros(6 * self.arm.n)
        errors[self.which] = u * self.scale
        moved = self._undone @ flange_poses(self.arm, self.q, errors.reshape(-1, 6)) @ self.tool
        F, H = mounted(get_mounting(self.mode), moved)
        return full_problem(F, self.camera, H)

    @cached_property
    def _undone(self) -> Array:
        as_is = flange_poses(self.arm, self.q, np.zeros((self.arm.n, 6)))
        return np.asarray(self.stated @ inverse(self.tool) @ inverse(as_is))

    def pick(self, rows: NDArray[np.bool_]) -> _Robot:
        """Return the same robot at some of its poses."""
        return replace(self, stated=self.stated[rows], q=self.q[rows], camera=self.camera[rows])


@dataclass(frozen=True)
class _Found:
    state: State
    u: Array
    V: Array
    slope: Array
    noise: tuple[float, float]


def refine_joints(
    pairs: PosePairs,
    plain: HandEyeResult,
    arm: Chain,
    kind: str = "joints",
    *,
    prior: JointPrior | None = None,
    config: HandEyeConfig | None = None,
) -> JointRefinement:
    """Estimate joint offsets, or all errors of the links, with the camera.

    ``kind`` is "joints" or "links", which are six numbers a joint.

    Maximum a posteriori: the prior holds what the poses do not show at zero. A change that only moves the base or the
    flange as a whole is no error of the robot and is omitted. That is all of the first joint, and turn and shift of the
    last one about and along its axis. The errors are applied only if both held-out errors fall, in a paired test on
    five folds. Otherwise the sentence says that they do not help. ``plain`` is the result of the poses as given.
    Raises DatasetError without joint angles, InputError where they do not belong to the arm or the mounting.
    """
    prior, config = prior or JointPrior(), config or HandEyeConfig()
    if kind not in KINDS:
        raise InputError(f"There is no refinement '{kind}'; choose one of {', '.join(KINDS)}.")
    robot, names = _robot(pairs, arm, kind, prior)
    keep, k = plain.inliers, len(robot.which)
    n = int(keep.sum())

    def refused(why: str, found: _Found | None = None) -> JointRefinement:
        values = np.zeros(k) if found is None else found.u * robot.scale
        sigma = robot.scale if found is None else np.sqrt(np.diag(found.V)[-k:]) * robot.scale
        said = f"Robot errors ({kind}) do not help: {why}; poses used as given."
        return JointRefinement(names, values, sigma, False, plain, said)

    if 6 * n < 12 + k + 12:
        return refused(f"{n} poses are too few for {k} more unknowns")
    if plain.unobservable:
        return refused("the motion leaves the camera itself open")
    state = _state_of(plain)
    try:
        found = _fit(robot.pick(keep), state, k, plain.noise_centre)
        label = fold_labels(int(plain.observation.max()) + 1, config.folds or 5)[plain.observation]
        errors = {m: _held_out(robot, state, keep, m, centre=plain.noise_centre, label=label) for m in (0, k)}
    except (WeldcalError, np.linalg.LinAlgError):
        return refused("no calibration agrees with them")
    sigma = np.sqrt(np.diag(found.V)[-k:])
    if float(sigma.min()) > _SHOWN:
        return refused("these poses do not show them (no surer than before)", found)
    base, new = (np.sqrt([(errors[m][i][keep] ** 2).mean() for i in range(2)]) for m in (0, k))
    deg, mm = new / np.maximum(base, 1e-300)
    gain = sum((errors[0][i] ** 2 - errors[k][i] ** 2)[keep] / max(base[i], 1e-300) ** 2 for i in range(2))
    surely = float(np.mean(gain)) > _CHANCE * float(np.std(gain, ddof=1)) / np.sqrt(n)
    change = f"held-out errors change by {100 * (deg - 1):+.1f} % (deg) and {100 * (mm - 1):+.1f} % (mm)"
    if not surely or deg * mm >= 1.0 or max(deg, mm) > 1.0 + _COLUMN_LOSS:
        return refused(change, found)
    better = solve_problem(robot.problem(found.u), config=replace(config, folds=0), labels=plain.labels)
    joint = better.joint_covariance + found.slope @ found.V[-k:, -k:] @ found.slope.T
    order = [x for x in NAMES if x in better.poses]
    better = replace(
        better,
        equation=plain.equation,
        held_out=HandEyeHeldOut(*errors[k]),
        joint_covariance=joint,
        covariance={x: joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, x in enumerate(order)},
    )
    values = found.u * robot.scale
    told = ", ".join(
        f"{name} {_number(v, s, name)}"
        for name, v, s, u in zip(names, values, sigma * robot.scale, sigma, strict=True)
        if u < _SHOWN
    )
    said = (
        f"Robot errors applied ({told}); {change}. The result applies to the robot with these corrections: enter these"
        " errors in its kinematics, or calibrate without them."
    )
    return JointRefinement(names, values, sigma * robot.scale, True, better, said)


def poses_of_arm(pairs: PosePairs, arm: Chain) -> PosePairs:
    """Return the pairs with the poses that this arm, with kinematics of its own, reaches at their joint angles.

    A constant tool stays.

    Raises as refine_joints does.
    """
    robot, _ = _robot(pairs, arm, "joints", JointPrior())
    return replace(pairs, robot=flange_poses(arm, robot.q, np.zeros((arm.n, 6))) @ robot.tool)


def _number(value: float, sigma: float, name: str) -> str:
    if name[-1] in "xyz" and "shift" in name:
        return f"{1e3 * value:+.2f} +- {1e3 * sigma:.2f} mm"
    return f"{np.degrees(value):+.3f} +- {np.degrees(sigma):.3f} deg"


def _robot(pairs: PosePairs, arm: Chain, kind: str, prior: JointPrior) -> tuple[_Robot, tuple[str, ...]]:
    if pairs.q is None:
        raise DatasetError(f"'{pairs.source}' holds no joint angles (q, radians): omit --refine.")
    if pairs.mode not in ("eye_in_hand", "eye_on_base"):
        raise InputError("Robot errors are refined where one robot's flange moves: eye_in_hand or eye_on_base.")
    if pairs.q.shape != (len(pairs.robot), arm.n):
        raise InputError(
            f"'{pairs.source}' holds joint angles {pairs.q.shape}; {arm.name} needs ({len(pairs.robot)}, {arm.n})."
        )
    if float(np.abs(pairs.q).max()) > 4.0 * np.pi + 0.1:
        raise InputError(f"Joint angles of '{pairs.source}' reach {np.abs(pairs.q).max():.0f}: give them in radians.")
    tool = _tool(pairs, arm)
    each = np.array([prior.turn_rad, prior.turn_rad, prior.offset_rad, *[prior.length_m] * 3])
    parts = ("turn x", "turn y", "offset", "shift x", "shift y", "shift z")
    last = 6 * (arm.n - 1)
    wanted = [6 * j + p for j in range(1, arm.n) for p in ((2,) if kind == "joints" else range(6))]
    which = np.array([i for i in wanted if i not in (last + 2, last + 5)])
    names = tuple(f"{arm.joint_names[i // 6]} {parts[i % 6]}" for i in which)
    return (
        _Robot(
            stated=pairs.robot,
            arm=arm,
            q=pairs.q,
            tool=tool,
            mode=pairs.mode,
            which=which,
            scale=each[which % 6],
            camera=pairs.camera,
        ),
        names,
    )


def _tool(pairs: PosePairs, arm: Chain) -> Array:
    """What the controller adds to the arm's flange, for stated poses that the joint angles explain."""
    assert pairs.q is not None
    reached = flange_poses(arm, pairs.q, np.zeros((arm.n, 6)))
    left = pairs.robot @ inverse(reached)
    if _constant(left):
        return IDENTITY
    right = inverse(reached) @ pairs.robot
    if _constant(right):
        return mean_pose(right)
    try:
        both = solve_ax_yb(pairs.robot, reached, HandEyeConfig(folds=0))
        if both.sigma_translation < _SAME_M and both.sigma_rotation_rad < _SAME_RAD:
            return inverse(np.asarray(both.X.GetAsMatrix4()))
    except WeldcalError:
        pass
    raise InputError(
        f"The joint angles of '{pairs.source}' do not lead {arm.name} to the stated poses; check the robot's name, the"
        " order of the joints, and that angles are radians."
    )


def _constant(X: Array) -> bool:
    off = inverse(mean_pose(X)) @ X
    near = float(np.linalg.norm(off[:, :3, 3], axis=1).max()) < _SAME_M
    return near and float(np.linalg.norm(log_rotation(off[:, :3, :3]), axis=1).max()) < _SAME_RAD


def _state_of(result: HandEyeResult) -> State:
    X, Y = (np.asarray(result.poses[k].GetAsMatrix4()) for k in "XY")
    return X, Y, IDENTITY


def _fit(robot: _Robot, state: State, k: int, centre: Array) -> _Found:
    """Adjust poses and the first ``k`` robot errors together, with a noise of rotations and one of positions."""
    rest = np.zeros(len(robot.which) - k)
    floor = robot.problem(np.append(np.zeros(k), rest)).extent * np.sqrt(TINY)

    def linearised(at: Unknowns) -> tuple[Observed, Observed]:
        now, u = (at.poses[0], at.poses[1], state[2]), np.append(at.numbers, rest)
        lin = linearise(robot.problem(u), now, centre)
        Jw, Jd = _by_errors(robot, now, k, centre, u)
        return Observed(lin.w, np.concatenate([lin.Jw, Jw], axis=2)), Observed(
            lin.d, np.concatenate([lin.Jd, Jd], axis=2)
        )

    start = Unknowns(state[:2], np.zeros(k))
    sizes = [float(np.sqrt((rows.e**2).mean())) for rows in linearised(start)]
    kinds = [
        Kind(rank=3, loss=plain, spread=helmert, sigma=max(size, least), floor=least)
        for size, least in zip(sizes, (float(np.sqrt(TINY)), floor), strict=True)
    ]
    found = adjust(start, linearised, kinds, prior=np.eye(k), steps=_STEPS)
    A, (X, Y) = found.information, found.at.poses
    slope = -inverse_information(A[:12, :12]) @ A[:12, 12:]
    w, d = (sigma**2 for sigma in found.sigmas)
    return _Found((X, Y, state[2]), np.append(found.at.numbers, rest), found.covariance, slope, (w, d))


def _by_errors(robot: _Robot, state: State, k: int, centre: Array, u: Array) -> tuple[Array, Array]:
    """Derivatives (n, 3, k) of rotations and displacements by the first ``k`` errors, by central differences."""
    Jw, Jd = np.zeros((len(robot.q), 3, k)), np.zeros((len(robot.q), 3, k))
    for j in range(k):
        e = np.zeros(len(u))
        e[j] = _STEP
        up, down = (residuals(robot.problem(u + s * e), state, centre) for s in (1.0, -1.0))
        Jw[:, :, j], Jd[:, :, j] = (up[0] - down[0]) / (2.0 * _STEP), (up[1] - down[1]) / (2.0 * _STEP)
    return Jw, Jd


def _held_out(
    robot: _Robot, state: State, keep: NDArray[np.bool_], k: int, *, centre: Array, label: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Errors (n,), (n,) of every pose under a fit with ``k`` robot errors that never saw its fold.

    ``label`` (n,): the folds.
    """
    w, d = np.full(len(keep), np.nan), np.full(len(keep), np.nan)
    for fold in range(int(label.max()) + 1):
        test = label == fold
        if not test.any():
            continue
        found = _fit(robot.pick(keep & ~test), state, k, centre)
        a, b = residuals(robot.pick(test).problem(found.u), found.state)
        w[test], d[test] = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    return w, d
