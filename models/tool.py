"""The touch-based welding tool (paper, Fig. 7): plate with flange ring, finger camera, soft tip with tag, torch."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.optimize import brentq

from weldcal.models.arms.kinematics import LINKS
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange

if TYPE_CHECKING:
    from weldcal.models.tools.elastomers import Elastomer

RING = get_flange("tool-ring-63")
LAST_LINK = len(LINKS)  # the flange's link, counted as in kinematics.link_frames (0 is the base)

# z_F points out of the flange (down while welding); the ring, the tip frame and the torch all have their z up, against
# z_F.
R_FLIPPED = RollPitchYaw(np.pi, 0.0, 0.0).ToRotationMatrix()


@dataclass(frozen=True)
class Placed:
    """A pose that compares and travels: x, y, z in m and roll, pitch, yaw in rad about fixed axes."""

    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def pose(self) -> RigidTransform:
        """The pose."""
        return RigidTransform(RollPitchYaw(*self.rpy_rad), self.xyz_m)


@dataclass(frozen=True, kw_only=True)
class ToolShape:
    """A drawn body of a tool, on the flange.

    ``size`` m of a box (x, y, z), cylinder (radius, length along z), capsule (likewise), sphere (radius) or mesh (none:
    vertices and triangles are those of the file).
    """

    name: str
    kind: str
    size: tuple[float, ...]
    place: Placed
    colour: str = "dark"
    mesh: str = ""  # path of the file
    unit_m: float = 1.0  # of the file


class Seat(NamedTuple):
    """A loaded tip against a hard ball in the same groove, m.

    How far towards the wall it leans on, and how far below.
    """

    aside_m: float
    below_m: float


def flipped_where_it_is(X: RigidTransform) -> RigidTransform:
    """Return the pose with R_FLIPPED as its rotation where it differs from that by rounding only."""
    same = np.abs(X.rotation().matrix() - R_FLIPPED.matrix()).max() < 1e-12
    return RigidTransform(R_FLIPPED, X.translation()) if same else X


@dataclass(frozen=True, kw_only=True)
class WeldingTool:
    """Numbers of a tool, all in the flange frame F (m, rad, N, kg).

    The defaults are the welding tool of the paper's figure; a tool file gives the fields at the end, which replace what
    follows from the others (models/tools).

    The soft tip is a sphere on three springs (omni-directional, as the metamaterial finger of the paper). The tag rides
    on it and the finger camera looks at the tag along +z_F. The torch trails the tip by `chord_m` along -x_T.
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
    memory: "Elastomer | None" = None  # creep and loss of the springs; None: none
    tag_reach_m: float = 0.110  # p_FM along +z_F
    tag_size_m: float = 0.010
    tag_dictionary: str = "4X4_50"
    tag_id: int = 7
    camera_distance_m: float = 0.040  # from the finger camera's centre to the tag
    chord_m: float = 0.060  # |d| of Eq. 14
    torch_height_m: float = -0.0015  # z of the wire point in T
    torch_tilt_rad: float = 0.0  # how far the wire's axis leans back from the tip's, away from it
    stick_out_m: float | None = 0.012  # from the nozzle's end to the wire point, as drawn; None: not known
    nozzle_radius_m: float = 0.009
    mass_kg: float = 1.4
    centre_of_mass_m: tuple[float, float, float] = (0.03, 0.0, 0.05)
    ring: FlangeStandard | None = RING  # what the scanner measures; None: the arm's bare flange
    finger_radius_m: float = 0.0022  # of the drawn rod between tag and ball
    membrane_radius_m: float = 0.026  # of the soft disc that carries the tag
    tag_plate_m: float = 0.016  # side of the white plate under the tag's print
    ring_pose: Placed | None = None
    tip_pose: Placed | None = None  # of T
    camera_pose: Placed | None = None
    tag_pose: Placed | None = None  # of M, tip at rest
    shapes: tuple[ToolShape, ...] | None = None
    keep_clear: tuple[Capsule, ...] | None = None

    def wall_force(self, depth_m: float) -> float:
        """Force in N of a flat rigid wall that is pressed `depth_m` into the ball.

        The pressure in the soft ball grows linearly from nothing at its surface to the modulus at its centre
        (hydroelastic contact: Elandt et al., A pressure field model for fast, robust approximation of net contact force
        and moment between nominally rigid objects, IROS 2019). Its integral over the disc that the wall cuts out is 2
        pi E (d^2 / 2 - d^3 / (3 r)).
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

        The springs press it down and to the left; each wall answers along its own normal, for in a weld friction points
        along the groove. A soft ball gives way to each wall by its `indentation`.

        Raises:
            InputError: pressed aside so hard that the other wall holds nothing: it would climb out.
        """
        down = self.axial_stiffness_N_per_m * self.press_axial_m
        left = self.lateral_stiffness_N_per_m * self.press_lateral_m
        s, c = np.sin(self.groove_half_angle_rad), np.cos(self.groove_half_angle_rad)
        on_left, on_right = 0.5 * (down / s + left / c), 0.5 * (down / s - left / c)
        if on_right <= 0.0:
            raise InputError(
                f"A tip pressed {1e3 * self.press_lateral_m:.1f} mm aside and {1e3 * self.press_axial_m:.1f} mm down"
                " climbs out of its groove: take less welding.deflection_mm or more welding.axial_deflection_mm."
            )
        into_left, into_right = self.indentation(on_left), self.indentation(on_right)
        return Seat((into_left - into_right) / (2.0 * c), (into_left + into_right) / (2.0 * s))

    @property
    def seat_sink_m(self) -> float:
        """How far a loaded tip's centre lies below a hard ball's in the same groove, m."""
        return self.seat.below_m

    @cached_property
    def X_FT(self) -> RigidTransform:
        """Pose of the soft tip at rest: z_T up, x_T from the torch to the tip."""
        if self.tip_pose is not None:
            return flipped_where_it_is(self.tip_pose.pose)
        return RigidTransform(R_FLIPPED, [0.0, 0.0, self.tip_reach_m])

    @property
    def p_TW(self) -> Array:
        """Wire point of the torch in the tip frame (3,), m."""
        return np.array([-self.chord_m, 0.0, self.torch_height_m])

    def with_stick_out(self, stick_out_m: float) -> "WeldingTool":
        """The same tool with another length of wire out of its nozzle.

        Raises:
            InputError: its own stick-out is not known, or the torch would come too near to the tip.
        """
        if self.stick_out_m is None:
            raise InputError("A stick-out is ordered, and the tool file has none: write torch.stick_out_mm there.")
        more, tilt = stick_out_m - self.stick_out_m, self.torch_tilt_rad
        return replace(
            self,
            chord_m=self.chord_m - more * np.sin(tilt),
            torch_height_m=self.torch_height_m - more * np.cos(tilt),
            stick_out_m=stick_out_m,
            shapes=self.drawn(),
            keep_clear=tuple(self.capsules()),
        )

    @property
    def X_FR(self) -> RigidTransform:
        """Pose of the flange-like ring: its face looks back along -z_F, at a scanner above the cell.

        Raises:
            InputError: the tool has no ring.
        """
        if self.ring is None:
            raise InputError("This tool has no ring: write calibration.feature: flange in the scenario.")
        if self.ring_pose is not None:
            return self.ring_pose.pose
        return RigidTransform(R_FLIPPED, [self.ring_offset_m, 0.0, -self.ring_height_m])

    def capsules(self) -> list[Capsule]:
        """What must keep clear of the table and out of the line of sight, on the arm's last link (frame F)."""
        if self.keep_clear is not None:
            return list(self.keep_clear)
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
        if self.camera_pose is not None:
            return self.camera_pose.pose
        return RigidTransform(RotationMatrix.Identity(), [0.0, 0.0, self.tag_reach_m - self.camera_distance_m])

    @property
    def X_FM_rest(self) -> RigidTransform:
        """Pose of the tag while the tip is at rest: it faces the camera (OpenCV marker frame, z out of the print)."""
        if self.tag_pose is not None:
            return self.tag_pose.pose
        return RigidTransform(R_FLIPPED, [0.0, 0.0, self.tag_reach_m])

    @property
    def X_TM(self) -> RigidTransform:
        """Pose of the tag on the tip."""
        X_TM = self.X_FT.InvertAndCompose(self.X_FM_rest)
        straight = RigidTransform(
            [0.0, 0.0, self.tip_reach_m - self.tag_reach_m]
        )  # without the rounding of the product
        return straight if X_TM.IsNearlyEqualTo(straight, 1e-12) else X_TM

    def drawn(self) -> tuple[ToolShape, ...]:
        """Return the bodies on the flange, besides ring, finger and tag.

        Those of the tool's file, or those of the welding tool.
        """
        if self.shapes is not None:
            return self.shapes
        t, r, camera_z = self.plate_thickness_m, self.ring_offset_m, float(self.X_FK.translation()[2])
        p_FW = self.X_FT @ self.p_TW
        x, length = float(p_FW[0]), float(p_FW[2]) - 0.012 - t
        rows: list[tuple[str, tuple[float, ...], tuple[float, float, float], str]] = [
            ("mount", (0.0375, t), (0.0, 0.0, t / 2), "dark"),
            ("bar", (r, 0.064, t), (r / 2, 0.0, t / 2), "dark"),
            ("ring_base", (0.0375, t), (r, 0.0, t / 2), "dark"),
            ("camera", (0.026, 0.026, camera_z - 0.006 - t), (0.0, 0.0, t + (camera_z - 0.006 - t) / 2), "dark"),
        ]
        for side in (-1.0, 1.0):  # the frame that carries the soft metamaterial, outside the camera's view
            middle = (0.0, side * 0.034, (t + self.tag_reach_m) / 2)
            rows.append((f"post{side:+.0f}", (0.012, 0.004, self.tag_reach_m - t), middle, "dark"))
        rows += [
            ("torch_arm", (-x + 0.02, 0.03, t), (x / 2 - 0.01, 0.0, t / 2 + t), "dark"),
            ("torch_body", (0.009, length), (x, 0.0, t + length / 2), "copper"),
            ("torch_wire", (0.0006, 0.012), (x, 0.0, float(p_FW[2]) - 0.006), "steel"),
        ]
        kinds = {2: "cylinder", 3: "box"}
        return tuple(
            ToolShape(name=name, kind=kinds[len(size)], size=size, place=Placed(at), colour=colour)
            for name, size, at, colour in rows
        )

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
