"""GenICam devices: the virtual ones that genicam 1.6 ships stand for the transport, made-up components for the data."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.systems.drivers.sensors.scripted import wait_until
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Acquisition, DeviceFault, DeviceLost, Garbage
from weldcal.systems.drivers.sensors.genicam.device import (
    Component,
    cloud_of,
    get_profile,
    picture_of,
    profile_of,
    profiles,
)
from weldcal.systems.drivers.sensors.genicam.finger_camera import GenicamFingerCamera
from weldcal.systems.drivers.sensors.genicam.profiler import GenicamProfiler, GenicamProfiles
from weldcal.systems.drivers.sensors.genicam.scanner import GenicamClouds, GenicamScanner
from weldcal.systems.drivers.sensors.own_process import SourceProcess
from weldcal.systems.drivers.sensors.wired_camera import acquire_pictures
from weldcal.systems.drivers.sensors.wired_profiler import acquire_profiles
from weldcal.systems.drivers.sensors.wired_scanner import acquire

RANGE = {"ComponentSelector": "Range", "ComponentEnable": "true"}
FAST = {"AcquisitionFrameRate": "100"}
BOTH = RANGE | FAST


def producer() -> str:
    """The virtual devices of genicam 1.6."""
    import genicam

    return str(Path(genicam.__file__).parent / "viky.cti")


Start = Callable[[Acquisition[Any], bool], Acquisition[Any]]


@pytest.fixture
def start() -> Iterator[Start]:
    running = []

    def begin(acquisition: Acquisition[Any], first_frame: bool) -> Acquisition[Any]:
        running.append(acquisition)
        acquisition.start(20.0, first_frame=first_frame)
        return acquisition

    yield begin
    for acquisition in running:
        acquisition.close()


def scanner(**keys: Any) -> tuple[GenicamClouds, Acquisition[Any]]:
    keys = {"producer": producer(), "device": "1", "settings": BOTH, "preset": "ideal", **keys}
    config = GenicamScanner(**keys)
    source = GenicamClouds(config)
    return source, acquire(config, source)


def test_clouds_come_in_metres_with_the_arrival_as_their_time(start: Start) -> None:
    source, acquisition = scanner(streams=True)
    start(acquisition, True)
    assert wait_until(lambda: acquisition.counts.received >= 5)
    frame = acquisition.frames()[-1]
    assert (frame.datum.shape, frame.datum.dtype) == ((400, 400, 3), np.float32)
    seen = frame.datum[np.isfinite(frame.datum[..., 2])]
    # the virtual device counts its coordinates A and B in pixels of 1 mm
    assert np.nanmax(seen[:, 0]) <= 0.3991
    assert 0.0 < np.nanmedian(seen[:, 2]) < 0.4
    assert source.device.stamped is False
    assert acquisition.summary()["capture_time_from"] == "arrival"
    assert frame.device_time is None


def test_a_scan_is_the_first_frame_after_the_request(start: Start) -> None:
    _, acquisition = scanner()
    start(acquisition, False)
    for number in (1, 2, 3):
        asked = time.monotonic()
        acquisition.request(number)
        assert wait_until(lambda n=number: acquisition.answer(n) is not None)
        found = acquisition.answer(number)
        assert found is not None
        assert found.arrived > asked


def test_every_frame_is_received_or_reported(start: Start) -> None:
    source, acquisition = scanner(streams=True)
    numbers: list[int] = []
    take = source.device.take

    def noted(timeout_s: float) -> Any:
        found = take(timeout_s)
        if found is not None:
            numbers.append(found.number)
            if len(numbers) == 20:
                time.sleep(0.5)  # longer than its buffers hold: some frames are lost
        return found

    source.device.take = noted  # type: ignore[method-assign]
    start(acquisition, True)
    assert wait_until(lambda: acquisition.counts.received >= 60)
    acquisition.close()
    c = acquisition.counts
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert missing > 0
    assert c.lost == missing
    assert c.received + c.garbled == len(numbers)
    assert acquisition.frames()[-1].number == c.received + c.lost


class Gone:
    """An image acquirer whose device was unplugged."""

    def __init__(self, acquirer: Any) -> None:
        self._acquirer = acquirer

    def try_fetch(self, timeout: float) -> Any:
        raise IndexError("list index out of range")

    def stop(self) -> None:
        self._acquirer.stop()

    def destroy(self) -> None:
        self._acquirer.destroy()


def test_an_unplugged_device_is_named_within_a_second_and_used_again_when_it_is_back(start: Start) -> None:
    source, acquisition = scanner(streams=True)
    start(acquisition, True)
    create = source.device._create

    def unplugged(harvester: Any) -> Any:
        raise DeviceLost("no such device answers (there are: none)")

    source.device._create = unplugged  # type: ignore[method-assign]
    source.device._acquirer = Gone(source.device._acquirer)
    begin = time.monotonic()
    assert wait_until(lambda: "is not connected" in (acquisition.fault(time.monotonic()) or ""))
    assert time.monotonic() - begin < 1.0
    assert (acquisition.fault(time.monotonic()) or "").startswith("The scanner 1 (GenICam) is not connected")
    source.device._create = create  # type: ignore[method-assign]
    before = acquisition.counts.received
    assert wait_until(lambda: acquisition.counts.received > before + 3)
    assert acquisition.fault(time.monotonic()) is None


def test_a_device_that_stops_sending_is_named(start: Start) -> None:
    source, acquisition = scanner(streams=True)
    start(acquisition, True)
    source.device.take = lambda timeout_s: time.sleep(timeout_s)  # type: ignore[method-assign,assignment,func-returns-value]
    assert wait_until(lambda: "sent nothing usable for 1 s" in (acquisition.fault(time.monotonic()) or ""))


def test_a_library_that_crashes_is_a_lost_device_and_the_next_process_opens_it_again(start: Start) -> None:
    keys = {"producer": producer(), "device": "0", "settings": BOTH, "preset": "ideal", "streams": True}
    config = GenicamScanner(**keys)  # type: ignore[arg-type]
    source = config.source()
    assert isinstance(source, SourceProcess)
    acquisition = acquire(config, source)
    running = start(acquisition, True)
    assert source._process is not None
    source._process.kill()
    begin = time.monotonic()
    assert wait_until(lambda: "is not connected" in (running.fault(time.monotonic()) or ""))
    assert time.monotonic() - begin < 1.0
    assert "the process that reads it has ended (exit code -9)" in (running.fault(time.monotonic()) or "")
    before = running.counts.received
    assert wait_until(lambda: running.counts.received > before + 3, 20.0)
    process = source._process
    assert process is not None
    running.close()
    assert not process.is_alive()


def test_two_devices_of_one_producer_are_open_at_a_time(start: Start) -> None:
    _, first = scanner(streams=True)
    camera = GenicamFingerCamera(width=400, height=400, rate_hz=20.0, producer=producer(), device="2", frozen_s=5.0)
    second = acquire_pictures(camera, camera.source())  # in a process of its own, as in a cell
    start(first, True)
    start(second, True)
    assert wait_until(lambda: second.counts.received > 3)
    picture = second.frames()[-1].datum
    assert (picture.shape, picture.dtype) == ((400, 400), np.uint8)
    first.close()
    before = second.counts.received
    assert wait_until(lambda: second.counts.received > before + 3)


def test_a_profile_is_the_last_line_of_a_frame(start: Start) -> None:
    config = GenicamProfiler(producer=producer(), device="0", profile="generic", settings=BOTH, scan_timeout_s=2.0)
    source = GenicamProfiles(config)
    acquisition = start(acquire_profiles(config, source), False)
    acquisition.request(1)
    # no surface in the last line of the virtual device: its profile has no points, and it says so
    assert wait_until(lambda: "the profile has 0 points" in (acquisition.fault(time.monotonic()) or ""))


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"device": "9"}, r"no such device answers \(there are: Viky 0, Viky 1, Viky 2\)"),
        ({"device": "Viky"}, "several devices fit"),
        ({"settings": {"Sharpness": "3"}}, "it has no feature Sharpness: correct it in the scenario's settings"),
        ({"settings": {"PixelFormat": "Mono7"}}, "it does not accept 'Mono7' for its feature PixelFormat"),
    ],
)
def test_what_cannot_be_opened_is_a_sentence(start: Start, keys: dict[str, Any], said: str) -> None:
    _, acquisition = scanner(**keys)
    with pytest.raises(DeviceFault, match=said):
        acquisition.start(0.5, first_frame=False)


def test_a_frame_without_coordinates_is_named(start: Start) -> None:
    _, acquisition = scanner(settings=FAST, streams=True)
    with pytest.raises(DeviceFault, match=r"in frame \d+: its frames have RGBa8 and no Coord3D_ABC32f"):
        acquisition.start(0.5, first_frame=True)


def test_without_harvesters_the_line_to_type_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("harvesters", "genicam"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"harvesters, which is not installed: type pip install 'weldcal\[genicam\]'\."
    ):
        GenicamClouds(GenicamScanner(producer="x.cti"))


def test_a_producer_that_is_not_there_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = producer()
    with pytest.raises(InputError, match=r"There is no GenTL producer 'nowhere\.cti'"):
        GenicamClouds(GenicamScanner(producer="nowhere.cti"))
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    with pytest.raises(InputError, match="GENICAM_GENTL64_PATH leads to none"):
        GenicamClouds(GenicamScanner())
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(Path(here).parent))
    assert GenicamClouds(GenicamScanner()).name == "The scanner generic (GenICam)"


# What follows needs no producer.


def grid(height: int = 3, width: int = 4) -> NDArray[np.float32]:
    return np.arange(height * width * 3, dtype=np.float32).reshape(height, width, 3)


@pytest.mark.parametrize("intensity", [True, False])
@pytest.mark.parametrize("form", ["whole", "planar", "planes"])
def test_each_form_of_a_cloud_gives_the_same_points(form: str, intensity: bool) -> None:
    points = grid()
    planar = np.moveaxis(points, -1, 0)
    parts = {
        "whole": [Component("Coord3D_ABC32f", 4, 3, points.ravel())],
        "planar": [Component("Coord3D_ABC32f_Planar", 4, 3, planar.ravel())],
        "planes": [Component(f"Coord3D_{a}32f", 4, 3, plane.ravel()) for a, plane in zip("ABC", planar, strict=True)],
    }[form]
    if intensity:
        parts = [Component("Mono16", 4, 3, np.zeros(12, np.uint16)), *parts]
    assert np.array_equal(cloud_of(parts), points)


def test_a_damaged_component_is_named() -> None:
    with pytest.raises(Garbage, match="its Coord3D_ABC32f has 30 values, not 4 x 3 x 3"):
        cloud_of([Component("Coord3D_ABC32f", 4, 3, np.zeros(30, np.float32))])


def test_a_profile_of_each_form() -> None:
    pairs = np.array([[1.0, 50.0], [2.0, 51.0], [3.0, 0.0]], np.float32)
    found = profile_of([Component("Coord3D_AC32f", 3, 1, pairs.ravel())])
    assert np.array_equal(found, [[1.0, 50.0], [2.0, 51.0], [np.nan, np.nan]], equal_nan=True)
    raw = np.array([[7, 7, 7], [0, 100, 200]], np.uint16)
    found = profile_of([Component("Coord3D_C16", 3, 2, raw.ravel())], ((0.1, -5.0), (0.5, 10.0)))
    assert np.allclose(found, [[-5.0, np.nan], [-4.9, 60.0], [-4.8, 110.0]], equal_nan=True)
    found = profile_of([Component("Coord3D_ABC32f", 4, 3, grid().ravel())])
    assert np.array_equal(found, grid()[-1][:, [0, 2]])


def test_a_picture_of_each_form() -> None:
    grey = np.arange(12, dtype=np.uint8)
    assert np.array_equal(picture_of([Component("Mono8", 4, 3, grey)]), grey.reshape(3, 4))
    assert np.array_equal(picture_of([Component("Mono12", 4, 3, 16 * grey.astype(np.uint16))]), grey.reshape(3, 4))
    colour = np.repeat(grey[:, None], 4, axis=1)
    assert np.array_equal(picture_of([Component("RGBa8", 4, 3, colour.ravel())]), grey.reshape(3, 4))
    with pytest.raises(Garbage, match="set its PixelFormat to Mono8"):
        picture_of([Component("YUV422_8", 4, 3, grey)])


def test_the_profiles_are_complete_and_an_owner_can_change_them() -> None:
    assert {"generic", "genicam_3d", "phoxi", "motioncam", "ranger3"} <= set(profiles())
    phoxi = get_profile("phoxi")
    assert (phoxi.trigger, phoxi.unit, phoxi.alive) == ("TriggerFrame", "mm", "IsConnected")
    features = phoxi.features(streams=False, own={"Resolution": "Res_1032_772", "ShutterMultiplier": "2"})
    assert features["Resolution"] == "Res_1032_772"
    assert features["PhotoneoTriggerMode"] == "Software"
    assert list(features)[-1] == "ShutterMultiplier"
    assert phoxi.features(streams=True, own={})["PhotoneoTriggerMode"] == "Freerun"
    with pytest.raises(InputError, match="There is no GenICam profile 'phoxy': use one of generic"):
        get_profile("phoxy")
