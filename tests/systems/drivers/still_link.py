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

    def state(self) -> LinkState:
        """What a worker would have written."""
        counts = {"sent": 0, "heard": 0, "late_periods": 0}
        times = dict.fromkeys(
            ("fault_time", "echo_latency_s", "worst_period_s", "clock_residual_s", "clock_drift"), 0.0
        )
        return LinkState(
            q=self.q,
            qd=self.qd,
            robot_time=self.robot_time,
            sampled_at=0.0,
            age_s=self.age_s,
            fault=self.fault,
            program_running=self.fault is Fault.NONE,
            **counts,
            **times,
        )

    def command(self, qd: np.ndarray, process: bool = False) -> int:
        """Remember it."""
        self.processes.append(process)
        self.commands.append(np.array(qd))
        return len(self.commands)
