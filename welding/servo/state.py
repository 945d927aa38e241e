"""What the welding servo is told, what it remembers between ticks and what it answers: immutable values only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array
from weldcal.welding.seam.feasibility import SeamWindows
from weldcal.welding.seam.plan_fit import PlanFit, PlanFitConfig
from weldcal.welding.seam.refinement import PendingPoint, RefinedSeam, RefinementConfig
from weldcal.welding.servo.weave import WeaveConfig


class ServoConfigError(InputError):
    """A servo setting that cannot be used."""


class Phase(StrEnum):
    """The phases of one weld, in order; FAULT is latched."""

    TOUCH = "TOUCH"
    TRACK = "TRACK"
    COAST = "COAST"
    FINISH = "FINISH"
    DONE = "DONE"
    FAULT = "FAULT"


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


@dataclass(frozen=True)
class TouchConfig:
    """The search for the groove.

    Attributes:
        arc_m: where along the seam the tip touches; offset_m: how far to the -n side of the plan it comes down.
        height_m: start height of the free tip's centre above where the plan expects it to meet the face.
        slow_height_m: height below which it descends slowly.
        fast_m_s, slow_m_s, search_m_s: speeds of descent and lateral search.
        range_m: lateral search; depth_m: how far below the expected face it may go.
        settle_s: pause on the face before the search.
        calibrate_gain: press to `press_ratio` times the wanted deflection and back, and fit the tag's gain.
        press_m_s: speed of that; gain_sigma: prior sigma of the gain about 1.
        feel_start: draw the seated tip back over the seam's start before the weld, so that the torch has felt points to
            begin on and the arc starts where the groove does (welding.feel_start).
        zero_frames: frames of the free tip, before the descent, whose mean is taken for its rest (0: the tag's own rest
            pose is); zero_limit_m: a larger mean, or as large a spread, is no free tip.
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
    settle_s: float = 0.25
    calibrate_gain: bool = False
    press_ratio: float = 1.6
    press_m_s: float = 1.0e-3
    gain_sigma: float = 0.06
    feel_start: bool = False
    zero_frames: int = 0
    zero_limit_m: float = 1.0e-3


@dataclass(frozen=True)
class ContactConfig:
    """When the tip counts as touching, and what breaks it.

    Attributes:
        normal_min_m, axial_min_m: below either, contact is lost; drop_m: so it is when both fall by this in a
            frame.
        regain_axial_m: axial deflection that shows the groove again; regain_frames: for so many frames,
            regain_after_m, regain_after_s: this far past the loss, and this long after it, at the earliest.
        limit_lateral_m, limit_axial_m: mechanical limits of the tip.
        hidden_s: tag not seen for this long stops the weld; frozen_frames: so does the very same reading in so many frames.
        coast_m: longest gap; hover_m: how far below its seat the free tip hangs while crossing one.
        end_window_m: how far the seam's end may be from the plan's.
    """

    normal_min_m: float = 0.4e-3
    axial_min_m: float = 0.4e-3
    drop_m: float = 0.35e-3
    regain_axial_m: float = 0.2e-3
    regain_frames: int = 2
    regain_after_m: float = 1.0e-3
    regain_after_s: float = 0.12
    limit_lateral_m: float = 5.0e-3
    limit_axial_m: float = 6.5e-3
    hidden_s: float = 0.3
    frozen_frames: int = 30
    coast_m: float = 40.0e-3
    hover_m: float = 0.5e-3
    end_window_m: float = 6.0e-3


