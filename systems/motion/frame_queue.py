"""FrameQueue: holds streamed frames for a slower reader; when it is full the oldest frame is dropped and counted."""

import dataclasses as dc
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import FlangeEstimate, Message, ScanStream, StreamedScan


@dc.dataclass(frozen=True, eq=False)
class Queue(Message):
    """The frame that the reader has, those that wait, oldest first, the number of the newest frame that came, and those
    dropped."""

    served: StreamedScan = dc.field(default_factory=StreamedScan)
    waiting: tuple[StreamedScan, ...] = ()
    newest: int = 0
    dropped: int = 0
    taken: int = 0


def advance(queue: Queue, arrived: tuple[StreamedScan, ...], done: int, capacity: int) -> Queue:
    """The queue after frames arrived and the reader finished those up to number ``done``.

    A frame that never came counts as dropped, too.
    """
    new = tuple(f for f in arrived if f.sequence > queue.newest)
    waiting, dropped, taken, served = (*queue.waiting, *new), queue.dropped, queue.taken, queue.served
    newest = new[-1].sequence if new else queue.newest
    if queue.newest:  # numbers that are missing were lost before they arrived, or between two looks
        dropped += newest - queue.newest - len(new)
    if done >= served.sequence and waiting:
        if len(waiting) > capacity:
            dropped += len(waiting) - capacity
            waiting = waiting[-capacity:]
        served, waiting, taken = waiting[0], waiting[1:], taken + 1
    surplus = max(len(waiting) - capacity, 0)
    if served is queue.served and not new and not surplus:
        return queue
    return Queue(served, waiting[surplus:], newest, dropped + surplus, taken)


class FrameQueue(LeafSystem):
    """A bounded queue between a streaming scanner and the system that fits its frames.

    .. pydrake_system::

        name: FrameQueue
        input_ports:
        - stream
        - flange_estimate
        output_ports:
        - scan
        - counts

    `scan` is the frame to be worked on until the estimate with its number is there; then the next one follows. `counts`
    (3): frames handed on, frames dropped, frames waiting.
    """

    def __init__(self, capacity: int = 2, period_s: float = 0.004) -> None:
        super().__init__()
        self._capacity = capacity
        self._stream = self.DeclareAbstractInputPort("stream", AbstractValue.Make(ScanStream()))
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(Queue()))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("scan", lambda: AbstractValue.Make(StreamedScan()), self._scan, ticket)
        self.DeclareVectorOutputPort("counts", 3, self._counts, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: Queue = context.get_abstract_state(self._state).get_value()
        stream: ScanStream = self._stream.Eval(context)
        new = advance(old, stream.frames, self._estimate.Eval(context).sequence, self._capacity)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)

    def _scan(self, context: Context, output: Any) -> None:
        output.set_value(context.get_abstract_state(self._state).get_value().served)

    def _counts(self, context: Context, output: BasicVector) -> None:
        q: Queue = context.get_abstract_state(self._state).get_value()
        output.SetFromVector([float(q.taken), float(q.dropped), float(len(q.waiting))])
