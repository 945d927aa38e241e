"""What touches the tool: one elastic plane, a hand that pushes, and the sensor that feels both."""

from dataclasses import dataclass, field

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

# stiffer than this the compliant arm, 500 steps a second, would chatter
STIFFEST_N_M = 1e5


@dataclass
class Surroundings:
    """An elastic half-space and a hand; wrenches are [f; t] on the tool centre point in base axes (N, N m)."""

    point: Array = field(default_factory=lambda: np.zeros(3))
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    stiffness: float = 0.0
    push: Array = field(default_factory=lambda: np.zeros(6))

    def place(self, point: list[float], normal: list[float], stiffness: float) -> None:
        """Puts the plane somewhere; a stiffness of 0 takes it away.

        Raises:
            InputError: a normal without a direction, or a stiffness that is negative or too high to be stable.
        """
        n = np.array(normal)
        if not (length := float(np.linalg.norm(n))) > 0.0:
            raise InputError("Give a normal that is not zero.")
        if not 0.0 <= stiffness <= STIFFEST_N_M:
            raise InputError(f"Give a stiffness from 0 to {STIFFEST_N_M:.0f} N/m.")
        self.point, self.normal, self.stiffness = np.array(point), n / length, stiffness

    @property
    def empty(self) -> bool:
        """Nothing touches the tool, wherever it is."""
        return self.stiffness == 0.0 and not self.push.any()

    def depth(self, p: Array) -> float:
        """How far p (3,) is behind the surface (m), 0 in front of it."""
        return max(0.0, float((self.point - p) @ self.normal)) if self.stiffness > 0.0 else 0.0

    def wrench(self, p: Array) -> Array:
        """What acts on the tool centre point at p (3,)."""
        found = self.push.copy()
        found[:3] += self.stiffness * self.depth(p) * self.normal
        return found


@dataclass
class ForceSensor:
    """Offset of zero_ftsensor, and the wrench that a client writes in place of the built-in sensor's."""

    offset: Array = field(default_factory=lambda: np.zeros(6))
    external: bool = False
    written: list[float] = field(default_factory=lambda: [0.0] * 6)
