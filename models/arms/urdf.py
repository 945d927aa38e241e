"""Build an arm's URDF for Drake, with masses, limits and actuators, and the capsules and meshes of its links.

Shapes are drawn in the link frames from the nominal lengths and stop 6 mm short of the flange plane: the flange disc
itself is a mesh of its own, because calibration measures it. They are visual only; the capsules serve planning.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, extrude, revolve

FLANGE_DISC_M = 0.006  # the last millimetres before the flange plane, left to the flange's own mesh
WRIST_3_RADIUS_M = 0.045  # of the UR10e; see wrist_3_size
WRIST_3_LENGTH_M = 0.046

_BODY = (0.80, 0.81, 0.82)
_CAP = (0.35, 0.45, 0.55)
_SEAL = (0.13, 0.14, 0.15)
_COLOR_NAMES = {_BODY: "light_grey", _CAP: "blue_grey", _SEAL: "charcoal"}

# The lengths below are those of the UR10e's body, whose housings have these radii; another arm's grow with its own
# radii.
_BIG, _ELBOW, _WRIST = 0.076, 0.064, 0.0465
_SEAL_LENGTH, _SEAL_INSET = 0.004, 0.001
_DOME = 0.45  # height of a cap over its radius

_SEGMENTS = 192


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` (m) of the segment p_start to p_end (3,) m, in a link's frame.

    ``link_index`` counts as `link_frames` and `link_names` do: 0 the base, 6 wrist 3. A sphere has p_start = p_end.
    """

    link_index: int
    p_start: Array
    p_end: Array
    radius: float


@dataclass(frozen=True)
class _Solid:
    """A cylinder (along z of its frame) or an ellipsoid, posed in a link; `size` is radius and length, or semi-axes."""

    link: int
    kind: str
    center: tuple[float, float, float]
    rpy: tuple[float, float, float]
    size: tuple[float, ...]
    color: tuple[float, float, float]


def arm_urdf(arm: ArmModel, model_name: str | None = None) -> str:
    """URDF text of the arm: root link `base` (= frame B), six actuated joints, a massless link `flange` (= frame F).

    Feed it to `Parser.AddModelsFromString(text, "urdf")` and weld `base` where the robot stands. Joint origins come
    from the arm's own (nominal or calibrated) kinematics, so a plant's flange pose equals `forward_kinematics`.
    """
    robot = ET.Element("robot", {"name": model_name or arm.name, "xmlns:drake": "http://drake.mit.edu"})
    for color, name in _COLOR_NAMES.items():
        ET.SubElement(ET.SubElement(robot, "material", name=name), "color", rgba=_text((*color, 1.0)))
    solids = _solids(arm)
    r, h, m = arm.base_radius, arm.base_length, arm.base_mass
    across, about = m * (3.0 * r * r + h * h) / 12.0, m * r * r / 2.0
    inertials = [(m, np.array([0.0, 0.0, h / 2.0]), np.diag([across, across, about]))]
    inertials += list(zip(arm.masses, arm.centers_of_mass, arm.inertias, strict=True))
    for index, (name, inertial) in enumerate(zip(arm.link_names, inertials, strict=True)):
        link = ET.SubElement(robot, "link", name=name)
        _add_inertial(link, *inertial)
        for solid in solids:
            if solid.link == index:
                _add_visual(link, solid)
    ET.SubElement(robot, "link", name="flange")
    for index, name in enumerate(arm.joint_names):
        joint = ET.SubElement(robot, "joint", name=name, type="revolute")
        X = arm.stack[index]
        rpy = RollPitchYaw(RotationMatrix(X[:3, :3])).vector()
        ET.SubElement(joint, "origin", xyz=_text(X[:3, 3]), rpy=_text(rpy))
        ET.SubElement(joint, "parent", link=arm.link_names[index])
        ET.SubElement(joint, "child", link=arm.link_names[index + 1])
        ET.SubElement(joint, "axis", xyz="0 0 1")
        limit = {
            "lower": arm.position_lower,
            "upper": arm.position_upper,
            "velocity": arm.velocity_limit,
            "drake:acceleration": arm.acceleration_limit,
            "effort": arm.effort_limit,
        }
        ET.SubElement(joint, "limit", {key: repr(float(values[index])) for key, values in limit.items()})
        transmission = ET.SubElement(robot, "transmission", name=f"{name}_transmission")
        ET.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        ET.SubElement(transmission, "joint", name=name)
        ET.SubElement(transmission, "actuator", name=name)
    fixed = ET.SubElement(robot, "joint", name="flange_joint", type="fixed")
    ET.SubElement(fixed, "parent", link=arm.link_names[-1])
    ET.SubElement(fixed, "child", link="flange")
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


