"""Settings of the welding servo in SI units, grouped by what they govern.

The defaults are those of docs/weld_law.md.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real

import numpy as np

from weldcal.models.errors import InputError
from weldcal.models.workpieces.seat import Press, Seated
from weldcal.welding.numerics import Array
from weldcal.welding.passes.stitch import StitchConfig
from weldcal.welding.passes.tacks import Hop, Tack, check_tacks, hops
from weldcal.welding.seam.feasibility import SeamWindows
from weldcal.welding.seam.plan_fit import PlanFitConfig
from weldcal.welding.seam.refinement import RefinementConfig
from weldcal.welding.servo.weave import Bound, WeaveConfig, check_weave, tool_bounds

TORCH_ABOVE_ROOT_M = 0.002  # height of the wire point above the root of the groove
Ends = tuple[float, float]
"""An angle at the seam's start and at its end, rad; linear between them."""


class ServoConfigError(InputError):
    """A servo setting that cannot be used."""


def _check_numbers(group: str, settings: object, signed: tuple[str, ...] = (), zero: tuple[str, ...] = ()) -> None:
    """Raise ServoConfigError unless every number of a group is finite and positive.

    `zero` may be 0, `signed` anything.
    """
    for name, value in vars(settings).items():
        if isinstance(value, bool) or not isinstance(value, Real):
            continue
        number = float(value)
        if not math.isfinite(number):
            raise ServoConfigError(f"The servo setting '{group}{name}' must be a finite number, not {value}.")
        if name in zero and number < 0.0:
            raise ServoConfigError(f"The servo setting '{group}{name}' must be zero or more, not {value}.")
        if name not in (*signed, *zero) and number <= 0.0:
            raise ServoConfigError(f"The servo setting '{group}{name}' must be a positive number, not {value}.")


@dataclass(frozen=True)
class ToolGeometry:
    """The tool in the tip frame T (x from torch to tip, z up away from the work), and the tip in its groove.

    Attributes:
        torch_offset_m, torch_height_m: the torch point is p_TW = (-d, 0, h).
        tip_seat_height_m: the seated tip's centre above the planned seam line: r/sin(half angle) when the plan is the
            groove's root, 0 when it already is the tip's line.
        tip_drop_m: how much lower the tip's centre sits in the groove than on the face beside it.
        torch_clearance_m: torch point above the tip's line; None keeps the tool level (h - the axial deflection).
        side_offset_m: torch line to the left (+n) of the tip's line.
    """

    torch_offset_m: float = 0.060
    torch_height_m: float = 0.0
    tip_seat_height_m: float = 0.0
    tip_drop_m: float = 3.97e-3
    torch_clearance_m: float | None = None
    side_offset_m: float = 0.0

    def __post_init__(self) -> None:
        # A plan of the tip's own line has no seat; the least torch offset is the servo's to check.
        _check_numbers(
            "tool.",
            self,
            signed=("torch_offset_m", "torch_height_m", "torch_clearance_m", "side_offset_m"),
            zero=("tip_seat_height_m",),
        )


@dataclass(frozen=True, kw_only=True)
class TouchOnConfig:
    """The touch-on: descent, search for the groove, gain calibration and zero.

    Attributes:
        arc_m: where along the seam the tip touches; offset_m: how far to the -n side of the plan it comes down.
        height_m: start height of the free tip's centre above where the plan expects it to meet the face.
        slow_height_m: height below which it descends slowly.
        fast_m_s, slow_m_s, search_m_s: speeds of descent and lateral search.
        range_m: lateral search; depth_m: how far below the expected face it may go; above_m: how far above the plan the
            root of a guiding joint may lie.
        settle_s: pause on the face before the search.
        calibrate_gain: press to `press_ratio` times the wanted deflection and back, and fit the tag's gain.
        press_m_s: speed of that; gain_sigma: prior sigma of the gain about 1.
        feel_start: draw the seated tip back over the seam's start before the weld, so that the torch has tactile points
            to start on and the arc starts where the groove does (welding.servo.feel_start).
        zero_frames: frames of the free tip, before the descent, whose mean is taken as its rest (0: the tag's own
            rest pose is); zero_limit_m: with a larger mean or spread the tip is not free.
    """

    arc_m: float = 6.0e-3
    offset_m: float = -5.0e-3
    height_m: float = 6.0e-3
    slow_height_m: float = 2.5e-3
    fast_m_s: float = 10.0e-3
    slow_m_s: float = 3.0e-3
    search_m_s: float = 4.0e-3
    range_m: float = 12.0e-3
    depth_m: float = 6.0e-3
    above_m: float = 3.0e-3
    settle_s: float = 0.25
    calibrate_gain: bool = False
    press_ratio: float = 1.6
    press_m_s: float = 1.0e-3
    gain_sigma: float = 0.06
    feel_start: bool = False
    zero_frames: int = 0
    zero_limit_m: float = 1.0e-3

    def __post_init__(self) -> None:
        _check_numbers("touch.", self, signed=("offset_m",), zero=("zero_frames", "settle_s"))
        if self.press_ratio <= 1.0:
            raise ServoConfigError(f"The servo setting 'touch.press_ratio' must be above 1, not {self.press_ratio}.")


