"""A link to a robot that is not there: it shows what it was given and remembers what it was told."""

from __future__ import annotations

import numpy as np

from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import LinkState


class StillLink:
    """Position q (6,) rad, velocity qd (6,) rad/s, the age of the sample s, and a fault; commands in order."""

    def __init__(self, q: np.ndarray) -> None:
        self.q, self.qd = np.array(q), np.zeros(6)
        self.age_s = 0.0
        self.robot_time = 0.0
        self.fault = Fault.NONE
        self.commands: list[np.ndarray] = []
        self.processes: list[bool] = []
        self.shares: np.ndarray | None = None  # of the newest command

    def state(self) -> LinkState:
        """What a worker would have written."""
        state = {"robot_mode": 7, "safety_mode": 1, "runtime_state": 2, "speed_scaling": 1.0}
        return LinkState(
            q=self.q, qd=self.qd, robot_time=self.robot_time, age_s=self.age_s, fault=self.fault, arc=-1, **state
        )

    def command(self, qd: np.ndarray, process: bool = False, shares: np.ndarray | None = None) -> int:
        """Remember it."""
        self.shares = shares
        self.processes.append(process)
        self.commands.append(np.array(qd))
        return len(self.commands)
