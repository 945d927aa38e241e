"""The touch probe of the world: contact of the true tip with the true sphere, and the wire from it to the controller's
input."""

from dataclasses import dataclass

import numpy as np

from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.profiler_world import TIP_RADIUS_M, ProfilerTruth

CHATTER_FRAMES = 2
HOWS = ("", "cut", "stuck", "chatters")


@dataclass(kw_only=True)
class TouchProbe:
    """What the input reads.

    `how`: cut (the cable is broken), stuck (the contact stays closed), chatters (the contact opens and closes every few
    frames, touched or not), or "" (right).

    `touches` counts the contacts, and `deepest_m` is how far the tip was inside the sphere at most.
    """

    arm: ArmModel
    truth: ProfilerTruth
    normally_closed: bool
    how: str = ""
    touches: int = 0
    deepest_m: float = 0.0
    _contact: bool = False
    _frames: int = 0

    def set_how(self, how: str) -> None:
        """Change what is wrong with the probe. Raises InputError where there is no such fault."""
        if how not in HOWS:
            raise InputError(f"Give one of {', '.join(HOWS[1:])} or nothing as 'how', not '{how}'.")
        self.how = how

    def step(self, q: Array) -> bool:
        """The input's level for the true joints (6,) rad of this frame."""
        tip = tick_flange_pose(self.arm, q).multiply(self.truth.p_FTip)
        depth = self.truth.radius_m + TIP_RADIUS_M - float(np.linalg.norm(tip - self.truth.center))
        self.touches += depth > 0.0 and not self._contact
        self._contact = depth > 0.0
        self.deepest_m = max(self.deepest_m, depth)
        self._frames += 1
        if self.how == "cut":  # no voltage arrives
            return False
        closed = self._contact or self.how == "stuck"
        if self.how == "chatters":
            closed = self._frames // CHATTER_FRAMES % 2 == 0
        return closed != self.normally_closed
