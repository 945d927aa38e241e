"""Detects usual mistakes in pose files: applies each correction and names the one that makes the poses agree."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import IDENTITY, inverse
from weldcal.calibration.hand_eye.choice import CANDIDATES, most_promising
from weldcal.calibration.hand_eye.determinacy import diversity
from weldcal.calibration.hand_eye.fit import descend
from weldcal.calibration.hand_eye.linearisation import inverse_information
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import Problem, full_problem, linearise, residuals
from weldcal.calibration.hand_eye.repeats import one_per_pose
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.calibration.hand_eye.starts import grid, kronecker, with_positions
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

_FAR_BETTER = 3.0  # times smaller residuals: no chance, whatever the noise
_HARDLY_WORSE = 0.5  # one kind of residuals may grow by two, where the wrong answer had turned it down
_ROUGH_STEPS = 6
_CHANCE = 1e-4  # at which few poses may agree that much better by luck
_ONE_AXIS = 0.1  # share of the turns off the main axis below which no closed form is to be trusted
_FEWEST = 5
_AGREE = 0.05  # rad, or share of the lesser spread: residuals of poses that agree
_STEP = 1e-4  # of the scale, for its derivative
_ROUGH_POSES = 400
_FITS = 4.0  # sigma per axis: a row with this correction agrees with the others
_MOST_ODD = 20  # excluded rows that are explained one by one
_SURE = 6.0  # standard deviations at which a scale is off
_LEAST_SCALE = 3e-3  # and by how much it must be, to be worth a sentence


@dataclass(frozen=True)
class _Trial:
    F: Array
    G: Array
    sentence: str


def likely_mistake(pairs: PosePairs, given: HandEyeResult | None, config: HandEyeConfig) -> str | None:
    """Find the one correction of the input under which the poses agree far better than in ``given`` (None: where they do not
    agree at all as they stand); None where no correction does. One robot only.

    With both lists inverted the equation holds as well, camera and target exchanged: no data can tell.
    """
    if pairs.mode not in ("eye_in_hand", "eye_on_base") or len(pairs.robot) < _FEWEST:
        return None
    quick = replace(config, folds=0, candidates=CANDIDATES[:1])
    rough = _rough(pairs.F, pairs.G)
    ranked = []
    for k, trial in enumerate(_trials(pairs)):
        turn, shift = _rough(trial.F, trial.G)
        # a closed form is enough to see which corrections are worth a fit
        if _times(turn, rough[0]) * _times(shift, rough[1]) < 0.6:
            ranked.append((turn + shift, k, trial))
    for _, _, trial in sorted(ranked, key=lambda r: r[:2])[:4]:
        try:
            result = solve_problem(full_problem(trial.F, trial.G), config=quick)
        except WeldcalError:
            continue
        shift = result.sigma_translation / _size(trial.F, trial.G)
        agrees = result.sigma_rotation_rad < _AGREE and shift < _AGREE
        if agrees and (
            given is None or _far_better(result, shift, given, given.sigma_translation / _size(pairs.F, pairs.G))
        ):
            return f"These poses contradict each other as given, but agree if {trial.sentence}: correct the file and run again."
    return None


def explain_outliers(pairs: PosePairs, result: HandEyeResult) -> tuple[str, ...]:
    """Sentences with the cause of poses that were excluded, where the solution of the others shows one. One robot only.

    A pose of one list that fits another row's pose of the other list was paired wrongly. One transform on the flange's side of the robot's
    poses (TCP), or on the base's side (frame), that makes several rows fit is their cause. Of one row alone six free numbers would always
    fit: its cause is a shift along one axis of the flange that leaves nothing else.
    """
    odd = np.flatnonzero(~result.inliers)
    if pairs.mode not in ("eye_in_hand", "eye_on_base") or not 0 < len(odd) <= _MOST_ODD:
        return ()
    X, Y = (np.asarray(result.poses[k].GetAsMatrix4()) for k in "XY")
    sigma = result.sigma_rotation_rad + 1e-12, result.sigma_translation + 1e-12

    def misfit(robot: Array, camera: Array) -> tuple[Array, Array]:
        F = replace(pairs, robot=robot, camera=np.broadcast_to(camera, robot.shape)).F
        w, d = residuals(full_problem(F, np.broadcast_to(camera, robot.shape)), (X, Y, IDENTITY), result.noise_centre)
        return w / sigma[0], d / sigma[1]

    def fits(robot: Array, camera: Array, sigmas: float = _FITS) -> Array:
        return _small(*misfit(robot, camera), sigmas)

    said: list[str] = []
    moved: dict[str, dict[int, int]] = {"camera": {}, "robot": {}}
    for i in map(int, odd):
        alike = np.broadcast_to(pairs.robot[i], pairs.robot.shape)
        for who, found in (("camera", fits(pairs.robot, pairs.camera[i])), ("robot", fits(alike, pairs.camera))):
            like = np.flatnonzero(found)
            if len(like) and (result.observation[like] == result.observation[like[0]]).all():
                moved[who][i] = int(like[0])
    exchanged = [(i, j) for i, j in moved["camera"].items() if i < j and moved["camera"].get(j) == i]
    for pair in exchanged:
        said.append(f"Poses {_listed(pairs, pair)} are exchanged in one list: both fit when they change places.")
    named = {i for pair in exchanged for i in pair}
    for who, other in (("camera", "robot"), ("robot", "camera")):
        wrong = [i for i in moved[who] if i not in named]
        named |= set(wrong)
        if wrong:
            said.append(
                f"The {who}'s pose{'s' * (len(wrong) > 1)} {_listed(pairs, wrong)} fit{'s' * (len(wrong) == 1)} the {other}'s "
                f"{_listed(pairs, [moved[who][i] for i in wrong])} instead: check how these rows are paired."
            )
    left = np.array([i for i in odd if i not in named], dtype=int)
    R, G = pairs.robot[left], pairs.camera[left]
    F = Y @ inverse(G) @ inverse(X)
    right = F if pairs.mode == "eye_in_hand" else inverse(F)
    tools, frames = inverse(right) @ R, R @ inverse(right)
    nothing = np.zeros(len(left), dtype=bool)
    by_tool = max((fits(R @ inverse(T), G, 2.0 * _FITS) for T in tools), key=np.sum, default=nothing)
    by_frame = max((fits(inverse(S) @ R, G, 2.0 * _FITS) for S in frames), key=np.sum, default=nothing)
    on_flange, else_ = ("camera", "target") if pairs.mode == "eye_in_hand" else ("target", "camera")
    for rows, others, changes, words in (
        (by_tool, by_frame, tools, f"another TCP, or if the {on_flange} moved on the flange"),
        (by_frame, by_tool, frames, f"another base or user frame, or if the {else_} moved"),
    ):
        if rows.sum() > max(others.sum(), 1):
            p = ", ".join(f"{1e3 * v:.1f}" for v in np.median(changes[rows, :3, 3], axis=0))
            turn = np.degrees(np.median(Rotation.from_matrix(changes[rows, :3, :3]).magnitude()))
            said.append(
                f"Poses {_listed(pairs, left[rows].tolist())} fit if the robot's poses had {words}: offset ({p}) mm, turned by {turn:.1f} degrees."
            )
            return tuple(said)
    for k, i in enumerate(left):
        axes = np.concatenate([R[k, :3, :3].T, np.eye(3)])
        shifted = np.repeat(R[k : k + 1], 6, axis=0)
        w, d = misfit(shifted, G[k])
        shifted[:, :3, 3] += axes
        slope = misfit(shifted, G[k])[1] - d
        shift = (slope * d).sum(axis=1) / (slope**2).sum(axis=1)
        good = _small(w, d - shift[:, None] * slope, _FITS)
        if good[:3].any() and not good[3:].any():
            axis = int(np.argmax(good[:3]))
            said.append(
                f"Pose {_listed(pairs, [i])} fits if the robot's pose had another TCP: offset {1e3 * shift[axis]:.1f} mm along {'xyz'[axis]} of "
                "the flange."
            )
    return tuple(said)


def _small(w: Array, d: Array, sigmas: float) -> Array:
    return np.asarray(np.maximum((w**2).sum(axis=1), (d**2).sum(axis=1)) < 3.0 * sigmas**2)


def _listed(pairs: PosePairs, rows: Sequence[int]) -> str:
    words = [f"{k} ('{pairs.ids[k]}')" if pairs.ids else str(k) for k in rows]
    return f"{', '.join(words[:-1])} and {words[-1]}" if words[1:] else words[0]


def scale_warning(problem: Problem, result: HandEyeResult) -> str | None:
    """A sentence where the robot's motion says that all camera distances are too long or too short by one factor (a target of
    another size, a wrong focal length): such an error shifts the answer without showing in any reprojection."""
    # repeats say nothing more about the scale than one sample does
    used = one_per_pose(problem).problem.pick(np.unique(result.observation[result.inliers]))
    if problem.tied or not used.all_full or 6 * len(used) < problem.size + 12 or result.unobservable:
        return None
    X, Y = (np.asarray(result.poses[k].GetAsMatrix4()) if k in result.poses else IDENTITY for k in "XY")
    Z = np.asarray(result.poses["Z"].GetAsMatrix4()) if "Z" in result.poses else IDENTITY
    state = X, Y, Z
    lin = linearise(used, state, np.zeros(3))
    _, up = residuals(replace(used, G=_scaled(used.G, 1.0 + _STEP)), state)
    column = (up - lin.d)[:, :, None] / _STEP
    Jd = np.concatenate([lin.Jd, column], axis=2).reshape(-1, problem.size + 1)
    Jw = np.concatenate([lin.Jw, np.zeros_like(column)], axis=2).reshape(-1, problem.size + 1)
    w, d = lin.w.reshape(-1), lin.d.reshape(-1)
    a, b = (max(float(e @ e) / (e.size - 0.5 * problem.size), 1e-30) for e in (w, d))
    V = inverse_information(Jw.T @ Jw / a + Jd.T @ Jd / b)
    s = -float(V[-1] @ (Jw.T @ w / a + Jd.T @ d / b))
    sigma = float(np.sqrt(V[-1, -1]))
    if abs(s) < max(_SURE * sigma, _LEAST_SCALE):
        return None
    # the positions fit when multiplied by 1 + s
    return (
        f"The camera's distances seem {abs(100 * s):.1f} % (+- {100 * sigma:.1f}) too {'short' if s > 0.0 else 'long'} for the "
        "robot's motion; check the size of the target and the camera's focal length: an error of either shifts the result."
    )


def _trials(pairs: PosePairs) -> Iterator[_Trial]:
    F, G = pairs.F, pairs.G
    other = "eye_on_base" if pairs.mode == "eye_in_hand" else "eye_in_hand"
    yield _Trial(inverse(F), G, f"the camera is mounted {other}, or either the robot or the camera poses are inverted")

    def again(robot: Array, camera: Array) -> tuple[Array, Array]:
        return (robot if pairs.mode == "eye_in_hand" else inverse(robot)), camera

    robot, camera = pairs.robot, pairs.camera
    yield _Trial(*again(_transposed(robot), camera), "the rotations of the robot are transposed")
    yield _Trial(*again(robot, _transposed(camera)), "the rotations of the camera are transposed")
    yield _Trial(*again(_transposed(robot), _transposed(camera)), "the rotations of robot and camera are transposed")
    for by, order in ((1, "x, y, z, w"), (-1, "w, x, y, z")):
        a, b = _rolled(robot, by), _rolled(camera, by)
        yield _Trial(*again(a, camera), f"the robot's quaternions are in the order {order}")
        yield _Trial(*again(robot, b), f"the camera's quaternions are in the order {order}")
        yield _Trial(*again(a, b), f"all quaternions are in the order {order}")
    yield _Trial(F[1:], G[:-1], "the camera poses come one sample later than the robot poses")
    yield _Trial(F[:-1], G[1:], "the camera poses come one sample earlier than the robot poses")
    for mount, A in (("", F), (f"the camera is mounted {other} and ", inverse(F))):
        for s in (1e-3, 1e3, _scale(A, G)):
            if s is None or abs(np.log(s)) < 0.05:
                continue
            what = {
                0.001: "are millimetres while the robot's are metres",
                1000.0: "are metres while the robot's are millimetres",
            }
            near = [words for unit, words in what.items() if abs(np.log(s / unit)) < 0.3]
            words = near[0] if near else f"are multiplied by {s:.4g} (a monocular scale, or a target of another size)"
            yield _Trial(A, _scaled(G, s), f"{mount}the camera's positions {words}")


def _rough(F: Array, G: Array) -> tuple[float, float]:
    """Medians of the residuals after a few steps from a closed form (where the robot turns about one axis only: from turns of
    the cube): rad, and share of the lesser spread. Of more than 400 poses as many, evenly spaced, are enough."""
    if len(F) > _ROUGH_POSES:
        some = np.linspace(0, len(F) - 1, _ROUGH_POSES).round().astype(int)
        F, G = F[some], G[some]
    problem = full_problem(F, G)
    state = (IDENTITY, IDENTITY, IDENTITY)
    a, b, _ = diversity(problem).turn_spread_deg
    if b > _ONE_AXIS * a:
        state, _ = descend(problem, with_positions(problem, kronecker(problem, state), state), iterations=_ROUGH_STEPS)
    else:
        best, _, _ = most_promising(problem, grid(problem, state, np.random.default_rng(0)), 4)
        state = state if best is None else best
    w, d = residuals(problem, state)
    return (
        float(np.median(np.linalg.norm(w, axis=1))),
        float(np.median(np.linalg.norm(d, axis=1))) / _size(F, G),
    )


def _size(F: Array, G: Array) -> float:
    """The smaller of the spreads of robot and camera, however each is stated: scaling one of them away is no agreement."""

    def spread(X: Array) -> float:
        return max(float(np.sqrt(p.var(axis=0).sum())) for p in (X[:, :3, 3], inverse(X)[:, :3, 3]))

    return max(min(spread(F), spread(G)), 1e-12)


def _scale(F: Array, G: Array) -> float | None:
    """Factor on the camera's positions that makes them fit the robot's, rotations from the closed form (linear)."""
    problem = full_problem(F, G)
    RX, _, _ = kronecker(problem, (IDENTITY, IDENTITY, IDENTITY))
    n = len(F)
    R = F[:, :3, :3]
    seen = (R @ (G[:, :3, 3] @ RX.T)[:, :, None])[:, :, 0]
    A = np.concatenate([R, np.broadcast_to(-np.eye(3), (n, 3, 3)), seen[:, :, None]], axis=2).reshape(3 * n, 7)
    scale = np.maximum(np.abs(A).max(axis=0), 1e-30)
    x = np.linalg.lstsq(A / scale, -F[:, :3, 3].reshape(-1), rcond=1e-9)[0] / scale
    return float(x[6]) if np.isfinite(x[6]) and float(x[6]) > 1e-6 else None


def _far_better(new: HandEyeResult, new_shift: float, given: HandEyeResult, given_shift: float) -> bool:
    """Neither kind of residuals much worse, and their product smaller by far more than chance."""
    turn = given.sigma_rotation_rad / max(new.sigma_rotation_rad, 1e-12)
    shift = given_shift / max(new_shift, 1e-12)
    lucky = float(np.sqrt(f_quantile(1.0 - _CHANCE, given.degrees_of_freedom, new.degrees_of_freedom)))
    return min(turn, shift) > _HARDLY_WORSE and turn * shift > max(_FAR_BETTER, lucky)


def _times(new: float, old: float) -> float:
    return max(new, 1e-9) / max(old, 1e-9)


def _scaled(X: Array, s: float) -> Array:
    out = X.copy()
    out[:, :3, 3] *= s
    return out


def _transposed(X: Array) -> Array:
    out = X.copy()
    out[:, :3, :3] = np.swapaxes(X[:, :3, :3], 1, 2)
    return out


def _rolled(X: Array, by: int) -> Array:
    """Rotations whose quaternion numbers (w, x, y, z) are shifted by one place."""
    q = np.roll(Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=True), by, axis=1)
    out = X.copy()
    out[:, :3, :3] = Rotation.from_quat(q, scalar_first=True).as_matrix()
    return out
