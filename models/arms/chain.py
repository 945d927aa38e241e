"""A serial arm of revolute joints: forward kinematics, Jacobian, and iterative inverse kinematics."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.yaml import yaml_load_file
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.models.arms.kinematics import ArmModel, joint_frames, known_arms, load_arm
from weldcal.models.arrays import Array
from weldcal.models.documents import did_you_mean
from weldcal.models.errors import InputError

RESIDUAL = 1e-9  # m and rad: what a returned solution fulfils
_HERE = Path(__file__).resolve().parent
_POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_DAMPING = 1e-3
_STEPS = 150
_STARTS = 24
_MAX_STEP_RAD = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """n joints in a row: ``stack`` (n, 4, 4) is the pose of each joint in its parent at zero angle, its z the axis.

    ``X_LF`` the flange in the last joint's frame; limits (n,) rad and rad/s.
    """

    name: str
    joint_names: tuple[str, ...]
    stack: Array
    X_LF: Array
    position_lower: Array
    position_upper: Array
    velocity_limit: Array

    @property
    def n(self) -> int:
        """How many joints."""
        return len(self.stack)


def known_chains() -> tuple[str, ...]:
    """Names that `load_chain` accepts: the arms with a chain.yaml, and Universal Robots' by their own files."""
    return tuple(sorted({p.parent.name for p in _HERE.glob("*/chain.yaml")} | set(known_arms())))


def is_urdf(name: str) -> bool:
    """Return whether an arm's name is that of a URDF file."""
    return name.lower().endswith(".urdf")


def load_chain(name: str, kinematics: Path | None = None) -> Chain:
    """Return the arm of that name, or of a URDF file, as a chain.

    ``kinematics``: the file of one Universal Robots arm (see load_arm).

    Raises InputError naming the known ones, where its file is not one, or for ``kinematics`` of another arm.
    """
    if kinematics is not None and name not in known_arms():
        raise InputError(
            f"A kinematics file is for a Universal Robots arm ({', '.join(known_arms())}), not for {name!r}."
        )
    if is_urdf(name):
        if not Path(name).is_file():
            raise InputError(f"There is no file '{name}' of an arm.")
        from weldcal.models.arms.urdf_file import read_urdf_chain  # Drake's parser takes a third of a second to import

        return Chain(name=Path(name).name, **read_urdf_chain(Path(name))._asdict())
    if name in known_arms():
        return chain_of(load_arm(name, kinematics))
    path = _HERE / name / "chain.yaml"
    if name not in known_chains():
        listed = f"choose one of: {', '.join(known_chains())}."
        raise InputError(f"There is no arm {name!r}; {did_you_mean(name, known_chains(), listed)}")
    data: dict[str, Any] = yaml_load_file(str(path))
    joints = data["joints"]
    lower, upper, velocity = (np.array([float(j[key]) for j in joints]) for key in ("lower", "upper", "velocity"))
    return Chain(
        name=name,
        joint_names=tuple(str(j["name"]) for j in joints),
        stack=np.array([_pose(j) for j in joints]),
        X_LF=_pose(data["flange"]),
        position_lower=lower,
        position_upper=upper,
        velocity_limit=velocity,
    )


def chain_capsules(name: str) -> list[list[float]]:
    """Return the capsules in an arm's chain.yaml: link (0 the base), ends of the axis in its frame, radius, m."""
    return [[float(v) for v in row] for row in yaml_load_file(str(_HERE / name / "chain.yaml"))["capsules"]]


def chain_of(arm: ArmModel) -> Chain:
    """Return a Universal Robots arm with its own kinematics as a chain."""
    return Chain(
        name=arm.name,
        joint_names=arm.joint_names,
        stack=arm.stack,
        X_LF=np.eye(4),
        position_lower=arm.position_lower,
        position_upper=arm.position_upper,
        velocity_limit=arm.velocity_limit,
    )


def chain_forward(chain: Chain, q: ArrayLike) -> RigidTransform:
    """Flange pose X_BF at joint angles q (n,) rad."""
    X = joint_frames(chain.stack, np.asarray(q, dtype=float))[-1] @ chain.X_LF
    return RigidTransform(RotationMatrix(X[:3, :3]), X[:3, 3])


