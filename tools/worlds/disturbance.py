"""What may happen to a calibrated cell while it is watched: a knock, a creep, a moved base, a scanner that warms up."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset

Vector = tuple[float, float, float]
_STILL: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Times in s after the start, lengths in mm in axes of the base, angles (roll, pitch, yaw) in degrees; zeros:
    nothing happens.

    knock_s, knock_mm, knock_deg   the scanner's housing jumps: its own origin by knock_mm, its axes by knock_deg
    creep_mm_per_min               the scanner moves steadily from creep_s on base_s, base_mm, base_deg      the robot's
    base jumps: the scanner and everything that stands still move in its frame warm_up_s                      time
    constant of the scanner's own warm-up; 0: it is warm warm_up_scale, warm_up_gradient_per_m  its relative error of
    lengths, and that per metre of x, while cold; both die away
    """

    knock_s: float = 0.0
    knock_mm: Vector = _STILL
    knock_deg: Vector = _STILL
    creep_s: float = 0.0
    creep_mm_per_min: Vector = _STILL
    base_s: float = 0.0
    base_mm: Vector = _STILL
    base_deg: Vector = _STILL
    warm_up_s: float = 0.0
    warm_up_scale: float = 0.0
    warm_up_gradient_per_m: float = 0.0

    def world_in_base(self, t: float) -> RigidTransform:
        """Pose X_BW of what stands still, in the robot's base, at ``t`` s; the two are one before the base has
        moved."""
        if t < self.base_s or not any((*self.base_mm, *self.base_deg)):
            return RigidTransform()
        return _pose(self.base_mm, self.base_deg).inverse()

    def scanner_pose(self, X_BC: RigidTransform, t: float) -> RigidTransform:
        """The scanner's true pose in the robot's base at ``t`` s, ``X_BC`` where nothing has happened."""
        p: Array = X_BC.translation()
        R = X_BC.rotation()
        if t >= self.knock_s:
            p = p + 1e-3 * np.array(self.knock_mm)
            R = RollPitchYaw(np.radians(self.knock_deg)).ToRotationMatrix() @ R
        if t > self.creep_s:
            p = p + 1e-3 * (t - self.creep_s) / 60.0 * np.array(self.creep_mm_per_min)
        return self.world_in_base(t) @ RigidTransform(R, p)

    def device(self, scanner: ScannerPreset, t: float) -> ScannerPreset:
        """The scanner with its own errors at ``t`` s of its warm-up."""
        if not self.warm_up_s:
            return scanner
        cold = float(np.exp(-max(t, 0.0) / self.warm_up_s))
        noise = replace(
            scanner.noise,
            scale_error=scanner.noise.scale_error + cold * self.warm_up_scale,
            gradient_per_m=(cold * self.warm_up_gradient_per_m, 0.0),
        )
        return replace(scanner, noise=noise)

    def summary(self, start_s: float) -> dict[str, Any]:
        """The truth file's entry, with times on the robot's clock."""
        out: dict[str, Any] = {}
        if any((*self.knock_mm, *self.knock_deg)):
            out["knock"] = {"time_s": start_s + self.knock_s, "mm": self.knock_mm, "deg": self.knock_deg}
        if any(self.creep_mm_per_min):
            out["creep"] = {"time_s": start_s + self.creep_s, "mm_per_min": self.creep_mm_per_min}
        if any((*self.base_mm, *self.base_deg)):
            out["base"] = {"time_s": start_s + self.base_s, "mm": self.base_mm, "deg": self.base_deg}
        if self.warm_up_s:
            out["warm_up"] = {
                "time_constant_s": self.warm_up_s,
                "scale": self.warm_up_scale,
                "gradient_per_m": self.warm_up_gradient_per_m,
            }
        return out


def _pose(mm: Vector, deg: Vector) -> RigidTransform:
    return RigidTransform(RollPitchYaw(np.radians(deg)), 1e-3 * np.array(mm))


def disturbance_of(knock: str = "", creep: str = "", base: str = "", warm_up: str = "") -> Disturbance:
    """What happens while the scanner streams, from the numbers of the command line; "" for nothing.

    Raises:
        InputError: a text is no such list of numbers.
    """
    knocked = _numbers(knock, "--knock", (4, 7))
    creeping = _numbers(creep, "--creep", (4,))
    based = _numbers(base, "--base", (4, 7))
    warming = _numbers(warm_up, "--warm-up", (2, 3))
    return Disturbance(
        knock_s=knocked[0],
        knock_mm=_vector(knocked[1:4]),
        knock_deg=_vector(knocked[4:7]),
        creep_s=creeping[0],
        creep_mm_per_min=_vector(creeping[1:4]),
        base_s=based[0],
        base_mm=_vector(based[1:4]),
        base_deg=_vector(based[4:7]),
        warm_up_s=warming[0],
        warm_up_scale=1e-6 * warming[1],
        warm_up_gradient_per_m=1e-6 * warming[2],
    )


def _numbers(text: str, name: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Seven numbers, zeros behind those given."""
    try:
        given = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        given = (float("nan"),)
    if text and (len(given) not in counts or not all(abs(v) < 1e6 for v in given)):
        raise InputError(f"{name} takes {' or '.join(map(str, counts))} numbers with commas between, and is '{text}'.")
    return given + (0.0,) * (7 - len(given))


def _vector(values: tuple[float, ...]) -> Vector:
    return values[0], values[1], values[2]
