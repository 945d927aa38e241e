"""The schema of a scenario YAML: typed configuration of one cell; devices and jobs add their own keys."""

import dataclasses as dc
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.models.robots import get_robot
from weldcal.models.tools.loading import WELDING, LoadedTool, load_tool
from weldcal.systems.drivers.config import DriverConfig, NoDevice, ScannerConfig
from weldcal.welding.locate.planning import PlanningMethod
from weldcal.welding.passes.felt import WeldPass
from weldcal.welding.passes.stitch import StitchConfig
from weldcal.welding.record.order import WeldOrder
from weldcal.welding.record.process import WeldProcess
from weldcal.welding.record.schedule import WeldSchedule
from weldcal.welding.servo.weave import WeaveConfig, WeaveError

JobConfigOf = TypeVar("JobConfigOf")
Order = TypeVar("Order")
SI = {"_mm_s": ("_m_s", 1e-3), "_mm": ("_m", 1e-3), "_deg": ("_rad", math.pi / 180.0)}
"""Of a key's unit: that of the setting, and the factor."""
LONGEST_STAND_S = 10.0  # a choice: an arc that stands for longer burns through
FILE = {"file": True}
"""Metadata of a key that names a file: a relative path is looked for beside the scenario first."""


def in_si(order: object, kind: Callable[..., Order], **others: float | None) -> Order:
    """Return the settings of an order's keys of the same names, in SI units, with ``others`` beside them.

    Raises what ``kind`` raises for invalid ones.
    """
    known, found = inspect.signature(kind).parameters, dict(others)
    for name, value in vars(order).items():
        unit = next((u for u in SI if name.endswith(u)), "")
        si, factor = SI.get(unit, ("", 1.0))
        if (key := name.removesuffix(unit) + si) in known:
            found[key] = factor * value if unit and value is not None else value
    return kind(**found)


@dc.dataclass
class PoseConfig:
    """A pose in metres and degrees, roll-pitch-yaw about fixed axes."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])

    def pose(self) -> RigidTransform:
        """The pose as a RigidTransform."""
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz_m)


@dc.dataclass
class ToolFile:
    """A tool of one's own: see docs/tool.md."""

    file: str = dc.field(default="", metadata=FILE)
    # the tool that the simulated arm carries in truth, such as one with a bent torch; empty: that of `file`
    simulated: str = dc.field(default="", metadata=FILE)


@dc.dataclass
class ErrorConfig:
    """Deviations of the simulated world from the nominal one (drawn from the run's seed)."""

    translation_mm: float = 0.0
    rotation_deg: float = 0.0


@dc.dataclass(kw_only=True)
class CalibrationConfig:
    """The calibration: the feature, the poses and the stop criterion."""

    configuration: str = "eye_on_base"  # or eye_in_hand, eye_on_arm_target_on_flange, ..._on_base, co_manipulation
    feature: str = "tool_ring"  # tool_ring: the ring on the welding tool; flange: the bare flange
    # nominal X_BC (X_FC, X_LC), such as measured with a tape
    mounting_guess: PoseConfig = dc.field(default_factory=PoseConfig)
    guess_radius_mm: float = 60.0  # largest distance of the feature from its predicted position
    theta_max_deg: float = 25.0  # between the feature's normal and the line of sight
    # e_required, for the estimate's expected error at the work point; in a mounting job for its bound at 95 %
    required_error_mm: float = 0.10
    minimum_scans: int = 6
    maximum_scans: int = 10  # k_max, without the verification scans
    correct_scanner: bool = True  # estimate scale, gradient and bends of the scanner with X_BC
    # none, local, joints or links: as calibrate --refine, after the last scan; needs 10 scans (local) or 12
    refine: str = "none"
    verification_scans: int = 1
    verification_limit_mm: float = 0.5  # a larger error at a held-out pose holds the job
    table_z_m: float = 0.0  # height of the table in the world W, whose origin is the base where `base` is not given
    clearance_m: float = 0.05
    work_point_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.05])  # used where there is no workpiece


