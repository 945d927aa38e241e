"""The circle of a robot's base mounting: its standard and its pose in the base."""

from dataclasses import dataclass

from pydrake.math import RigidTransform

from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_ring


@dataclass(frozen=True)
class BaseCircle:
    """The upper face of the foot: ``standard`` says its outer and inner edge, ``X_BR`` (frame R as a flange's: origin at the
    circle's centre in the face, z out of it) where the drawing puts it in the base."""

    standard: FlangeStandard
    X_BR: RigidTransform


# Outer diameter (m): base footprint in Universal Robots' user manuals (UR10e 190 mm, as UR5e 149 mm). Inner edge, where the
# column rises out of the foot, and height of the face: as the arm is drawn here (arms/urdf.py); measure them on another arm.
_FEET = {"ur10e": (0.190, 0.166, 0.014)}


def base_circle(arm: str) -> BaseCircle:
    """The base-mounting circle of that arm (flange paper, Fig. 14a). Raises InputError naming the arms whose foot is known."""
    if arm not in _FEET:
        raise InputError(f"The base circle of arm '{arm}' is not known: use one of {', '.join(_FEET)}.")
    outer, inner, height = _FEET[arm]
    ring = flange_ring(outer, inner, designation=f"{arm}-base-{1e3 * outer:.0f}", bore_depth_m=height, chamfer_m=0.0)
    return BaseCircle(ring, RigidTransform([0.0, 0.0, height]))