@dataclass(frozen=True)
class _Sizes:
    """Radii of an arm's housings, and its size by joint relative to the UR10e.

    Lengths of housings grow with their radii.
    """

    big: float
    mid: float
    small: float
    shoulder: float
    elbow: float
    wrist: float

    @staticmethod
    def of(arm: ArmModel) -> "_Sizes":
        """Return the sizes of an arm."""
        h = arm.housings
        return _Sizes(h.shoulder, h.elbow, h.wrist, h.shoulder / _BIG, h.elbow / _ELBOW, h.wrist / _WRIST)


def wrist_3_size(arm: ArmModel) -> tuple[float, float]:
    """Radius and length (m) of the last link's drawn body, behind the flange disc."""
    size = _Sizes.of(arm)
    free = arm.dh.d6 - size.small - FLANGE_DISC_M - _SEAL_LENGTH  # between the housing of wrist 2 and the flange disc
    return WRIST_3_RADIUS_M * size.wrist, min(WRIST_3_LENGTH_M * size.wrist, free)


def _column(arm: ArmModel, size: _Sizes) -> float:
    """Height (m) of the fixed column: below the housing of the shoulder's lift joint, which turns above it."""
    return min(0.094 * size.shoulder, arm.dh.d1 - size.big - _SEAL_LENGTH)


def link_capsules(arm: ArmModel) -> list[Capsule]:
    """Capsules (spheres included) that enclose the drawn body of every link, in link frames, for clearance checks."""
    upper, fore, shoulder, elbow = arm.dh.a2, arm.dh.a3, *arm.tube_offsets
    size = _Sizes.of(arm)
    b, m, w = size.shoulder, size.elbow, size.wrist
    big, mid, small = size.big + 0.004, size.mid + 0.004, size.small + 0.004
    foot_end = min(-0.075 * b, _column(arm, size) + 0.003 * b - arm.dh.d1 + 0.01)
    lift_start = min(shoulder - 0.08 * b, 0.108 * b)
    elbow_end = max(elbow + 0.06 * m, 0.5 * (shoulder + elbow) - 0.02 * m)
    rows: list[tuple[int, ArrayLike, ArrayLike, float]] = [
        (0, (0.0, 0.0, 0.01), (0.0, 0.0, 0.075 * b), 0.1 * b),
        (1, (0.0, 0.0, foot_end), (0.0, 0.0, 0.0), big),
        (1, (0.0, -0.08 * b, 0.0), (0.0, 0.08 * b, 0.0), big),
        (2, (0.0, 0.0, lift_start), (0.0, 0.0, shoulder + 0.08 * b), big),
        (2, (0.0, 0.0, shoulder), (upper, 0.0, shoulder), max(mid, arm.housings.upper_tube + 0.007 * b)),
        (2, (upper, 0.0, shoulder - 0.065 * m), (upper, 0.0, shoulder + 0.07 * m), mid),
        (3, (0.0, 0.0, elbow - 0.065 * m), (0.0, 0.0, elbow_end), mid),
        (3, (0.0, 0.0, elbow), (fore, 0.0, elbow), arm.housings.forearm_tube + 0.008),
        (3, (fore, 0.0, elbow - 0.055 * w), (fore, 0.0, elbow + 0.05 * w), small + 0.002),
        (4, (0.0, 0.0, -0.08 * w), (0.0, 0.0, 0.05 * w), small),
        (4, (0.0, 0.0, 0.0), (0.0, -0.06 * w, 0.0), small),
        (5, (0.0, 0.0, -0.055 * w), (0.0, 0.0, 0.05 * w), small),
        (5, (0.0, 0.0, 0.0), (0.0, 0.06 * w, 0.0), small),
    ]
    radius, length = wrist_3_size(arm)
    middle = (0.0, 0.0, -FLANGE_DISC_M - length / 2.0)
    rows.append((6, middle, middle, float(np.hypot(radius, length / 2.0))))
    return [Capsule(i, np.array(a, dtype=np.float64), np.array(b, dtype=np.float64), r) for i, a, b, r in rows]