@dc.dataclass(kw_only=True)
class AnglesOrder:
    """Angles of the wire against the seam, as one number or as those at its start and end, and the stick-out."""

    # lean across the seam from the joint's bisector, the tool's left side up
    work_angle_deg: list[float] | float | int = 0.0
    # lean along the seam: push is positive, drag is negative; null: as the usual press of the tip gives it
    travel_angle_deg: list[float] | float | int | None = None
    # of the tool about the wire, the tip to the left; null: as the usual press of the tip gives it
    wire_rotation_deg: list[float] | float | int | None = None
    stick_out_mm: float | None = None  # from the nozzle's end to the wire point; null: that of the tool file

    def ends_rad(self, name: str) -> tuple[float, float] | None:
        """An angle at the seam's start and end, rad; raises InputError for a list that is not of two."""
        value = getattr(self, name)
        ends = value if isinstance(value, list) else [value]
        if len(ends) not in (1, 2):
            raise InputError(f"angles.{name} must hold one number or two, not {len(ends)}.")
        return None if value is None else (math.radians(ends[0]), math.radians(ends[-1]))


@dc.dataclass(kw_only=True)
class SeamConfig:
    """A seam on a part from a file: a polyline or edges."""

    # CSV of x,y,z[,nx,ny,nz] in the part's frame and unit
    polyline: str | None = dc.field(default=None, metadata=FILE)
    edges: list[int] = dc.field(default_factory=list)  # numbers from weldcal part FILE, in the order of travel
    direction: str = "forward"  # forward or reverse
    start_mm: float = 0.0  # cut off at the start
    end_mm: float = 0.0  # cut off at the end
    # true: the tip feels it; false: it is followed from the scan and the drawing; null: felt where a ball can feel it
    feel: bool | None = None
    angles: AnglesOrder | None = None  # null: welding.angles


@dc.dataclass(kw_only=True)
class WorkpieceConfig:
    """The nominal workpiece from its CAD, and the deviations of the true one."""

    shape: str = "s"  # s, straight or l; not used with a file
    # STEP, STL, OBJ or PLY of a part of your own
    file: str | None = dc.field(default=None, metadata=FILE)
    units: str | None = None  # of the file and its seams: mm, m or inch; null: the STEP file's own, mm for a mesh
    seams: list[SeamConfig] = dc.field(default_factory=list)  # of the file
    joint: str | None = None  # of the file: v_groove, butt, fillet or lap
    length_mm: float = 300.0
    pose_guess: PoseConfig = dc.field(default_factory=PoseConfig)  # nominal X_BP from the fixture's drawing
    bend_radius_mm: float | None = None  # bent over a cylinder of this radius, its axis across the plate
    located_by: str = "scan"  # scan: register the CAD to the scan; drawing: use the fixture's drawing
    placement_error: ErrorConfig = dc.field(default_factory=ErrorConfig)  # deviation of the plate on the fixture
    groove_error: ErrorConfig = dc.field(default_factory=ErrorConfig)  # deviation of the groove from the plate's datums
    # from this arc length on the true groove has no walls, which the scan does not show: contact is lost
    hole_from_mm: float | None = None


@dc.dataclass
class ObstacleConfig:
    """A part of the cell's surroundings that the arm must not touch: a box, or the surface in a mesh file."""

    name: str = ""  # in messages; empty: surroundings and a number
    box_m: list[float] | None = None  # length along x, y and z of a box about the origin of its pose
    mesh: str | None = dc.field(default=None, metadata=FILE)  # STEP, STL, OBJ or PLY file
    unit: str = "mm"  # of the mesh: mm, m or inch
    pose: PoseConfig = dc.field(default_factory=PoseConfig)  # in the robot's base
    margin_m: float = 0.02  # how far the arm keeps away


