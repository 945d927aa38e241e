"""`weldcal check-cell`: each device of a scenario is ok, or there is a sentence that says what to do."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.systems.drivers.sensors.scripted import MjpegCamera, mjpeg_camera
from tests.systems.drivers.sensors.test_folder_scanner import drop
from tests.systems.plugin_robot import KinematicArm
from tests.systems.plugin_scanner import RayScanner, RaySensor
from weldcal.systems.drivers.sensors.folder_scanner import FolderScanner
from weldcal.systems.drivers.sensors.video_finger_camera import VideoFingerCamera
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.cell.check import CellReport, edge_width_px, look_at_cell
from weldcal.tools.commands.controllers import state_of

FACING = RigidTransform(RollPitchYaw(np.pi, 0.1, 0.3), [0.02, 0.01, 0.6])  # a flange before the scanner


def states(report: CellReport) -> dict[tuple[str, str], str]:
    return {(device, check.name): state_of(check) for device, check in report.rows if device != "computer"}


def remedy(report: CellReport, device: str, check: str) -> str:
    (found,) = (row.operator_action for of, row in report.rows if (of, row.name) == (device, check))
    return found


def wired(**devices: object) -> Scenario:
    scenario = load_scenario("calibrate_only")
    scenario.robot = KinematicArm()
    for name, config in devices.items():
        setattr(scenario, name, config)
    return scenario


def test_a_simulated_cell_is_ready_and_nothing_of_it_moves() -> None:
    found = look_at_cell(load_scenario("s_groove"), "s_groove")
    assert set(states(found).values()) == {"ok"}
    assert ("scanner", "flange") in states(found)
    assert ("finger_camera", "tag") in states(found)
    assert {check.name for device, check in found.rows if device == "computer"} == {"timing", "disk"}


class FlangeProgram(threading.Thread):
    """Writes a cloud of the flange (or of nothing but a table) whenever the trigger file appears."""

    def __init__(self, folder: Path, points: np.ndarray) -> None:
        super().__init__(daemon=True)
        self._folder, self._points = folder, points
        self.trigger, self.stop = folder / "trigger", threading.Event()
        self.start()

    def run(self) -> None:
        while not self.stop.wait(0.01):
            if self.trigger.exists():
                self.trigger.unlink()
                drop(self._folder, "scan.npz", self._points)


@pytest.fixture
def flange_points() -> np.ndarray:
    sensor = RaySensor(RigidTransform(), RayScanner().scanner())
    return np.asarray(sensor._cast(FACING, np.random.default_rng(0)))


@pytest.fixture
def tag_camera() -> Iterator[MjpegCamera]:
    """A finger camera that sees the tag as OpenCV draws it."""
    cells = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50).generateImageMarker(
        7, 114, borderBits=1
    )  # 19 px a cell
    picture = np.full((300, 400), 200, np.uint8)
    picture[93:207, 143:257] = np.where(cells > 0, 200, 30)
    with mjpeg_camera(30.0) as camera:
        camera.draws = lambda number: cv2.add(
            camera.blurred(picture), np.random.default_rng(number).integers(0, 4, picture.shape, dtype=np.uint8)
        )
        yield camera


def test_a_cell_by_wire_is_looked_at_device_by_device(
    tmp_path: Path, flange_points: np.ndarray, tag_camera: MjpegCamera
) -> None:
    program = FlangeProgram(tmp_path, flange_points)
    scanner = FolderScanner(folder=str(tmp_path), trigger=f"file:{program.trigger}", settle_s=0.02)
    camera = VideoFingerCamera(source=tag_camera.url, stamps="host")
    found = look_at_cell(wired(scanner=scanner, finger_camera=camera), "mine")
    program.stop.set()
    assert states(found) == {
        ("robot", "robot"): "not checked",  # a driver without a preflight
        ("scanner", "scan"): "ok",
        ("scanner", "flange"): "ok",
        ("finger_camera", "pictures"): "ok",
        ("finger_camera", "tag"): "ok",
    }
    summary = found.summary()
    assert summary["state"] == "refused"
    assert [row["remedy"] for row in summary["devices"] if row["state"] == "to change"] == []  # type: ignore[attr-defined]


def test_each_trouble_has_its_remedy(tmp_path: Path, flange_points: np.ndarray, tag_camera: MjpegCamera) -> None:
    empty = np.where(np.isfinite(flange_points), flange_points, 0.0)
    u, v = np.meshgrid(np.linspace(-0.2, 0.2, 824), np.linspace(-0.2, 0.2, 616))
    empty = np.stack([u, v, np.full(u.shape, 0.9)], axis=-1)  # a table, and no flange
    program = FlangeProgram(tmp_path, empty)
    scanner = FolderScanner(folder=str(tmp_path), trigger=f"file:{program.trigger}", settle_s=0.02)
    tag_camera.blur_px = 12.0
    camera = VideoFingerCamera(source=tag_camera.url)
    found = look_at_cell(wired(scanner=scanner, finger_camera=camera), "mine")
    program.stop.set()
    assert "Jog the arm until the flange faces the scanner" in remedy(found, "scanner", "flange")
    assert "focus" in remedy(found, "finger_camera", "tag")
    dead = wired(
        scanner=FolderScanner(folder=str(tmp_path / "none")),
        finger_camera=VideoFingerCamera(source="http://127.0.0.1:1/"),
    )
    found = look_at_cell(dead, "mine")
    assert "there is no folder" in remedy(found, "scanner", "scan")
    assert "switch the camera on" in remedy(found, "finger_camera", "pictures")
    assert found.first_problem == remedy(found, "scanner", "scan")


@pytest.mark.parametrize("sigma", [0.8, 1.6, 3.2])
def test_the_width_of_an_edge_grows_with_its_blur(sigma: float) -> None:
    picture = np.full((100, 100), 40, np.uint8)
    picture[30:70, 30:70] = 200
    blurred = cv2.GaussianBlur(picture, (0, 0), sigma)
    found = edge_width_px(blurred, np.array([[30.0, 30.0], [69.0, 69.0]]))
    # the steepest slope of a Gaussian edge is its contrast over sigma times the root of 2 pi; the Sobel filter blurs it
    # further
    assert found == pytest.approx(2.507 * np.sqrt(sigma**2 + 1.0 / 3.0), rel=0.2)
