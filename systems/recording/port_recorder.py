"""Give every change of the ports that a cell reads and drives to a sink, in the order in which Drake made it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, InputPort

from weldcal.systems.leaf_system import LeafSystem

PERIOD_S = 0.002  # of the systems that are updated most often
UPDATE_TICKS = 4  # unrestricted updates are made at each fourth tick, 8 ms
# Publishing and unrestricted updates see a tick's ports as they were before it; discrete updates see them after the
# unrestricted ones.
BEFORE, UPDATED = 0, 1
STAGES = 2
ENTERED, LEFT, BOTH = "entered", "left", "both"
_Port = tuple[str, str, InputPort]  # name, key of its last value
_NOTHING: Mapping[str, Any] = {}


class PortSink(Protocol):
    """Takes the changes of ports. `key` is STAGES times the tick plus the stage; keys never fall."""

    def changed(self, key: int, row: np.ndarray | None, entered: Mapping[str, Any], left: Mapping[str, Any]) -> None:
        """Take what changed: a row of the vector ports, messages and poses by port.

        At BEFORE the row holds all that entered and then all that left, at UPDATED only what entered; None where that
        is as it was.
        """


def tick_of(time_s: float) -> int:
    """Number of the newest tick at a time of the Diagram."""
    return int(time_s / PERIOD_S + 1e-6)


class PortRecorder(LeafSystem):
    """Looks at its inputs and gives those that changed to its sink.

    .. pydrake_system::

        name: PortRecorder
        input_ports:
        - entered
        - both

    Each recorded port with a message has an input port of its own besides, named "in." or "out." and its name.
    `entered` holds all vector ports of what entered in a row, `both` holds them and those that left, of the given
    sizes. `both` is looked at before the updates of each tick, and what entered once more between the unrestricted
    updates (each 8 ms) and the discrete ones. Messages change with unrestricted updates: they are looked at each 8 ms,
    those in `quick` at each tick.
    """

    def __init__(
        self,
        sizes: tuple[int, int],
        entered: Mapping[str, AbstractValue],
        left: Mapping[str, AbstractValue],
        sink: PortSink,
        quick: tuple[str, ...] = (),
    ) -> None:
        super().__init__()
        self._sink = sink
        self._row = self.DeclareVectorInputPort("entered", sizes[0]) if sizes[0] else None
        self._both = self.DeclareVectorInputPort("both", sum(sizes)) if sum(sizes) else None
        self._n_entered = sizes[0]
        self._entered, self._left = (
            [
                (name, f"{side}.{name}", self.DeclareAbstractInputPort(f"{side}.{name}", model))
                for name, model in of.items()
            ]
            for side, of in (("in", entered), ("out", left))
        )
        self._quick = [port for port in self._entered if port[0] in quick]
        self._last: dict[str, Any] = {}
        self._last_entered = b""
        self.DeclareDiscreteState([0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S * UPDATE_TICKS, 0.0, self._updated)
        self.DeclarePeriodicPublishEvent(PERIOD_S, 0.0, self._before)

    def _updated(self, context: Context, discrete: DiscreteValues) -> None:
        row = None
        if self._row is not None and (now := self._row.Eval(context)).tobytes() != self._last_entered:
            row, self._last_entered = now, now.tobytes()
        messages = self._new_messages(context, self._entered)
        if row is not None or messages:
            self._sink.changed(STAGES * tick_of(context.get_time()) + UPDATED, row, messages, {})

    def _before(self, context: Context) -> None:
        tick = tick_of(context.get_time())
        row = self._both.Eval(context) if self._both is not None else None
        if tick % UPDATE_TICKS:
            entered, left = self._new_messages(context, self._quick), _NOTHING
        else:
            if row is not None:
                self._last_entered = row[: self._n_entered].tobytes()
            entered = self._new_messages(context, self._entered)
            left = self._new_messages(context, self._left)
        self._sink.changed(STAGES * tick + BEFORE, row, entered, left)

    def _new_messages(self, context: Context, ports: list[_Port]) -> Mapping[str, Any]:
        found: dict[str, Any] = {}
        for name, key, port in ports:
            value, last = port.Eval(context), self._last.get(key)
            if value is last:
                continue
            if isinstance(value, RigidTransform):
                value = value.GetAsMatrix34()
                if last is not None and np.array_equal(value, last):
                    continue
            elif _both_empty(value, last):
                continue
            self._last[key] = found[name] = value
        return found


def _both_empty(value: Any, last: Any) -> bool:
    """Return whether both are messages from before the first, which a sensor may make anew each time."""
    return getattr(value, "sequence", 1) == 0 and getattr(last, "sequence", 1) == 0 and type(value) is type(last)