def _solids(arm: ArmModel) -> list[_Solid]:
    """The drawn body: each joint has a housing on its axis, a seal where it turns, a domed cap at its blind end."""
    upper, fore, shoulder, elbow = arm.dh.a2, arm.dh.a3, *arm.tube_offsets
    size, tube_u, tube_f = _Sizes.of(arm), arm.housings.upper_tube, arm.housings.forearm_tube
    big, mid, small, b, m, w = size.big, size.mid, size.small, size.shoulder, size.elbow, size.wrist
    column = _column(arm, size)
    elbow_split = 0.5 * (shoulder + elbow)  # where forearm meets upper arm, along the elbow axis
    wrist_1_split = 0.5 * (elbow + arm.dh.d4) - 0.016 * w
    wrist_1_start = wrist_1_split - arm.dh.d4 + _SEAL_LENGTH
    wrist_2_start = -arm.dh.d5 / 2.0 + _SEAL_LENGTH
    wrist_3_radius, wrist_3_length = wrist_3_size(arm)
    wrist_3_start = -FLANGE_DISC_M - wrist_3_length
    wrist_2_end = arm.dh.d6 + wrist_3_start
    return [
        # Base: a foot, a step, the fixed half of the first joint.
        _rod(0, "z", (0.0, 0.0), 0.0, 0.014 * b, 0.095 * b, _BODY),
        _rod(0, "z", (0.0, 0.0), 0.014 * b, 0.030 * b, 0.083 * b, _BODY),
        _rod(0, "z", (0.0, 0.0), 0.030 * b, column, big, _BODY),
        _seal(0, "z", (0.0, 0.0), column, big),
        # Shoulder: upright housing turning into the one along the lift axis (-y carries the arm).
        _rod(1, "z", (0.0, 0.0), column + 0.003 * b - arm.dh.d1, 0.0, big, _BODY),
        _rod(1, "y", (0.0, 0.0), -0.085 * b, 0.070 * b, big, _BODY),
        _seal(1, "y", (0.0, 0.0), -0.088 * b, big),
        *_cap(1, "y", (0.0, 0.0), 0.070 * b, 1.0, big),
        # Upper arm: its own half of the lift joint, the tube with two collars, its half of the elbow.
        _rod(2, "z", (0.0, 0.0), 0.088 * b, shoulder + 0.070 * b, big, _BODY),
        *_cap(2, "z", (0.0, 0.0), shoulder + 0.070 * b, 1.0, big),
        _rod(2, "x", (0.0, shoulder), upper, 0.0, tube_u, _BODY),
        _rod(2, "x", (0.0, shoulder), -0.112 * b, -0.02 * b, tube_u + 0.005 * b, _BODY),
        _rod(2, "x", (0.0, shoulder), upper + 0.02 * m, upper + 0.098 * m, tube_u + 0.0025 * m, _BODY),
        _rod(2, "z", (upper, 0.0), elbow_split + _SEAL_LENGTH, shoulder + 0.062 * m, mid, _BODY),
        _seal(2, "z", (upper, 0.0), elbow_split, mid),
        *_cap(2, "z", (upper, 0.0), shoulder + 0.062 * m, 1.0, mid),
        # Forearm: elbow half, tube, and its half of wrist 1.
        _rod(3, "z", (0.0, 0.0), elbow - 0.055 * m, elbow_split, mid, _BODY),
        *_cap(3, "z", (0.0, 0.0), elbow - 0.055 * m, -1.0, mid),
        _rod(3, "x", (0.0, elbow), fore, 0.0, tube_f, _BODY),
        _rod(3, "x", (0.0, elbow), -0.098 * m, -0.02 * m, tube_f + 0.004 * m, _BODY),
        _rod(3, "z", (fore, 0.0), elbow - 0.048 * w, wrist_1_split, small + 0.0045 * w, _BODY),
        *_cap(3, "z", (fore, 0.0), elbow - 0.048 * w, -1.0, small + 0.0045 * w),
        _seal(3, "z", (fore, 0.0), wrist_1_split, small),
        # Wrists 1 and 2: an elbow pipe each.
        _rod(4, "z", (0.0, 0.0), wrist_1_start, 0.042 * w, small, _BODY),
        *_cap(4, "z", (0.0, 0.0), 0.042 * w, 1.0, small),
        _rod(4, "y", (0.0, 0.0), -arm.dh.d5 / 2.0, 0.0, small, _BODY),
        _seal(5, "z", (0.0, 0.0), wrist_2_start - _SEAL_LENGTH, small),
        _rod(5, "z", (0.0, 0.0), wrist_2_start, 0.042 * w, small, _BODY),
        *_cap(5, "z", (0.0, 0.0), 0.042 * w, 1.0, small),
        _rod(5, "y", (0.0, 0.0), 0.0, wrist_2_end - _SEAL_LENGTH, small, _BODY),
        _seal(5, "y", (0.0, 0.0), wrist_2_end - _SEAL_LENGTH, wrist_3_radius),
        # Wrist 3 ends where the flange disc begins.
        _rod(6, "z", (0.0, 0.0), wrist_3_start, -FLANGE_DISC_M, wrist_3_radius, _BODY),
    ]


_ALONG = {"x": (0.0, np.pi / 2, 0.0), "y": (np.pi / 2, 0.0, 0.0), "z": (0.0, 0.0, 0.0)}


