"""A serial arm of revolute joints, of our files or a URDF: forward and inverse kinematics, and Jacobian."""

import xml.etree.ElementTree as ET
from copy import deepcopy
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
from weldcal.models.files import LARGEST_DOCUMENT, read_text

RESIDUAL = 1e-9  # m and rad: what a returned solution fulfils
_HERE = Path(__file__).resolve().parent
_POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_DAMPING = 1e-3
_STEPS = 150
_STARTS = 24
_MAX_STEP_RAD = 0.5
BASES, FLANGES = ("base", "base_link"), ("tool0", "flange", "ee_link", "link_ee", "hand", "tool_link")
"""Names of links that are taken for base and flange, the first that is there; otherwise the root, and the end of the
chain."""
UNLIMITED_RAD = 2.0 * np.pi  # of a continuous joint
PICTURES = ("visual", "collision")
"""Elements of a URDF's link that hold its shape, the finer one first."""


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
        return read_urdf_chain(Path(name))
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


def read_urdf_chain(path: Path) -> Chain:
    """Return the chain of a URDF file; meshes are not needed.

    The base is a link named `base` (as a UR controller means it) or `base_link`, else the root. The flange is `tool0`
    or `flange` (z out of it), else the last link.

    Raises:
        InputError: the file cannot be read, or is no serial arm of revolute joints.
    """
    _, plant, bodies, above = _parsed(path)
    base, flange = _base(bodies, above), _flange(path, bodies, above)
    joints = _between(path, base, flange, above)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    X_WB = bodies[base].EvalPoseInWorld(context)
    stack, before = [], X_WB
    for joint in joints:
        axis = joint.frame_on_child().CalcPoseInWorld(context)
        z = np.asarray(joint.revolute_axis())
        turn = RotationMatrix() if z[2] > 1.0 - 1e-12 else RotationMatrix.MakeFromOneVector(z, 2)
        X = axis @ RigidTransform(turn, np.zeros(3))
        stack.append((before.inverse() @ X).GetAsMatrix4())
        before = X
    X_LF = before.inverse() @ bodies[flange].EvalPoseInWorld(context)
    low, high, speed = (
        np.array([float(getattr(j, limit)()[0]) for j in joints])
        for limit in ("position_lower_limits", "position_upper_limits", "velocity_upper_limits")
    )
    return Chain(
        name=path.name,
        joint_names=tuple(j.name() for j in joints),
        stack=np.array(stack),
        X_LF=X_LF.GetAsMatrix4(),
        position_lower=np.where(np.isfinite(low), low, -UNLIMITED_RAD),
        position_upper=np.where(np.isfinite(high), high, UNLIMITED_RAD),
        velocity_limit=np.where(np.isfinite(speed), speed, np.pi),
    )


def _parsed(path: Path) -> tuple[ET.Element, Any, dict[str, Any], dict[str, Any]]:
    """Return a URDF, Drake's plant of it without its pictures, its bodies and the joint above each, by name."""
    try:
        robot = ET.fromstring(read_text(path, LARGEST_DOCUMENT))
    except ET.ParseError as error:
        raise InputError(f"'{path.name}' is not XML: {error}; make a URDF of a xacro file with xacro first.") from error
    if robot.tag != "robot" or any("xacro" in (e.tag if isinstance(e.tag, str) else "") for e in robot.iter()):
        raise InputError(f"'{path.name}' is no URDF: make one of a xacro file with xacro first.")
    bare = deepcopy(robot)
    for link in bare.iter("link"):
        for picture in [e for e in link if e.tag in PICTURES]:
            link.remove(picture)  # kinematics needs no meshes, whose files may not be here
    # Drake's parser takes a third of a second to import
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(time_step=0.0)
    try:
        (model,) = Parser(plant).AddModelsFromString(ET.tostring(bare, encoding="unicode"), "urdf")
        above = {plant.get_joint(i).child_body().name(): plant.get_joint(i) for i in plant.GetJointIndices(model)}
        bodies = {plant.get_body(i).name(): plant.get_body(i) for i in plant.GetBodyIndices(model)}
        for name in bodies.keys() - above.keys():
            plant.WeldFrames(plant.world_frame(), bodies[name].body_frame())
        plant.Finalize()
    except Exception as error:  # Drake raises RuntimeError for most, and other types
        raise InputError(f"'{path.name}' cannot be read as a URDF: {' '.join(str(error).split())[:200]}") from error
    return robot, plant, bodies, above


def urdf_links(path: Path, q: ArrayLike) -> list[tuple[ET.Element, RigidTransform]]:
    """All links of a URDF file with their poses X_BL, at the angles q (n,) rad of its chain, other joints at zero.

    Raises InputError: see read_urdf_chain, or another number of angles.
    """
    robot, plant, bodies, above = _parsed(path)
    base, angles = _base(bodies, above), np.asarray(q, dtype=float)
    joints, context = _between(path, base, _flange(path, bodies, above), above), plant.CreateDefaultContext()
    if len(joints) != len(angles):
        raise InputError(f"'{path.name}' has {len(joints)} joints from base to flange, and {len(angles)} are given.")
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    for joint, angle in zip(joints, angles, strict=True):
        joint.set_angle(context, angle)
    X_BW = bodies[base].EvalPoseInWorld(context).inverse()
    return [(e, X_BW @ bodies[e.get("name", "")].EvalPoseInWorld(context)) for e in robot.iter("link")]


def _base(bodies: dict[str, Any], above: dict[str, Any]) -> str:
    named = next((name for name in BASES if name in bodies), "")
    roots = [name for name in bodies if name not in above or above[name].parent_body().name() not in bodies]
    return named or roots[0]


def _flange(path: Path, bodies: dict[str, Any], above: dict[str, Any]) -> str:
    named = next((name for name in FLANGES if name in bodies), "")
    if named:
        return named
    parents = {joint.parent_body().name() for joint in above.values()}
    ends = [name for name in bodies if name not in parents]
    if len(ends) != 1:
        raise InputError(
            f"'{path.name}' has {len(ends)} ends ({', '.join(ends[:4])}) and none is called {' or '.join(FLANGES[:2])}:"
            " name the link of the flange tool0, z out of its face."
        )
    return ends[0]


def _between(path: Path, base: str, flange: str, above: dict[str, Any]) -> list[Any]:
    """Return the revolute joints from the base's root to the flange; fixed joints are passed."""
    found: list[Any] = []
    name = flange
    while name in above and name != base:
        joint = above[name]
        if joint.type_name() == "revolute":
            found.append(joint)
        elif joint.num_positions():
            raise InputError(
                f"'{path.name}': joint '{joint.name()}' is {joint.type_name()}; only arms of revolute joints are known."
            )
        name = joint.parent_body().name()
    if len(found) < 3:
        raise InputError(
            f"'{path.name}' has {len(found)} revolute joints between '{base}' and '{flange}': an arm has three or more."
        )
    return found[::-1]
