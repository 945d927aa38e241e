"""Inputs, state and outputs of the welding servo: immutable values only."""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.welding.numerics import Array
from weldcal.welding.seam.plan_fit import PlanFit
from weldcal.welding.seam.refinement import PendingPoint, RefinedSeam
from weldcal.welding.servo.weave import Learnt


class Phase(StrEnum):
    """The phases of one weld, in order; FAULT is latched.

    HELD and BACK: an operator holds it, and the way back after that.
    """

    TOUCH = "TOUCH"
    TRACK = "TRACK"
    COAST = "COAST"
    FINISH = "FINISH"
    DONE = "DONE"
    FAULT = "FAULT"
    HELD = "HELD"
    BACK = "BACK"


@dataclass(frozen=True)
class DeflectionSample:
    """One finger-camera frame: its capture time, the pose of T then, and the tip's displacement from rest in T (m)."""

    capture_time: float
    X_BT_at_capture: RigidTransform
    deflection_T: Array
    valid: bool


@dataclass(frozen=True)
class ServoSample:
    """One servo tick's input.

    Time s, pose of T in B now, the newest frame (the same again until a newer comes), and whether the arc is
    established where the torch is on; True where nobody tells.
    """

    time: float
    X_BT: RigidTransform
    deflection: DeflectionSample | None = None
    arc: bool = True


@dataclass(frozen=True, kw_only=True)
class Diagnostics:
    """Measured and commanded values of one tick; NaN where a phase has none.

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
    """One servo tick's output: V_BT (6,) = [omega; v] of T in B, the torch, the phase, and the reason of a stop."""

    V_BT: Array
    torch_on: bool
    phase: Phase
    reason: str | None
    diagnostics: Diagnostics


class Measurement(NamedTuple):
    """The newest valid frame, in the base: time, tip point m, delta = P_r - P_s m, and T's position m (each (3,))."""

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


@dataclass(frozen=True, kw_only=True)
class TouchOnState:
    """State of the touch search: its step, the step's start, heights and lateral place.

    `free`: deflections of the free tip; `felt`: points measured on the way back to the start, each with how far ahead
    of its rest point friction held the tip; `rest_m`: height above the plan at which the ball has come to rest;
    `raised_m`: of a ball seated above the plan, its height there, slowly followed.
    """

    step: str = "descend"
    since: float = 0.0
    face_height: float = math.nan
    start_left: float = math.nan
    seated_frames: int = 0
    rest_m: float = math.nan
    raised_m: float = math.nan
    gain_fit: GainFit = field(default_factory=GainFit)
    free: tuple[Array, ...] = ()
    felt: tuple[PendingPoint, ...] = ()


@dataclass(frozen=True, kw_only=True)
class WeldingState:
    """State of the servo between ticks; `WeldingState()` is the start of a weld."""

    phase: Phase = Phase.TOUCH
    reason: str | None = None
    time: float | None = None
    clock_stopped_s: float = 0.0
    started: float = 0.0
    plan_fit: PlanFit | None = None
    refined: RefinedSeam = field(default_factory=RefinedSeam.empty)
    touch: TouchOnState = field(default_factory=TouchOnState)
    gain: float = 1.0
    zero: Array | None = None
    measurement: Measurement | None = None
    frame_time: float = -math.inf
    reading: Array | None = None
    same_readings: int = 0
    delta_n: float = 0.0
    delta_axial: float = 0.0
    regained: int = 0
    proven: bool = False
    settling: bool = False
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
    stitched_to: float = 0.0
    weave: Learnt = field(default_factory=Learnt)
    arc_seen: bool = False
    arc_waited_s: float = 0.0
    stand: str = ""
    stood_s: float = 0.0
    V: Array = field(default_factory=lambda: np.zeros(6))
    V_stop: Array = field(default_factory=lambda: np.zeros(6))
    stopped_ticks: int = 0
