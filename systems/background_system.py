"""BackgroundSystem: a LeafSystem whose output is computed beside the control loop from inputs of an earlier tick."""

from dataclasses import dataclass
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, State

from weldcal.systems.background import Answer, Background, Inline, import_module
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message


@dataclass(frozen=True, eq=False)
class _Work(Message):
    """The newest value of the output, and the answer that will replace it."""

    newest: Any
    asked: Answer[Any] | None = None


class BackgroundSystem(LeafSystem):
    """Asks for one computation at a time and outputs its answer at the first update after it is ready.

    A subclass declares its input ports and implements `ask`. In a simulation the answer is there at once, so the
    output does not depend on the computer.
    """

    def __init__(self, port: str, first: Message, background: Background | None, period_s: float) -> None:
        super().__init__()
        self.background = background or Inline()
        self.background.prepare(import_module, type(self).__module__)
        self._work = self.DeclareAbstractState(AbstractValue.Make(_Work(first)))
        ticket = {self.abstract_state_ticket(self._work)}
        self.DeclareAbstractOutputPort(port, lambda: AbstractValue.Make(first), self._output, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def ask(self, context: Context, newest: Any) -> Answer[Any] | None:
        """Start the computation that the inputs call for; None where they call for none.

        `newest` is the present output.
        """
        raise NotImplementedError

    def newest(self, context: Context) -> Any:
        """The present output in this system's context."""
        return context.get_abstract_state(self._work).get_value().newest

    def _update(self, context: Context, state: State) -> None:
        old: _Work = context.get_abstract_state(self._work).get_value()
        asked = old.asked or self.ask(context, old.newest)
        if asked is None or (asked is old.asked and not asked.ready):
            return
        new = _Work(asked.value) if asked.ready else _Work(old.newest, asked)
        state.get_mutable_abstract_state(self._work).set_value(new)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(self.newest(context))
