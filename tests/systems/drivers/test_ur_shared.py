"""Memory shared by two processes: what is read was written, whole, whenever the writer is interrupted."""

from __future__ import annotations

import dataclasses as dc
import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from weldcal.systems.drivers.ur.shared import (
    JOINTS,
    RING_ROWS,
    Block,
    Given,
    JointRing,
    Memory,
    Published,
    Record,
    TornRead,
)

NAMES = ("number", *(f"x{i}" for i in range(20)))

# each write has all its numbers in one simple relation
WRITER = """
import mmap, sys
from weldcal.systems.drivers.ur.shared import Block
block = Block(mmap.mmap(int(sys.argv[1]), 0), 0, tuple(sys.argv[2].split(",")))
k = 0.0
while True:
    k += 1.0
    block.write([k * i for i in range(1, len(block.names) + 1)])
"""
RING_WRITER = """
import mmap, sys
from weldcal.systems.drivers.ur.shared import JointRing
ring = JointRing(mmap.mmap(int(sys.argv[1]), 0), 0)
k = 0.0
while True:
    k += 1.0
    ring.append(k, [k * i for i in range(1, 7)])
"""


@pytest.fixture
def descriptor() -> Iterator[int]:
    """Of an anonymous file of 1 MB."""
    made = os.memfd_create("test")
    os.ftruncate(made, 1 << 20)
    yield made
    os.close(made)


@pytest.fixture
def block(descriptor: int) -> Block:
    """A block of this process."""
    return Block(mmap.mmap(descriptor, 0), 0, NAMES)


def newest(block: Block) -> tuple[float, ...] | None:
    """Read while another process writes as fast as it can: on a busy computer each of a read's attempts may meet two
    writes."""
    while True:
        with suppress(TornRead):
            return block.read()


def writing(text: str, descriptor: int) -> subprocess.Popen[bytes]:
    """Another process that writes as fast as it can."""
    return subprocess.Popen([sys.executable, "-c", text, str(descriptor), ",".join(NAMES)], pass_fds=(descriptor,))


def test_nothing_is_read_before_something_is_written(block: Block) -> None:
    assert block.read() is None


def test_the_newest_write_is_read(block: Block) -> None:
    for k in range(5):
        block.write([float(k + i) for i in range(len(NAMES))])
    assert block.read() == tuple(4.0 + i for i in range(len(NAMES)))


def test_a_number_that_is_not_one_passes_through(block: Block) -> None:
    block.write([float("nan")] * len(NAMES))
    found = block.read()
    assert found is not None
    assert np.isnan(found).all()


def test_no_read_is_ever_torn(descriptor: int, block: Block) -> None:
    process = writing(WRITER, descriptor)
    try:
        while newest(block) is None:
            assert process.poll() is None
            time.sleep(0.01)
        seen, last = set(), 0.0
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            found = newest(block)
            assert found is not None
            assert found == tuple(found[0] * i for i in range(1, len(NAMES) + 1))
            assert found[0] >= last, "time does not run backwards"
            last = found[0]
            seen.add(found[0])
        assert len(seen) > 10, "the writer wrote meanwhile"
    finally:
        process.kill()
        process.wait()


def test_a_writer_that_is_killed_leaves_a_whole_value(descriptor: int, block: Block) -> None:
    # killed at ten random moments of its loop, of which most is the write
    for k in range(10):
        process = writing(WRITER, descriptor)
        try:
            before = newest(block)
            while newest(block) == before:
                assert process.poll() is None
            time.sleep(1e-4 * k)
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
        found = block.read()
        assert found is not None
        assert found == tuple(found[0] * i for i in range(1, len(NAMES) + 1))


def test_a_write_that_ends_in_the_middle_is_not_seen(descriptor: int) -> None:
    memory = mmap.mmap(descriptor, 0)
    block = Block(memory, 0, NAMES)
    for k in range(3):
        block.write([float(k)] * len(NAMES))
    # what the next write begins with, at every length
    size = 8 * len(NAMES)
    start = 8 + 0 * (size + 8)
    for length in range(0, size + 1, 4):
        memory[start : start + length] = b"\x55" * length
        assert block.read() == (2.0,) * len(NAMES)


def test_the_ring_interpolates_between_samples(descriptor: int) -> None:
    ring = JointRing(mmap.mmap(descriptor, 0), 0)
    for k in range(5):
        ring.append(10.0 + 0.004 * k, [0.1 * k] * 6)
    found = ring.at(10.009)
    assert found is not None
    np.testing.assert_allclose(found, [0.225] * 6, atol=1e-12)


