"""Random worlds for the hand-eye solver: no NaN, no confident wrong answer, mistakes are named."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose, random_rotations
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.solve import HandEyeConfig, as_transform
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.commands.hand_eye import solve_pairs

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
    """What the solver said of a world: "answer", "open" (a direction named), "warning", "refused", "named" (the
    mistake), or "NAN" and "WRONG", which must not be; ``nees``: of the answer, in units of the region that holds the
    truth."""

    said: str
    sentence: str
    nees: float


def random_world(rng: np.random.Generator, mistake: str | None = None) -> MistakenPairs:
    """A world with any motion, mounting, noise (normal or heavy-tailed, about the middle of a board whose origin is a
    corner), outliers, and one of the usual mistakes (``mistake``; else half of them without)."""
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
    """Solve a world as the command does and judge what it said against the truth."""
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


def _scaled(X: Array, s: float) -> Array:
    out = X.copy()
    out[:, :3, 3] *= s
    return out


def _transposed(X: Array) -> Array:
    return pose(np.swapaxes(X[:, :3, :3], 1, 2), X[:, :3, 3])


def _xyzw(X: Array) -> Array:
    q = Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=False)
    return pose(Rotation.from_quat(q, scalar_first=True).as_matrix(), X[:, :3, 3])


_MISTAKES: dict[str, Callable[[Array, Array, np.random.Generator], tuple[Array, Array]]] = {
    "none": lambda A, B, _: (A, B),
    "robot inverted": lambda A, B, _: (inverse(A), B),
    "camera inverted": lambda A, B, _: (A, inverse(B)),
    "millimetres": lambda A, B, rng: (_scaled(A, 1e3), B) if rng.uniform() < 0.5 else (A, _scaled(B, 1e3)),
    "transposed": lambda A, B, rng: (_transposed(A), B) if rng.uniform() < 0.5 else (A, _transposed(B)),
    "quaternion order": lambda A, B, rng: (_xyzw(A), B) if rng.uniform() < 0.5 else (A, _xyzw(B)),
    "scale": lambda A, B, rng: (A, _scaled(B, float(np.exp(rng.uniform(0.7, 2.3) * rng.choice([-1.0, 1.0]))))),
    "target size": lambda A, B, rng: (A, _scaled(B, 1.0 + float(rng.uniform(0.02, 0.1) * rng.choice([-1.0, 1.0])))),
}
