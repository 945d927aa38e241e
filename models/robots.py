"""Supported robots: flange, payload, reach, and the sources of their numbers."""

import math
from dataclasses import dataclass

from pydrake.math import RigidTransform

from weldcal.models.arms.chain import Chain, is_urdf, load_chain
from weldcal.models.documents import did_you_mean
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_ring, get_flange


@dataclass(frozen=True)
class BaseCircle:
    """The upper face of the foot: ``standard`` says its outer and inner edge, ``X_BR`` (frame R as a flange's: origin
    at the circle's centre in the face, z out of it) where the drawing puts it in the base."""

    standard: FlangeStandard
    X_BR: RigidTransform


# Outer diameter (m): base footprint in Universal Robots' user manuals (UR10e 190 mm, as UR5e 149 mm). Inner edge, where
# the column rises out of the foot, and height of the face: as the arm is drawn here (arms/urdf.py); measure them on
# another arm.
_FEET = {"ur10e": (0.190, 0.166, 0.014)}


def base_circle(arm: str) -> BaseCircle:
    """The base-mounting circle of that arm (flange paper, Fig. 14a).

    Raises InputError naming the arms whose foot is known.
    """
    if arm not in _FEET:
        raise InputError(f"The base circle of arm '{arm}' is not known: use one of {', '.join(_FEET)}.")
    outer, inner, height = _FEET[arm]
    ring = flange_ring(outer, inner, designation=f"{arm}-base-{1e3 * outer:.0f}", bore_depth_m=height, chamfer_m=0.0)
    return BaseCircle(ring, RigidTransform([0.0, 0.0, height]))


ISO_50, ISO_80 = "iso9409-1-50-4-m6", "iso9409-1-80-6-m8"
CLOSED_FORM, NUMERIC = "closed form", "numeric"
"""How joint angles are found: every solution (arms.inverse), or one by iteration (arms.chain)."""

CATALOGUE = ("flange", "payload", "reach", "repeatability", "joint limits")
"""What a maker's data sheet says of a robot, beside its kinematics."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One robot.

    ``flange`` is its ISO 9409-1 designation, the dowel at ``pin_angle_rad``; payload kg, reach m (the maker's working
    radius), repeatability m; ``inverse`` says how its joint angles are found; ``source`` where the numbers are from.
    Joint limits and kinematics are the arm's own files (`chain`). ``confirmed`` holds which of CATALOGUE a public
    source bears out, and that source; what is not there is written from memory of the maker's data sheet.
    """

    name: str
    title: str
    joints: int
    flange: str
    pin_angle_rad: float
    payload_kg: float
    reach_m: float
    repeatability_m: float
    inverse: str
    source: str
    confirmed: tuple[tuple[str, str], ...] = ()

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """The entries of CATALOGUE that no public source was found for."""
        found = {what for what, _ in self.confirmed}
        return tuple(what for what in CATALOGUE if what not in found)

    @property
    def standard(self) -> FlangeStandard:
        """The flange to look for."""
        return get_flange(self.flange, pin_angle_rad=self.pin_angle_rad)

    @property
    def chain(self) -> Chain:
        """Kinematics and limits."""
        return load_chain(self.name)


_UR_E = "user manual, e-Series, technical specifications; kinematics: Universal Robots, DH parameters"
_UR_CB3 = "user manual, CB3, technical specifications; kinematics: Universal Robots, DH parameters (series 3)"
_UR_TWIN = (
    "technical specifications; kinematics: Universal Robots, ROS 2 description, as the predecessor of the same build"
)
_UR_LARGE = (
    "technical specifications (UR20, UR30: the smaller of two published payloads); kinematics: Universal Robots, DH"
    " parameters"
)
_RIGHT_ANGLE = math.pi / 2


