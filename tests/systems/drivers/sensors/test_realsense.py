"""RealSense through its real library: a software device takes depth pictures of a flange and gives them back as
points."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.systems.drivers.sensors.scripted import wait_until
from tests.systems.plugin_scanner import FLANGE
from weldcal.calibration.eye_on_base.solve import estimate_eye_on_base
from weldcal.calibration.flange.fit import FlangeGuess, fit_flange
from weldcal.calibration.flange.observation import observation_from_fit
from weldcal.models.errors import InputError
from weldcal.models.scanners import depth_to_points
from weldcal.systems.drivers.sensors.acquisition import Acquisition, DeviceFault
from weldcal.systems.drivers.sensors.realsense import RealSense, RealSenseClouds
from weldcal.systems.drivers.sensors.wired_scanner import acquire

WIDTH, HEIGHT, FPS, FOCAL = 320, 240, 30, 420.0
UNIT_M = 1e-4
CX, CY = 159.3, 119.8


class Software:
    """librealsense's software device: pictures are pushed in and come out as from a camera."""

    def __init__(self) -> None:
        import pyrealsense2 as rs

        self._rs = rs
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, "S1")
        self._sensor = self.device.add_sensor("Depth")
        intrinsics = rs.intrinsics()
        intrinsics.width, intrinsics.height = WIDTH, HEIGHT
        intrinsics.ppx, intrinsics.ppy, intrinsics.fx, intrinsics.fy = CX, CY, FOCAL, FOCAL
        intrinsics.model = rs.distortion.none
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid = rs.stream.depth, 0, 1
        stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, FPS, 2
        stream.fmt, stream.intrinsics = rs.format.z16, intrinsics
        self._profile = self._sensor.add_video_stream(stream)
        self._sensor.add_read_only_option(rs.option.depth_units, UNIT_M)
        self._number = 0

    def send(self, depth_m: np.ndarray, device_ms: float | None = None, skip: int = 0) -> None:
        """A picture (H, W) of depths, stamped by the device's clock."""
        rs = self._rs
        self._number += 1 + skip
        frame = rs.software_video_frame()
        frame.pixels = np.rint(np.nan_to_num(depth_m) / UNIT_M).astype(np.uint16)
        frame.stride, frame.bpp, frame.depth_units = 2 * WIDTH, 2, UNIT_M
        frame.timestamp = 1e3 * time.monotonic() + 5e6 if device_ms is None else device_ms
        frame.domain, frame.frame_number = rs.timestamp_domain.hardware_clock, self._number
        frame.profile = self._profile.as_video_stream_profile()
        self._sensor.on_video_frame(frame)


def config(**keys: Any) -> RealSense:
    return RealSense(**{"stream_width": WIDTH, "stream_height": HEIGHT, "fps": FPS, "preset": "d435", **keys})


@pytest.fixture
def camera() -> Software:
    return Software()


@pytest.fixture
def streaming(camera: Software) -> Iterator[Acquisition[Any]]:
    settings = config(streams=True)
    acquisition = acquire(settings, RealSenseClouds(settings, lambda: [camera.device]))
    acquisition.start(3.0, first_frame=False)
    yield acquisition
    acquisition.close()


