"""Memory shared by two processes: blocks with one writer each and consistent reads, and a ring of joint positions."""

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar

import numpy as np

from weldcal.models.arrays import Array

_COUNT_BYTES = 8
_CHECK = struct.Struct("<I")
_TRIES = 50
RING_ROWS = 1024  # 2 s at 500 Hz
JOINTS = {"numbers": 6}  # metadata of a field that holds one number a joint

T = TypeVar("T")


class TornRead(RuntimeError):
    """The writer changed the block during each attempt to read it."""


class Block:
    """Numbers with one writer and any number of readers: a seqlock over two slots.

    A writer that is preempted during a write leaves the other slot intact. The count is the number of complete writes;
    its last bit selects the newest slot. The checksum covers machines that reorder stores.
    """

    def __init__(self, memory: mmap.mmap, offset: int, names: tuple[str, ...]) -> None:
        self._memory, self._offset = memory, offset
        self.names = names
        self._payload = struct.Struct(f"<{len(names)}d")
        # an aligned array element is written and read atomically; struct.pack_into writes byte by byte
        self._writes = np.frombuffer(memory, dtype=np.uint64, count=1, offset=offset)
        self._count = 0

    @staticmethod
    def size(names: tuple[str, ...]) -> int:
        """Bytes of a block of these numbers."""
        return _COUNT_BYTES + 2 * (8 * len(names) + 8)

    def _slot(self, count: int) -> int:
        return self._offset + _COUNT_BYTES + (count % 2) * (self._payload.size + 8)

    def write(self, values: list[float]) -> None:
        """Replace all numbers, in the order of `names`."""
        payload = self._payload.pack(*values)
        start = self._slot(self._count + 1)
        self._memory[start : start + len(payload)] = payload
        _CHECK.pack_into(self._memory, start + len(payload), zlib.crc32(payload))
        self._count += 1
        self._writes[0] = self._count

    def read(self) -> tuple[float, ...] | None:
        """Return all numbers of the newest write; None where nothing has been written yet.

        Raises:
            TornRead: the writer changed the block during each attempt.
        """
        size = self._payload.size
        for _ in range(_TRIES):
            count = int(self._writes[0])
            if count == 0:
                return None
            start = self._slot(count)
            payload = self._memory[start : start + size]
            (check,) = _CHECK.unpack_from(self._memory, start + size)
            # while the count is unchanged, its slot is not written
            if count == int(self._writes[0]) and check == zlib.crc32(payload):
                return self._payload.unpack(payload)
        raise TornRead("the shared memory could not be read consistently")


class Record(Generic[T]):
    """A block that holds the fields of a dataclass: float, int, bool, or an Array with its size as in JOINTS.

    The layout is generated from the fields, so that both processes agree whatever their order is.
    """

    def __init__(self, memory: mmap.mmap, offset: int, kind: type[T]) -> None:
        self._kind, self._parts = kind, tuple(_parts(kind))
        self._block = Block(memory, offset, _numbers(kind))

    @staticmethod
    def size(kind: type[Any]) -> int:
        """Bytes of a block that holds the fields of this dataclass."""
        return Block.size(_numbers(kind))

    def write(self, record: T) -> None:
        """Replace all fields."""
        values: list[float] = []
        for name, _, count, _ in self._parts:
            value = getattr(record, name)
            if count is None:
                values.append(value)
            else:
                values.extend(value)
        self._block.write(values)

    def read(self) -> T | None:
        """Return the newest record; None where nothing has been written yet.

        Raises:
            TornRead: the writer changed the block during each attempt.
        """
        found = self._block.read()
        if found is None:
            return None
        return self._kind(
            **{
                name: convert(found[at]) if count is None else np.array(found[at : at + count])
                for name, at, count, convert in self._parts
            }
        )


def _parts(kind: type[Any]) -> Iterator[tuple[str, int, int | None, Callable[[float], Any]]]:
    """Of each field: its name, the index of its first number, how many numbers an Array has, and its type."""
    at = 0
    for item in fields(kind):
        count: int | None = item.metadata.get("numbers")
        if count is None and item.type not in (float, int, bool):
            raise TypeError(f"{kind.__name__}.{item.name} is neither a number nor an array of a stated size")
        yield item.name, at, count, item.type if callable(item.type) else float
        at += 1 if count is None else count


