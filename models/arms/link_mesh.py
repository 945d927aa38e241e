"""Surfaces of an arm's links as meshes, from the solids of its description."""

import xml.etree.ElementTree as ET

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.urdf import arm_urdf
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, revolve

_SEGMENTS = 192


def link_index(arm: ArmModel, link: str) -> int:
    """Index of a link of ``arm.link_names``, 0 the base. Raises InputError naming the links."""
    if link not in arm.link_names:
        raise InputError(f"The {arm.name} has no link '{link}': use one of {', '.join(arm.link_names[1:])}.")
    return arm.link_names.index(link)


def link_solids(arm: ArmModel, link: int) -> list[TriMesh]:
    """The closed solids that a link consists of, in its frame, m; they overlap.

    Cylinders and ellipsoids with the published radii and lengths: housings, tubes and caps, without screws and seams.
    """
    for element in ET.fromstring(arm_urdf(arm)).iter("link"):
        if element.get("name") == arm.link_names[link]:
            return [_placed(visual) for visual in element.iter("visual")]
    return []


def _placed(visual: ET.Element) -> TriMesh:
    origin, geometry = visual.find("origin"), visual.find("geometry")
    assert origin is not None
    assert geometry is not None
    xyz, rpy = (np.array(origin.get(key, "0 0 0").split(), dtype=np.float64) for key in ("xyz", "rpy"))
    return _solid(geometry[0]).transformed(RigidTransform(RollPitchYaw(rpy), xyz))


def _solid(shape: ET.Element) -> TriMesh:
    if shape.tag == "cylinder":
        r, half = float(shape.get("radius", "0")), 0.5 * float(shape.get("length", "0"))
        return revolve(np.array([(0.0, -half), (r, -half), (r, half), (0.0, half)]), _SEGMENTS)
    a, c = (float(shape.get(key, "0")) for key in "ac")
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)
    profile = np.column_stack([a * np.cos(angle), c * np.sin(angle)])
    profile[[0, -1], 0] = 0.0
    return revolve(profile, _SEGMENTS)
