"""The touch-based welding tool of Fig. 7: plate with a flange-like ring, finger camera, soft tip with its tag, torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.models.arms.kinematics import LINKS
from weldcal.models.arms.urdf import Capsule

Array = NDArray[np.float64]
LAST_LINK = len(LINKS)  # the flange's link, counted as in kinematics.link_frames (0 is the base)

# z_F points out of the flange (down while welding); the ring, the tip frame and the torch all have their z up, against z_F.
R_FLIPPED = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix()


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
    # Where the loaded tip is felt, by its tag, in the groove: below a hard ball's seat and towards the wall it leans on. Indentation
    # and the tag's own bias are in it, so it is calibrated once, on a straight groove in a known place (test_soft_tip.py).
    seat_sink_m: float = 0.00092
    seat_side_m: float = 0.00005
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
