"""SlewLimiter: limits speed, acceleration and jerk of the joint velocity command and replaces non-finite commands."""

from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

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
        state = self.DeclareDiscreteState(np.zeros(12))
        self.DeclareVectorOutputPort("velocity_command", 6, self._output, {self.discrete_state_ticket(state)})
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        old = context.get_discrete_state_vector().value()
        v, a = slew_limit(self._wanted.Eval(context), old[:6], old[6:], self._limits, self._period_s)
        discrete.set_value(np.concatenate([v, a]))

    def _output(self, context: Context, output: BasicVector) -> Any:
        output.SetFromVector(context.get_discrete_state_vector().value()[:6])
