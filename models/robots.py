"""Supported robots: flange, payload, reach, and the sources of their numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from pydrake.math import RigidTransform

from weldcal.models.arms.chain import is_urdf, load_chain
from weldcal.models.arms.kinematics import LINKS, Chain
from weldcal.models.documents import did_you_mean
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_ring, get_flange


@dataclass(frozen=True)
class BaseCircle:
    """Describe the upper face of the foot.

    ``standard`` has its outer and inner edge. ``X_BR`` is its pose in the base on the drawing. Frame R is as a
    flange's: origin at the circle's centre in the face, z out of the face.
    """

    standard: FlangeStandard
    X_BR: RigidTransform


# Outer diameter (m): base footprint in Universal Robots' user manuals (UR10e 190 mm, as UR5e 149 mm). Inner edge, where
# the column rises out of the foot, and height of the face: as the arm is drawn here (arms/urdf.py); measure them on
# another arm.
_FEET = {"ur10e": (0.190, 0.166, 0.014)}


def base_circle(arm: str) -> BaseCircle:
    """Return the base-mounting circle of that arm (flange paper, Fig. 14a).

    Raises InputError naming the arms whose foot is known.
    """
    if arm not in _FEET:
        raise InputError(f"The base circle of arm '{arm}' is not known: use one of {', '.join(_FEET)}.")
    outer, inner, height = _FEET[arm]
    ring = flange_ring(outer, inner, designation=f"{arm}-base-{1e3 * outer:.0f}", bore_depth_m=height, chamfer_m=0.0)
    return BaseCircle(ring, RigidTransform([0.0, 0.0, height]))


ISO_50, ISO_80 = "iso9409-1-50-4-m6", "iso9409-1-80-6-m8"

FACTS = ("flange", "dowel", "payload", "reach", "repeatability", "joint limits", "kinematics", "TCP")
"""What is stated of a robot, each with its source."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One robot. A fact that no public document states is None or empty, and ``sources`` does not name it.

    Attributes:
        name: as in a scenario.
        title: maker and model.
        joints: number of them.
        flange: ISO 9409-1 designation.
        dowel_deg: direction of the dowel hole about z of the tool frame (TCP at zero), from x.
        payload_kg: in the whole working range.
        reach_m: the maker's working radius.
        repeatability_m: of the pose, by ISO 9283.
        tcp: where its TCP is read.
        sources: document and section by entry of FACTS.
    """

    name: str
    title: str
    joints: int
    flange: str
    dowel_deg: float | None
    payload_kg: float
    reach_m: float
    repeatability_m: float | None
    tcp: str
    sources: Mapping[str, str]

    @property
    def standard(self) -> FlangeStandard:
        """The flange to look for. Its dowel hole is at 90 degrees for every robot: a calibration's axis turn is
        measured from there."""
        return get_flange(self.flange)

    @property
    def inverse(self) -> str:
        """Which joint angles `inverse_kinematics` finds."""
        return "all" if self.joints == len(LINKS) else "some"

    @cached_property
    def chain(self) -> Chain:
        """Kinematics and limits."""
        return load_chain(self.name)


def stated_flange(name: str, robot: str) -> FlangeStandard:
    """Return the flange of that designation; where none is named, the error names the one of the robot.

    Raises InputError: none is named, or it is not known.
    """
    known = ROBOTS.get(robot.lower())
    if name or known is None:
        return get_flange(name)
    raise InputError(
        f"No flange is named: did you mean that of the {known.name}? Add --flange {known.flange}, or write 'flange:"
        f" {known.flange}' in dataset.yaml."
    )


# A document that is not open as a whole was read as public repositories quote it.
_UR_MESH = "meshes of Universal_Robots_ROS2_Description, {}/visual/wrist3.dae"
_SCANS = "pattern of holes and dowel in the recorded scans"
_MODELS = "table of models in api-evangelist/universal-robots"
_HUB = "industrialroboticshub.com, Robot Tool Flange Sizes by Brand"
_ELSNER = "Elsner 2023, after the maker"


def _ur(
    model: str,
    numbers: tuple[float, float, float | None],
    sheet: str,
    mesh: str = "",
    designation: str = ISO_50,
    **sources: str,
) -> Robot:
    """Describe a robot of Universal Robots.

    Payload (kg), reach and repeatability (m) are from ``sheet`` but for what ``sources`` names. ``mesh`` shows the
    dowel hole at -y of the tool frame.
    """
    payload, reach, repeatability = numbers
    name = model.lower()
    stated = dict.fromkeys(("flange", "payload", "reach", "repeatability"), sheet) | sources
    if repeatability is None:
        del stated["repeatability"]
    if mesh:
        stated["dowel"] = _UR_MESH.format(mesh)
    stated["joint limits"] = (
        f"Universal_Robots_ROS2_Description, config/{name}/joint_limits.yaml; the elbow's 180 degrees are its choice"
    )
    stated["kinematics"] = "Universal Robots, DH parameters for calculations of kinematics and dynamics"
    stated["TCP"] = "User Manual UR5e, 10.4.2; Universal_Robots_Client_Library, rtde_output_recipe.txt"
    return Robot(
        name=name,
        title=f"Universal Robots {model}",
        joints=6,
        flange=designation,
        dowel_deg=270.0 if mesh else None,
        payload_kg=payload,
        reach_m=reach,
        repeatability_m=repeatability,
        tcp="pendant: Installation > General > TCP; RTDE: tcp_offset",
        sources=stated,
    )


def _franka(name: str, title: str, **sources: str) -> Robot:
    """Return a Franka arm. The maker's meshes disagree on the dowel hole (hand.dae: +x, link7.dae: +y)."""
    return Robot(
        name=name,
        title=title,
        joints=7,
        flange=ISO_50,
        dowel_deg=None,
        payload_kg=3.0,
        reach_m=0.855,
        repeatability_m=1e-4,
        tcp="libfranka: F_T_EE of RobotState",
        sources=sources
        | {
            "kinematics": "franka_description, robots/fer/kinematics.yaml; FCI documentation, Denavit-Hartenberg"
            " parameters",
            "joint limits": "FCI documentation, Robot and interface specifications",
            "TCP": "libfranka, RobotState; franka_ros, franka_model_interface.h",
        },
    )


