"""Moves the point that the soft tip's springs pull to, as the tip's memory says."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from weldcal.models.tools.elastomers import Elastomer
from weldcal.systems.leaf_system import LeafSystem


class RelaxingTip(LeafSystem):
    """The rest point of the tip's three springs, which relax and lose work.

    .. pydrake_system::

        name: RelaxingTip
        input_ports:
        - tip_state
        output_ports:
        - desired_state

    `tip_state` (6): deflection m and its rate m/s. `desired_state` (6): the rest point m, and no rate. Both along the
    axes of T. The springs are `Elastomer.relaxing` stiffer than after relaxation.
    """

    def __init__(self, memory: Elastomer, period_s: float) -> None:
        super().__init__()
        self._memory, self._period_s = memory, period_s
        self._tip = self.DeclareVectorInputPort("tip_state", 6)
        state = self.DeclareDiscreteState(9)  # deflection, v and z of the last step
        self.DeclareVectorOutputPort("desired_state", 6, self._rest, {self.discrete_state_ticket(state)})
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        last = context.get_discrete_state_vector().value().reshape(3, 3)
        now = self._tip.Eval(context)[:3]
        memory = self._memory.step(last[1:], last[0], now, self._period_s)
        state.get_mutable_vector().SetFromVector(np.concatenate([now, *memory]))

    def _rest(self, context: Context, output: BasicVector) -> None:
        last = context.get_discrete_state_vector().value().reshape(3, 3)
        output.SetFromVector(np.concatenate([self._memory.rest(last[1:], last[0]), np.zeros(3)]))
