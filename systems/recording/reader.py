"""Read a recording, also one that was cut off, and compare a replayed cell with it bit for bit."""

from __future__ import annotations

import json
from base64 import b64decode
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError
from weldcal.models.files import opened
from weldcal.systems import messages
from weldcal.systems.recording.player import Track
from weldcal.systems.recording.port_recorder import BEFORE, BOTH, ENTERED, LEFT, PERIOD_S, STAGES
from weldcal.systems.recording.values import array, decode, encode, first_difference, read_cloud, read_image
from weldcal.systems.recording.writer import FORMAT, LISTED

READS = ("1", str(FORMAT))
LARGEST_RECORDING = 64 * 1024**3
_PLAYED = {
    kind.__name__: kind
    for kind in (messages.Scan, messages.StreamedScan, messages.ScanStream, messages.Image, messages.UrStatus)
}


@dataclass(frozen=True)
class Left:
    """One value (as JSON) of a port or result that left the cell, its key, and its number in the file."""

    number: int
    key: int
    value: Any


@dataclass(eq=False, kw_only=True)
class Recording:
    """A recording in memory.

    ``about``: versions, seed and what else the file says of the run; files: by name. entered: what the station's ports
    showed. left: messages by the name of the port or result, in order. rows: number in the file, key and values of all
    vector ports of a side. answers: looks by the number of the question. end: what is said of the end of the run; None
    where the file was cut off. last_key: of the newest message.
    """

    about: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    entered: dict[str, Track] = field(default_factory=dict)
    left: dict[str, list[Left]] = field(default_factory=dict)
    rows: dict[str, list[tuple[int, int, np.ndarray]]] = field(default_factory=dict)
    answers: dict[int, int] = field(default_factory=dict)
    end: dict[str, Any] | None = None
    last_key: int = 0
    n_messages: int = 0

    @property
    def n_entered(self) -> int:
        """The size of a row of all vector ports that entered."""
        return sum(json.loads(self.about["sizes"])[ENTERED].values())

    @property
    def end_tick(self) -> int:
        """The newest tick that is complete in the file."""
        return self.last_key // STAGES if self.end is not None else max(0, self.last_key // STAGES - 1)


def read_recording(path: Path) -> Recording:
    """Read a recording up to its last whole message.

    Raises:
        InputError: the file is no recording of weldcal, or of another format.
    """
    found, rising = Recording(), dict[str, tuple[list[int], list[Any]]]()
    with opened(path, LARGEST_RECORDING) as file:
        topics: dict[int, str] = {}
        body: np.ndarray | None = None
        try:
            for record in StreamReader(file, record_size_limit=None).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Metadata) and record.name == "weldcal":
                    found.about = dict(record.metadata)
                elif isinstance(record, Attachment):
                    found.files[record.name] = record.data
                elif isinstance(record, Message):
                    found.n_messages += 1
                    body = _take(found, rising, topics.get(record.channel_id, ""), record.data, body)
        except (McapError, EOFError, OSError, ValueError, IndexError):
            pass  # cut off, or no MCAP at all
        except Exception as error:  # the reader's own errors of a truncated record
            if type(error).__module__ not in ("struct", "mcap.exceptions", "builtins"):
                raise
    if not found.about:
        raise InputError(f"'{path}' is no recording of weldcal: give a recording.mcap that --record has written.")
    if found.about.get("format") not in READS:
        raise InputError(
            f"'{path}' has the format {found.about.get('format')}, and this weldcal reads {' and '.join(READS)}: use"
            f" the version that wrote it ({found.about.get('version', 'unknown')})."
        )
    sizes = json.loads(found.about["sizes"])
    _split(found.rows.get(ENTERED, []), sizes[ENTERED], rising)
    found.entered = {name: Track(keys, values) for name, (keys, values) in rising.items()}
    return found


def _split(
    rows: list[tuple[int, int, np.ndarray]], sizes: dict[str, int], rising: dict[str, tuple[list[int], list[Any]]]
) -> None:
    """Add the vector ports of rows."""
    first = 0
    keys = [key for _, key, _ in rows]
    for name, size in sizes.items():
        if rows:
            rising[name] = keys, [row[first : first + size] for _, _, row in rows]
        first += size


def _take(
    found: Recording, rising: dict[str, tuple[list[int], list[Any]]], topic: str, data: bytes, body: np.ndarray | None
) -> np.ndarray | None:
    """Add a message; returns the cloud or image that the next message belongs to."""
    if topic == "/scanner/points":
        return read_cloud(data)
    if topic == "/finger_camera/image":
        return read_image(data)
    if topic == "/tf":
        return body
    text = json.loads(data)
    if topic == "/answer":
        found.answers[text["number"]] = text["looks"]
        return None
    if topic == "/end":
        found.end = text
        return None
    key = int(text["key"])
    found.last_key = max(found.last_key, key)
    if topic == "/vectors":
        _add_rows(found, text["rows"])
        return None
    side, _, port = topic.strip("/").partition("/")
    if side == "out":
        found.left.setdefault(port, []).append(Left(found.n_messages, key, text["value"]))
    else:
        _add(rising, port, key, _played(text["type"], text["value"], body))
    return None


def _add_rows(found: Recording, given: list[Any]) -> None:
    """Add the rows of a message, in the order of their keys.

    In a recording of format 1 each has an entry of its own.
    """
    rows: dict[str, list[tuple[int, np.ndarray]]] = {}
    for keys, side, data in given:
        values = np.frombuffer(b64decode(data))
        if isinstance(keys, int):
            rows.setdefault(side, []).append((keys, values))
            continue
        table = values.reshape(len(keys), -1)
        n = found.n_entered if side == BOTH else table.shape[1]
        for name, part in ((ENTERED, table[:, :n]), (LEFT, table[:, n:])):
            if part.size:
                rows.setdefault(name, []).extend(zip(keys, part, strict=True))
    for side, of_side in rows.items():
        of_side.sort(key=lambda row: row[0])
        found.rows.setdefault(side, []).extend((found.n_messages, key, row) for key, row in of_side)


def _add(rising: dict[str, tuple[list[int], list[Any]]], port: str, key: int, value: Any) -> None:
    keys, values = rising.setdefault(port, ([], []))
    keys.append(key)
    values.append(value)


def _played(kind: str, value: dict[str, Any], body: np.ndarray | None) -> Any:
    """Return the message of a port from its JSON and the cloud or image before it."""
    if kind == "ndarray":  # a pose
        return RigidTransform(array(value))
    if kind not in _PLAYED:
        raise InputError(
            f"The recording holds a {kind}, which this version cannot play back: use the version that wrote it."
        )
    if kind in ("Scan", "StreamedScan"):
        return _with(_PLAYED[kind], value, "points_C", body)
    if kind == "Image":
        return _with(_PLAYED[kind], value, "pixels", body)
    return decode(value, _PLAYED[kind])


def _with(kind: Any, value: dict[str, Any], name: str, body: np.ndarray | None) -> Any:
    if body is None:
        raise InputError("The recording holds a scan or an image without its data: record the run again.")
    few = decode(value, kind)
    return type(few)(**{**vars(few), name: body})


@dataclass(frozen=True)
class Difference:
    """A value that is another one than in the recording.

    Its port and field, the time s, and the number of its message.
    """

    name: str
    time_s: float
    message: int
    was: Any
    now: Any

    def summary(self) -> dict[str, object]:
        """Return the JSON object."""
        return {"name": self.name, "time_s": self.time_s, "message": self.message, "was": self.was, "now": self.now}


class Comparison:
    """Compares with a recording up to its newest complete tick; keeps the first difference of each port."""

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
