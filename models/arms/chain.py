"""Read a serial arm of revolute joints by its name, or from a URDF."""

import xml.etree.ElementTree as ET
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arms.kinematics import POSE_KEYS, Chain, known_arms, load_arm, pose_matrix
from weldcal.models.documents import did_you_mean, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, read_text

_HERE = Path(__file__).resolve().parent
BASES, FLANGES = ("base", "base_link"), ("tool0", "flange", "ee_link", "link_ee", "hand", "tool_link")
"""Names of links that are taken for base and flange, the first that is there; otherwise the root, and the end of the
chain."""
UNLIMITED_RAD = 2.0 * np.pi  # of a continuous joint
PICTURES = ("visual", "collision")
"""Elements of a URDF's link that hold its shape, the finer one first."""


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
        return load_arm(name, kinematics)
    path = _HERE / name / "chain.yaml"
    if name not in known_chains():
        listed = f"choose one of: {', '.join(known_chains())}."
        raise InputError(f"There is no arm {name!r}; {did_you_mean(name, known_chains(), listed)}")
    data: dict[str, Any] = read_document(path)
    joints = data["joints"]
    lower, upper, velocity = (np.array([float(j[key]) for j in joints]) for key in ("lower", "upper", "velocity"))
    return Chain(
        name=name,
        joint_names=tuple(str(j["name"]) for j in joints),
        stack=np.array([pose_matrix([float(j[k]) for k in POSE_KEYS]) for j in joints]),
        X_LF=pose_matrix([float(data["flange"][k]) for k in POSE_KEYS]),
        position_lower=lower,
        position_upper=upper,
        velocity_limit=velocity,
    )


def chain_capsules(name: str) -> list[list[float]]:
    """Return the capsules in an arm's chain.yaml: link (0 the base), ends of the axis in its frame, radius, m."""
    return [[float(v) for v in row] for row in read_document(_HERE / name / "chain.yaml")["capsules"]]


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
        file=path,
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


def urdf_links(path: Path, q: ArrayLike) -> list[tuple[ET.Element, RigidTransform, int]]:
    """All links of a URDF file with their poses X_BL, at the angles q (n,) rad of its chain, other joints at zero.

    The third entry is how many joints of the chain carry the link: 0 for the base.

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
    found = []
    for e in robot.iter("link"):
        name = carrier = e.get("name", "")
        while carrier in above and above[carrier] not in joints:
            carrier = above[carrier].parent_body().name()
        carried = joints.index(above[carrier]) + 1 if carrier in above else 0
        found.append((e, X_BW @ bodies[name].EvalPoseInWorld(context), carried))
    return found


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
