"""The worker beside the Diagram: newest wins, nothing is lost uncounted, and every kind of trouble has its sentence."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.systems.drivers.sensors.scripted import Scripted, wait_until
from weldcal.systems.drivers.sensors.acquisition import Acquisition, Delivery, DeviceFault, DeviceLost, Garbage, Rules

CAMERA = Rules(silent_s=0.1, frozen_s=0.1, late_s=0.3, lost_s=0.1)


def picture(number: int) -> np.ndarray:
    return np.full((4, 4), number % 256, np.uint8)


@pytest.fixture
def device() -> Scripted:
    return Scripted(picture(1))


@pytest.fixture
def started(device: Scripted) -> Iterator[Acquisition[Any]]:
    acquisition = Acquisition(device, CAMERA, kept=3)
    acquisition.start(2.0, first_frame=True)
    yield acquisition
    acquisition.close()


def test_the_newest_frames_are_kept_and_those_nobody_looked_at_are_counted(
    started: Acquisition[Any], device: Scripted
) -> None:
    assert [int(f.datum[0, 0]) for f in started.frames()] == [1]
    device.script.extend(picture(n) for n in range(2, 12))
    assert wait_until(lambda: started.counts.received == 11)
    assert [int(f.datum[0, 0]) for f in started.frames()] == [9, 10, 11]
    # of the eleven the first was looked at, three are still there
    assert started.counts.dropped == 7
    assert started.counts.lost == 0


def test_gaps_in_the_devices_own_count_are_losses(started: Acquisition[Any], device: Scripted) -> None:
    now = time.monotonic()
    device.script.extend(Delivery(datum=picture(n), arrived=now, number=n) for n in (5, 6, 9, 10))
    assert wait_until(lambda: started.counts.received == 5)
    assert started.counts.lost == 2
    numbers = [f.number for f in started.frames()]
    assert numbers == [3, 6, 7]  # 1, 2, 3, then two that never came


def test_garbage_is_counted_and_what_follows_is_used(started: Acquisition[Any], device: Scripted) -> None:
    device.script.extend([Garbage("no JPEG"), Garbage("no JPEG"), picture(7)])
    assert wait_until(lambda: started.counts.received == 2)
    assert started.counts.garbled == 2
    assert started.fault(time.monotonic()) is None


def test_silence_is_a_fault_that_names_the_last_trouble(started: Acquisition[Any], device: Scripted) -> None:
    device.script.append(Garbage("it sent a picture that is not a whole JPEG"))
    assert wait_until(lambda: started.counts.garbled == 1)
    assert wait_until(lambda: started.fault(time.monotonic()) is not None)
    said = started.fault(time.monotonic())
    assert said == "The scripted device sent nothing usable for 0.1 s: it sent a picture that is not a whole JPEG."


def test_time_in_which_nobody_could_read_is_no_silence(started: Acquisition[Any]) -> None:
    assert wait_until(lambda: started.fault(time.monotonic()) is not None)
    started.excuse(10.0)
    assert started.fault(time.monotonic()) is None


def test_identical_frames_are_a_fault_and_a_new_one_ends_it(started: Acquisition[Any], device: Scripted) -> None:
    def send(number: int) -> bool:
        device.script.append(picture(number))
        time.sleep(0.02)
        return (started.fault(time.monotonic()) or "").startswith("The scripted device is frozen")

    assert wait_until(lambda: send(1))
    assert not send(2)


def test_a_lost_device_is_named_and_connected_again(started: Acquisition[Any], device: Scripted) -> None:
    device.refuses = DeviceLost("nothing answers at its address")
    device.script.append(DeviceLost("it ended its stream"))
    assert wait_until(lambda: started.fault(time.monotonic()) is not None)
    assert wait_until(
        lambda: (
            started.fault(time.monotonic()) == "The scripted device is not connected: nothing answers at its address."
        )
    )
    device.refuses = None
    device.script.append(picture(2))
    assert wait_until(lambda: started.fault(time.monotonic()) is None)
    assert int(started.frames()[-1].datum[0, 0]) == 2
    assert started.counts.reconnects == 1
    assert device.closed >= 1


def test_a_device_that_connects_and_drops_again_and_again_is_not_connected(device: Scripted) -> None:
    acquisition = Acquisition(device, Rules(late_s=float("inf"), lost_s=0.3))
    device.script.clear()
    acquisition.start(2.0, first_frame=False)
    try:
        time.sleep(0.35)  # the connection has lasted
        device.script.extend([DeviceLost("it ended the connection")] * 20)
        begun = time.monotonic()
        assert wait_until(lambda: acquisition.fault(time.monotonic()) is not None)
        assert time.monotonic() - begun > 0.25, "one loss alone is forgiven"
        assert acquisition.fault(time.monotonic()) in (
            None,  # the moment in which it is connected
            "The scripted device is not connected: it ended the connection.",
        )
        assert acquisition.counts.reconnects > 1
    finally:
        acquisition.close()


def test_any_exception_of_a_devices_library_is_a_loss_and_the_thread_goes_on(
    started: Acquisition[Any], device: Scripted
) -> None:
    device.script.extend([ZeroDivisionError("in the driver"), picture(2)])
    assert wait_until(lambda: started.counts.received == 2)
    assert started.counts.reconnects == 1


def test_late_frames_are_a_fault(started: Acquisition[Any], device: Scripted) -> None:
    for k in range(5):
        device.script.append(Delivery(datum=picture(k), arrived=time.monotonic(), device_time=100.0 + time.monotonic()))
    assert wait_until(lambda: started.counts.received == 6)
    assert "late" not in (started.fault(time.monotonic()) or "")
    device.script.append(Delivery(datum=picture(9), arrived=time.monotonic(), device_time=98.0 + time.monotonic()))
    assert wait_until(lambda: "is late: a frame came 2.0 s after its time" in (started.fault(time.monotonic()) or ""))


def test_frames_of_a_time_in_which_nobody_could_read_are_not_late(started: Acquisition[Any], device: Scripted) -> None:
    before = time.time()
    time.sleep(0.4)
    started.excuse(0.4)
    device.script.append(Delivery(datum=picture(2), arrived=time.monotonic(), unix_time=before))
    assert wait_until(lambda: started.counts.received == 2)
    assert "late" not in (started.fault(time.monotonic()) or "")
    device.script.append(Delivery(datum=picture(3), arrived=time.monotonic() + 2.0, unix_time=time.time() + 0.01))
    assert wait_until(lambda: "is late" in (started.fault(time.monotonic()) or ""))


def test_a_request_is_sent_once_and_its_answer_found(device: Scripted) -> None:
    acquisition = Acquisition(device, Rules(answer_s=0.2, late_s=float("inf")))
    device.script.clear()
    acquisition.start(2.0, first_frame=False)
    try:
        acquisition.request(1)
        assert wait_until(lambda: device.asked == [1])
        assert acquisition.answer(1) is None
        assert wait_until(lambda: acquisition.fault(time.monotonic()) is not None)
        assert acquisition.fault(time.monotonic()) == "The scripted device did not deliver scan 1 within 0.2 s."
        device.script.append(Delivery(datum=picture(3), arrived=time.monotonic(), request=1))
        assert wait_until(lambda: acquisition.answer(1) is not None)
        assert acquisition.fault(time.monotonic()) is None
        assert device.asked == [1]
    finally:
        acquisition.close()


def test_an_unanswered_request_is_repeated_after_a_reconnection(device: Scripted) -> None:
    acquisition = Acquisition(device, Rules(answer_s=5.0, late_s=float("inf")))
    device.script.clear()
    acquisition.start(2.0, first_frame=False)
    try:
        acquisition.request(4)
        assert wait_until(lambda: device.asked == [4])
        device.script.append(DeviceLost("unplugged"))
        assert wait_until(lambda: device.asked == [4, 4])
    finally:
        acquisition.close()


def test_a_device_that_does_not_answer_is_refused_by_its_reason() -> None:
    device = Scripted()
    device.refuses = DeviceLost("there is no folder 'scans'")
    before = threading.active_count()
    with pytest.raises(DeviceFault, match=r"The scripted device does not answer: there is no folder 'scans'\."):
        Acquisition(device, CAMERA).start(0.1, first_frame=False)
    assert wait_until(lambda: threading.active_count() == before)


def test_a_forgotten_acquisition_ends_its_thread() -> None:
    device, before = Scripted(picture(1)), threading.active_count()
    acquisition = Acquisition(device, CAMERA)
    acquisition.start(2.0, first_frame=True)
    assert threading.active_count() == before + 1
    del acquisition
    gc.collect()
    assert wait_until(lambda: threading.active_count() == before)
    assert device.closed == 1


def test_reading_never_waits_for_the_device(started: Acquisition[Any], device: Scripted) -> None:
    asked, released, answered = threading.Event(), threading.Event(), threading.Event()

    def silent(timeout_s: float) -> None:
        asked.set()
        released.wait(60.0)
        answered.set()

    device.next = silent  # type: ignore[method-assign]
    try:
        assert asked.wait(10.0)
        for _ in range(1000):
            started.frames()
            started.fault(time.monotonic())
            started.request(3)
        assert not answered.is_set(), "what waits for the device comes after its answer"
    finally:
        released.set()
