"""MotionCollector: keeps the fits of streamed frames and the joints of the arm while the flange moves through the cube."""

from dataclasses import replace

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, State

from weldcal.calibration.data.motion_dataset import FrameTime
from weldcal.systems.jobs.motion.messages import MotionRecord, MotionState
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import FlangeEstimate

_BLOCK = 512  # samples that are joined to one array: copies of short tuples are cheap


class MotionCollector(LeafSystem):
    """Adds each new estimate, and a sample of the joints per tick.

    .. pydrake_system::

        name: MotionCollector
        input_ports:
        - flange_estimate
        - position_measured
        - sample_time
        - state
        output_ports:
        - record
    """

    def __init__(self, period_s: float = 0.008) -> None:
        super().__init__()
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._time = self.DeclareVectorInputPort("sample_time", 1)
        self._job = self.DeclareAbstractInputPort("state", AbstractValue.Make(MotionState()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(MotionRecord()))
        self.DeclareStateOutputPort("record", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._collect)

    def _collect(self, context: Context, state: State) -> None:
        old: MotionRecord = context.get_abstract_state(self._state).get_value()
        if self._job.Eval(context).phase not in ("approach", "collect", "home"):
            return
        row = np.append(self._time.Eval(context), self._position.Eval(context))
        new = _sampled(old, row)
        estimate: FlangeEstimate = self._estimate.Eval(context)
        if estimate.sequence > old.sequence and np.isfinite(estimate.arrival_time):
            new = _with_frame(new, estimate, context.get_time())
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)


def _sampled(record: MotionRecord, row: np.ndarray) -> MotionRecord:
    """The record with one more sample; a repeated time is left out."""
    last = record.newest[-1] if record.newest else (record.blocks[-1][-1] if record.blocks else None)
    if last is not None and row[0] <= last[0]:
        return record
    newest = (*record.newest, row)
    if len(newest) < _BLOCK:
        return replace(record, newest=newest)
    return replace(record, blocks=(*record.blocks, np.array(newest)), newest=())


def _with_frame(record: MotionRecord, estimate: FlangeEstimate, now: float) -> MotionRecord:
    """The record with one more frame."""
    id = f"{estimate.sequence:05d}"
    record = replace(record, sequence=estimate.sequence, waits_s=(*record.waits_s, now - estimate.arrival_time))
    if estimate.fit is None:
        return replace(record, refused=(*record.refused, (id, estimate.reason or "")))
    frame = FrameTime(id, estimate.arrival_time, estimate.device_time)
    return replace(record, seen=(*record.seen, (frame, estimate.fit)))
