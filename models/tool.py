"""The touch-based welding tool (paper, Fig. 7): plate with flange ring, finger camera, soft tip with tag, torch."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.optimize import brentq

from weldcal.models.arms.kinematics import LINKS
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LAST_LINK = len(LINKS)  # the flange's link, counted as in kinematics.link_frames (0 is the base)

# z_F points out of the flange (down while welding); the ring, the tip frame and the torch all have their z up, against z_F.
R_FLIPPED = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix()


class Seat(NamedTuple):
    """A loaded tip against a hard ball in the same groove, m: how far towards the wall it leans on, and how far below."""

    aside_m: float
    below_m: float


@dataclass(frozen=True)
class WeldingTool:
    """Numbers of the tool, all in the flange frame F (m, rad, N, kg).

    The soft tip is a sphere on three springs (omni-directional, as the metamaterial finger of the paper); the tag rides on
    it and the finger camera looks at the tag along +z_F. The torch trails the tip by `chord_m` along -x_T.
    """

    plate_thickness_m: float = 0.012
    ring_offset_m: float = 0.140  # p_FR along +x_F: far enough out that the wrist never hides it from above
    ring_height_m: float = 0.008  # the ring's face stands this far above the plate, towards the scanner
    tip_reach_m: float = 0.170  # p_FT along +z_F, tip at rest
    tip_radius_m: float = 0.0025
    tip_modulus_Pa: float = 1e7  # hydroelastic modulus of the soft tip
    press_axial_m: float = 0.003  # how hard it is pressed into the groove, and against its left wall
    press_lateral_m: float = 0.002
    groove_half_angle_rad: float = np.deg2rad(22.5)
    tip_mass_kg: float = 0.005
    lateral_stiffness_N_per_m: float = 600.0
    axial_stiffness_N_per_m: float = 300.0
    damping_N_s_per_m: float = 3.0
    tag_reach_m: float = 0.110  # p_FM along +z_F
    tag_size_m: float = 0.010
    tag_dictionary: str = "4X4_50"
    tag_id: int = 7
    camera_distance_m: float = 0.040  # from the finger camera's centre to the tag
    chord_m: float = 0.060  # |d| of Eq. 14
    torch_height_m: float = -0.0015  # z of the wire point in T
    mass_kg: float = 1.4

    def wall_force(self, depth_m: float) -> float:
        """Force in N of a flat rigid wall that is pressed `depth_m` into the ball.

        The pressure in the soft ball grows linearly from nothing at its surface to the modulus at its centre (hydroelastic
        contact: Elandt et al., A pressure field model for fast, robust approximation of net contact force and moment
        between nominally rigid objects, IROS 2019). Its integral over the disc that the wall cuts out is
        2 pi E (d^2 / 2 - d^3 / (3 r)).
        """
        return 2.0 * np.pi * self.tip_modulus_Pa * (depth_m**2 / 2.0 - depth_m**3 / (3.0 * self.tip_radius_m))

    def indentation(self, force_N: float) -> float:
        """How deep that force presses a flat rigid wall into the ball, m, at most to its centre."""
        if force_N >= self.wall_force(self.tip_radius_m):
            return self.tip_radius_m
        return float(brentq(lambda depth: self.wall_force(depth) - force_N, 0.0, self.tip_radius_m))

    @property
    def seat(self) -> Seat:
        """Where the loaded tip rests in its V, against a hard ball in the same groove.

        The springs press it down and to the left; each wall answers along its own normal, for in a weld friction points along
        the groove. A soft ball gives way to each wall by its `indentation`.

        Raises:
            InputError: pressed aside so hard that the other wall holds nothing: it would climb out.
        """
        down = self.axial_stiffness_N_per_m * self.press_axial_m
        left = self.lateral_stiffness_N_per_m * self.press_lateral_m
        s, c = np.sin(self.groove_half_angle_rad), np.cos(self.groove_half_angle_rad)
        on_left, on_right = 0.5 * (down / s + left / c), 0.5 * (down / s - left / c)
        if on_right <= 0.0:
            raise InputError(
                f"A tip pressed {1e3 * self.press_lateral_m:.1f} mm aside and {1e3 * self.press_axial_m:.1f} mm down climbs out "
                "of its groove: take less welding.deflection_mm or more welding.axial_deflection_mm."
            )
        into_left, into_right = self.indentation(on_left), self.indentation(on_right)
        return Seat((into_left - into_right) / (2.0 * c), (into_left + into_right) / (2.0 * s))

    @property
    def seat_side_m(self) -> float:
        """How far a loaded tip's centre lies to the left of the groove's middle, m."""
        return self.seat.aside_m

    @property
    def seat_sink_m(self) -> float:
        """How far a loaded tip's centre lies below a hard ball's in the same groove, m."""
        return self.seat.below_m

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the soft tip at rest: z_T up, x_T from the torch to the tip."""
        return RigidTransform(R_FLIPPED, [0.0, 0.0, self.tip_reach_m])

    @property
    def p_TW(self) -> Array:
        """Wire point of the torch in the tip frame (3,), m."""
        return np.array([-self.chord_m, 0.0, self.torch_height_m])

    @property
    def X_FR(self) -> RigidTransform:
        """Pose of the flange-like ring: its face looks back along -z_F, at a scanner above the cell."""
        return RigidTransform(R_FLIPPED, [self.ring_offset_m, 0.0, -self.ring_height_m])

    def capsules(self) -> list[Capsule]:
        """What must keep clear of the table and out of the line of sight, on the arm's last link (frame F)."""
        p_FW = self.X_FT @ self.p_TW
        bar_z = 0.030  # low enough that the capsule's top does not rise above the ring that stands on the bar
        spans = [
            ([0.0, 0.0, bar_z], [self.ring_offset_m, 0.0, bar_z], 0.030),
            ([0.0, 0.0, 0.0], [0.0, 0.0, self.tag_reach_m], 0.040),
            ([0.0, 0.0, self.tag_reach_m], [0.0, 0.0, self.tip_reach_m], 0.006),
            ([p_FW[0], 0.0, 0.0], [p_FW[0], 0.0, float(p_FW[2])], 0.012),
        ]
        return [Capsule(LAST_LINK, np.array(a), np.array(b), radius) for a, b, radius in spans]

    @property
    def X_FK(self) -> RigidTransform:
        """Pose of the finger camera (optical frame: z along +z_F, x along +x_F)."""
        return RigidTransform(RotationMatrix.Identity(), [0.0, 0.0, self.tag_reach_m - self.camera_distance_m])

    @property
    def X_FM_rest(self) -> RigidTransform:
        """Pose of the tag while the tip is at rest: it faces the camera (OpenCV marker frame, z out of the print)."""
        return RigidTransform(R_FLIPPED, [0.0, 0.0, self.tag_reach_m])

    @property
    def X_KM_rest(self) -> RigidTransform:
        """Pose of the resting tag in the finger camera."""
        return self.X_FK.InvertAndCompose(self.X_FM_rest)


@dataclass(frozen=True)
class FingerCamera:
    """Pinhole intrinsics of the finger camera (OpenCV convention) and its timing."""

    width: int = 400  # the window that is read out of a 640 x 480 sensor: the tag and as far as it can move
    height: int = 300
    focal_px: float = 450.0
    rate_hz: float = 30.0
    latency_s: float = 0.040
    noise_grey: float = 2.0

    @property
    def camera_matrix(self) -> Array:
        """K (3, 3), pixels, centre of the first pixel at (0, 0)."""
        cx, cy = (self.width - 1) / 2.0, (self.height - 1) / 2.0
        return np.array([[self.focal_px, 0.0, cx], [0.0, self.focal_px, cy], [0.0, 0.0, 1.0]])
