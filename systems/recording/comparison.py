"""Compares what leaves a replayed cell with what left the recorded one, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from weldcal.systems.recording.port_recorder import BEFORE, LEFT, PERIOD_S, STAGES
from weldcal.systems.recording.reader import Recording
from weldcal.systems.recording.values import encode, first_difference
from weldcal.systems.recording.writer import LISTED


@dataclass(frozen=True)
class Difference:
    """A value that is another one than in the recording: its port and field, the time s, and the number of its
    message."""

    name: str
    time_s: float
    message: int
    was: Any
    now: Any

    def summary(self) -> dict[str, object]:
        """The JSON object."""
        return {"name": self.name, "time_s": self.time_s, "message": self.message, "was": self.was, "now": self.now}


class Comparison:
    """A CellSink that compares with a recording up to its newest complete tick, and keeps the first difference of each
    port."""

    def __init__(self, recording: Recording, sizes: Mapping[str, int]) -> None:
        self._recording, self._sizes = recording, sizes
        self._rows = iter(recording.rows.get(LEFT, []))
        self._next = dict.fromkeys(recording.left, 0)
        self.differences: dict[str, Difference] = {}
        self.compared = 0

    @property
    def first(self) -> Difference | None:
        """The earliest difference."""
        return min(self.differences.values(), key=lambda d: (d.time_s, d.message), default=None)

    def changed(self, key: int, row: np.ndarray | None, entered: Mapping[str, Any], left: Mapping[str, Any]) -> None:
        """See PortSink."""
        if key // STAGES > self._recording.end_tick:
            return
        n = sum(self._sizes.values())
        if n and row is not None and key % STAGES == BEFORE:
            self._row(key, row[len(row) - n :])
        for name, value in left.items():
            self._message(key, name, value)

    def answered(self, number: int, looks: int) -> None:
        """See CellSink: the recording decides when an answer is there."""

    def finish(self) -> None:
        """Note the messages of the recording that did not come."""
        for name, given in self._recording.left.items():
            rest = [m for m in given[self._next[name] :] if m.key // STAGES <= self._recording.end_tick]
            if rest:
                self._note(name, rest[0].key, rest[0].number, "a message", None)

    def _row(self, key: int, row: np.ndarray) -> None:
        number, was_key, was = next(self._rows, (0, -1, None))
        if was is None or was_key != key:
            self._note("vectors", key, number, None, "a row of values")
            return
        self.compared += 1
        if row.tobytes() == was.tobytes():
            return
        first = 0
        for name, size in self._sizes.items():
            for k in range(first, first + size):
                if row[k].tobytes() != was[k].tobytes():
                    self._note(
                        f"{name}[{k - first}]" if size > 1 else name, key, number, float(was[k]), float(row[k]), name
                    )
                    break
            first += size

    def _message(self, key: int, name: str, value: Any) -> None:
        given, index = self._recording.left.get(name, []), self._next.get(name, 0)
        if index >= len(given) or given[index].key != key:
            self._note(name, key, given[index].number if index < len(given) else 0, None, "a message")
            if index >= len(given) or given[index].key > key:
                return
        self._next[name] = index + 1
        self.compared += 1
        found = first_difference(given[index].value, encode(value, LISTED))
        if found is not None:
            field, was, now = found
            self._note(f"{name}.{field}" if field else name, key, given[index].number, was, now, name)

    def _note(self, what: str, key: int, message: int, was: Any, now: Any, port: str | None = None) -> None:
        self.differences.setdefault(port or what, Difference(what, key // STAGES * PERIOD_S, message, was, now))