def chain_poses(chain: Chain, q: Array) -> Array:
    """Flange poses X_BF (N, 4, 4) at joint angles (N, n) rad."""
    c, s = np.cos(q), np.sin(q)
    X = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for i, joint in enumerate(chain.stack):
        turned = np.broadcast_to(joint, (len(q), 4, 4)).copy()
        turned[:, :, 0] = joint[:, 0] * c[:, i, None] + joint[:, 1] * s[:, i, None]
        turned[:, :, 1] = joint[:, 1] * c[:, i, None] - joint[:, 0] * s[:, i, None]
        X = X @ turned
    return np.asarray(X @ chain.X_LF)


def chain_jacobian(chain: Chain, q: ArrayLike) -> Array:
    """Geometric Jacobian (6, n) of the flange.

    [omega_BF; v_BF] = J qdot, in axes of B (Siciliano et al., 2009, Eq. 3.30).
    """
    X = joint_frames(chain.stack, np.asarray(q, dtype=float))
    p = (X[-1] @ chain.X_LF)[:3, 3]
    z = X[:, :3, 2]
    return np.vstack([z.T, np.cross(z, p - X[:, :3, 3]).T])


def chain_inverse(chain: Chain, X_BF: RigidTransform, near: ArrayLike | None = None, *, seed: int = 0) -> Array | None:
    """Joint angles (n,) rad within the limits that put the flange at X_BF, or None where none was found.

    Damped least squares (Nakamura and Hanafusa 1986) from ``near`` and from seeded starts within the limits. An arm
    with more than six joints has whole families of answers, of which this is one. None is no proof that there is none:
    the closed form of inverse.inverse_kinematics is, for Universal Robots' arms. Raises InputError where X_BF is not
    finite.
    """
    goal = X_BF.GetAsMatrix4()
    if not np.isfinite(goal).all():
        raise InputError("The flange pose must be finite to find joint angles for it.")
    lengths = np.linalg.norm(chain.stack[1:, :3, 3], axis=1).sum() + np.linalg.norm(chain.X_LF[:3, 3])
    if float(np.linalg.norm(goal[:3, 3] - chain.stack[0, :3, 3])) > lengths:
        return None  # farther than all links laid end to end
    rng = np.random.default_rng(seed)
    low, high = np.maximum(chain.position_lower, -np.pi), np.minimum(chain.position_upper, np.pi)
    starts = [] if near is None else [np.asarray(near, dtype=float)]
    starts += [0.5 * (low + high), *rng.uniform(low, high, (_STARTS, chain.n))]
    for start in starts:
        q = _descend(chain, goal, start)
        if q is not None:
            return q
    return None


def _descend(chain: Chain, goal: Array, start: Array) -> Array | None:
    q = np.clip(start, chain.position_lower, chain.position_upper)
    for _ in range(_STEPS):
        error = _error(chain, goal, q)
        size = float(np.linalg.norm(error))
        if size < RESIDUAL:
            return q
        J = chain_jacobian(chain, q)
        damping = min(_DAMPING, size * size)  # none left near the goal, so that the last steps are Newton's
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
        q = q + step * min(1.0, _MAX_STEP_RAD / max(float(np.abs(step).max()), 1e-12))
        q = np.clip(q, chain.position_lower, chain.position_upper)
    return None


def _error(chain: Chain, goal: Array, q: Array) -> Array:
    X = joint_frames(chain.stack, q)[-1] @ chain.X_LF
    turn = RotationMatrix(RotationMatrix.ProjectToRotationMatrix(goal[:3, :3] @ X[:3, :3].T)).ToAngleAxis()
    return np.concatenate([turn.axis() * turn.angle(), goal[:3, 3] - X[:3, 3]])


def _pose(row: dict[str, Any]) -> Array:
    x, y, z, *rpy = (float(row[k]) for k in _POSE_KEYS)
    X = np.eye(4)
    X[:3, :3] = RollPitchYaw(*rpy).ToRotationMatrix().matrix()
    X[:3, 3] = x, y, z
    return X
