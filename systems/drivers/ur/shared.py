"""Memory shared by two processes: blocks with one writer each and consistent reads, and a ring of joint positions."""

import mmap
import struct
import zlib

import numpy as np

from weldcal.models.arrays import Array

_COUNT_BYTES = 8
_CHECK = struct.Struct("<I")
_TRIES = 50
RING_ROWS = 1024  # 2 s at 500 Hz


class TornRead(RuntimeError):
    """The writer changed the block during each attempt to read it."""


class Block:
    """Numbers with one writer and any number of readers: a seqlock over two slots.

    A writer that is preempted during a write leaves the other slot intact. The count is the number of complete writes; its
    last bit selects the newest slot. The checksum covers machines that reorder stores.
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
        """All numbers of the newest write; None where nothing has been written yet.

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


COMMAND = ("number", "host_time", "stop", "process", *(f"qd{i}" for i in range(6)))
STATE = (
    "heartbeat",  # host time of the worker's last pass
    "phase",  # Phase of the worker
    "host_time",  # host time at which the robot took the sample
    "robot_time",
    *(f"q{i}" for i in range(6)),
    *(f"qd{i}" for i in range(6)),
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "speed_scaling",
    "fault",
    "detail",
    "fault_time",
    "number",  # of the newest command that was sent on
    "sent_time",
    "echo",  # newest number that the guard script has read
    "echo_latency",
    "worst_period",
    "late_periods",  # passes that came more than 20 ms late
    "process",  # 1 where the process output is on, as the controller reports it
    "residual",  # of the clock fit, s
    "drift",
    "arc",  # 1 established, 0 not, -1: not wired
)


class Memory:
    """The shared memory: one anonymous file, mapped by both processes."""

    def __init__(self, descriptor: int) -> None:
        command, state = Block.size(COMMAND), Block.size(STATE)
        self._map = mmap.mmap(descriptor, self.size())
        self.command = Block(self._map, 0, COMMAND)
        self.state = Block(self._map, command, STATE)
        self.ring = JointRing(self._map, command + state)

    @staticmethod
    def size() -> int:
        """Bytes to reserve."""
        return Block.size(COMMAND) + Block.size(STATE) + JointRing.size()