@dataclass(frozen=True, kw_only=True)
class ContactConfig:
    """When the tip counts as in contact with the groove, and when contact is lost.

    Attributes:
        normal_min_m, axial_min_m: contact is lost below either deflection.
        drop_m: contact is also lost when both deflections fall by this much within one frame.
        regain_axial_m: axial deflection that shows the groove again; regain_frames: in so many consecutive frames.
        regain_after_m, regain_after_s: travel and time after the loss before contact can be regained.
    """

    normal_min_m: float = 0.4e-3
    axial_min_m: float = 0.4e-3
    drop_m: float = 0.35e-3
    regain_axial_m: float = 0.2e-3
    regain_frames: int = 2
    regain_after_m: float = 1.0e-3
    regain_after_s: float = 0.12

    def __post_init__(self) -> None:
        _check_numbers("contact.", self)


@dataclass(frozen=True)
class GapConfig:
    """How gaps and the seam's end are crossed without contact.

    Attributes:
        coast_m: longest gap that is crossed.
        hover_m: how far below its seat the free tip hangs while it crosses a gap.
        end_window_m: largest distance between the seam's end and the end of the plan.
    """

    coast_m: float = 40.0e-3
    hover_m: float = 0.5e-3
    end_window_m: float = 6.0e-3

    def __post_init__(self) -> None:
        _check_numbers("gap.", self)


@dataclass(frozen=True)
class FaultLimits:
    """Limits beyond which the weld stops with a fault.

    Attributes:
        lateral_m, axial_m: mechanical limits of the tip's deflection.
        hidden_s: longest time without a valid view of the tag; frozen_frames: identical readings in so many frames are
            a fault.
        stall_s: time in which the torch must advance by half a millimetre.
        torch_error_m: largest distance of the burning torch from the seam.
    """

    lateral_m: float = 5.0e-3
    axial_m: float = 6.5e-3
    hidden_s: float = 0.3
    frozen_frames: int = 30
    stall_s: float = 4.0
    torch_error_m: float = 4.0e-3

    def __post_init__(self) -> None:
        _check_numbers("faults.", self)


@dataclass(frozen=True, kw_only=True)
class DeflectionControl:
    """The servo that holds the tip's deflection, and that follows plan offsets without contact.

    Attributes:
        delta_d_m, axial_d_m: wanted lateral and axial deflection.
        k_p, k_z: their gains, 1/s; k_follow: gain towards plan offsets in COAST and FINISH, 1/s.
        speed_m_s, slew_m_s2: limits of the servo's speed and acceleration.
    """

    delta_d_m: float = 2.0e-3
    axial_d_m: float = 3.0e-3
    k_p: float = 5.0
    k_z: float = 5.0
    k_follow: float = 4.0
    speed_m_s: float = 6.0e-3
    slew_m_s2: float = 40.0e-3

    def __post_init__(self) -> None:
        _check_numbers("deflection.", self)


