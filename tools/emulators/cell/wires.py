"""Devices at the controller's digital inputs, power source and touch probe, and the wires to them, which may fail."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.profiler_world import TIP_RADIUS_M, ProfilerTruth

IGNITION_S = 0.12
CHATTER_FRAMES = 2
HOWS = ("", "cut", "stuck", "chatters")
DELAY_S = 2.0
NOISE_S = 0.02  # a noisy wire has another value so often
SEED = 11


@dataclass
class Arc:
    """The arc behind an enable; without its set points (`fed`) it does not burn.

    `fails`: it does not ignite, and the fault input is on while it is asked for.
    """

    ignition_s: float = IGNITION_S
    fails: bool = False
    burns: bool = False
    fault: bool = False
    _asked_s: float = 0.0

    def step(self, enabled: bool, dt: float, fed: bool = True) -> None:
        """Advance by `dt` s."""
        enabled = enabled and fed
        self._asked_s = self._asked_s + dt if enabled else 0.0
        ready = self._asked_s > self.ignition_s + 1e-9
        self.burns = enabled and ready and not self.fails
        self.fault = enabled and ready and self.fails


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
        """Return the input's level for the true joints (6,) rad of this frame."""
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


@dataclass
class InputWire:
    """What the two inputs (arc established, arc fault) read.

    `how`: killed (off), frozen (as they are), delayed, garbage, or "" (right).
    """

    how: str = ""
    _shown: tuple[bool, bool] = (False, False)
    _sent: deque[tuple[float, tuple[bool, bool]]] = field(default_factory=deque)
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(SEED))
    _noise_until: float = 0.0

    def step(self, now: float, established: bool, fault: bool) -> tuple[bool, bool]:
        """Return the inputs at `now` (s) for an arc that is established and a power source at fault, or not."""
        right = (established, fault)
        if not self._sent or self._sent[-1][1] != right:
            self._sent.append((now, right))
        while len(self._sent) > 1 and self._sent[1][0] <= now - DELAY_S:
            self._sent.popleft()
        if self.how == "killed":
            self._shown = (False, False)
        elif self.how == "delayed":
            self._shown = self._sent[0][1] if self._sent[0][0] <= now - DELAY_S else self._shown
        elif self.how == "garbage":
            if now >= self._noise_until:
                self._noise_until = now + NOISE_S
                self._shown = (bool(self._rng.integers(2)), bool(self._rng.integers(2)))
        elif self.how != "frozen":
            self._shown = right
        return self._shown