@dc.dataclass(kw_only=True)
class WeaveOrder:
    """The weave: the torch swings across the seam while the tip keeps its path."""

    shape: str = "sine"  # sine, triangle, trapezoid or crescent
    amplitude_mm: float = 2.0  # to each side, at most 8
    frequency_hz: float = 1.0  # swings a second, the dwells not counted, at most 5
    dwell_s: list[float] | float | int = 0.0  # rest at the sides: one number, or those of the left and the right
    # how far a crescent's sides lag behind its middle; negative: they lead; null: a quarter of the amplitude
    bow_mm: float | None = None
    plane_deg: float = 0.0  # tilt of the weave's plane about the seam, left side up; 0: square to the joint's bisector

    def weave(self) -> WeaveConfig:
        """The order as a WeaveConfig; raises WeaveError for an invalid one."""
        dwell = self.dwell_s if isinstance(self.dwell_s, list) else [float(self.dwell_s)]
        if len(dwell) not in (1, 2):
            raise WeaveError(f"welding.weave.dwell_s must hold one number or two, not {len(dwell)}.")
        return in_si(self, WeaveConfig, dwell_left_s=dwell[0], dwell_right_s=dwell[-1])


@dc.dataclass
class StitchOrder:
    """Stitches: the arc burns along pieces of the seam only."""

    on_mm: float = 30.0  # length of a piece; the seam's end may cut the last one to a half, a shorter rest is left out
    off_mm: float = 60.0  # from the end of a piece to the start of the next one
    from_mm: float = 0.0  # where the first piece starts, so that both sides of a web can be staggered
    # along: all in one motion along the seam; middle_out: each by a touch of its own, from the middle to both ends by
    # turns, so that the part bends evenly
    order: str = "along"

    def stitch(self) -> StitchConfig:
        """The order as a StitchConfig."""
        return in_si(self, StitchConfig)


@dc.dataclass(kw_only=True)
class PassOrder:
    """A pass: where its torch is beside the root's path, as the root pass has felt it."""

    lateral_mm: float = 0.0  # to the left of the root's travel, square to the joint's bisector
    vertical_mm: float = 0.0  # along the bisector, out of the joint
    angle_deg: float = 0.0  # lean of the tool across the seam, the left side up
    travel_angle_deg: float | None = None  # push is positive, drag is negative; null: as the lifted tip gives it
    speed_mm_s: float | None = None  # null: welding.speed_mm_s
    reverse: bool = False  # weld it from the seam's end to its start
    interpass_s: float = 0.0  # least time since the arc of the pass before went out

    def weld_pass(self) -> WeldPass:
        """The order as a WeldPass."""
        angle = self.travel_angle_deg
        return in_si(self, WeldPass, travel_rad=None if angle is None else math.radians(angle))


@dc.dataclass(kw_only=True)
class TackOrder:
    """A tack in the joint, over which the tip is lifted."""

    from_mm: float = 0.0  # along the seam
    to_mm: float = 0.0
    height_mm: float = 4.0  # of its top over the root
    seam: int = 1  # number of the seam, from 1


@dc.dataclass
class ArcConfig:
    """How the arc starts and ends."""

    # rest: the torch comes to rest on the seam's start before it is asked for; moving: it is asked for in passing;
    # null: rest where robot.arc_input is wired, else moving
    start: str | None = None
    start_s: float = 0.0  # how long the torch waits with the arc before it moves on, 0 to 10; needs start: rest
    crater_s: float = 0.0  # how long it waits at the seam's end before the arc goes out, 0 to 10

    def from_rest(self, reported: bool) -> bool:
        """Whether the arc starts with the torch at rest; `reported`: the power source reports the arc."""
        return self.start == "rest" or (self.start is None and reported)

    def check(self, reported: bool) -> None:
        """Raise InputError for another start, or for a time that cannot be stood."""
        if self.start not in (None, "rest", "moving"):
            raise InputError(f"welding.arc.start must be rest or moving, not '{self.start}'.")
        for name in ("start_s", "crater_s"):
            if not 0.0 <= getattr(self, name) <= LONGEST_STAND_S:
                raise InputError(
                    f"welding.arc.{name} must be from 0 to {LONGEST_STAND_S:g}, not {getattr(self, name):g}."
                )
        if self.start_s > 0.0 and not self.from_rest(reported):
            raise InputError("welding.arc.start_s needs an arc that starts at rest: write welding.arc.start: rest.")


@dc.dataclass
class PlanningConfig(PlanningMethod):
    """The method of planning the seam from the workpiece's scan."""

    # joints from which a scanner on the flange scans the part, six angles each; one plan is made from all scans; empty:
    # from home
    scan_poses_deg: list[list[float]] = dc.field(default_factory=list)


