"""The power source: an arc some time after its enable, where it is given its set points; a digital input tells the
controller."""

from dataclasses import dataclass

IGNITION_S = 0.12


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
