"""The supported mountings: the frames of each equation, the names of its unknowns, and a sketch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.geometry.se3 import IDENTITY, inverse
from weldcal.calibration.hand_eye.problem import Problem
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError


@dataclass(frozen=True)
class Unknown:
    """A pose that a mounting solves for: monogram name, its parent and child frames in words and as tf names."""

    symbol: str
    child_words: str
    parent_words: str
    child: str
    parent: str

    @property
    def sentence(self) -> str:
        """Description of the pose for printed results."""
        return f"pose of the {self.child_words} in the {self.parent_words} frame: {self.symbol}"


@dataclass(frozen=True)
class Mounting:
    """A configuration: its unknowns by the letters of F X G = Y H Z, its equation in monogram notation, a sketch."""

    name: str
    words: str
    equation: str
    source: str
    unknowns: dict[str, Unknown]
    sketch: str

    @property
    def labels(self) -> dict[str, str]:
        """Letter -> sentence."""
        return {k: u.sentence for k, u in self.unknowns.items()}


def _unknown(symbol: str, child: tuple[str, str], parent: tuple[str, str]) -> Unknown:
    return Unknown(symbol, child[0], parent[0], child[1], parent[1])


_CAMERA = ("camera", "camera_optical_frame")
_BASE = ("base", "base")
_HAND = (
    "flange",
    "tool0",
)  # of ROS-Industrial: z along the flange's normal, as controllers count; REP 199's "flange" has x there
_TARGET = ("target", "target")
_LINK = ("arm link", "arm_link")

MOUNTINGS: dict[str, Mounting] = {
    m.name: m
    for m in (
        Mounting(
            "eye_in_hand",
            "the camera rides on the flange, the target stands still in the base",
            "X_BF X_FC X_CM = X_BM",
            "paper, Eq. (1), Fig. 2a",
            {"X": _unknown("X_FC", _CAMERA, _HAND), "Y": _unknown("X_BM", _TARGET, _BASE)},
            "base B --X_BF(robot)--> flange F ==X_FC==> camera C --X_CM(seen)--> target M\n"
            "base B ================X_BM (found with it)==================> target M",
        ),
        Mounting(
            "eye_on_base",
            "the camera stands still in the base, the target rides on the flange",
            "X_BC X_CM = X_BF X_FM",
            "paper, Eq. (4), Fig. 2b",
            {"X": _unknown("X_BC", _CAMERA, _BASE), "Y": _unknown("X_FM", _TARGET, _HAND)},
            "base B ==X_BC==> camera C --X_CM(seen)--> target M\n"
            "base B --X_BF(robot)--> flange F ==X_FM (found with it)==> target M",
        ),
        Mounting(
            "eye_on_arm_target_on_flange",
            "the camera rides on a link of the arm, the target on the flange beyond it",
            "X_BL X_LC X_CM = X_BF X_FM",
            "paper, Eq. (8), Fig. 3",
            {"X": _unknown("X_LC", _CAMERA, _LINK), "Y": _unknown("X_FM", _TARGET, _HAND)},
            "base B --X_BL(robot)--> link L ==X_LC==> camera C --X_CM(seen)--> target M\n"
            "base B --X_BF(robot)--> flange F ==X_FM (found with it)=========> target M",
        ),
        Mounting(
            "eye_on_arm_target_on_base",
            "the camera rides on a link of the arm, the target stands still in the base",
            "X_BL X_LC X_CM = X_BM",
            "paper, Eq. (7), Fig. 3",
            {"X": _unknown("X_LC", _CAMERA, _LINK), "Y": _unknown("X_BM", _TARGET, _BASE)},
            "base B --X_BL(robot)--> link L ==X_LC==> camera C --X_CM(seen)--> target M\n"
            "base B ================X_BM (found with it)=================> target M",
        ),
        Mounting(
            "co_manipulation",
            "one robot holds the camera, another one the target",
            "X_BF X_FC X_CM = X_BD X_DE X_EM",
            "paper, Eq. (5), Fig. 2c",
            {
                "X": _unknown("X_FC", _CAMERA, ("first robot's flange", "robot1_tool0")),
                "Y": _unknown("X_BD", ("second robot's base", "robot2_base"), ("first robot's base", "robot1_base")),
                "Z": _unknown("X_EM", _TARGET, ("second robot's flange", "robot2_tool0")),
            },
            "base B --X_BF(robot 1)--> flange F ==X_FC==> camera C --X_CM(seen)--> target M\n"
            "base B ==X_BD==> second base D --X_DE(robot 2)--> second flange E ==X_EM==> target M",
        ),
    )
}


@dataclass(frozen=True, kw_only=True)
class TargetObservation:
    """One observation of the target.

    ``X_BF``: flange in base (of the robot with the camera where there are two). ``X_BL``: the link that carries the
    camera (eye_on_arm only). ``X_DE``: the second robot's flange in its base (co_manipulation only).

    Measured: ``p_CM`` (3,) always, with ``n_CM`` (3,) the unit z axis of the target (its normal) or ``R_CM`` all of its
    rotation where known. ``covariance`` (6, 6) [rotation; translation] of the measurement in the target's axes, None
    where unknown (rows of rotations that were not seen are ignored).
    """

    X_BF: RigidTransform
    p_CM: Array
    n_CM: Array | None = None
    R_CM: RotationMatrix | None = None
    covariance: Array | None = None
    X_BL: RigidTransform | None = None
    X_DE: RigidTransform | None = None


def get_mounting(name: str) -> Mounting:
    """Return a mounting by name; InputError naming the known ones."""
    if name not in MOUNTINGS:
        raise InputError(f"There is no mounting '{name}'; choose one of {', '.join(MOUNTINGS)}.")
    return MOUNTINGS[name]


def chain(mounting: Mounting, X_BF: Array, X_BL: Array | None = None, X_DE: Array | None = None) -> tuple[Array, Array]:
    """F and H (n, 4, 4) of F X G = Y H Z for poses the robots state; InputError where a needed one is missing."""
    n = len(X_BF)
    H = np.broadcast_to(IDENTITY, (n, 4, 4))
    if mounting.name == "eye_in_hand":
        return X_BF, H
    if mounting.name == "eye_on_base":
        return inverse(X_BF), H
    if mounting.name == "co_manipulation":
        if X_DE is None:
            raise InputError("Co-manipulation needs the second robot's flange pose in its own base for every sample.")
        return X_BF, X_DE
    if X_BL is None:
        raise InputError("An eye on the arm needs the pose of the link that carries the camera for every sample.")
    return (X_BL, H) if mounting.name == "eye_on_arm_target_on_base" else (inverse(X_BF) @ X_BL, H)


def problem_of(
    mounting: Mounting, observations: Sequence[TargetObservation], known: dict[str, RigidTransform]
) -> Problem:
    """Return the equation of these observations.

    ``known``: letters of unknowns that are given (a flange as target: Y or Z).
    """
    X_BF = np.array([s.X_BF.GetAsMatrix4() for s in observations]).reshape(-1, 4, 4)
    links = [s.X_BL for s in observations]
    others = [s.X_DE for s in observations]
    X_BL = None if any(x is None for x in links) else np.array([x.GetAsMatrix4() for x in links if x is not None])
    X_DE = None if any(x is None for x in others) else np.array([x.GetAsMatrix4() for x in others if x is not None])
    F, H = chain(mounting, X_BF, X_BL, X_DE)
    G = np.broadcast_to(IDENTITY, (len(observations), 4, 4)).copy()
    for i, s in enumerate(observations):
        G[i, :3, 3] = s.p_CM
        if s.R_CM is not None:
            G[i, :3, :3] = s.R_CM.matrix()
        elif s.n_CM is not None:
            G[i, :3, :3] = _frame_with_z(np.asarray(s.n_CM, dtype=float))
    if not (np.isfinite(F).all() and np.isfinite(G).all() and np.isfinite(H).all()):
        raise InputError("A sample holds numbers that are not finite.")
    full = np.array([s.R_CM is not None for s in observations], dtype=bool)
    normal = np.array([s.R_CM is None and s.n_CM is not None for s in observations], dtype=bool)
    stated = [s.covariance for s in observations]
    covariance = None
    if any(c is not None for c in stated):
        if any(c is None for c in stated):
            raise InputError("Give a covariance for every sample or for none.")
        covariance = np.array([c for c in stated if c is not None], dtype=float)
    free = tuple(k in mounting.unknowns and k not in known for k in "XYZ")
    return Problem(F=F, G=G, H=H, full=full, normal=normal, covariance=covariance, free=(free[0], free[1], free[2]))


def _frame_with_z(z: Array) -> Array:
    if abs(float(np.linalg.norm(z)) - 1.0) > 1e-6:
        raise InputError("A normal must be a unit vector.")
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
