"""Buffers between clocks: recent joint positions for a sensor datum, streamed frames for a slower reader."""

import dataclasses as dc
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import FlangeEstimate, Message, ScanStream, StreamedScan

LENGTH_S = 10.0  # an estimate of a scan is paired with its pose when it is ready, which a job waits 8 s for


@dataclass(frozen=True, eq=False)
class PoseHistory(Message):
    """Recent times (n,) s, ascending, and joint positions (n, 6) rad."""

    times: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    positions: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 6)))

    def joints_at(self, time: float) -> NDArray[np.float64] | None:
        """Joint positions (6,) rad interpolated to `time` s.

        None where `time` is more than one sample outside the history.
        """
        t = self.times
        if t.size < 2 or not t[0] <= time <= t[-1] + (t[-1] - t[-2]):
            return None
        k = int(np.clip(np.searchsorted(t, time), 1, t.size - 1))
        w = (time - t[k - 1]) / (t[k] - t[k - 1])
        return np.asarray((1.0 - w) * self.positions[k - 1] + w * self.positions[k])

    def pose_at(self, arm: ArmModel, time: float) -> RigidTransform | None:
        """Flange pose X_BF at `time` s; None as in joints_at."""
        q = self.joints_at(time)
        return None if q is None else tick_flange_pose(arm, q)


class PoseRecorder(LeafSystem):
    """Keeps a ring of joint positions with their sample times.

    .. pydrake_system::

        name: PoseRecorder
        input_ports:
        - position_measured
        - sample_time
        output_ports:
        - history
    """

    def __init__(self, period_s: float = 0.008, length_s: float = LENGTH_S) -> None:
        super().__init__()
        self._length = int(length_s / period_s)
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._time = self.DeclareVectorInputPort("sample_time", 1)
        self._state = self.DeclareAbstractState(AbstractValue.Make(PoseHistory()))
        self.DeclareStateOutputPort("history", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._record)

    def _record(self, context: Context, state: State) -> None:
        old: PoseHistory = context.get_abstract_state(self._state).get_value()
        time = float(self._time.Eval(context)[0])
        if old.times.size and time <= old.times[-1]:
            return
        n = min(old.times.size, self._length)
        times, positions = np.empty(n + 1), np.empty((n + 1, 6))
        times[:n], positions[:n] = old.times[old.times.size - n :], old.positions[old.times.size - n :]
        times[n], positions[n] = time, self._position.Eval(context)
        state.get_mutable_abstract_state(self._state).set_value(PoseHistory(times, positions))


@dc.dataclass(frozen=True, eq=False)
class Queue(Message):
    """The frame that the reader has, those that wait, oldest first, the newest frame's number, and those dropped."""

    served: StreamedScan = dc.field(default_factory=StreamedScan)
    waiting: tuple[StreamedScan, ...] = ()
    newest: int = 0
    dropped: int = 0
    taken: int = 0


def advance(queue: Queue, arrived: tuple[StreamedScan, ...], done: int, capacity: int) -> Queue:
    """Return the queue after frames arrived and the reader finished those up to number ``done``.

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
