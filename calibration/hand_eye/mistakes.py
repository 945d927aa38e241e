"""Name the usual mistakes in pairs of poses.

In whole lists, in single rows, and in the scale of the camera's distances.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.readings import PoseReading, apply_change
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.geometry.se3 import IDENTITY, inverse, pose, scaled
from weldcal.calibration.hand_eye.pairs.conventions import ReadingAgreement
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pairs.importing import LEAST_SCALE, SCALE_SIGMA, decided
from weldcal.calibration.hand_eye.problem import Problem, full_problem, linearise, predicted, residuals
from weldcal.calibration.hand_eye.repeats import one_per_pose
from weldcal.calibration.hand_eye.solve import CameraScale, HandEyeConfig, HandEyeResult, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

_FEWEST = 5
_COUNTS = {1: "one sample", 2: "two samples", 3: "three samples"}
_FITS = 4.0  # sigma per axis: a row with this correction agrees with the others
_MOST_ODD = 20  # excluded rows that are explained one by one
_LEVEL = 0.01  # at which a scale is no chance, as the shift of a principal point
_LEAST_SCALE, _MOST_SCALE = 3e-3, 0.3  # choices: less is not worth a sentence, more is another mistake
_VAGUE_SCALE = 0.05  # a choice: one sigma from which on the motion does not tell the scale
_ROUNDS = 8  # of the two variances, which settle within four
_OPEN = 1e-7  # of a column: what the others leave of it, below which it is theirs


def likely_mistake(pairs: PosePairs) -> str | None:
    """Find the correction of the input that the data select, where they reject the poses as they stand; else None.

    One robot only.

    Besides the readings of a file (pairs.conventions) the matrices may be of quaternions in the other order. With both
    lists inverted the equation holds as well, camera and target exchanged: no data can tell.
    """
    n = len(pairs.robot)
    if pairs.mode not in ("eye_in_hand", "eye_on_base") or n < _FEWEST:
        return None
    robot, camera = _orders(pairs.robot), _orders(pairs.camera)
    decision, shift = decided(robot, camera, pairs.mode == "eye_in_hand", n)
    if decision is None or not (decision.best.agrees or _solvable(decision.best, pairs.mode)):
        return None
    alive = [decision.best, *decision.same, *decision.rivals]
    plain = [one for one in alive if not one.robot.form and not one.camera.form]
    words = _words(plain[0] if plain else decision.best, pairs.mode)
    if shift:
        later = "later" if shift > 0 else "earlier"
        words.append(f"the camera poses come {_COUNTS[abs(shift)]} {later} than the robot poses")
    if not words:
        return None
    return (
        f"These poses contradict each other as given, but agree if {' and '.join(words)}: correct the file and run"
        " again."
    )


def _solvable(one: ReadingAgreement, mode: str) -> bool:
    """Test whether the solver finds a result.

    A quarter of outliers or more hides from the comparison that a reading agrees.
    """
    F = one.robot.X if mode == "eye_in_hand" else inverse(one.robot.X)
    try:
        solve_problem(
            full_problem(F, scaled(one.camera.X, one.scale)), config=HandEyeConfig(folds=0, usual_discord_rad=0.0)
        )
    except WeldcalError:
        return False
    return True


def _orders(X: Array) -> list[PoseReading]:
    """The poses as given, with rotations transposed (both lists may be), and with quaternions in either other order."""
    some = [PoseReading("", "", X), PoseReading(",transposed", "", apply_change(X, "transposed"))]
    for by, order in ((1, "xyzw"), (-1, "wxyz")):
        q = np.roll(Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=True), by, axis=1)
        some.append(PoseReading(order, order, pose(Rotation.from_quat(q, scalar_first=True).as_matrix(), X[:, :3, 3])))
    return some


def _words(one: ReadingAgreement, mode: str) -> list[str]:
    """What must be corrected for an agreement."""
    other = "eye_on_base" if mode == "eye_in_hand" else "eye_in_hand"
    said, forms = [], {"robot": one.robot.form.split(","), "camera": one.camera.form.split(",")}
    if forms["robot"] == forms["camera"] != [""]:
        order = ", ".join(forms["robot"][0])
        said.append(
            f"all quaternions are in the order {order}" if order else "the rotations of robot and camera are transposed"
        )
        forms = {}
    for who, (order, *changes) in forms.items():
        said += [f"the {who}'s quaternions are in the order {', '.join(order)}"] if order else []
        said += [f"the rotations of the {who} are transposed"] if "transposed" in changes else []
        said += [f"the frame of the {who}'s poses is left-handed"] if "left_handed" in changes else []
        if "inverse" in changes:
            said.append(f"the camera is mounted {other}, or either the robot or the camera poses are inverted")
    if abs(np.log(one.scale)) > LEAST_SCALE > SCALE_SIGMA * one.scale_sigma:
        known = {
            1e-3: "are millimetres while the robot's are metres",
            1e3: "are metres while the robot's are millimetres",
        }
        near = min(known, key=lambda unit: abs(np.log(one.scale / unit)))
        monocular = f"are multiplied by {one.scale:.4g} (a monocular scale, or a target of another size)"
        said.append(f"the camera's positions {known[near] if abs(np.log(one.scale / near)) < 0.3 else monocular}")
    return said


def explain_outliers(pairs: PosePairs, result: HandEyeResult) -> tuple[str, ...]:
    """Sentences with the cause of poses that were excluded, where the solution of the others shows one. One robot only.

    A pose of one list that fits another row's pose of the other list was paired wrongly. One transform on the flange's
    side of the robot's poses (TCP), or on the base's side (frame), that makes several rows fit is their cause. Of one
    row alone six free numbers would always fit: its cause is a shift along one axis of the flange that leaves nothing
    else.
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
                f"The {who}'s pose{'s' * (len(wrong) > 1)} {_listed(pairs, wrong)} fit{'s' * (len(wrong) == 1)} the"
                f" {other}'s {_listed(pairs, [moved[who][i] for i in wrong])} instead: check how these rows are paired."
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
                f"Poses {_listed(pairs, left[rows].tolist())} fit if the robot's poses had {words}: offset ({p}) mm,"
                f" turned by {turn:.1f} degrees."
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
                f"Pose {_listed(pairs, [i])} fits if the robot's pose had another TCP: offset {1e3 * shift[axis]:.1f}"
                f" mm along {'xyz'[axis]} of the flange."
            )
    return tuple(said)