@dataclass(frozen=True, kw_only=True)
class TorchControl:
    """How the torch is held on the refined seam, and when the arc starts.

    Attributes:
        k_b, k_h: feedback of its lateral and height error, 1/s; feedback_limit_m: error at which it saturates.
        k_roll: work-angle feedback, 1/s; work_angle_rad: wanted roll about the chord.
        ignition_error_m: the arc starts only with the torch this close to the seam; ignition_window_m: a weld whose arc
            does not start within so much of the seam is a fault.
        ignition_limit_s: longest time from the torch's start to an established arc; arc_lost_s: longest time without it
            after.
        from_rest: the torch comes to rest at the seam's start before it is asked for.
        start_s: it waits so long with the arc. crater_s: it waits so long at the seam's end before the arc goes out.
    """

    k_b: float = 4.0
    k_h: float = 2.5
    feedback_limit_m: float = 1.5e-3
    k_roll: float = 2.0
    work_angle_rad: float = 0.0
    ignition_error_m: float = 1.5e-3
    ignition_window_m: float = 10.0e-3
    ignition_limit_s: float = 2.0
    arc_lost_s: float = 0.3
    from_rest: bool = False
    start_s: float = 0.0
    crater_s: float = 0.0

    def __post_init__(self) -> None:
        _check_numbers("torch.", self, signed=("work_angle_rad",), zero=("start_s", "crater_s"))


@dataclass(frozen=True, kw_only=True)
class TorchAngles:
    """Ordered angles of the wire against the frame of the seam beside it.

    Attributes:
        work_rad: lean across the seam from the joint's bisector; positive: the tool's left side is up.
        travel_rad: lean along it; positive: push, the wire points in the direction of travel. None: as the press gives.
        rotation_rad: of the tool about the wire, from the line to the seam at the tip; positive: the tip to the left.
        half_angle_rad: between a wall and the bisector, as the ball feels it.
        stiffness_ratio: of the tip's springs, axial to lateral.
        seat: where the tip rests in the joint at a press; None: the tip is not used.
        stick_out_m: of the wire, for messages; NaN: not known.
    """

    work_rad: Ends = (0.0, 0.0)
    travel_rad: Ends | None = None
    rotation_rad: Ends | None = None
    half_angle_rad: float = 0.5 * math.pi
    stiffness_ratio: float = 0.5
    seat: Callable[[Press], Seated] | None = None
    stick_out_m: float = math.nan

    def between(self, first: float, last: float) -> "TorchAngles":
        """What is ordered on a part of the seam, given by its ends as shares of the whole seam."""
        ends = (self.work_rad, self.travel_rad, self.rotation_rad)
        work, travel, rotation = ((a[0] + first * (a[1] - a[0]), a[0] + last * (a[1] - a[0])) if a else a for a in ends)
        return replace(self, work_rad=work or (0.0, 0.0), travel_rad=travel, rotation_rad=rotation)


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Bounds on the motion that a law may command.

    Attributes:
        tip_speed_max_m_s, omega_max_rad_s, pitch_rate_max_rad_s: largest speeds.
        tip_acceleration_m_s2, omega_acceleration_rad_s2, pitch_acceleration_rad_s2: rate limits of tip speed, turning
            and pitch.
        turn_rate_max_rad_s: the tip speed is at most this times the seam's radius; tip_speed_floor: but not below this
            share of the weld speed.
        creep: share of the weld speed that a tip square to the chord keeps.
        give_back_m_s, give_back_m: how fast and how far the tip may go back where the chord is past square to the
            torch's path.
        ramp_s: duration of a stop.
    """

    tip_speed_max_m_s: float = 40.0e-3
    omega_max_rad_s: float = 0.8
    pitch_rate_max_rad_s: float = 0.3
    tip_acceleration_m_s2: float = 0.3
    omega_acceleration_rad_s2: float = 4.0
    pitch_acceleration_rad_s2: float = 100.0
    turn_rate_max_rad_s: float = 1.2
    tip_speed_floor: float = 0.35
    creep: float = 0.4
    give_back_m_s: float = 2.0e-3
    give_back_m: float = 1.5e-3
    ramp_s: float = 0.15

    def __post_init__(self) -> None:
        _check_numbers("limits.", self)


@dataclass(frozen=True)
class LawWeights:
    """Weights of the guarded law's least squares: torch lateral error, torch speed, tip speed, turning rate."""

    lateral: float = 400.0
    torch_speed: float = 1.0
    tip_speed: float = 0.0064
    omega: float = 1.0e-3

    def __post_init__(self) -> None:
        _check_numbers("weights.", self)


@dataclass(frozen=True)
class SteeringConfig:
    """Where the direction of the deformation overrules the plan's normal.

    Attributes:
        dead_rad, full_rad: difference at which this begins, and at which it is complete.
        drag_m: deflection against the travel that friction explains; reach_m: how far ahead or behind the plan may be
            at a corner.
    """

    dead_rad: float = math.radians(20.0)
    full_rad: float = math.radians(40.0)
    drag_m: float = 1.0e-3
    reach_m: float = 8.0e-3

    def __post_init__(self) -> None:
        _check_numbers("steering.", self)


