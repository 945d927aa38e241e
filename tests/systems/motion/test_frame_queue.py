"""The bounded queue: the newest frames win, and what is dropped or never came is counted."""

from __future__ import annotations

from weldcal.systems.messages import StreamedScan
from weldcal.systems.motion.buffers import Queue, advance


def frames(*numbers: int) -> tuple[StreamedScan, ...]:
    return tuple(StreamedScan(n, arrival_time=0.05 * n) for n in numbers)


def test_a_reader_that_keeps_up_gets_every_frame_in_order() -> None:
    queue, got = Queue(), []
    for n in range(1, 9):
        queue = advance(queue, frames(*range(max(1, n - 3), n + 1)), n - 1, 2)
        got.append(queue.served.sequence)
    assert got == list(range(1, 9))
    assert (queue.dropped, queue.taken) == (0, 8)


def test_a_slow_reader_gets_the_newest_and_the_rest_is_counted() -> None:
    queue = advance(Queue(), frames(1), 0, 2)
    for n in range(2, 11):  # the reader is busy with frame 1
        queue = advance(queue, frames(n), 0, 2)
        assert len(queue.waiting) <= 2
        assert queue.served.sequence == 1
    assert queue.dropped == 7
    queue = advance(queue, frames(10), 1, 2)
    assert queue.served.sequence == 9
    queue = advance(queue, frames(10), 9, 2)
    assert (queue.served.sequence, queue.taken, queue.dropped) == (10, 3, 7)
    assert queue.taken + queue.dropped == 10


def test_frames_that_never_came_count_as_dropped() -> None:
    queue = advance(Queue(), frames(1), 0, 2)
    queue = advance(queue, frames(5), 1, 2)
    assert (queue.served.sequence, queue.dropped) == (5, 3)
    assert advance(queue, frames(5), 0, 2) is queue
