"""PortRecorder: gives every change of the ports that a cell reads and drives to a sink, in the order in which Drake made it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, EventStatus

from weldcal.systems.leaf_system import LeafSystem

PERIOD_S = 0.002  # of the systems that are updated most often
UPDATE_TICKS = 4  # unrestricted updates are made at each fourth tick, 8 ms
# Publishing and unrestricted updates see a tick's ports as they were before it; discrete updates see them after the unrestricted ones.
BEFORE, UPDATED = 0, 1
STAGES = 2
ENTERED, LEFT = "entered", "left"


class PortSink(Protocol):
    """Takes the changes of ports. `key` is STAGES times the tick plus the stage; keys never fall."""

    def changed(
        self, key: int, vectors: Mapping[str, np.ndarray], entered: Mapping[str, Any], left: Mapping[str, Any]
    ) -> None:
        """Take what changed: `vectors` ENTERED and LEFT hold all vector ports of a side in a row; messages and poses by port."""


def tick_of(time_s: float) -> int:
    """Number of the newest tick at a time of the Diagram."""
    return int(time_s / PERIOD_S + 1e-6)


class PortRecorder(LeafSystem):
    """Looks at its inputs and gives those that changed to its sink.

    .. pydrake_system::

        name: PortRecorder
        input_ports:
        - entered
        - left

    Each recorded port with a message has an input port of its own besides, named "in." or "out." and its name.
    `entered` and `left` hold all vector ports of the two sides in a row, of the given sizes. All are looked at before the updates
    of each tick, and what entered once more between the unrestricted updates (each 8 ms) and the discrete ones. Messages change with
    unrestricted updates: they are looked at each 8 ms, those in `quick` at each tick.
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
        self._vectors = [
            (name, self.DeclareVectorInputPort(name, size))
            for name, size in zip((ENTERED, LEFT), sizes, strict=True)
            if size
        ]
        self._entered = [(name, self.DeclareAbstractInputPort(f"in.{name}", model)) for name, model in entered.items()]
        self._left = [(name, self.DeclareAbstractInputPort(f"out.{name}", model)) for name, model in left.items()]
        self._quick = [(name, port) for name, port in self._entered if name in quick]
        self._last: dict[str, Any] = {name: np.full(port.size(), np.nan) for name, port in self._vectors}
        self.DeclareDiscreteState([0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S * UPDATE_TICKS, 0.0, self._updated)
        self.DeclarePeriodicPublishEvent(PERIOD_S, 0.0, self._before)

    def _updated(self, context: Context, discrete: DiscreteValues) -> None:
        found = {}
        for name, port in self._vectors:
            if name == ENTERED and not np.array_equal(value := port.Eval(context), self._last[name], equal_nan=True):
                found[name] = self._last[name] = value
        messages = self._new_messages(context, "in.", self._entered)
        if found or messages:
            self._sink.changed(STAGES * tick_of(context.get_time()) + UPDATED, found, messages, {})

    def _before(self, context: Context) -> EventStatus:
        tick = tick_of(context.get_time())
        found = {name: port.Eval(context) for name, port in self._vectors}
        self._last |= found
        if tick % UPDATE_TICKS:
            entered, left = self._new_messages(context, "in.", self._quick), {}
        else:
            entered = self._new_messages(context, "in.", self._entered)
            left = self._new_messages(context, "out.", self._left)
        self._sink.changed(STAGES * tick + BEFORE, found, entered, left)
        return EventStatus.Succeeded()

    def _new_messages(self, context: Context, side: str, ports: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, port in ports:
            value, key = port.Eval(context), side + name
            last = self._last.get(key)
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
    """Whether both are messages from before the first, which a sensor may make anew each time."""
    return getattr(value, "sequence", 1) == 0 and getattr(last, "sequence", 1) == 0 and type(value) is type(last)