@dc.dataclass(kw_only=True)
class WeldingConfig:
    """The welding job."""

    speed_mm_s: float = 8.0
    deflection_mm: float | None = None  # delta_d of Eq. 16; null: 2, less in a wide joint
    axial_deflection_mm: float | None = None  # null: 3, more in a wide joint
    clearance_mm: float = 25.0  # height above the seam at which the approach ends
    seam_length_mm: float | None = None  # arc length to weld; the groove may go on past it; null: the whole seam
    process: WeldProcess = dc.field(default_factory=WeldProcess)
    arc: ArcConfig = dc.field(default_factory=ArcConfig)
    schedule: WeldSchedule | None = None  # null: no set values; the power source is set by hand
    order: WeldOrder = dc.field(default_factory=WeldOrder)
    angles: AnglesOrder | None = None  # of the wire; null: as tip and torch give them on the joint's bisector
    weave: WeaveOrder | None = None  # null: a stringer bead
    stitch: StitchOrder | None = None  # null: the arc burns along the whole seam
    tacks: list[TackOrder] = dc.field(default_factory=list)  # a simulated part has them
    passes: list[PassOrder] = dc.field(default_factory=list)  # after the root pass, in the order of welding
    # how far the tool may lean sideways where the arm cannot follow the seam otherwise, 0 to 10
    lean_deg: float = 0.0
    posture: str = "home"  # branch of the inverse kinematics: home, that of home_deg; any, another one where it must
    # CSV of limits of gap, misalignment and angle along the seam: out of them it is not welded
    fit_up: str | None = dc.field(default=None, metadata=FILE)
    seam_order: str = "given"  # given: as listed; least_travel: with the least way of the tool between the seams
    # home: the arm goes home and scans the part again; direct: to the next seam that the tip feels, by home if it must
    between_seams: str = "home"
    # where something that the drawing does not have is in the way, the seam is interrupted; else it is not welded
    pass_obstacles: bool = False
    # largest sigma across a seam that the tip does not feel: with a larger one it is not welded
    tolerance_mm: float = 0.5

    def tacks_m(self) -> list[tuple[int, float, float, float]]:
        """The tacks: number of the seam, from 0, start and end along it, and height over its root, m."""
        return [(t.seam - 1, 1e-3 * t.from_mm, 1e-3 * t.to_mm, 1e-3 * t.height_mm) for t in self.tacks]

    def later_passes(self) -> tuple[WeldPass, ...]:
        """The passes after the root."""
        return tuple(order.weld_pass() for order in self.passes)


@dc.dataclass(kw_only=True)
class JobConfig:
    """The parts of the job to run, and its limits."""

    calibrate: bool = True
    weld: bool = True
    # a known calibration, where `calibrate` is off; null: a simulated scanner is then exactly at its nominal pose
    X_BC: PoseConfig | None = None
    X_FC: PoseConfig | None = None  # the same of a scanner on the flange: its pose in the flange's frame
    # its expected error at the work point, one sigma; null: that of an arm as its maker leaves it
    X_BC_sigma_mm: float | None = None
    speed_factor: float = 1.0  # speed of the arm's moves, 0.05 to 1; the weld speed does not change
    maximum_time_s: float = 240.0  # at speed_factor 1


@dc.dataclass
class VisualizationConfig:
    """Settings of the Meshcat recording."""

    recording_fps: float = 10.0
    cloud_points: int = 20000