@dataclass(frozen=True)
class ServoConfig:
    """Everything about the servo, SI units; the defaults are those of docs/weld_law.md.

    Attributes:
        weld_speed_m_s: torch speed, the primary variable.
        delta_d_m, axial_d_m: wanted lateral and axial deflection.
        k_p, k_z: their servo gains 1/s; servo_speed_m_s, servo_slew_m_s2: their limits.
        k_b, k_h: torch position feedback, lateral and height, 1/s; feedback_limit_m: error beyond which it saturates.
        k_roll: work-angle feedback 1/s; work_angle_rad: wanted roll about the chord.
        k_follow: how fast plan offsets are followed in COAST and FINISH, 1/s.
        tip_speed_max_m_s, omega_max_rad_s, pitch_rate_max_rad_s: limits.
        tip_acceleration_m_s2, omega_acceleration_rad_s2: rate limits.
        turn_rate_max_rad_s: tip speed is at most this times the seam's radius; tip_speed_floor: but not under this
            share of the weld speed.
        weight_*: of the torch's lateral equation, its speed, the tip's speed.
        steering_*, drag_m: where the deformation, less what friction drags the tip back, overrules the plan's normal, and
            by when fully; steering_reach_m: how far ahead or behind the plan may be at a corner.
        felt_length_m, felt_points, felt_dead_rad, felt_full_rad: length and number of last points whose direction
            overrules the plan's tangent, from which difference on, and by when fully.
        creep: share of the weld speed that a tip square to the chord keeps; give_back_m_s, give_back_m: how fast and far
            it may go back where the chord is past square to the torch's way.
        lag_s: between command and motion of the robot; the torch's equations look that far ahead.
        stall_s: a torch that comes on by less than half a millimetre in this time stops the weld.
        ignition_error_m, torch_error_max_m: the arc starts only this close to the seam; farther than that it faults.
        ramp_s: how long a stop takes; period_s: servo tick; law: a name of welding.laws, for comparison.
    """

    tool: ToolGeometry = field(default_factory=ToolGeometry)
    touch: TouchConfig = field(default_factory=TouchConfig)
    contact: ContactConfig = field(default_factory=ContactConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    plan_fit: PlanFitConfig = field(default_factory=PlanFitConfig)
    windows: SeamWindows = field(default_factory=SeamWindows)
    weave: WeaveConfig = field(default_factory=WeaveConfig)
    weld_speed_m_s: float = 8.0e-3
    delta_d_m: float = 2.0e-3
    axial_d_m: float = 3.0e-3
    k_p: float = 5.0
    k_z: float = 5.0
    servo_speed_m_s: float = 6.0e-3
    servo_slew_m_s2: float = 40.0e-3
    k_b: float = 4.0
    k_h: float = 2.5
    feedback_limit_m: float = 1.5e-3
    k_roll: float = 2.0
    work_angle_rad: float = 0.0
    k_follow: float = 4.0
    tip_speed_max_m_s: float = 40.0e-3
    omega_max_rad_s: float = 0.8
    pitch_rate_max_rad_s: float = 0.3
    tip_acceleration_m_s2: float = 0.3
    omega_acceleration_rad_s2: float = 4.0
    turn_rate_max_rad_s: float = 1.2
    tip_speed_floor: float = 0.35
    weight_lateral: float = 400.0
    weight_torch_speed: float = 1.0
    weight_tip_speed: float = 0.0064
    weight_omega: float = 1.0e-3
    steering_dead_rad: float = math.radians(20.0)
    steering_full_rad: float = math.radians(40.0)
    drag_m: float = 1.0e-3
    steering_reach_m: float = 8.0e-3
    felt_length_m: float = 1.6e-3
    felt_points: int = 5
    felt_dead_rad: float = math.radians(15.0)
    felt_full_rad: float = math.radians(30.0)
    creep: float = 0.4
    give_back_m_s: float = 2.0e-3
    give_back_m: float = 1.5e-3
    stall_s: float = 4.0
    lag_s: float = 0.025
    ignition_error_m: float = 1.5e-3
    torch_error_max_m: float = 4.0e-3
    ramp_s: float = 0.15
    period_s: float = 0.008
    law: str = "guarded"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            # A work angle may be zero or negative; every other number of the servo divides, limits or drives something.
            if name == "work_angle_rad" or not isinstance(value, float):
                continue
            if not (math.isfinite(value) and value > 0.0):
                raise ServoConfigError(f"The servo setting '{name}' must be a positive number, not {value}.")
        if self.weave.peak_speed_m_s > 0.7 * self.omega_max_rad_s * self.tool.torch_offset_m:
            raise ServoConfigError("The weave asks for more turning than the limit leaves; make it slower or smaller.")
        if self.tool.torch_offset_m < 0.010:
            raise ServoConfigError("The torch must trail the tip by at least 10 mm (tool.torch_offset_m).")

    @property
    def clearance_m(self) -> float:
        """Height of the torch point over the tip's line, m."""
        tool = self.tool
        return tool.torch_height_m - self.axial_d_m if tool.torch_clearance_m is None else tool.torch_clearance_m

    @property
    def p_TW(self) -> Array:
        """The torch point in T, (3,) m."""
        return np.array([-self.tool.torch_offset_m, 0.0, self.tool.torch_height_m])


@dataclass(frozen=True)
class DeflectionSample:
    """One finger-camera frame: when it was taken, where T was then, the tip's displacement from rest in T (m)."""

    capture_time: float
    X_BT_at_capture: RigidTransform
    deflection_T: Array
    valid: bool


@dataclass(frozen=True)
class ServoSample:
    """One servo tick's input: time s, pose of T in B now, and the newest frame (the same again until a newer comes)."""

    time: float
    X_BT: RigidTransform
    deflection: DeflectionSample | None = None


@dataclass(frozen=True)
class Diagnostics:
    """What the tick saw; NaN where a phase has no such thing.

    Attributes:
        e_t, e_height: torch off the refined seam, to the left and up, m.
        n_d_dot_n_t: the paper's singularity measure; conditioning: the guarded law's, 0..sqrt 2.
        omega: rate about the tool's own up axis, rad/s.
        delta_n, delta_axial: deflections, m; s_tip, s_torch: plan arc lengths, m.
        torch_speed, tip_speed: commanded, m/s.
        p_BTorch_target: (3,) m; p_BTip: (3,) m, the newest tactile point, None before contact.
        gain: tag gain in use; n_points: committed tactile points.
    """

    e_t: float = math.nan
    e_height: float = math.nan
    n_d_dot_n_t: float = math.nan
    conditioning: float = math.nan
    omega: float = 0.0
    delta_n: float = math.nan
    delta_axial: float = math.nan
    s_tip: float = math.nan
    s_torch: float = math.nan
    torch_speed: float = 0.0
    tip_speed: float = 0.0
    p_BTorch_target: Array | None = None
    p_BTip: Array | None = None
    gain: float = 1.0
    n_points: int = 0


@dataclass(frozen=True)
class WeldingCommand:
    """One servo tick's answer: V_BT (6,) = [omega; v] of T in B, the torch, the phase, and why it stopped."""

    V_BT: Array
    torch_on: bool
    phase: Phase
    reason: str | None
    diagnostics: Diagnostics


class Measurement(NamedTuple):
    """The newest valid frame, in the base: time, tip point m, delta = P_r - P_s m, and T's place m (each (3,))."""

    capture_time: float
    point: Array
    delta: Array
    p_BT: Array


class GainFit(NamedTuple):
    """Running sums of the press: how deflection (y) grows with tool motion (x), both m."""

    n: int = 0
    x: float = 0.0
    y: float = 0.0
    xx: float = 0.0
    xy: float = 0.0


@dataclass(frozen=True)
class TouchState:
    """Where the search is: its step, the step's start, heights and lateral place; `free`: deflections of the free tip;
    `felt`: points felt on the way back to the start, each with how far ahead of its rest point friction held the tip."""

    step: str = "descend"
    since: float = 0.0
    face_height: float = math.nan
    start_left: float = math.nan
    seated_frames: int = 0
    gain_fit: GainFit = field(default_factory=GainFit)
    free: tuple[Array, ...] = ()
    felt: tuple[PendingPoint, ...] = ()


@dataclass(frozen=True)
class WeldingState:
    """Everything the servo remembers. `WeldingState()` is the start of a weld."""

    phase: Phase = Phase.TOUCH
    reason: str | None = None
    time: float | None = None
    stood: float = 0.0
    started: float = 0.0
    plan_fit: PlanFit | None = None
    refined: RefinedSeam = field(default_factory=RefinedSeam.empty)
    touch: TouchState = field(default_factory=TouchState)
    gain: float = 1.0
    zero: Array | None = None
    measurement: Measurement | None = None
    frame_time: float = -math.inf
    reading: Array | None = None
    same_readings: int = 0
    delta_n: float = 0.0
    delta_axial: float = 0.0
    delta_wanted: float | None = None
    sunk: bool = False
    regained: int = 0
    proven: bool = False
    progress: float = 0.0
    furthest: float = -math.inf
    progress_log: tuple[tuple[float, float], ...] = ()
    s_tip: float = 0.0
    s_torch: float = 0.0
    torch_arc: float = 0.0
    residual: Array = field(default_factory=lambda: np.zeros(2))
    felt: float = 0.0
    steer: float = 0.0
    v_tip: float = 0.0
    omega: float = 0.0
    u_n: float = 0.0
    u_a: float = 0.0
    lost_at: float = math.nan
    lost_time: float = -math.inf
    hold: Array = field(default_factory=lambda: np.zeros(2))
    residual_at_loss: Array = field(default_factory=lambda: np.zeros(2))
    s_end: float = math.nan
    start_point: Array | None = None
    advanced: tuple[float, float] = (0.0, -math.inf)
    torch_on: bool = False
    lit_at: float = math.nan
    V: Array = field(default_factory=lambda: np.zeros(6))
    V_stop: Array = field(default_factory=lambda: np.zeros(6))
    stopped_at: float = 0.0