def _at(axis: str, off_axis: tuple[float, float], along: float) -> tuple[float, float, float]:
    """Return the point at `along` on a line parallel to `axis` that passes the other two coordinates at `off_axis`."""
    a, b = off_axis
    return {"x": (along, a, b), "y": (a, along, b), "z": (a, b, along)}[axis]


def _rod(
    link: int,
    axis: str,
    off_axis: tuple[float, float],
    start: float,
    end: float,
    radius: float,
    color: tuple[float, float, float],
) -> _Solid:
    center = _at(axis, off_axis, 0.5 * (start + end))
    return _Solid(link, "cylinder", center, _ALONG[axis], (radius, end - start), color)


def _seal(link: int, axis: str, off_axis: tuple[float, float], start: float, radius: float) -> _Solid:
    return _rod(link, axis, off_axis, start, start + _SEAL_LENGTH, radius - _SEAL_INSET, _SEAL)


def _cap(
    link: int, axis: str, off_axis: tuple[float, float], start: float, sign: float, radius: float
) -> tuple[_Solid, _Solid]:
    """Return a low rim and a flat dome on the blind end of a housing, towards `sign` along `axis`."""
    rim = 0.1 * radius
    low, high = sorted((start, start + sign * rim))
    dome = (0.9 * radius, 0.9 * radius, 0.9 * radius * _DOME - rim)
    return (
        _rod(link, axis, off_axis, low, high, 0.955 * radius, _CAP),
        _Solid(link, "ellipsoid", _at(axis, off_axis, start + sign * rim), _ALONG[axis], dome, _CAP),
    )


def _add_inertial(link: ET.Element, mass: float, center: Array, inertia: Array) -> None:
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(center))
    ET.SubElement(inertial, "mass", value=repr(float(mass)))
    pairs = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: repr(float(inertia[ij])) for key, ij in pairs.items()})


def _add_visual(link: ET.Element, solid: _Solid) -> None:
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_text(solid.center), rpy=_text(solid.rpy))
    geometry = ET.SubElement(visual, "geometry")
    if solid.kind == "cylinder":
        radius, length = solid.size
        ET.SubElement(geometry, "cylinder", radius=repr(float(radius)), length=repr(float(length)))
    else:
        sizes = {key: repr(float(value)) for key, value in zip("abc", solid.size, strict=True)}
        ET.SubElement(geometry, "drake:ellipsoid", sizes)
    ET.SubElement(visual, "material", name=_COLOR_NAMES[solid.color])


def _text(values: ArrayLike) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values, dtype=np.float64))


def link_index(arm: ArmModel, link: str) -> int:
    """Index of a link of ``arm.link_names``, 0 the base. Raises InputError naming the links."""
    if link not in arm.link_names:
        raise InputError(f"The {arm.name} has no link '{link}': use one of {', '.join(arm.link_names[1:])}.")
    return arm.link_names.index(link)


def link_solids(arm: ArmModel, link: int) -> list[TriMesh]:
    """Return the closed solids that a link consists of, in its frame, m; they overlap.

    Cylinders and ellipsoids with the published radii and lengths: housings, tubes and caps, without screws and seams.
    """
    for element in ET.fromstring(arm_urdf(arm)).iter("link"):
        if element.get("name") == arm.link_names[link]:
            return [placed_solid(visual) for visual in element.iter("visual")]
    return []


def placed_solid(visual: ET.Element, mesh: TriMesh | None = None) -> TriMesh:
    """Return the closed solid of a URDF's visual or collision element, or its ``mesh``, in its link's frame, m."""
    origin, geometry = visual.find("origin"), visual.find("geometry")
    assert geometry is not None
    place = {} if origin is None else origin.attrib
    xyz, rpy = (np.array(place.get(key, "0 0 0").split(), dtype=np.float64) for key in ("xyz", "rpy"))
    return (mesh or _solid(geometry[0])).transformed(RigidTransform(RollPitchYaw(rpy), xyz))


def _solid(shape: ET.Element) -> TriMesh:
    if shape.tag == "box":
        x, y, z = (0.5 * float(v) for v in shape.get("size", "").split())
        return extrude(np.array([(-x, -y), (x, -y), (x, y), (-x, y)]), -z, z)
    if shape.tag == "cylinder":
        r, half = float(shape.get("radius", "0")), 0.5 * float(shape.get("length", "0"))
        return revolve(np.array([(0.0, -half), (r, -half), (r, half), (0.0, half)]), _SEGMENTS)
    a, c = (float(shape.get(key, shape.get("radius", "0"))) for key in "ac")
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)
    profile = np.column_stack([a * np.cos(angle), c * np.sin(angle)])
    profile[[0, -1], 0] = 0.0
    return revolve(profile, _SEGMENTS)