def _numbers(kind: type[Any]) -> tuple[str, ...]:
    """Return a name for each number of the block."""
    return tuple(
        name if count is None else f"{name}{i}" for name, _, count, _ in _parts(kind) for i in range(count or 1)
    )


class JointRing:
    """The last joint positions with the host time (s, monotonic) at which the robot took them; one writer."""

    def __init__(self, memory: mmap.mmap, offset: int) -> None:
        self._head = np.frombuffer(memory, dtype=np.uint64, count=1, offset=offset)
        flat = np.frombuffer(memory, dtype=np.float64, count=7 * RING_ROWS, offset=offset + 8)
        self._rows = flat.reshape(RING_ROWS, 7)

    @staticmethod
    def size() -> int:
        """Bytes of the ring."""
        return 8 + 56 * RING_ROWS

    def append(self, host_time: float, q: list[float]) -> None:
        """Add the newest sample."""
        head = int(self._head[0])
        self._rows[head % RING_ROWS] = (host_time, *q)
        self._head[0] = head + 1

    def samples(self) -> Array:
        """(n, 7) host time and joint positions, oldest first; rows overwritten during the read are omitted."""
        before = int(self._head[0])
        n = min(before, RING_ROWS)
        rows = self._rows[np.arange(before - n, before) % RING_ROWS].copy()
        lost = max(int(self._head[0]) - before + 1, 0) if n == RING_ROWS else 0
        return rows[lost:]

    def at(self, host_time: float, *, beyond_s: float = 0.004) -> Array | None:
        """Joint positions (6,) rad interpolated to a host time; None where the ring does not cover it."""
        rows = self.samples()
        if rows.shape[0] < 2 or not rows[0, 0] <= host_time <= rows[-1, 0] + beyond_s:
            return None
        k = int(np.clip(np.searchsorted(rows[:, 0], host_time), 1, rows.shape[0] - 1))
        (t0, *q0), (t1, *q1) = rows[k - 1], rows[k]
        w = (host_time - t0) / max(t1 - t0, 1e-9)
        return np.asarray((1.0 - w) * np.array(q0) + w * np.array(q1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Given:
    """A command of the cell."""

    number: int
    host_time: float  # at which it was given
    stop: bool
    process: bool  # the process output is enabled
    qd: Array = field(metadata=JOINTS)
    # of the range of analog outputs 0 and 1, while the torch is asked for; NaN: the scenario's value
    shares: Array = field(default_factory=lambda: np.full(2, np.nan), metadata={"numbers": 2})


@dataclass(frozen=True, eq=False, kw_only=True)
class Published:
    """The state that the worker publishes in each pass; times in s."""

    heartbeat: float = 0.0  # host time of the worker's last pass
    phase: int = 0  # Phase of the worker
    host_time: float = 0.0  # host time at which the robot took the sample
    robot_time: float = 0.0
    q: Array = field(default_factory=lambda: np.zeros(6), metadata=JOINTS)
    qd: Array = field(default_factory=lambda: np.zeros(6), metadata=JOINTS)
    robot_mode: int = 0
    safety_mode: int = 0
    runtime_state: int = 0
    speed_scaling: float = 0.0
    fault: int = 0
    detail: float = 0.0  # of the fault
    fault_time: float = 0.0
    number: float = 0.0  # of the newest command that was sent on
    sent_time: float = 0.0
    echo: float = 0.0  # newest number that the guard script has read
    echo_latency: float = 0.0
    worst_period: float = 0.0
    late_periods: int = 0  # passes that came more than 20 ms late
    process_on: bool = False  # the process output, as the controller reports it
    clock_residual: float = 0.0  # of the clock fit
    clock_drift: float = 0.0
    arc: int = 0  # 1 established, 0 not, -1: not wired


@dataclass(frozen=True, eq=False)
class Calling:
    """Whether the worker is inside a call of the transport, which may not return where the connection is lost."""

    inside: bool = False


class Memory:
    """The shared memory: one anonymous file, mapped by both processes."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, self.size())
        self.command = Record(self._map, 0, Given)
        self.state = Record(self._map, Record.size(Given), Published)
        self.calling = Record(self._map, Record.size(Given) + Record.size(Published), Calling)
        self.ring = JointRing(self._map, self.size() - JointRing.size())

    @staticmethod
    def size() -> int:
        """Bytes to reserve."""
        return sum(map(Record.size, (Given, Published, Calling))) + JointRing.size()