def test_the_ring_answers_only_for_what_it_holds(descriptor: int) -> None:
    ring = JointRing(mmap.mmap(descriptor, 0), 0)
    assert ring.at(10.0) is None
    for k in range(5):
        ring.append(10.0 + 0.004 * k, [float(k)] * 6)
    assert ring.at(9.999) is None
    assert ring.at(10.016) is not None
    assert ring.at(10.03) is None


def test_the_ring_forgets_the_oldest(descriptor: int) -> None:
    ring = JointRing(mmap.mmap(descriptor, 0), 0)
    for k in range(RING_ROWS + 300):
        ring.append(0.002 * k, [float(k)] * 6)
    rows = ring.samples()
    assert RING_ROWS - 2 <= rows.shape[0] <= RING_ROWS
    assert (np.diff(rows[:, 0]) > 0.0).all()
    assert rows[-1, 1] == RING_ROWS + 299
    assert ring.at(0.002 * 200) is None
    found = ring.at(0.002 * 1000.5)
    assert found is not None
    np.testing.assert_allclose(found, [1000.5] * 6)


def test_the_ring_is_never_torn(descriptor: int) -> None:
    ring = JointRing(mmap.mmap(descriptor, 0), 0)
    process = writing(RING_WRITER, descriptor)
    try:
        until = time.monotonic() + 10.0
        while ring.samples().shape[0] < RING_ROWS - 1 and time.monotonic() < until:
            assert process.poll() is None
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            rows = ring.samples()
            np.testing.assert_array_equal(rows[:, 1:], rows[:, :1] * np.arange(1.0, 7.0))
    finally:
        process.kill()
        process.wait()


def filled(kind: type[Any], first: float) -> Any:
    """A record in which every number is another one, from `first` on."""
    values: dict[str, Any] = {}
    for item in dc.fields(kind):
        start = first + 10.0 * len(values)
        values[item.name] = np.arange(float(item.metadata["numbers"])) + start if item.metadata else item.type(start)  # type: ignore[operator]
    return kind(**values)


def assert_same(found: Any, written: Any) -> None:
    for item in dc.fields(written):
        given, back = getattr(written, item.name), getattr(found, item.name)
        assert type(back) is type(given), item.name
        np.testing.assert_array_equal(back, given, err_msg=item.name)


def test_blocks_and_ring_do_not_overlap(tmp_path: Path) -> None:
    with (tmp_path / "memory").open("w+b") as file:
        file.truncate(Memory.size())
        memory, other = Memory(file.fileno()), Memory(file.fileno())
    for k in range(RING_ROWS + 1):
        memory.command.write(filled(Given, 1.0 + k))
        memory.state.write(filled(Published, 2.0 + k))
        memory.ring.append(3.0 + k, [4.0] * 6)
    assert_same(other.command.read(), filled(Given, 1.0 + RING_ROWS))
    assert_same(other.state.read(), filled(Published, 2.0 + RING_ROWS))
    assert other.ring.samples()[-1, 0] == 3.0 + RING_ROWS


def remade(kind: type[Any], order: Sequence[int], added: bool) -> type[Any]:
    """The same record with its fields in another order, and with a field more in the middle."""
    given = dc.fields(kind)
    columns: list[Any] = [(f.name, f.type, dc.field(metadata=dict(f.metadata))) for f in (given[k] for k in order)]
    if added:
        columns.insert(len(columns) // 2, ("added", np.ndarray, dc.field(metadata=JOINTS)))
    return dc.make_dataclass(kind.__name__, columns, frozen=True, eq=False, kw_only=True)


@pytest.mark.parametrize("kind", [Given, Published])
@pytest.mark.parametrize("added", [False, True])
def test_fields_in_any_order_and_one_more_come_back_by_name(kind: type[Any], added: bool, descriptor: int) -> None:
    n = len(dc.fields(kind))
    for seed in range(5):
        other = remade(kind, np.random.default_rng(seed).permutation(n).tolist(), added)
        memory = mmap.mmap(descriptor, 0)
        written = filled(other, 1.0)
        Record(memory, 64, other).write(written)
        assert_same(Record(memory, 64, other).read(), written)
    assert Record.size(other) == Record.size(kind) + added * 2 * 8 * 6


def test_a_field_that_has_no_layout_is_refused(descriptor: int) -> None:
    kind = dc.make_dataclass("Kind", [("name", str)])
    with pytest.raises(TypeError, match=r"Kind\.name is neither a number nor an array"):
        Record(mmap.mmap(descriptor, 0), 0, kind)
