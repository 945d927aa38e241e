"""A Diagram's system that asks a device for one datum per trigger: what scanners and profilers by wire share."""

import time
from typing import Any, Generic, Protocol, TypeVar

from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.systems.drivers.sensors.acquisition import Acquisition
from weldcal.systems.drivers.sensors.stamps import DiagramTime
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message

Shown = TypeVar("Shown", bound=Message)
Made = TypeVar("Made", bound=Message, covariant=True)


class Maker(Protocol[Made]):
    """Makes the message on the port from number, capture time and datum; without arguments the empty one."""

    def __call__(self, sequence: int = ..., capture_time: float = ..., datum: NDArray[Any] = ..., /) -> Made: ...


class OnTrigger(LeafSystem, Generic[Shown]):
    """Asks the device for one datum per trigger.

    .. pydrake_system::

        name: OnTrigger
        input_ports:
        - trigger
        output_ports:
        - scan

    The output port has the name `port`, such as scan or profile. The Diagram does not wait for the answer, unless it
    may (`waits`). The capture time is that of the datum's stamp, and at the earliest that of its trigger: from then on
    the arm is at rest.
    """

    def __init__(
        self, acquisition: Acquisition[Any], port: str, message: Maker[Shown], period_s: float, waits: bool = False
    ) -> None:
        super().__init__()
        self.acquisition, self._message, self._waits = acquisition, message, waits
        self._times, self._shown = DiagramTime(), message()
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        state = self.DeclareDiscreteState([0.0, 0.0, 0.0])  # number asked for, its time, number shown
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort(port, lambda: AbstractValue.Make(message()), self._output, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        now = context.get_time()
        self._times.add(time.monotonic(), now)
        asked, asked_at, shown = context.get_discrete_state_vector().value()
        wanted = int(self._trigger.Eval(context)[0])
        if wanted > asked:
            asked, asked_at = float(wanted), now
            self.acquisition.request(wanted)
        if asked > shown:
            number = int(asked)
            found = self.acquisition.wait_for_answer(number) if self._waits else self.acquisition.answer(number)
            if found is not None:
                captured = max(self._times.at(found.stamp.captured), asked_at)
                self._shown = self._message(number, captured, found.datum)
                shown = asked
        discrete.set_value([asked, asked_at, shown])

    def _output(self, context: Context, output: Any) -> None:
        shown = context.get_discrete_state_vector()[2] > 0.5
        output.set_value(self._shown if shown else self._message())
