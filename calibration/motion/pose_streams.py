"""Synchronises two streams of poses for hand-eye calibration.

The clock offset between a robot's hand and a camera, and pose pairs.

Equation (eye in hand; the other mounting alike): H(t - d) X = Y E(t), with H the robot's hand in its base on the
robot's clock, E the camera in the target's frame on its own clock, and d the camera's stamps less the robot's time of
the same instant. The offset is searched by correlating the angular speeds, which no unknown pose changes (Furrer et al.
2017), then estimated together with X and Y.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.data.poses.listing import Listing
from weldcal.calibration.data.poses.source import unit_by_size
from weldcal.calibration.errors import DatasetError, UndeterminedPoses
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, log_rotation, pose, scaled
from weldcal.calibration.hand_eye.pairs.conventions import UNITS
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.calibration.motion.line_clock import offset_sigma
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.array_files import read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError


def is_stream_file(path: Path) -> bool:
    """Return whether a file is an npz with the arrays `hand` and `eye`."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        return {"hand", "eye"} <= set(read_npz(path, ("hand", "eye")))
    except InputError:
        return False


_WIDEST_S, _STEP_S = 2.0, 0.005  # offsets that are searched
_RATE_S = 0.05  # half the interval of an angular speed
_MOST_FRAMES, _MOST_PAIRS = 2000, 300
_FEWEST = 20
_BLOCK_S = 1.0  # within which errors of the streams may be correlated
_SOFT = 2.0  # residuals, in sigmas, from which on they count less
_MARGIN_S = 0.1  # by which the refined offset may differ from the first
_SHORTEST_S, _SLOWEST_S = 3.0, 0.25  # a trajectory: its length, and the step between its poses
_MOST_READINGS = 4
_FAR_BETTER = 3.0  # ratio of residuals beyond which the better reading of two trajectories is the right one
_LEAST_TURN = 0.02  # rad/s (rms): slower motion shows no offset by its speed


@dataclass(frozen=True, eq=False)
class PoseStreams:
    """Two recorded streams.

    Times (n,), (m,) s and poses ``hand`` X_BF (n, 4, 4) and ``eye`` X_world_eye (m, 4, 4) in metres.
    """

    hand_time: Array
    hand: Array
    eye_time: Array
    eye: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockOffset:
    """The clock offset of two streams, and the poses that were estimated with it.

    ``offset_s`` is the time of the eye's stamps less the hand's time of the same instant, ``sigma_s`` its standard
    deviation. ``X`` is the eye in the hand, ``Y`` the world in the base, 4 x 4. ``rms_deg`` and ``rms_m`` are of the
    frames, ``before_m`` the rms at offset zero with the same poses. ``pairs`` are for the solvers.
    """

    offset_s: float
    sigma_s: float
    X: Array
    Y: Array
    rms_deg: float
    rms_m: float
    before_m: float
    pairs: PosePairs

    @property
    def sentence(self) -> str:
        """One sentence for the user."""
        return (
            f"The camera's stamps are {1e3 * self.offset_s:+.2f} +- {1e3 * self.sigma_s:.2f} ms later than the hand's"
            f" (one sigma); {len(self.pairs.robot)} pairs at that offset."
        )


def read_streams(path: Path) -> PoseStreams:
    """Read an npz with `hand` and `eye`, each (n, 8): t (s), x, y, z (m), qx, qy, qz, qw. Raises DatasetError."""
    try:
        data = read_npz(path, ("hand", "eye"))
    except InputError as e:
        raise DatasetError(str(e)) from e
    parts: list[Array] = []
    for name in ("hand", "eye"):
        try:
            table = np.asarray(data[name], dtype=float)
        except (KeyError, ValueError):
            raise DatasetError(
                f"'{path.name}' has no numbers under '{name}'; give t, x, y, z, qx, qy, qz, qw."
            ) from None
        if table.ndim != 2 or table.shape[1] != 8 or not np.isfinite(table).all():
            raise DatasetError(f"'{name}' in '{path.name}' must be (n, 8) finite numbers: t, x, y, z, qx, qy, qz, qw.")
        if len(table) < _FEWEST:
            raise DatasetError(f"'{name}' in '{path.name}' has {len(table)} poses; {_FEWEST} or more are needed.")
        if (np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0) > 1e-2).any():
            raise DatasetError(
                f"'{name}' in '{path.name}' holds quaternions that are not of length 1 (order qx, qy, qz, qw)."
            )
        table = table[np.argsort(table[:, 0], kind="stable")]
        table = table[np.concatenate([[True], np.diff(table[:, 0]) > 0.0])]
        q = table[:, 4:] / np.linalg.norm(table[:, 4:], axis=1)[:, None]
        parts += [table[:, 0], pose(Rotation.from_quat(q).as_matrix(), table[:, 1:4])]
    return PoseStreams(*parts)


