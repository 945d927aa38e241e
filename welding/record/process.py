"""Computes the figures of a weld: arc events, torch speed, heat input, angles and path error."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamCurve

END_M = 0.005  # the first and the last stretch of a weld, where the motion starts and the tip has left the seam


# Thermal efficiency k by process, EN 1011-1:2009, table 1.
EFFICIENCY = {"MAG": 0.8, "MIG": 0.8, "FCAW": 0.8, "MMA": 0.8, "SAW": 1.0, "TIG": 0.6, "plasma": 0.6}


class ProcessLogError(InputError):
    """A weld log that cannot be evaluated."""


class WeldProcessError(InputError):
    """A welding process with invalid values."""


@dataclass
class WeldProcess:
    """The arc settings of the power source, for the weld log; missing values stay empty.

    Attributes:
        current_A, voltage_V: both or neither.

    Raises:
        WeldProcessError: unknown process, a number that is not positive, or half of what a heat input needs.
    """

    name: str | None = None  # MAG, MIG, FCAW, MMA, SAW, TIG or plasma
    current_A: float | None = None
    voltage_V: float | None = None
    efficiency: float | None = None  # thermal efficiency k; default: the value of the process in EN 1011-1
    wire_feed_m_min: float | None = None

    def __post_init__(self) -> None:
        if self.name is not None and self.name not in EFFICIENCY:
            raise WeldProcessError(f"The welding process must be one of {', '.join(EFFICIENCY)}, not '{self.name}'.")
        for key in ("current_A", "voltage_V", "efficiency", "wire_feed_m_min"):
            value = getattr(self, key)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise WeldProcessError(f"The welding process's {key} must be a positive number, not {value:g}.")
        if self.efficiency is not None and self.efficiency > 1.0:
            raise WeldProcessError(f"The welding process's efficiency is at most 1, and it is {self.efficiency:g}.")
        if (self.current_A is None) != (self.voltage_V is None):
            raise WeldProcessError("Give both current_A and voltage_V of the welding process, or neither.")
        if self.current_A is not None and self.k is None:
            raise WeldProcessError(
                "Give the welding process's name or its efficiency: without it there is no heat input."
            )

    @property
    def k(self) -> float | None:
        """The thermal efficiency in use."""
        if self.efficiency is not None:
            return self.efficiency
        return None if self.name is None else EFFICIENCY[self.name]

    @property
    def missing(self) -> str | None:
        """Why no heat input can be stated, as one sentence; None where it can."""
        if self.current_A is not None:
            return None
        return "No welding current and voltage were given, so the log states the torch speed and no heat input."

    def heat_input(
        self, speed_m_s: ArrayLike, current_A: ArrayLike = math.nan, voltage_V: ArrayLike = math.nan
    ) -> Array:
        """Heat brought in per length of weld, k U I / v, in J/m; NaN without current and voltage, infinite at rest.

        Args:
            speed_m_s: torch speed, any shape; NaN where the arc is off.
            current_A, voltage_V: measured, of the same shape; where one is NaN both are the set ones.

        Source: EN 1011-1:2009, section 19, and ISO/TR 18491 (direct current or mean values: no pulses are resolved).
        """
        v = np.asarray(speed_m_s, dtype=float)
        power = np.asarray(current_A, dtype=float) * np.asarray(voltage_V, dtype=float)
        power_set = math.nan if self.current_A is None or self.voltage_V is None else self.current_A * self.voltage_V
        with np.errstate(divide="ignore"):
            return np.asarray((self.k or math.nan) * np.where(np.isfinite(power), power, power_set) / np.abs(v))


@dataclass(frozen=True)
class PathError:
    """Per sample: arc length on the true seam m, offset to its left m, offset along its up m."""

    s: Array
    lateral: Array
    height: Array

    @property
    def mean_m(self) -> float:
        """Mean unsigned lateral error, m."""
        return float(np.mean(np.abs(self.lateral)))

    @property
    def max_m(self) -> float:
        """Largest unsigned lateral error, m."""
        return float(np.max(np.abs(self.lateral)))

    @property
    def distance_m(self) -> Array:
        """Distance (N,) from the true line in space, m."""
        return np.hypot(self.lateral, self.height)

    def ends_m(self, length_m: float = END_M) -> tuple[float, float, float]:
        """Largest distance in space over the first and the last stretch, and between them, m; NaN without samples."""
        first, last = self.s <= self.s[0] + length_m, self.s >= self.s[-1] - length_m
        if self.s[-1] < self.s[0]:  # backwards
            first, last = self.s >= self.s[0] - length_m, self.s <= self.s[-1] + length_m
        most = (np.max(self.distance_m, where=part, initial=-np.inf) for part in (first, last, ~(first | last)))
        first_m, last_m, between_m = (float(v) if v >= 0.0 else math.nan for v in most)
        return first_m, last_m, between_m


def path_error(p_B: ArrayLike, seam: SeamCurve, backwards: bool = False) -> PathError:
    """Distance of each point from the true line, in the seam's frame.

    Args:
        p_B: (N,3) m, in order of travel.
        seam: the line they should be on, in the same frame.
        backwards: whether they travel it from its end.

    Raises:
        ProcessLogError: no points, or not (N,3).
    """
    p = np.asarray(p_B, dtype=float)
    if p.ndim != 2 or p.shape[1] != 3 or not len(p):
        raise ProcessLogError(f"A path needs an (N, 3) array of points in metres; this one has shape {p.shape}.")
    s = np.empty(len(p))
    rows = range(len(p))[:: -1 if backwards else 1]
    s[rows[0]] = at = float(seam.project(p[rows[0]]))
    for i in rows[1:]:
        s[i] = at = seam.nearest(p[i], at)
    gap = p - seam.position(s)
    return PathError(s, np.sum(gap * seam.normal(s), axis=1), np.sum(gap * seam.up(s), axis=1))


def speed_along(time: ArrayLike, p_B: ArrayLike, window_s: float = 0.05) -> Array:
    """Speed (N,) m/s of a point at each sample: its path over a window around it, which suppresses the robot's noise.

    Args:
        time: (N,) s, rising; p_B: (N,3) m.
        window_s: at the ends, half of it.

    Raises:
        ProcessLogError: the lengths differ, there are fewer than two samples, or time does not rise.
    """
    t, p = np.asarray(time, dtype=float), np.asarray(p_B, dtype=float)
    if len(t) != len(p) or len(t) < 2 or not (np.diff(t) > 0.0).all():
        raise ProcessLogError("A speed needs at least two points, and a time for each that rises.")
    first, last = np.maximum(t - 0.5 * window_s, t[0]), np.minimum(t + 0.5 * window_s, t[-1])
    ends = [np.column_stack([np.interp(at, t, p[:, k]) for k in range(3)]) for at in (first, last)]
    return np.asarray(np.linalg.norm(ends[1] - ends[0], axis=1) / (last - first))


def wire_angles(R_BT: Array, t: Array, n: Array, up: Array, tilt_rad: float = 0.0) -> tuple[Array, Array]:
    """Work and travel angle (N,), rad: how far the wire leans across and along the seam from the joint's bisector.

    Args:
        R_BT: (N,3,3) orientation of T, x_T from torch to tip.
        t, n, up: (N,3) the seam's tangent, left and bisector beside the torch.
        tilt_rad: how far the wire leans back in T, as of WeldingTool.

    Positive travel: push, the wire points in the direction of travel; positive work: the tool's left is up. The travel
    angle is that of AWS A3.0, in the plane of wire and seam.
    """
    axis = R_BT @ np.array([-math.sin(tilt_rad), 0.0, math.cos(tilt_rad)])
    along, left, high = (np.sum(axis * v, axis=1) for v in (t, n, up))
    return -np.arctan2(left, high), -np.arcsin(np.clip(along, -1.0, 1.0))