@dc.dataclass(kw_only=True)
class Scenario:
    """One cell: arm, devices, calibration, workpiece, welding and job.

    The class that the YAML is loaded into (see loading.scenario_class) narrows each device to the installed drivers,
    and adds a key for each kind of job.
    """

    description: str = ""
    # a shipped scenario, or a YAML file beside this one: its values are used for the keys left out here
    extends: str = ""
    arm: str = "ur10e"  # a Universal Robots arm, ur3e to ur30
    # X_WB: the robot's base in a world whose z points up; all other poses of a scenario are in B
    base: PoseConfig = dc.field(default_factory=PoseConfig)
    # a factory calibration in Universal Robots' kinematics.yaml schema
    kinematics: str | None = dc.field(default=None, metadata=FILE)
    # the kinematics.yaml that calibrate --refine wrote: the cell plans and sees with it, the controller keeps its own
    corrected_kinematics: str | None = dc.field(default=None, metadata=FILE)
    flange: str = ""  # ISO 9409-1 designation of the arm's flange; empty: that of the arm (`weldcal robots`)
    tool: ToolFile | str = "welding"  # welding, pen or none; or {file: my_tool.yaml}, relative to the scenario
    robot: DriverConfig = dc.field(default_factory=NoDevice)
    robot_2: DriverConfig = dc.field(default_factory=NoDevice)
    scanner: DriverConfig = dc.field(default_factory=NoDevice)
    finger_camera: DriverConfig = dc.field(default_factory=NoDevice)
    wrist_camera: DriverConfig = dc.field(default_factory=NoDevice)
    digitizer: DriverConfig = dc.field(default_factory=NoDevice)
    profiler: DriverConfig = dc.field(default_factory=NoDevice)
    touch_probe: DriverConfig = dc.field(default_factory=NoDevice)
    power_source: DriverConfig = dc.field(default_factory=NoDevice)
    home_deg: list[float] = dc.field(default_factory=lambda: [0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
    calibration: CalibrationConfig = dc.field(default_factory=CalibrationConfig)
    workpiece: WorkpieceConfig | None = None
    surroundings: list[ObstacleConfig] = dc.field(default_factory=list)
    planning: PlanningConfig = dc.field(default_factory=PlanningConfig)
    welding: WeldingConfig = dc.field(default_factory=WeldingConfig)
    job: JobConfig = dc.field(default_factory=JobConfig)
    visualization: VisualizationConfig = dc.field(default_factory=VisualizationConfig)

    def part(self, kind: type[JobConfigOf]) -> JobConfigOf | None:
        """The part of the scenario of this type, such as a job's configuration; None where it has none."""
        found = (getattr(self, field.name) for field in dc.fields(self))
        return next((value for value in found if isinstance(value, kind)), None)

    def table_height_m(self) -> float:
        """Height of the table over the base's origin, against gravity, m."""
        return self.calibration.table_z_m - self.base.xyz_m[2]

    @property
    def reports_arc(self) -> bool:
        """Whether robot or power source report the arc."""
        return self.robot.reports_arc or self.power_source.reports_arc

    @property
    def welds(self) -> bool:
        """Whether the tool is one that welds."""
        return self.tool == "welding" or isinstance(self.tool, ToolFile)

    def loaded_tool(self, *, simulated: bool = False) -> LoadedTool | None:
        """The welding tool from its file, or the one that the simulated arm carries; None for pen and none.

        Raises InputError where the file is no tool's.
        """
        if not self.welds:
            return None
        if isinstance(self.tool, ToolFile) and not isinstance(self.tool.file, str):
            raise InputError("The scenario's tool is welding, pen, none or {file: my_tool.yaml}.")
        if not isinstance(self.tool, ToolFile):
            return load_tool(WELDING)
        return load_tool(Path(self.tool.simulated if simulated and self.tool.simulated else self.tool.file))

    def feature_standard(self) -> FlangeStandard:
        """Dimensions of the feature that the scanner measures: the tool's ring, or the arm's flange."""
        loaded = self.loaded_tool() if self.calibration.feature == "tool_ring" else None
        ring = None if loaded is None else loaded.tool.ring
        return get_flange(self.flange_name()) if ring is None else ring

    def flange_name(self) -> str:
        """Designation of the arm's flange: the scenario's, or that of the arm's maker."""
        return self.flange or get_robot(self.arm).flange

    def carried_scanner(self) -> PoseConfig | None:
        """The known pose X_FC of a scanner on the flange that welds; None for a scanner elsewhere."""
        scanner = self.scanner_config()
        return self.job.X_FC if scanner is not None and scanner.mounted_on == "flange" else None

    def scanner_config(self) -> ScannerConfig | None:
        """The scanner's configuration; None where there is no scanner."""
        return self.scanner if isinstance(self.scanner, ScannerConfig) else None