def are_trajectories(robot: Listing, camera: Listing) -> bool:
    """Return whether two lists of poses with times are recordings in motion, of different lengths.

    They pair by interpolation.
    """
    if len(robot) == len(camera):
        return False
    for one in (robot, camera):
        t = one.times
        if t is None or len(t) < _FEWEST or not (np.diff(t) > 0.0).all():
            return False
        if t[-1] - t[0] < _SHORTEST_S or float(np.median(np.diff(t))) > _SLOWEST_S:
            return False
    return True


def synchronise_lists(
    robot: Listing, camera: Listing, *, mounting: str = "eye_in_hand", source: str = "trajectories"
) -> ClockOffset:
    """Estimate the clock offset of two trajectories, both poses, and pairs.

    The camera's trajectory is X_CM, or the camera in the target's or the world's frame.

    Orders of quaternions and the direction of the camera's poses follow from the residuals where nobody states them.

    Raises:
        DatasetError: too many readings are possible, no reading fits, or two fit alike.
        UndeterminedPoses: the hand hardly turns.
    """
    a, b = robot.readings, camera.readings
    if len(a) * len(b) > _MOST_READINGS:
        who = "robot" if len(a) >= len(b) else "camera"
        raise DatasetError(
            f"The rotations of '{(robot if who == 'robot' else camera).name}' fit {max(len(a), len(b))}"
            f" conventions. Name the right one, for example --as {who}-form={(a if who == 'robot' else b)[0].form}."
        )
    words = [one.unit or unit_by_size(one.numbers[0].p) for one in (robot, camera)]
    units = [UNITS[unit] for unit in words]
    tried: list[tuple[float, ClockOffset, str, str]] = []
    problem: WeldcalError | None = None
    for one, other in itertools.product(a, b):
        for inverted in (False, True):
            eye = scaled(other.X, units[1])
            streams = PoseStreams(
                _good(robot.times, robot),
                scaled(one.X, units[0])[robot.good],
                _good(camera.times, camera),
                (eye if inverted else inverse(eye))[camera.good],
            )
            try:
                found = synchronise(streams, mounting=mounting, source=source)
            except WeldcalError as why:
                problem = problem or why
                continue
            tried.append(
                (found.rms_deg * found.rms_m, found, one.form, f"{other.form},inverse" if inverted else other.form)
            )
    if not tried:
        assert problem is not None
        raise problem
    tried.sort(key=lambda t: t[0])
    if len(tried) > 1 and tried[1][0] < _FAR_BETTER**2 * tried[0][0]:
        raise DatasetError(
            f"Two readings of the trajectories fit alike: {tried[0][2]} with {tried[0][3]}, and {tried[1][2]} with"
            f" {tried[1][3]}. State one with --as robot-form=FORM or --as camera-form=FORM."
        )
    _, found, form, other_form = tried[0]
    reading = {
        who: {"file": one.name, "form": one.form, "unit": unit, "reading": written, "rows": len(one), "left_out": []}
        for who, one, unit, written in (("robot", robot, words[0], form), ("camera", camera, words[1], other_form))
    }
    return replace(found, pairs=replace(found.pairs, reading=reading))


def _good(times: Array | None, listing: Listing) -> Array:
    assert times is not None
    return np.asarray(times[listing.good])


