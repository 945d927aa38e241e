"""The memory of a soft tip: springs that relax with one time, and friction within the material.

Spring constant k, deflection x: F = k (x + r (x - v) + b |x| z). v follows x with the relaxation time (standard linear
solid: the Zener model describes printed polyurethane up to 15 % strain, Golovkin et al., CMC 86(3), 18, 2026). z goes
from -1 to 1 with the direction of the motion, over TRANSITION_M: friction that does not depend on speed, in proportion
to the deflection. k is the constant after relaxation.
"""

import math
from dataclasses import dataclass

import numpy as np

from weldcal.models.arrays import Array

TRANSITION_M = 0.3e-3  # a choice: a tenth of the weld's press; the friction turns over it


@dataclass(frozen=True)
class Elastomer:
    """What a soft tip remembers.

    Attributes:
        relaxation_s: time in which the force of a held tip falls towards its last value.
        creep_share: part of the force of a fast press that relaxes, 0 to less than 1.
        loss_share: part of the work of a slow loading that friction keeps, 0 to less than 1.
    """

    relaxation_s: float
    creep_share: float
    loss_share: float

    @property
    def relaxing(self) -> float:
        """Stiffness of what relaxes over that of what does not (r)."""
        return self.creep_share / (1.0 - self.creep_share)

    @property
    def friction(self) -> float:
        """Friction over the elastic force (b): loading does k x^2 (1 + b) / 2, unloading returns k x^2 (1 - b) / 2."""
        return self.loss_share / (2.0 - self.loss_share)

    def step(self, memory: Array, before_m: Array, after_m: Array, dt_s: float) -> Array:
        """Return the memory (2, n), v in m and z, after a time in which the deflection (n,) m went evenly."""
        v, z = memory
        moved = after_m - before_m
        behind = moved / dt_s * self.relaxation_s  # v lags an even motion by this
        side = np.sign(moved)
        return np.array(
            [
                after_m - behind + (v - before_m + behind) * np.exp(-dt_s / self.relaxation_s),
                side + (z - side) * np.exp(-np.abs(moved) / TRANSITION_M),
            ]
        )

    def free_s(self, press_m: float, zero_m: float) -> float:
        """Return how long after a long press m a tip must be free until it is that near to its rest, m; in s.

        A free tip is at x = c v with c = r / (1 + r - b), and v' = (x - v) / relaxation_s.
        """
        share = self.relaxing / (1.0 + self.relaxing - self.friction)
        left = max(share * press_m / zero_m, 1.0)
        return self.relaxation_s / (1.0 - share) * math.log(left)

    def rest(self, memory: Array, deflection_m: Array) -> Array:
        """Return where the springs (n,), k (1 + r) stiff, pull to, m: where a tip rests that nothing touches."""
        v, z = memory
        return np.asarray((self.relaxing * v - self.friction * np.abs(deflection_m) * z) / (1.0 + self.relaxing))


# Compression set after 22 h at 23 C is the share of a held deflection that stays (ASTM D395B), Bayshore resilience the
# share of an impact's work that returns (ASTM D2632); Covestro's data sheets state: Texin 985 (85A) set 16 to 19 %;
# 245 (43D, about 95A) set 18 %, resilience 45 %; 255 (55D) set 20 %, resilience 40 %. A slow press loses less than an
# impact; a printed soft sensor less than 6 % (Soft Robotics, 10.1089/soro.2021.0074). Creep of TPU follows a power of
# time (Polymers 15:3770, 2023), so that no data sheet has one time: each time is a choice, of a weld's first seconds.
MATERIALS = {
    "tpu_85a": Elastomer(2.0, 0.16, 0.20),  # set of Texin 985; loss: a choice between 6 and 55 %
    "tpu_95a": Elastomer(2.0, 0.18, 0.30),  # set of Texin 245; loss: a choice between 6 and 55 %
    "silicone": Elastomer(1.0, 0.05, 0.06),  # loss of the soft sensor; creep small once stretched (Ecoflex, Liao 2020)
}