ROBOTS: dict[str, Robot] = {
    robot.name: robot
    for robot in (
        _ur("UR3e", (3.0, 0.500, 3e-5), "User Manual UR3e, 2.1", "ur3e", flange="UR3e data sheet, Tool Flange"),
        _ur(
            "UR5",
            (5.0, 0.850, 1e-4),
            "UR5 Technical specifications, item 110105",
            flange="holes of the recorded scans' CAD",
            payload="User Manual UR5/CB3 3.4.5, appendix A",
        ),
        _ur("UR5e", (5.0, 0.850, 3e-5), "User Manual UR5e, 2.1", "ur5e", flange="User Manual UR5e, figure 4.2"),
        _ur("UR7e", (7.5, 0.850, 3e-5), "UR7e Technical Specification", "ur5e"),
        _ur(
            "UR10",
            (10.0, 1.300, 1e-4),
            "UR10 Technical specifications, item 110110",
            "ur10",
            flange=f"holes in {_UR_MESH.format('ur10')}",
        ),
        _ur(
            "UR10e",
            (12.5, 1.300, 5e-5),
            "UR10e Technical Specification, May 2025",
            "ur10e",
            flange="User Manual UR10e (SW 5.19), 8.7.5 Securing Tool",
            payload="UR10e Technical Specification, May 2025; 10 kg if the label says so (online manual, Maximum"
            " Payload)",
        ),
        _ur(
            "UR12e",
            (12.5, 1.300, 5e-5),
            _MODELS,
            "ur10e",
            flange=_HUB,
            repeatability="UR10e Technical Specification: by Universal_Robots_ROS2_Description, config/ur12e, the same"
            " arm",
        ),
        _ur("UR16e", (16.0, 0.900, 5e-5), "UR16e Technical Specification", "ur10e", flange=_HUB),
        _ur(
            "UR20",
            (20.0, 1.750, 1e-4),
            "UR20 Technical Specification",
            "ur20",
            designation=ISO_80,
            flange="User Manual UR20 (SW 5.21), 8.11.3 Securing Tool",
            payload="User Manual UR20 (SW 5.19), 2.1; 25 kg with the tool pointing down (2.2)",
        ),
        _ur(
            "UR30",
            (30.0, 1.300, None),
            _MODELS,
            "ur20",
            designation=ISO_80,
            flange="graspmonkey.de, ISO 9409-1, table of robots",
            payload="UR30 data sheet; 35 kg under the maker's conditions",
        ),
        _franka(
            "franka_panda",
            "Franka Emika Panda",
            flange=f"{_SCANS}; Franka Hand product manual 1.2 (DIN ISO 9409-1-A50)",
            payload=_ELSNER,
            reach=_ELSNER,
            repeatability=_ELSNER,
        ),
        _franka(
            "franka_fr3",
            "Franka Research 3",
            **dict.fromkeys(("flange", "payload", "reach", "repeatability"), "Datasheet Franka Research 3, R02212 2.6"),
        ),
        Robot(
            name="aubo_i5",
            title="AUBO i5",
            joints=6,
            flange=ISO_50,
            dowel_deg=90.0,
            payload_kg=5.0,
            reach_m=0.8865,
            repeatability_m=5e-5,
            tcp="",
            sources={
                "flange": _SCANS,
                "dowel": f"{_SCANS}; aubo_description, meshes/aubo_i5/visual/link6.DAE",
                "payload": "aubo_description, README: the number in the name",
                "reach": "sum of a2, a3 and d5 in aubo_description; AUBO i series product data",
                "repeatability": "AUBO i series product data",
                "joint limits": "aubo_description, README (175 degrees) and urdf/aubo_i5.urdf (speeds)",
                "kinematics": "aubo_description, urdf/aubo_i5.urdf",
            },
        ),
    )
}
"""Every robot known by name."""

