"""SlewLimiter: limits speed, acceleration and jerk of the joint velocity command and replaces non-finite commands."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.systems.leaf_system import LeafSystem
from weldcal.welding.servo.guards import SlewLimits, slew_limit


class SlewLimiter(LeafSystem):
    """Follows the commanded joint velocity as fast as its limits allow.

    .. pydrake_system::

        name: SlewLimiter
        input_ports:
        - velocity_wanted
        output_ports:
        - velocity_command

    Both (6) rad/s. A commanded velocity that is not finite makes it slow down to rest.
    """

    def __init__(self, limits: SlewLimits, period_s: float = 0.002) -> None:
        super().__init__()
        self._limits, self._period_s = SlewLimits(*limits.rows(6)), period_s
        # the first call loads machine code, which no tick has time for
        slew_limit(np.zeros(6), np.zeros(6), np.zeros(6), self._limits, period_s)
        self._wanted = self.DeclareVectorInputPort("velocity_wanted", 6)
        self._velocity = self.DeclareDiscreteState(np.zeros(6))
        self._acceleration = self.DeclareDiscreteState(np.zeros(6))
        self.DeclareStateOutputPort("velocity_command", self._velocity)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        v, a = discrete.value(self._velocity), discrete.value(self._acceleration)
        v, a = slew_limit(self._wanted.Eval(context), v, a, self._limits, self._period_s)
        discrete.set_value(self._velocity, v)
        discrete.set_value(self._acceleration, a)
