"""Reads the kinematics of a serial arm from a URDF: its revolute joints from base to flange."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RevoluteJoint, RigidBody

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, read_text

BASES, FLANGES = ("base", "base_link"), ("tool0", "flange", "ee_link", "link_ee", "hand", "tool_link")
"""Names of links that are taken for base and flange, the first that is there; otherwise the root, and the end of the
chain."""
UNLIMITED_RAD = 2.0 * np.pi  # of a continuous joint
_PICTURES = ("visual", "collision")


class UrdfChain(NamedTuple):
    """Joints from base to flange.

    Names, ``stack`` (n, 4, 4) pose of each in its parent at zero (its z the axis), flange in the last joint's frame (4,
    4), limits (n,) rad and rad/s.
    """

    joint_names: tuple[str, ...]
    stack: Array
    X_LF: Array
    position_lower: Array
    position_upper: Array
    velocity_limit: Array


def read_urdf_chain(path: Path) -> UrdfChain:
    """Return the chain of a URDF file; meshes are not needed.

    The base is a link named `base` (as a UR controller means it) or `base_link`, else the root. The flange is `tool0`
    or `flange` (z out of it), else the last link.

    Raises:
        InputError: the file cannot be read, or is no serial arm of revolute joints.
    """
    try:
        robot = ET.fromstring(read_text(path, LARGEST_DOCUMENT))
    except ET.ParseError as error:
        raise InputError(f"'{path.name}' is not XML: {error}; make a URDF of a xacro file with xacro first.") from error
    if robot.tag != "robot" or any("xacro" in (e.tag if isinstance(e.tag, str) else "") for e in robot.iter()):
        raise InputError(f"'{path.name}' is no URDF: make one of a xacro file with xacro first.")
    for link in robot.iter("link"):
        for picture in [e for e in link if e.tag in _PICTURES]:
            link.remove(picture)  # kinematics needs no meshes, whose files may not be here
    plant = MultibodyPlant(time_step=0.0)
    try:
        (model,) = Parser(plant).AddModelsFromString(ET.tostring(robot, encoding="unicode"), "urdf")
        above = {plant.get_joint(i).child_body().name(): plant.get_joint(i) for i in plant.GetJointIndices(model)}
        bodies = {plant.get_body(i).name(): plant.get_body(i) for i in plant.GetBodyIndices(model)}
        for name in bodies.keys() - above.keys():
            plant.WeldFrames(plant.world_frame(), bodies[name].body_frame())
        plant.Finalize()
    except Exception as error:  # Drake raises RuntimeError for most, and other types
        raise InputError(f"'{path.name}' cannot be read as a URDF: {' '.join(str(error).split())[:200]}") from error
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
    low, high = (
        np.array([float(v(j)[0]) for j in joints]) for v in (Joint.position_lower_limits, Joint.position_upper_limits)
    )
    speed = np.array([float(j.velocity_upper_limits()[0]) for j in joints])
    return UrdfChain(
        tuple(j.name() for j in joints),
        np.array(stack),
        X_LF.GetAsMatrix4(),
        np.where(np.isfinite(low), low, -UNLIMITED_RAD),
        np.where(np.isfinite(high), high, UNLIMITED_RAD),
        np.where(np.isfinite(speed), speed, np.pi),
    )


def _base(bodies: dict[str, RigidBody], above: dict[str, Joint]) -> str:
    named = next((name for name in BASES if name in bodies), "")
    roots = [name for name in bodies if name not in above or above[name].parent_body().name() not in bodies]
    return named or roots[0]


def _flange(path: Path, bodies: dict[str, RigidBody], above: dict[str, Joint]) -> str:
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


def _between(path: Path, base: str, flange: str, above: dict[str, Joint]) -> list[RevoluteJoint]:
    """Return the revolute joints from the base's root to the flange; fixed joints are passed."""
    found: list[RevoluteJoint] = []
    name = flange
    while name in above and name != base:
        joint = above[name]
        if isinstance(joint, RevoluteJoint):
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