def synchronise(streams: PoseStreams, *, mounting: str = "eye_in_hand", source: str = "streams") -> ClockOffset:
    """Clock offset and both poses from two streams, and pairs at the offset for the solvers of hand-eye calibration.

    The eye's stamps are used as they are; X and Y are those of the mounting. The standard deviation of the offset
    counts errors as common within a second (the sandwich formula by blocks of time). Raises UndeterminedPoses where the
    hand hardly turns, DatasetError where the streams do not overlap.
    """
    # numerical derivatives need times near zero
    zero = float(streams.hand_time[0])
    streams = replace(streams, hand_time=streams.hand_time - zero, eye_time=streams.eye_time - zero)
    hand = ContinuousMotion(RobotStream(streams.hand_time, streams.hand))
    start = _correlated(streams, hand)
    t = streams.eye_time[:: max(1, len(streams.eye_time) // _MOST_FRAMES)]
    E = streams.eye[:: max(1, len(streams.eye_time) // _MOST_FRAMES)]
    inside = hand.known(t - start - _MARGIN_S) & hand.known(t - start + _MARGIN_S)
    for end, begin in hand.gaps:  # a shorter gap lies between both ends of the margin
        inside &= (t - start + _MARGIN_S < end) | (t - start - _MARGIN_S > begin)
    t, E = t[inside], E[inside]
    if len(t) < _FEWEST:
        raise DatasetError("The two streams overlap in fewer than 20 frames; record them at the same time.")
    in_hand = mounting != "eye_on_base"
    chosen = np.unique(np.linspace(0, len(t) - 1, min(len(t), _MOST_PAIRS)).astype(int))

    def moved(d: float, which: NDArray[np.int64] | slice = slice(None)) -> Array:
        H = hand.poses(t[which] - d)
        return H if in_hand else inverse(H)

    # the offset is not known yet: equal robot poses have unequal camera poses
    config = HandEyeConfig(join_repeats=False)
    first = solve_problem(
        full_problem(moved(start, chosen), inverse(E[chosen]), free=(True, True, False)), config=config
    )
    X, Y = (np.asarray(first.poses[name].GetAsMatrix4()) for name in ("X", "Y"))

    def poses_of(x: Array) -> tuple[Array, Array]:
        return (X @ pose(exp_rotation(x[:3]), x[3:6]), Y @ pose(exp_rotation(x[6:9]), x[9:12]))

    scales = np.ones(2)

    def residuals(x: Array) -> Array:
        A, B = poses_of(x)
        D = inverse(B @ E) @ moved(start + x[12]) @ A
        return np.concatenate([log_rotation(D[:, :3, :3]) / scales[0], D[:, :3, 3] / scales[1]], axis=1)

    def flat(x: Array) -> Array:
        return residuals(x).ravel()

    x = np.zeros(13)
    for _ in range(3):
        r = residuals(x) * np.repeat(scales, 3)
        scales = np.array([MAD * float(np.median(np.abs(r[:, k : k + 3]))) + 1e-9 for k in (0, 3)])
        unit = np.concatenate([np.repeat([scales[0], scales[1]], 3)] * 2 + [[1e-3]])
        fit = least_squares(flat, x, loss="soft_l1", f_scale=_SOFT, x_scale=unit)
        x = fit.x
    sigma = offset_sigma(flat, x, unit, t, _SOFT, _BLOCK_S)[0]
    offset = start + float(x[12])
    A, B = poses_of(x)
    r = residuals(x) * np.repeat(scales, 3)
    none = x.copy()
    none[12] = -start
    known = hand.known(t)
    before = residuals(none)[:, 3:] * scales[1]
    pairs = PosePairs(source=source, robot=hand.poses(t[chosen] - offset), camera=inverse(E[chosen]), mode=mounting)
    return ClockOffset(
        offset_s=offset,
        sigma_s=sigma,
        X=A,
        Y=B,
        rms_deg=float(np.degrees(np.sqrt((r[:, :3] ** 2).sum(axis=1).mean()))),
        rms_m=float(np.sqrt((r[:, 3:] ** 2).sum(axis=1).mean())),
        before_m=float(np.sqrt((before[known] ** 2).sum(axis=1).mean())),
        pairs=pairs,
    )


def _correlated(streams: PoseStreams, hand: ContinuousMotion) -> float:
    """Return the offset (s) at which the angular speeds of both agree best."""
    eye = ContinuousMotion(RobotStream(streams.eye_time, streams.eye))
    begin = max(hand.span[0], eye.span[0] - _WIDEST_S) + _RATE_S
    end = min(hand.span[1], eye.span[1] + _WIDEST_S) - _RATE_S
    if end - begin < 2.0:
        raise DatasetError(
            f"The streams overlap for less than two seconds (hand {hand.span[0]:.3f} to {hand.span[1]:.3f} s, eye"
            f" {eye.span[0]:.3f} to {eye.span[1]:.3f} s); give both on clocks that agree to {_WIDEST_S:g} s."
        )
    t = np.arange(begin, end, 2.0 * _STEP_S)
    of_hand = _speed(hand, t)
    if float(np.sqrt(np.nanmean(of_hand**2))) < _LEAST_TURN:
        raise UndeterminedPoses("The hand hardly turns, so the streams show no clock offset: turn it back and forth.")
    offsets = np.arange(-_WIDEST_S, _WIDEST_S + 0.5 * _STEP_S, _STEP_S)
    grid = np.arange(begin - _WIDEST_S - 0.02, end + _WIDEST_S + 0.02, _STEP_S)
    of_eye = _speed(eye, grid)
    costs = np.full(len(offsets), np.inf)
    for k, d in enumerate(offsets):
        e = np.interp(t + d, grid, of_eye) - of_hand
        good = np.isfinite(e)
        if np.count_nonzero(good) > 0.5 * len(t):
            costs[k] = float(np.mean(np.abs(e[good])))
    return float(offsets[np.argmin(costs)])


def _speed(motion: ContinuousMotion, t: Array) -> Array:
    """Angular speeds (n,) rad/s over a tenth of a second; NaN where there is no data."""
    R0, R1 = motion.poses(t - _RATE_S)[:, :3, :3], motion.poses(t + _RATE_S)[:, :3, :3]
    good = np.isfinite(R0[:, 0, 0]) & np.isfinite(R1[:, 0, 0])
    out = np.full(len(t), np.nan)
    out[good] = np.linalg.norm(log_rotation(np.swapaxes(R0[good], 1, 2) @ R1[good]), axis=1) / (2.0 * _RATE_S)
    return out