_SCANS = "pattern of holes and dowel in the recorded scans and their CAD"
_DESCRIPTION = "ur_description (URDF of ROS-Industrial)"
_SERIES = "table of models in the API catalogue of Universal Robots (api-evangelist/universal-robots)"
_FLANGES = "graspmonkey.de, ISO 9409-1 (table of robots): UR20 and UR30 have ISO 9409-1-80-6-M8"
CONFIRMED: dict[str, tuple[tuple[str, str], ...]] = {
    "ur5": (
        ("flange", _SCANS),
        ("payload", "user manual UR5/CB3 3.4.5, appendix A: 5 kg"),
        ("joint limits", _DESCRIPTION),
    ),
    "ur5e": (("payload", "hardware manual UR5e 2022, chapter 9: 5 kg"), ("joint limits", _DESCRIPTION)),
    "ur7e": (("payload", _SERIES), ("reach", _SERIES), ("joint limits", _DESCRIPTION)),
    "ur10e": (
        ("flange", _SCANS),
        ("payload", "online manual UR10e, software 10.6, Maximum Payload: 10 or 12.5 kg, by the label on the arm"),
        ("reach", "the same page: work space of 1300 mm"),
    ),
    "ur12e": (("payload", _SERIES), ("reach", _SERIES), ("joint limits", _DESCRIPTION)),
    "ur16e": (("payload", _SERIES), ("reach", _SERIES), ("joint limits", _DESCRIPTION)),
    "ur20": (
        ("flange", _FLANGES),
        ("payload", "rocketfarm.no, UR20 cobot for palletizing: 20 kg (later labels say 25 kg)"),
        ("reach", "the same page: 1750 mm"),
        ("joint limits", _DESCRIPTION),
    ),
    "ur30": (("flange", _FLANGES), ("reach", _SERIES), ("joint limits", _DESCRIPTION)),
    "franka_panda": (
        ("flange", _SCANS),
        ("payload", "Elsner 2023, after the maker: 3 kg"),
        ("reach", "Elsner 2023: 0.855 m"),
        ("repeatability", "Elsner 2023: 0.1 mm"),
        ("joint limits", "FCI documentation, control parameters; the same in Elsner 2023"),
    ),
    "franka_fr3": (("joint limits", "franka_rust 0.1.14 on docs.rs, FrankaFR3"),),
    "aubo_i5": (
        ("flange", _SCANS),
        ("payload", "AUBO's aubo_description: the number in the name is the load in kg"),
        ("reach", "sum of the published a2, a3 and d5: 0.408 + 0.376 + 0.1025 m"),
        ("joint limits", "AUBO's aubo_description: 175 degrees either way"),
    ),
}
"""By robot: what of CATALOGUE could be looked up, and where."""


def _ur(
    name: str, title: str, payload: float, reach: float, repeatability: float, source: str, flange: str = ISO_50
) -> Robot:
    known = CONFIRMED.get(name, ())
    return Robot(
        name=name,
        title=title,
        joints=6,
        flange=flange,
        pin_angle_rad=_RIGHT_ANGLE,
        payload_kg=payload,
        reach_m=reach,
        repeatability_m=repeatability,
        inverse=CLOSED_FORM,
        source=source,
        confirmed=known,
    )


ROBOTS: dict[str, Robot] = {
    robot.name: robot
    for robot in (
        _ur("ur3e", "Universal Robots UR3e", 3.0, 0.500, 3e-5, _UR_E),
        _ur("ur5", "Universal Robots UR5", 5.0, 0.850, 1e-4, _UR_CB3),
        _ur("ur5e", "Universal Robots UR5e", 5.0, 0.850, 3e-5, _UR_E),
        _ur("ur7e", "Universal Robots UR7e", 7.5, 0.850, 3e-5, _UR_TWIN),
        _ur("ur10", "Universal Robots UR10", 10.0, 1.300, 1e-4, _UR_CB3),
        _ur("ur10e", "Universal Robots UR10e", 12.5, 1.300, 5e-5, _UR_E),
        _ur("ur12e", "Universal Robots UR12e", 12.5, 1.300, 5e-5, _UR_TWIN),
        _ur("ur16e", "Universal Robots UR16e", 16.0, 0.900, 5e-5, _UR_E),
        _ur("ur20", "Universal Robots UR20", 20.0, 1.750, 1e-4, _UR_LARGE, ISO_80),
        _ur("ur30", "Universal Robots UR30", 30.0, 1.300, 1e-4, _UR_LARGE, ISO_80),
        Robot(
            name="franka_panda",
            title="Franka Emika Panda",
            joints=7,
            flange=ISO_50,
            pin_angle_rad=math.pi,
            payload_kg=3.0,
            reach_m=0.855,
            repeatability_m=1e-4,
            inverse=NUMERIC,
            source=(
                "Franka Emika data sheet; limits: FCI documentation; kinematics: franka_description; dowel: the"
                " recorded scans' CAD"
            ),
            confirmed=CONFIRMED["franka_panda"],
        ),
        Robot(
            name="franka_fr3",
            title="Franka Research 3",
            joints=7,
            flange=ISO_50,
            pin_angle_rad=math.pi,
            payload_kg=3.0,
            reach_m=0.855,
            repeatability_m=1e-4,
            inverse=NUMERIC,
            source="Franka Research 3 data sheet; limits and kinematics: franka_description; dowel as on the Panda",
            confirmed=CONFIRMED["franka_fr3"],
        ),
        Robot(
            name="aubo_i5",
            title="AUBO i5",
            joints=6,
            flange=ISO_50,
            pin_angle_rad=_RIGHT_ANGLE,
            payload_kg=5.0,
            reach_m=0.8865,
            repeatability_m=5e-5,
            inverse=NUMERIC,
            source="AUBO i5 user manual (not confirmed by a second source); kinematics: AUBO's aubo_i5.urdf",
            confirmed=CONFIRMED["aubo_i5"],
        ),
    )
}
"""Every robot known by name; the ISO 9409-1 designation of each in one place."""

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
