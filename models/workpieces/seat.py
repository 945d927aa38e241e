"""Computes where the soft ball of the tip rests in a joint: pressed by springs against the walls it feels.

The joint is cut square to the seam: x to the left of the travel, y along the bisector of the walls, the origin at the
root. Derivation in docs/parts.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from scipy.optimize import root as find_root

from weldcal.models.errors import InputError

Floats = npt.NDArray[np.float64]

FLATTEST_RAD, NARROWEST_RAD = math.radians(150.0), math.radians(20.0)
LEAST_LEAN_M = 0.0005  # deflection against the wall below which contact and its loss cannot be told apart
MARGIN_M = 0.0004  # of a wall beyond the point at which the ball touches it
WIDEST_GAP = 1.4  # tip radii: into a wider gap the soft ball sinks past its edges
HELD_SHARE = 0.5  # of the sideways force that would lift the ball off its other wall
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


class SeatedTip(Protocol):
    """The numbers of the soft tip that its seat depends on; weldcal.models.tool.WeldingTool has them."""

    @property
    def tip_radius_m(self) -> float: ...
    @property
    def tip_modulus_Pa(self) -> float: ...
    @property
    def lateral_stiffness_N_per_m(self) -> float: ...
    @property
    def axial_stiffness_N_per_m(self) -> float: ...


class Seated(NamedTuple):
    """Centre of the loaded ball, m: to the left of the bisector through the root, and above the root along it."""

    aside_m: float
    above_m: float


class Press(NamedTuple):
    """How far the tip's rest point is driven past its seat, m: along the joint's bisector and to the left."""

    axial_m: float
    lateral_m: float


class TipApproach(NamedTuple):
    """How the tip is brought into a joint, m.

    How far to the left of the root it comes down (negative: to the right), and how much lower it then rests in the
    joint than where it lands.
    """

    aside_m: float
    drop_m: float


class JointNotWeldable(InputError):
    """The tip cannot feel this joint; the text names why."""


@dataclass(frozen=True)
class JointSection:
    """The joint's walls in the cut: one face on each side that leaves the root line.

    Attributes:
        half_angle_rad: between each wall and the bisector; pi/2 of level plates.
        left_m, right_m: extent of the walls from the root.
        gap_m: of level plates, between their edges.
    """

    half_angle_rad: float
    left_m: float
    right_m: float
    gap_m: float = 0.0

    def faces(self) -> tuple[Floats, Floats]:
        """Faces (M,2,2) as segments, and their normals (M,2) out of the material."""
        s, c = math.sin(self.half_angle_rad), math.cos(self.half_angle_rad)
        g = 0.5 * self.gap_m
        left, right = np.array([s, c]), np.array([-s, c])
        segments = [(g * np.array([1.0, 0.0]), g * np.array([1.0, 0.0]) + self.left_m * left)]
        segments += [(g * np.array([-1.0, 0.0]), g * np.array([-1.0, 0.0]) + self.right_m * right)]
        normals = [np.array([-c, s]), np.array([c, s])]
        if self.gap_m > 0.0:  # the plates' edges below
            segments += [(np.array([side * g, 0.0]), np.array([side * g, -0.05])) for side in (1.0, -1.0)]
            normals += [np.array([-1.0, 0.0]), np.array([1.0, 0.0])]
        return np.array(segments), np.array(normals)


def contact_angle(section: JointSection, radius_m: float) -> float:
    """Half the angle between the walls as the ball feels them, rad: of a gap that of the tangents at its two edges."""
    if section.gap_m > 0.0:
        return math.acos(min(1.0, 0.5 * section.gap_m / radius_m))
    return section.half_angle_rad


def hard_height(section: JointSection, radius_m: float) -> float:
    """Height of a hard ball's centre above the root, m.

    Radius / sin(half angle), over a gap sqrt(radius^2 - (gap/2)^2).
    """
    if section.gap_m > 0.0:
        return math.sqrt(max(0.0, radius_m**2 - (0.5 * section.gap_m) ** 2))
    return radius_m / math.sin(section.half_angle_rad)


def check_weldable(section: JointSection, radius_m: float) -> None:
    """Check that a ball of this radius sits on both walls of the joint.

    Raises:
        JointNotWeldable: the ball falls through the gap or is too large, a wall ends below the ball, or the walls open
            too far or too little.
    """
    r, mm = radius_m, 1e3
    if section.gap_m > 0.0:
        if section.gap_m > WIDEST_GAP * r:
            raise JointNotWeldable(
                f"A tip of radius {mm * r:.3g} mm falls through a gap of {mm * section.gap_m:.3g} mm: use a larger tip"
                f" or close the gap to {mm * WIDEST_GAP * r:.2g} mm or less."
            )
        sinks = r - math.sqrt(r**2 - 0.25 * section.gap_m**2)
        if min(section.left_m, section.right_m) < sinks + MARGIN_M:
            raise JointNotWeldable(
                f"A tip of radius {mm * r:.3g} mm sinks {mm * sinks:.2g} mm into a gap of {mm * section.gap_m:.3g} mm"
                " and touches the ground, because the plates are thinner. Use a larger tip or a narrower gap."
            )
    elif section.half_angle_rad > 0.5 * math.radians(176.0):
        raise JointNotWeldable("The plates meet without a gap: there is nothing the tip could feel; leave a gap.")
    opening = 2.0 * contact_angle(section, r)
    if opening > FLATTEST_RAD:
        what = "gap is too narrow" if section.gap_m > 0.0 else "walls are too flat"
        raise JointNotWeldable(
            f"The {what} to be felt: the tip touches it under {math.degrees(opening):.0f} deg, and at most "
            f"{math.degrees(FLATTEST_RAD):.0f} deg hold it."
        )
    if opening < NARROWEST_RAD:
        raise JointNotWeldable(
            f"The joint opens only {math.degrees(opening):.0f} deg: the tip needs at least"
            f" {math.degrees(NARROWEST_RAD):.0f} deg."
        )
    if section.gap_m > 0.0:
        return
    needed = r / math.tan(section.half_angle_rad) + MARGIN_M
    for side, extent in (("left", section.left_m), ("right", section.right_m)):
        if extent < needed:
            raise JointNotWeldable(
                f"A tip of radius {mm * r:.3g} mm is too large for this joint: it needs walls of"
                f" {mm * needed:.3g} mm, and the {side} wall ends {mm * extent:.3g} mm from the root."
            )


def press_for(
    section: JointSection, tip: SeatedTip, axial_m: float | None = None, lateral_m: float | None = None
) -> Press:
    """Return how deep the tip is pressed into this joint, m; a given value is used as it is.

    Pressed sideways by more than cot(half angle) of the downward force the ball would climb its wall. Half of that is
    taken, at most 2 mm, and in wide joints the downward press is increased.

    Raises:
        JointNotWeldable: even so the lean is too small to be told from none, or what was given lets it climb out.
    """
    slope = 1.0 / math.tan(contact_angle(section, tip.tip_radius_m))
    ratio = tip.axial_stiffness_N_per_m / tip.lateral_stiffness_N_per_m
    for axial in (0.003, 0.004, 0.005) if axial_m is None else (axial_m,):
        most = axial * ratio * slope
        if lateral_m is not None:
            if lateral_m < 0.9 * most or axial == 0.005:
                break
            continue
        if HELD_SHARE * most >= 0.001:
            break
    lateral = min(0.002, HELD_SHARE * most) if lateral_m is None else lateral_m
    if lateral >= most:
        raise JointNotWeldable(
            f"A tip pressed {1e3 * lateral:.1f} mm aside and {1e3 * axial:.1f} mm down climbs out of its joint: take"
            " less welding.deflection_mm or more welding.axial_deflection_mm."
        )
    if lateral < LEAST_LEAN_M:
        raise JointNotWeldable(
            f"The tip can press only {1e3 * lateral:.2f} mm against the wall of this joint before it climbs out. That"
            " is too little to be felt: use a smaller tip or a wider gap."
        )
    return Press(axial, lateral)


def seat(section: JointSection, tip: SeatedTip, press: Press) -> Seated:
    """Where the ball of the tip rests, pressed left and down by its springs.

    The pressure in the soft ball grows linearly from its surface to the modulus at its centre (Elandt et al., IROS
    2019). Each rigid face answers with its integral over what it cuts out of the ball, along its own normal.

    Raises:
        JointNotWeldable: no such place: the ball climbs out.
    """
    down = tip.axial_stiffness_N_per_m * press.axial_m
    left = tip.lateral_stiffness_N_per_m * press.lateral_m
    segments, normals = section.faces()
    r, modulus = tip.tip_radius_m, tip.tip_modulus_Pa
    load = np.array([left, -down])

    def unbalanced(at: Floats) -> Floats:
        return np.asarray((face_forces(at * 1e-3, segments, normals, r, modulus) + load) / math.hypot(left, down))

    start = hard_height(section, r)
    for sunk in (0.05, 0.1, 0.2, 0.02):
        found = find_root(unbalanced, 1e3 * np.array([0.3 * sunk * r, start - sunk * r]), tol=1e-10)
        if found.success and np.linalg.norm(found.fun) < 1e-6:
            return Seated(float(found.x[0]) * 1e-3, float(found.x[1]) * 1e-3)
    raise JointNotWeldable("The tip finds no rest in this joint: press it less to the side or more into the joint.")


def face_forces(centre: Floats, segments: Floats, normals: Floats, radius_m: float, modulus_Pa: float) -> Floats:
    """Force (2,) N of rigid faces (M,2,2), long along the seam, on a soft ball at a point (2,) of the cut.

    A strip of a face at distance p from the centre meets the ball over 2 l, l^2 = r^2 - p^2, with the pressure
    E (1 - sqrt(p^2 + z^2) / r). Its integral over z is E (l - p^2 asinh(l / p) / r).
    """
    a, d = segments[:, 0] - centre, segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(d, axis=1)
    along = d / length[:, None]
    foot = -np.sum(a * along, axis=1)
    off = -np.sum(a * normals, axis=1)  # height of the centre over the face
    half = np.sqrt(np.maximum(radius_m**2 - off**2, 0.0))
    low, high = np.clip(foot - half, 0.0, length), np.clip(foot + half, 0.0, length)
    low, high = np.where(off > -radius_m, low, 0.0), np.where(off > -radius_m, high, 0.0)
    u = 0.5 * (high + low)[:, None] + 0.5 * (high - low)[:, None] * _NODES[None]
    p = np.sqrt((u - foot[:, None]) ** 2 + off[:, None] ** 2)
    across = np.sqrt(np.maximum(radius_m**2 - p**2, 0.0))
    strip = modulus_Pa * (across - p**2 * np.arcsinh(across / np.maximum(p, 1e-12)) / radius_m)
    force = 0.5 * (high - low) * (strip @ _WEIGHTS)
    return np.asarray(force @ normals)
