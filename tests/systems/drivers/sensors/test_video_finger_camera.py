"""Pictures over HTTP and from a file: each with the time it was taken, and every way in which a camera fails is
named."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.systems.drivers.sensors.scripted import MjpegCamera, mjpeg_camera, number_in, speckle, wait_until
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Acquisition, DeviceFault
from weldcal.systems.drivers.sensors.video_finger_camera import VideoFingerCamera
from weldcal.systems.drivers.sensors.wired_camera import Picture, acquire_pictures

Start = Callable[..., Acquisition[Picture]]
LIMITS = {"silent_s": 0.2, "frozen_s": 0.2, "late_s": 0.2}


@pytest.fixture
def camera() -> Iterator[MjpegCamera]:
    with mjpeg_camera() as found:
        yield found


@pytest.fixture
def start() -> Iterator[Start]:
    running = []

    def begin(source: str, wait_s: float = 2.0, **keys: object) -> Acquisition[Picture]:
        config = VideoFingerCamera(**{"source": source, "width": 64, "height": 48, "rate_hz": 50.0, **LIMITS, **keys})
        acquisition = acquire_pictures(config, config.open_source())
        acquisition.start(wait_s, first_frame=True)
        running.append(acquisition)
        return acquisition

    yield begin
    for acquisition in running:
        acquisition.close()


def fault(acquisition: Acquisition[Picture]) -> str:
    return acquisition.fault(time.monotonic()) or ""


@pytest.mark.parametrize(("stamps", "error_s"), [("host", 0.003), ("device", 0.008)])
def test_each_picture_has_the_time_it_was_taken(camera: MjpegCamera, start: Start, stamps: str, error_s: float) -> None:
    camera.delay_s = 0.055  # and to the server's next period: 60 ms
    camera.epoch_s = 0.0 if stamps == "host" else -1.7e9
    # the earliest arrivals cannot tell how long the shortest way is: the scenario says it
    seen = start(camera.url, stamps=stamps, latency_s=0.06)
    assert wait_until(lambda: seen.counts.received > 25)
    errors = [f.stamp.captured - camera.taken[number_in(f.datum)] for f in seen.frames()]
    # a computer that was away is late with one of them; the picture before or after is a period, 20 ms, off
    assert np.median(np.abs(errors)) < error_s
    assert np.abs(errors).max() < 0.01
    assert seen.frames()[-1].stamp.clock == stamps
    assert seen.summary()["capture_time_from"] == stamps


def test_without_a_stamp_the_time_is_that_of_the_arrival_less_the_latency(camera: MjpegCamera, start: Start) -> None:
    seen = start(camera.url, latency_s=0.03)
    found = seen.frames()[-1]
    assert found.stamp.captured == pytest.approx(found.arrived - 0.03)
    assert seen.summary()["capture_time_from"] == "arrival"


def test_the_latency_is_measured(camera: MjpegCamera, start: Start) -> None:
    camera.delay_s = 0.08
    seen = start(camera.url, stamps="host", late_s=0.5)
    assert wait_until(lambda: seen.counts.received > 20)
    latency = seen.summary()["latency_ms"]
    assert isinstance(latency, dict)
    assert 80.0 <= latency["median"] < 105.0  # the way, and up to a period of 20 ms in this server's queue


def test_a_stream_without_lengths_is_split_at_its_boundary(camera: MjpegCamera, start: Start) -> None:
    camera.lengthless = True
    seen = start(camera.url)
    assert wait_until(lambda: seen.counts.received > 5)
    assert seen.counts.garbled == 0


def test_an_unplugged_camera_is_named_and_seen_again_when_it_is_back(camera: MjpegCamera, start: Start) -> None:
    seen = start(camera.url)
    begin = time.monotonic()
    camera.unplug()
    assert wait_until(lambda: "is not connected" in fault(seen))
    assert time.monotonic() - begin < 1.0
    camera.plug_in()
    assert wait_until(lambda: fault(seen) == "")
    assert seen.counts.reconnects >= 1


def test_a_silent_camera_is_named(camera: MjpegCamera, start: Start) -> None:
    seen = start(camera.url)
    camera.silent = True
    assert wait_until(lambda: "sent nothing usable for 0.2 s" in fault(seen))


def test_a_frozen_camera_is_named(camera: MjpegCamera, start: Start) -> None:
    seen = start(camera.url)
    camera.frozen = True
    assert wait_until(lambda: "is frozen: its frames were identical for 0.2 s" in fault(seen))


@pytest.mark.parametrize("stamps", ["host", "device"])
def test_a_camera_whose_pictures_come_late_is_named(camera: MjpegCamera, start: Start, stamps: str) -> None:
    seen = start(camera.url, stamps=stamps, silent_s=10.0)
    assert fault(seen) == ""
    camera.delay_s = 0.6
    assert wait_until(lambda: "is late" in fault(seen))


def test_garbage_is_counted_and_named_when_it_does_not_end(camera: MjpegCamera, start: Start) -> None:
    seen = start(camera.url)
    camera.garbage = True
    assert wait_until(lambda: "not a whole JPEG" in fault(seen))
    assert seen.counts.garbled > 3
    camera.garbage = False
    assert wait_until(lambda: fault(seen) == "")


def test_the_pictures_of_a_file_come_at_its_rate_and_its_end_is_named(tmp_path: Path, start: Start) -> None:
    path = tmp_path / "seen.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50.0, (64, 48), False)
    for number in range(1, 26):
        writer.write(speckle(number))
    writer.release()
    begin = time.monotonic()
    seen = start(str(path))
    assert wait_until(lambda: seen.counts.received == 25)
    assert 0.4 < time.monotonic() - begin < 1.5
    assert [number_in(f.datum) for f in seen.frames()] == [23, 24, 25]
    assert wait_until(lambda: "the file has ended" in fault(seen))


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"source": ""}, "Write the camera's source"),
        ({"source": "http://"}, "is not the URL of an MJPEG stream"),
        ({"source": "http://127.0.0.1:1/", "stamps": "gps"}, "finger_camera.stamps must be host, device, none"),
        ({"source": "seen.avi", "stamps": "host"}, "Only an MJPEG stream over http has stamps"),
        ({"source": "http://127.0.0.1:1/", "exposure_ms": 2.0}, "is set at its camera"),
        ({"source": "http://127.0.0.1:1/", "frozen_s": 0.01}, "finger_camera.frozen_s must be at least 0.06"),
    ],
)
def test_a_wrong_key_is_refused_before_anything_is_opened(start: Start, keys: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        start(str(keys.pop("source")), **keys)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("http://127.0.0.1:1/", "nothing answers at 127.0.0.1:1"),
        ("nowhere.avi", "there is no file"),
        ("7", "cannot be opened"),
    ],
)
def test_a_camera_that_is_not_there_is_a_sentence(start: Start, source: str, said: str) -> None:
    with pytest.raises(DeviceFault, match=said):
        start(source, wait_s=20.0)


def test_pictures_of_another_size_are_a_sentence(camera: MjpegCamera, start: Start) -> None:
    with pytest.raises(DeviceFault, match="its pictures are 64 x 48, and the scenario has 32 x 48"):
        start(camera.url, wait_s=0.3, width=32)