CONTROLLER_MODELS: dict[str, tuple[str, int]] = {
    "ur3e": ("UR3", 3),
    "ur5": ("UR5", 1),
    "ur5e": ("UR5", 1),
    "ur7e": ("UR5", 1),
    "ur10": ("UR10", 2),
    "ur10e": ("UR10", 2),
    "ur12e": ("UR10", 2),
    "ur16e": ("UR16", 4),
    "ur20": ("UR20", 7),
    "ur30": ("UR30", 8),
}
"""What a Universal Robots controller calls its arm: `get robot model` of the dashboard, and robot_type of the primary
interface (numbers: RobotType of UniversalRobots/Universal_Robots_Client_Library). UR7e and UR12e are assumed to answer
as the UR5e and UR10e, or with their own names."""

ALIASES = {"franka": "franka_panda", "panda": "franka_panda", "fr3": "franka_fr3", "aubo": "aubo_i5"}
"""Shorter names that datasets use."""


def get_robot(name: str) -> Robot:
    """The robot of that name (`franka` is the Panda of the recorded data). Raises InputError naming the known ones."""
    key = name.strip().lower().replace("-", "_").replace(" ", "_")
    robot = ROBOTS.get(ALIASES.get(key, key))
    if robot is None:
        listed = f"use one of {', '.join(ROBOTS)}."
        raise InputError(f"Robot '{name}' is not known: {did_you_mean(key, (*ROBOTS, *ALIASES), listed)}")
    return robot


def get_chain(name: str) -> Chain:
    """Kinematics and limits of the robot of that name, or of a URDF file. Raises InputError naming the known ones."""
    return load_chain(name) if is_urdf(name) else get_robot(name).chain
