"""The world's streaming scanner: its frames are exposed at its own rate, stamped by its own clock, and arrive after
their delay."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.streaming_scanner import StreamingScanner
from weldcal.tools.emulators.cell.physics import STEP_S
from weldcal.tools.emulators.cell.streamer import IDLE_S, LIMIT_S, Exposure, Streamer, Waiter


class Pipe:
    """The scanner's end of the pipe, which renders at once; `frame` is the world's when an exposure was handed on."""

    def __init__(self) -> None:
        self.frame = 0
        self.handed: list[tuple[int, Exposure]] = []

    def send(self, it: Exposure) -> None:
        self.handed.append((self.frame, it))

    def poll(self, _: float) -> bool:
        return True

    def recv(self) -> str:
        return "shown"


def played(config: StreamingScanner, frames: int, *, busy: bool = True, knock_at: int = -1) -> tuple[Streamer, Pipe]:
    pipe = Pipe()
    streamer = Streamer(config, 1, pipe, lambda: STEP_S * pipe.frame)  # type: ignore[arg-type]
    for frame in range(1, frames + 1):
        pipe.frame = frame
        if frame == knock_at:
            streamer.knock(STEP_S * frame)
        streamer.step(frame, lambda: np.full(6, STEP_S * pipe.frame), busy)
    return streamer, pipe


def test_frames_are_stamped_by_the_scanners_own_clock_and_arrive_after_their_delay() -> None:
    config = StreamingScanner(fps=10.0, delay_ms=100.0, jitter_ms=10.0, device_epoch_s=500.0, device_drift_ppm=100.0)
    streamer, pipe = played(config, 2500)
    exposures = [it for _, it in pipe.handed]
    assert [it.number for it in exposures] == list(range(1, len(exposures) + 1))
    captured = np.array([np.mean([q[0] for q in it.instants]) for it in exposures])  # the poses tell when they were
    assert {len(it.instants) for it in exposures} == {config.exposure_samples}
    assert np.diff(captured) == pytest.approx(0.1, abs=1.1 * STEP_S)
    truth = streamer.truth()["scanner_clock"]
    assert isinstance(truth, dict)
    world_s = (np.array([it.device_s for it in exposures]) - truth["at_0_s"]) / truth["rate"]
    assert world_s == pytest.approx(captured, abs=2e-4)
    delays = np.array([STEP_S * frame for frame, _ in pipe.handed]) - captured
    assert delays.min() > 0.08
    assert delays.mean() == pytest.approx(0.1, abs=0.01)


def test_a_scanner_that_nobody_looks_at_takes_a_frame_now_and_then() -> None:
    assert len(played(StreamingScanner(), 5000, busy=False)[1].handed) == pytest.approx(10.0 / IDLE_S, abs=1)


def test_a_device_that_has_stopped_is_waited_for_once() -> None:
    class Stopped(Pipe):
        def poll(self, seconds: float) -> bool:
            waits.append(seconds)
            return len(waits) > 4

    waits: list[float] = []
    pipe = Stopped()
    waiter = Waiter(pipe)  # type: ignore[arg-type]
    for number in range(6):
        waiter.send(number)
    assert waits == [LIMIT_S, 0.0, 0.0, 0.0, 0.0]
    assert [it for _, it in pipe.handed] == [0, 5]


def test_a_knock_shows_in_the_frames_after_it() -> None:
    streamer, pipe = played(StreamingScanner(fps=10.0, knock_s=1e5), 2500, knock_at=1250)
    assert streamer.truth()["knocked_at_s"] == 2.5
    for _, it in pipe.handed:
        assert it.knocked == (it.instants[-1][0] >= 2.5)
    planned = played(StreamingScanner(fps=10.0, knock_s=1.5), 1000)[0]
    assert planned.truth()["knocked_at_s"] == 1.5


def test_a_scanner_without_a_stand_to_be_knocked_says_what_to_write() -> None:
    with pytest.raises(InputError, match=r"scanner\.knock_s"):
        played(StreamingScanner(), 10, knock_at=5)