def _small(w: Array, d: Array, sigmas: float) -> Array:
    return np.asarray(np.maximum((w**2).sum(axis=1), (d**2).sum(axis=1)) < 3.0 * sigmas**2)


def _listed(pairs: PosePairs, rows: Sequence[int]) -> str:
    words = [f"{k} ('{pairs.ids[k]}')" if pairs.ids else str(k) for k in rows]
    return f"{', '.join(words[:-1])} and {words[-1]}" if words[1:] else words[0]


def wrong_scale(problem: Problem, result: HandEyeResult, config: HandEyeConfig | None = None) -> CameraScale | None:
    """Find the factor by which all camera distances are too long or too short; None where it may be chance.

    Causes are a target of another size, a wrong focal length, or the robot's unit. Such an error shifts the answer
    without showing in any reprojection. The factor is one more unknown; its F test takes the variances that the fit
    with this unknown leaves (level _LEVEL). A second fit with the factor applied gives the poses.
    """
    first = _scale_fit(problem, result)
    if first is None or first[2] > _LEVEL:
        return None
    config = replace(config or HandEyeConfig(), folds=0)
    try:
        again = solve_problem(replace(problem, G=scaled(problem.G, 1.0 + first[0])), config=config)
    except WeldcalError:
        return None
    rest = _scale_fit(replace(problem, G=scaled(problem.G, 1.0 + first[0])), again, first[0])
    if rest is None or rest[2] > _LEVEL:
        return None
    factor = (1.0 + first[0]) * (1.0 + rest[0])
    if not _LEAST_SCALE <= abs(factor - 1.0) < _MOST_SCALE:
        return None
    return CameraScale(factor=factor, sigma=rest[1], chance=rest[2], poses=again.poses)


def with_scale(problem: Problem, result: HandEyeResult, config: HandEyeConfig) -> HandEyeResult:
    """Return the result with what the robot's motion says of the camera's scale."""
    scale = wrong_scale(problem, result, config)
    return result if scale is None else replace(result, scale=scale, warnings=(*result.warnings, scale.sentence))


def _scale_fit(problem: Problem, result: HandEyeResult, applied: float = 0.0) -> tuple[float, float, float] | None:
    """Find the change of scale that the residuals ask for, its sigma, and the chance of the whole change.

    Beside the poses and the scale, the positions may be turned against the rotations of the camera, as a wrong
    principal point turns them: three more unknowns. ``applied``: change that the poses already have.
    """
    # repeats say nothing more about the scale than one sample does
    used = one_per_pose(problem).problem.pick(np.unique(result.observation[result.inliers]))
    if not used.all_full or result.unobservable:
        return None
    X, Y, Z = (np.asarray(result.poses[k].GetAsMatrix4()) if k in result.poses else IDENTITY for k in "XYZ")
    state = X, X if problem.tied else Y, Z
    lin = linearise(used, state, np.zeros(3))
    n, blank = 3 * len(used), np.zeros((3 * len(used), 3))
    J = np.vstack(
        [np.hstack([lin.Jw.reshape(n, -1), blank]), np.hstack([lin.Jd.reshape(n, -1), lin.Jd[:, :, :3].reshape(n, 3)])]
    )
    # positions as the poses predict them: measured ones share their noise with the residuals
    G = predicted(used, state)
    column = np.concatenate([np.zeros(n), np.einsum("nji,nj->ni", G[:, :3, :3], G[:, :3, 3]).ravel()])
    e = np.concatenate([lin.w.ravel(), lin.d.ravel()])
    a, b = (max(float(part @ part) / n, 1e-30) for part in (e[:n], e[n:]))
    for _ in range(_ROUNDS):
        root = np.repeat([a**-0.5, b**-0.5], n)
        left, size, _ = np.linalg.svd(
            root[:, None] * J / np.maximum(np.linalg.norm(J, axis=0), 1e-30), full_matrices=False
        )
        Q, c = left[:, size > _OPEN * size[0]], root * column
        own = c - Q @ (Q.T @ c)
        known = float(own @ own)
        if not known > (_OPEN * float(np.linalg.norm(c))) ** 2:
            return None
        s = -float(own @ (root * e)) / known
        r = (e - (Q @ (Q.T @ (root * e))) / root) + s * own / root
        taken = (Q**2).sum(axis=1) + own**2 / known
        free_w, free_d = n - float(taken[:n].sum()), n - float(taken[n:].sum())
        if min(free_w, free_d) < 1.0:
            return None
        a, b = (max(float(part @ part) / free, 1e-30) for part, free in ((r[:n], free_w), (r[n:], free_d)))
    sigma = known**-0.5
    whole = (1.0 + applied) * (1.0 + s) - 1.0
    if not sigma < _VAGUE_SCALE:
        return None
    return s, sigma, float(f_tail((whole / sigma) ** 2, 1, free_d))