@dataclass(frozen=True)
class FeltPathConfig:
    """Where the direction of the last tactile points overrules the plan's tangent.

    Attributes:
        length_m, points: least length and number of the points used.
        dead_rad, full_rad: difference at which this begins, and at which it is complete.
    """

    length_m: float = 1.6e-3
    points: int = 5
    dead_rad: float = math.radians(15.0)
    full_rad: float = math.radians(30.0)

    def __post_init__(self) -> None:
        _check_numbers("felt_path.", self)


@dataclass(frozen=True, kw_only=True)
class ServoConfig:
    """All settings of the welding servo.

    Attributes:
        weld_speed_m_s: torch speed, the primary variable.
        period_s: servo tick; lag_s: delay between command and motion of the robot, which the torch's equations look
            ahead by.
        felt: whether the tip is used; else it hangs clear and the torch follows the plan.
        angles: those that are ordered; None: as tip and torch give them.
    """

    tool: ToolGeometry = field(default_factory=ToolGeometry)
    touch: TouchOnConfig = field(default_factory=TouchOnConfig)
    contact: ContactConfig = field(default_factory=ContactConfig)
    gap: GapConfig = field(default_factory=GapConfig)
    faults: FaultLimits = field(default_factory=FaultLimits)
    deflection: DeflectionControl = field(default_factory=DeflectionControl)
    torch: TorchControl = field(default_factory=TorchControl)
    limits: MotionLimits = field(default_factory=MotionLimits)
    weights: LawWeights = field(default_factory=LawWeights)
    steering: SteeringConfig = field(default_factory=SteeringConfig)
    felt_path: FeltPathConfig = field(default_factory=FeltPathConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    plan_fit: PlanFitConfig = field(default_factory=PlanFitConfig)
    windows: SeamWindows = field(default_factory=SeamWindows)
    weave: WeaveConfig = field(default_factory=WeaveConfig)
    stitch: StitchConfig = field(default_factory=StitchConfig)
    tacks: tuple[Tack, ...] = ()
    angles: TorchAngles | None = None
    weld_speed_m_s: float = 8.0e-3
    period_s: float = 0.008
    lag_s: float = 0.025
    felt: bool = True

    def __post_init__(self) -> None:
        _check_numbers("", self)
        for group in ("refinement", "plan_fit", "windows"):
            _check_numbers(f"{group}.", getattr(self, group), ("tilt_rad",), ("frames_to_commit", "back_up_m"))
        _check_numbers("refinement.corner.", self.refinement.corner)
        if self.tool.torch_offset_m < 0.010:
            raise ServoConfigError("The torch must trail the tip by at least 10 mm (tool.torch_offset_m).")
        self.stitch.check(self.weld_speed_m_s)
        if self.tacks and self.felt:
            check_tacks(self.tacks, self.hops, self.touch.arc_m, self.tool.torch_offset_m, self.weld_speed_m_s)
        if self.weave.amplitude_m:
            check_weave(self.weave, self.weave_bounds(self.weave))

    @cached_property
    def hops(self) -> tuple[Hop, ...]:
        """The lifts of the tip over the tacks."""
        chord, touch = self.tool.torch_offset_m, self.touch.arc_m
        return hops(self.tacks, self.weld_speed_m_s, self.deflection.axial_d_m, chord, touch)

    def hop_at(self, s: float) -> Hop | None:
        """Return the lift that the tip is in at an arc length s m of the seam."""
        return next((hop for hop in self.hops if hop.begin <= s < hop.end), None) if self.tacks else None

    def weave_bounds(self, weave: WeaveConfig) -> list[Bound]:
        """The tool's limits of a weave."""
        chord, limits = self.tool.torch_offset_m, self.limits
        return tool_bounds(weave, chord, limits.omega_max_rad_s, limits.pitch_rate_max_rad_s, self.weld_speed_m_s)

    @property
    def clearance_m(self) -> float:
        """Height of the torch point over the tip's line, m."""
        tool = self.tool
        if tool.torch_clearance_m is not None:
            return tool.torch_clearance_m
        return tool.torch_height_m - self.deflection.axial_d_m

    @property
    def p_TW(self) -> Array:
        """The torch point in T, (3,) m."""
        return np.array([-self.tool.torch_offset_m, 0.0, self.tool.torch_height_m])