def flange_depth(X_CF: RigidTransform) -> np.ndarray:
    """Exact depths (H, W) of the flange's face, NaN beside it."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - CX) / FOCAL, (v - CY) / FOCAL, np.ones(u.shape)], axis=-1)
    normal, centre = X_CF.rotation().matrix()[:, 2], X_CF.translation()
    depth = (normal @ centre) / (rays @ normal)
    face = (rays * depth[..., None] - centre) @ X_CF.rotation().matrix()
    radius = np.linalg.norm(face[..., :2], axis=-1)
    seen = (radius > FLANGE.face_inner_radius_m) & (radius < FLANGE.face_outer_radius_m)
    for x, y, hole in FLANGE.openings():
        seen &= np.hypot(face[..., 0] - x, face[..., 1] - y) > hole
    return np.where(seen, depth, np.nan)


def views(count: int) -> list[RigidTransform]:
    """Flange poses in the camera, face towards it."""
    rng = np.random.default_rng(3)
    found = []
    for _ in range(count):
        lean = RollPitchYaw([np.pi + rng.uniform(-0.35, 0.35), rng.uniform(-0.35, 0.35), rng.uniform(-np.pi, np.pi)])
        found.append(RigidTransform(lean, [rng.uniform(-0.05, 0.05), rng.uniform(-0.04, 0.04), rng.uniform(0.3, 0.42)]))
    return found


def points_of(depth: np.ndarray) -> np.ndarray:
    return depth_to_points(depth, FOCAL, FOCAL, CX, CY)


def test_the_points_are_those_of_the_depths_that_went_in(camera: Software, streaming: Acquisition[Any]) -> None:
    depth = flange_depth(views(1)[0])
    camera.send(depth)
    assert wait_until(lambda: streaming.counts.received == 1)
    rounded = np.rint(depth / UNIT_M) * UNIT_M
    assert np.allclose(streaming.frames()[-1].datum, points_of(rounded), atol=1e-6, equal_nan=True)


def test_the_calibration_differs_from_the_direct_one_only_by_the_depths_step(
    camera: Software, streaming: Acquisition[Any]
) -> None:
    X_BC = RigidTransform(RollPitchYaw(0.1, -0.2, 0.7), [0.4, -0.1, 0.8])
    found: dict[str, list[Any]] = {"device": [], "rounded": [], "exact": []}
    for k, X_CF in enumerate(views(8), 1):
        depth = flange_depth(X_CF)
        camera.send(depth)
        assert wait_until(lambda k=k: streaming.counts.received == k)
        clouds = {
            "device": streaming.frames()[-1].datum,
            "rounded": points_of(np.rint(depth / UNIT_M) * UNIT_M),
            "exact": points_of(depth),
        }
        guess = FlangeGuess(center_C=X_CF.translation(), radius_m=0.06, normal_C=X_CF.rotation().matrix()[:, 2])
        for name, cloud in clouds.items():
            fit = fit_flange(cloud.astype(float), FLANGE, guess=guess)
            found[name].append(observation_from_fit(str(k), X_BC @ X_CF, fit))
    solved = {name: estimate_eye_on_base(seen).X_BC for name, seen in found.items()}
    apart = {
        name: np.linalg.norm(solved["device"].translation() - solved[name].translation())
        for name in ("rounded", "exact")
    }
    # what the library does is rounding and single precision, nothing else
    assert apart["rounded"] < 2e-6
    # the step of 0.1 mm moves a point by 0.03 mm rms: the camera's origin, 0.36 m away, by less than the step
    assert 0.0 < apart["exact"] < UNIT_M


def test_lost_frames_are_counted_and_device_stamps_are_kept(camera: Software, streaming: Acquisition[Any]) -> None:
    depth, begin, stamps = flange_depth(views(1)[0]), time.monotonic(), []
    for k, skip in enumerate((0, 0, 3, 0), 1):
        stamps.append(5e6 + 1e3 * (time.monotonic() - begin))
        camera.send(depth, device_ms=stamps[-1], skip=skip)
        assert wait_until(lambda k=k: streaming.counts.received == k)
        time.sleep(0.03)
    assert streaming.counts.lost == 3
    frame = streaming.frames()[-1]
    assert frame.device_time == pytest.approx(1e-3 * stamps[-1])
    assert frame.stamp.clock == "device"
    assert abs(frame.stamp.captured - frame.arrived) < 0.05


def test_a_scan_is_a_whole_frame_after_the_request(camera: Software) -> None:
    settings = config(scan_timeout_s=3.0)
    acquisition = acquire(settings, RealSenseClouds(settings, lambda: [camera.device]))
    acquisition.start(3.0, first_frame=False)
    first, second = views(2)
    try:
        camera.send(flange_depth(first))
        time.sleep(0.1)
        acquisition.request(1)
        time.sleep(0.1)
        camera.send(flange_depth(first))  # its exposure may have begun before the request
        time.sleep(0.1)
        assert acquisition.answer(1) is None
        camera.send(flange_depth(second))
        assert wait_until(lambda: acquisition.answer(1) is not None)
        found = acquisition.answer(1)
        assert found is not None
        expected = points_of(np.rint(flange_depth(second) / UNIT_M) * UNIT_M)
        assert np.allclose(found.datum, expected, atol=1e-6, equal_nan=True)
    finally:
        acquisition.close()


def test_a_camera_that_sends_nothing_any_more_is_named(camera: Software, streaming: Acquisition[Any]) -> None:
    camera.send(flange_depth(views(1)[0]))
    assert wait_until(lambda: streaming.counts.received == 1)
    begin = time.monotonic()
    assert wait_until(lambda: streaming.fault(time.monotonic()) is not None)
    assert time.monotonic() - begin < 1.5
    camera.send(flange_depth(views(2)[1]))
    assert wait_until(lambda: streaming.fault(time.monotonic()) is None)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"serial": "S2"}, r"there is no such camera \(there are: S1\)"),
        ({"fps": 7}, "no depth stream of 320 x 240 at 7 Hz: .* one of 320 x 240 at 30"),
        ({"depth_unit_mm": 0.05}, "no option depth_units that can be set"),
        ({"options": {"sharpness_of_mind": 1.0}}, "no option sharpness_of_mind"),
    ],
)
def test_what_the_camera_cannot_do_is_a_sentence(camera: Software, keys: dict[str, Any], said: str) -> None:
    settings = config(**keys)
    acquisition = acquire(settings, RealSenseClouds(settings, lambda: [camera.device]))
    with pytest.raises(DeviceFault, match=said):
        acquisition.start(2.0, first_frame=False)


def test_without_the_library_the_line_to_type_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"pyrealsense2, which is not installed: type pip install 'weldcal\[realsense\]'"
    ):
        config().source()
