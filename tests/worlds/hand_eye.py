"""Simulated hand-eye data: imperfect cells, mistakes in the pairs, and lists of poses in random conventions."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.se3 import (
    as_transform,
    exp_rotation,
    flange_poses,
    inverse,
    nearest_rotation,
    pose,
    scaled,
)
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_held_out
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.calibration.recorded_hand_eye import solve_pairs
from weldcal.models.arms.chain import load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.runner import Progress, no_progress

KINDS = ("corners only", "camera", "robot", "both", "target poses", "heavy tails", "poor camera", "far target")
"""What is wrong besides the corners' own noise; "target poses" and "heavy tails": no corners, but poses with noise of
their own (normal, or Student's t of three degrees of freedom); "far target": a larger board 2 to 6 m away."""
_ARMS = ("ur10e", "ur5e")
_WIDTH, _HEIGHT = 1280.0, 960.0
_LEAST = 6  # corners in an image that is kept


def random_rotations(n: int, rng: np.random.Generator) -> Array:
    """Rotations (n, 3, 3), uniform over all of them."""
    return np.asarray(Rotation.random(n, rng=rng).as_matrix()).reshape(n, 3, 3)


@dataclass(frozen=True)
class PairedPoses:
    """Pairs of one cell.

    ``F`` (n, 4, 4) the stated flange poses, ``G`` (n, 4, 4) the target in the camera as estimated, ``X`` (4, 4) and
    ``Y`` (4, 4) the truth, which no solver is given. F X G = Y but for the errors of this ``kind``.
    """

    kind: str
    F: Array
    G: Array
    X: Array
    Y: Array


def imperfect_cell(kind: str, seed: int) -> PairedPoses:
    """One cell with a wrist camera and a board; numbers are drawn from ranges that cells have (metres, rad, pixels).

    8 to 60 poses about a work point, scattered or on a path, with turns of 6 to 35 degrees; a board of 0.1 to 0.3 m,
    0.3 to 1 m away, whose origin is its corner; corners read to 0.1 to 0.6 px. ``camera``: focal lengths off by 0.5 %,
    principal point by 5 px, a distortion of 0.02 (rms). ``robot``: joint offsets of 0.1 degrees, lengths of 0.5 mm,
    turns of 0.05 degrees. The board's pose is OpenCV's solvePnP with the wrong camera matrix.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    arm = load_chain(_ARMS[int(rng.integers(len(_ARMS)))])
    n = round(float(np.exp(rng.uniform(np.log(8.0), np.log(60.0)))))
    wrong_camera, wrong_robot = kind in ("camera", "both", "poor camera"), kind in ("robot", "both")
    much = 3.0 if kind == "poor camera" else 1.0
    errors = np.zeros((arm.n, 6))
    if wrong_robot:
        errors = rng.normal(size=(arm.n, 6)) * np.radians([0.05, 0.05, 0.1, 0.0, 0.0, 0.0])
        errors[:, 3:] = rng.normal(size=(arm.n, 3)) * 5e-4
    focal = rng.uniform(900.0, 1800.0)
    K = np.array([[focal, 0.0, 0.5 * _WIDTH], [0.0, focal, 0.5 * _HEIGHT], [0.0, 0.0, 1.0]])
    true_K, true_bend = K.copy(), np.zeros(5)
    if wrong_camera:
        true_K[0, 0] *= 1.0 + 0.005 * much * rng.normal()
        true_K[1, 1] = true_K[0, 0] * (1.0 + 0.001 * rng.normal())
        true_K[:2, 2] += 5.0 * much * rng.normal(size=2)
        true_bend[:2] = 0.02 * much * rng.normal(size=2)
    pixel = rng.uniform(0.1, 0.6)
    rows, columns, side = int(rng.integers(4, 9)), int(rng.integers(5, 12)), rng.uniform(0.012, 0.03)
    side *= 2.5 if kind == "far target" else 1.0
    flat = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * side
    board: Array = np.column_stack([flat, np.zeros(len(flat))]).astype(np.float64)
    X = pose(exp_rotation(rng.normal(size=3) * 0.7), rng.normal(size=3) * 0.05)
    middle = np.radians([0.0, -80.0, 110.0, -120.0, -90.0, 0.0]) + rng.normal(size=6) * 0.2
    distance = rng.uniform(2.0, 6.0) if kind == "far target" else rng.uniform(0.3, 1.0)
    seen_at = pose(
        exp_rotation(np.array([np.pi, 0.0, 0.0])) @ exp_rotation(rng.normal(size=3) * 0.3),
        np.array([0.0, 0.0, distance]),
    )
    seen_at[:3, 3] -= seen_at[:3, :3] @ board.mean(axis=0)
    Y = flange_poses(arm, middle[None], errors)[0] @ X @ seen_at
    # a small turn moves a far target out of the image
    spread = (
        np.radians(rng.uniform(6.0, 35.0))
        * (0.25 if kind == "far target" else 1.0)
        * np.array([0.4, 0.4, 0.4, 1.0, 1.0, 1.0])
    )
    path = bool(rng.integers(2))
    F, G = [], []
    walk = np.zeros(6)
    for _ in range(4000):
        walk = 0.85 * walk + 0.53 * rng.normal(size=6) if path else rng.normal(size=6)
        q = (middle + spread * walk)[None]
        true = inverse(flange_poses(arm, q, errors)[0] @ X) @ Y
        found = _read(true, kind, board, true_K, true_bend, K, pixel, rng)
        if found is not None:
            F.append(flange_poses(arm, q, np.zeros((arm.n, 6)))[0])
            G.append(found)
        if len(F) == n:
            break
    return PairedPoses(kind, np.array(F), np.array(G), X, Y)


def _read(
    true: Array, kind: str, board: Array, true_K: Array, bend: Array, K: Array, pixel: float, rng: np.random.Generator
) -> Array | None:
    """Return the board's pose as a program estimates it, None where too little of it is in the image."""
    in_camera = board @ true[:3, :3].T + true[:3, 3]
    if float(in_camera[:, 2].min()) < 0.1:
        return None
    turn = cv2.Rodrigues(true[:3, :3])[0]
    at = np.asarray(cv2.projectPoints(board, turn, true[:3, 3], true_K, bend)[0], dtype=float)[:, 0]
    inside = ((at > 0.0) & (at < [_WIDTH, _HEIGHT])).all(axis=1)
    if int(inside.sum()) < max(_LEAST, int(0.6 * len(board))):
        return None
    if kind in ("target poses", "heavy tails"):
        tail = 1.0 if kind == "target poses" else 1.0 / float(np.sqrt(rng.chisquare(3.0) / 3.0))
        size = tail * pixel / 0.3
        noise = pose(exp_rotation(rng.normal(size=3) * 3e-3 * size), rng.normal(size=3) * 1e-3 * size)
        return np.asarray(true @ noise)
    read = at + pixel * rng.normal(size=at.shape)
    good, turn, shift = cv2.solvePnP(board[inside], read[inside], K, None, turn.copy(), true[:3, 3:].copy(), True)
    if not good:
        return None
    return pose(nearest_rotation(np.asarray(cv2.Rodrigues(turn)[0], dtype=float)), np.asarray(shift, dtype=float)[:, 0])


WEIGHTINGS = {
    "weldcal": HandEyeConfig(),
    "least squares alone": HandEyeConfig(usual_discord_rad=0.0),
    "rotations alone": HandEyeConfig(usual_discord_rad=1e6),
}
NO_ANSWER = 1e9  # the ratio where weldcal gives none: the worst one


def ratios(kind: str, seed: int) -> dict[str, list[float]]:
    """Held-out errors (deg, mm) of each of WEIGHTINGS in one cell over the best of OpenCV's methods in that column."""
    cell = imperfect_cell(kind, seed)
    theirs = [opencv_held_out(m, cell.F, cell.G) for m in METHODS]
    whole = [h for h in theirs if np.isfinite(h.translation).all()]
    best = min(h.rms_deg for h in whole), min(h.rms_translation for h in whole)
    out = {}
    for name, config in WEIGHTINGS.items():
        try:
            ours = solve_problem(full_problem(cell.F, cell.G), config=config).held_out
            out[name] = [ours.rms_deg / best[0], ours.rms_translation / best[1]]
        except WeldcalError:
            out[name] = [NO_ANSWER, NO_ANSWER]
    return out


MOTIONS = ("arm", "stream", "few", "planar", "wobble", "small")
MISTAKES = (
    "none",
    "robot inverted",
    "camera inverted",
    "millimetres",
    "transposed",
    "quaternion order",
    "scale",
    "target size",
)
_SURE = 0.9999  # region beyond which an answer without a warning counts as wrong
_SLACK = 3.0  # times that region: noise here is not normal, and a covariance is known to a factor only


@dataclass(frozen=True)
class MistakenPairs:
    """Pairs as a file would hold them, how they were made, and the truth."""

    pairs: PosePairs
    motion: str
    mistake: str
    X: Array


@dataclass(frozen=True)
class SolverVerdict:
    """Hold the solver's answer on a world.

    "answer", "open" (a direction named), "warning", "refused", "named" (the mistake), or "NAN" and "WRONG", which must
    not be. ``nees``: of the answer, in units of the region that holds the truth.
    """

    said: str
    sentence: str
    nees: float


def random_world(rng: np.random.Generator, mistake: str | None = None) -> MistakenPairs:
    """Draw a world with any motion, mounting, noise and outliers, and one of the usual mistakes.

    The noise is normal or heavy-tailed, about the middle of a board whose origin is a corner. ``mistake``: the mistake;
    else half of them are without.
    """
    motion = str(rng.choice(MOTIONS))
    if mistake is None:
        mistake = "none" if rng.uniform() < 0.5 else str(rng.choice(MISTAKES[1:]))
    hand = _motion(motion, rng)
    n = len(hand)
    mode = str(rng.choice(["eye_in_hand", "eye_on_base"]))
    F = hand if mode == "eye_in_hand" else inverse(hand)
    X = pose(random_rotations(1, rng)[0], rng.normal(size=3) * 0.15)
    # the target about in front of the camera at the first pose
    seen = pose(
        exp_rotation(rng.normal(size=3) * 0.3), np.array([0.0, 0.0, rng.uniform(0.3, 1.5)]) + 0.05 * rng.normal(size=3)
    )
    Y = F[0] @ X @ seen
    middle = pose(np.eye(3), rng.uniform(0.0, 0.15, 3) * [1.0, 1.0, 0.0])
    turn, shift = np.radians(10.0 ** rng.uniform(-2.0, -0.5)), 10.0 ** rng.uniform(-4.3, -2.7)
    draw = rng.standard_normal if rng.uniform() < 0.6 else (lambda size: rng.standard_t(5.0, size=size) * np.sqrt(0.6))
    noise = pose(exp_rotation(draw((n, 3)) * turn), draw((n, 3)) * shift)
    G = inverse(F @ X) @ Y @ middle @ noise @ inverse(middle)
    if n >= 12 and rng.uniform() < 0.3:
        bad = rng.choice(n, int(rng.integers(1, 1 + n // 5)), replace=False)
        G[bad] = G[bad] @ pose(exp_rotation(rng.normal(size=(len(bad), 3)) * 0.5), rng.normal(size=(len(bad), 3)) * 0.1)
    robot, camera = _MISTAKES[mistake](hand, G, rng)
    return MistakenPairs(PosePairs(source="world", robot=robot, camera=camera, mode=mode), motion, mistake, X)


def judge(world: MistakenPairs, config: HandEyeConfig | None = None) -> SolverVerdict:
    """Solve a world as the command does and judge the answer against the truth."""
    try:
        result = solve_pairs(world.pairs, config or HandEyeConfig(folds=0))
    except WeldcalError as e:
        return SolverVerdict("named" if "agree if" in str(e) else "refused", str(e), float("nan"))
    whole = all(np.isfinite(v).all() for v in (result.X.GetAsMatrix4(), result.joint_covariance, result.translation))
    if not whole:
        return SolverVerdict("NAN", result.method, float("nan"))
    nees = result.normalised_error("X", as_transform(world.X)) / result.region(_SURE)
    other_warnings = [w for w in result.warnings if "left out" not in w]
    if nees > _SLACK:
        return SolverVerdict("warning" if other_warnings else "WRONG", "; ".join(result.warnings), nees)
    return SolverVerdict(
        "open" if result.unobservable else "warning" if other_warnings else "answer", "; ".join(other_warnings), nees
    )


def fuzz(n: int, seed: int = 0, progress: Progress = no_progress) -> dict[str, Counter[str]]:
    """Verdicts over ``n`` random worlds, by mistake. World k is random_world(default_rng((seed, k)))."""
    out: dict[str, Counter[str]] = {m: Counter() for m in MISTAKES}
    for k in range(n):
        world = random_world(np.random.default_rng((seed, k)))
        out[world.mistake][judge(world).said] += 1
        progress("random worlds", (k + 1) / n)
    return out


def _motion(kind: str, rng: np.random.Generator) -> Array:
    reach = rng.uniform(0.1, 0.5)
    if kind == "stream":  # one sweep, as a hand-held or flying camera makes it
        n = int(rng.integers(60, 200))
        t = np.linspace(0.0, 1.0, n)[:, None]
        waves = np.zeros((2, n, 3))
        for k in (1, 2, 3):
            waves += rng.normal(size=(2, 1, 3)) * np.sin(2.0 * np.pi * (k * t + rng.uniform(size=(2, 1, 3)))) / k
        return pose(exp_rotation(waves[0] * rng.uniform(0.2, 0.7)), waves[1] * reach)
    n = int(rng.integers(3, 7)) if kind == "few" else int(rng.integers(8, 40))
    spread = {"small": np.radians(rng.uniform(2.0, 8.0)), "few": 0.5}.get(kind, rng.uniform(0.2, 0.8))
    p = rng.normal(size=(n, 3)) * reach
    if kind in ("planar", "wobble"):
        axis = random_rotations(1, rng)[0]
        p = (p * [1.0, 1.0, 0.0 if kind == "planar" else 0.1]) @ axis.T
        w = rng.uniform(-1.5, 1.5, (n, 1)) * axis[:, 2]
        off = 0.0 if kind == "planar" else np.radians(rng.uniform(0.3, 3.0))
        return pose(exp_rotation(w) @ exp_rotation(rng.normal(size=(n, 3)) * off), p)
    return pose(exp_rotation(rng.normal(size=(n, 3)) * spread), p)


def _transposed(X: Array) -> Array:
    return pose(np.swapaxes(X[:, :3, :3], 1, 2), X[:, :3, 3])


def _xyzw(X: Array) -> Array:
    q = Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=False)
    return pose(Rotation.from_quat(q, scalar_first=True).as_matrix(), X[:, :3, 3])


_MISTAKES: dict[str, Callable[[Array, Array, np.random.Generator], tuple[Array, Array]]] = {
    "none": lambda A, B, _: (A, B),
    "robot inverted": lambda A, B, _: (inverse(A), B),
    "camera inverted": lambda A, B, _: (A, inverse(B)),
    "millimetres": lambda A, B, rng: (scaled(A, 1e3), B) if rng.uniform() < 0.5 else (A, scaled(B, 1e3)),
    "transposed": lambda A, B, rng: (_transposed(A), B) if rng.uniform() < 0.5 else (A, _transposed(B)),
    "quaternion order": lambda A, B, rng: (_xyzw(A), B) if rng.uniform() < 0.5 else (A, _xyzw(B)),
    "scale": lambda A, B, rng: (A, scaled(B, float(np.exp(rng.uniform(0.7, 2.3) * rng.choice([-1.0, 1.0]))))),
    "target size": lambda A, B, rng: (A, scaled(B, 1.0 + float(rng.uniform(0.02, 0.1) * rng.choice([-1.0, 1.0])))),
}
