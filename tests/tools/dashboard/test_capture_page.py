"""The capture page in a real browser: an emulated arm is jogged and scanned until X_BC is known, by keys and buttons."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.browser import Browser
from tests.figures.hand_eye.sessions import cell_and_task
from weldcal.calibration.capture.carried import CarriedTask
from weldcal.calibration.capture.session import Advice, CaptureSession, CaptureVerdict
from weldcal.calibration.capture.tasks import FlangeTask
from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.hand_eye.pictures.search import load_grey
from weldcal.calibration.recorded_flange import calibrate_flange
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.folder_scanner import FolderScanner
from weldcal.tools.dashboard.capture_demo import ROBOT, DemoCell
from weldcal.tools.dashboard.capture_run import READY, CaptureRun, DriverSensor, FolderSensor, webcam
from weldcal.tools.dashboard.capture_view import CaptureView
from weldcal.tools.dashboard.server import Dashboard

SECONDS = 30.0


def until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + SECONDS
    while not done():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[CaptureRun]:
    cell = DemoCell(5)
    with closing(
        CaptureRun(CaptureSession(tmp_path / "s", FlangeTask(ROBOT, "ISO 9409-1-50-4-M6")), cell, cell, 0.1, "demo")
    ) as one:
        yield one


def test_a_person_reaches_a_calibration_by_the_page_alone(run: CaptureRun, browser: Browser, tmp_path: Path) -> None:
    cell = run.arm
    assert isinstance(cell, DemoCell)
    view = CaptureView()
    with closing(Dashboard(run, view.url, page="capture")) as page:
        browser.open(page.url, wait_for="document.getElementById('title').textContent === 'demo'")
        moves = ["+rx", "-ry", "+x", *["next"] * 5]
        for k, move in enumerate(moves):
            browser.run("document.body.dispatchEvent(new KeyboardEvent('keydown', {code: 'Space', bubbles: true}))")
            until(lambda k=k: len(run.session.captures) == k + 1 and run.state == READY)  # type: ignore[misc]
            view.show(run)
            name = "to the next pose" if move == "next" else f"turn {move.replace('r', '')}" if "r" in move else move
            before = cell.pose()
            browser.run(f"[...document.querySelectorAll('#jogs button')].find(b => b.textContent === '{name}').click()")
            until(lambda before=before: max(cell.pose().moved(before)) > 1e-6)  # type: ignore[misc]
        assert run.problem == ""
        browser.screenshot(tmp_path / "page.png")
    assert run.verdict.X is not None
    assert run.verdict.error_95_m is not None
    off = np.linalg.norm(run.verdict.X.translation() - cell.X_LC.translation())
    assert off < 2e-4
    again = calibrate_flange(tmp_path / "s")
    assert (again.result.X_BC.GetAsMatrix4() == run.verdict.X.GetAsMatrix4()).all()


@pytest.mark.parametrize("clock_s", [0.0, -3600.0, 3600.0])
def test_only_a_file_from_after_the_press_counts(tmp_path: Path, clock_s: float) -> None:
    """A scan that lay there before is of a pose that nobody knows. The clock of the sensor's computer may be off."""
    (tmp_path / "in").mkdir()
    sensor, cell = FolderSensor(tmp_path / "in"), DemoCell(1)
    old = cell.take(tmp_path).rename(tmp_path / "in" / "old.npz")
    time.sleep(0.5)
    done: list[Path] = []
    waiting = threading.Thread(target=lambda: done.append(sensor.take(tmp_path)))
    waiting.start()
    time.sleep(0.6)
    assert not done
    scan = cell.take(tmp_path)
    os.utime(scan, (time.time() + clock_s, time.time() + clock_s))
    new = scan.rename(tmp_path / "in" / "new.npz")
    waiting.join(5.0)
    assert done == [new]
    assert old.is_file()


def test_space_captures_wherever_the_focus_is(run: CaptureRun, browser: Browser) -> None:
    cell = run.arm
    assert isinstance(cell, DemoCell)
    with closing(Dashboard(run, None, page="capture")) as page:
        browser.open(page.url, wait_for="document.querySelectorAll('#jogs button').length > 12")
        before = cell.pose()
        browser.run("document.querySelector('#jogs button').focus()")
        for kind in ("rawKeyDown", "keyUp"):
            browser.devtools("Input.dispatchKeyEvent", type=kind, code="Space", key=" ", windowsVirtualKeyCode=32)
        until(lambda: len(run.session.captures) == 1)
        assert max(cell.pose().moved(before)) < 1e-9, "the button was not pressed"
        browser.devtools("Input.dispatchKeyEvent", type="keyDown", code="Enter", key="Enter", text="\r")
        until(lambda: max(cell.pose().moved(before)) > 1e-6)
        browser.resize(390, 800)
        time.sleep(0.5)
        assert browser.run("return document.documentElement.scrollWidth") == 390
        browser.resize(1280, 800)


def test_the_scanner_of_a_driver_gives_its_scan(tmp_path: Path) -> None:
    """The driver of a folder, as a scenario names it."""
    (tmp_path / "in").mkdir()
    sensor, cell = DriverSensor(FolderScanner(folder=str(tmp_path / "in")).source(), "FolderScanner"), DemoCell(1)
    done: list[Path] = []
    waiting = threading.Thread(target=lambda: done.append(sensor.take(tmp_path / "out")))
    (tmp_path / "out").mkdir()
    waiting.start()
    time.sleep(0.5)
    scan = cell.take(tmp_path).rename(tmp_path / "in" / "new.npz")
    waiting.join(10.0)
    sensor.close()
    np.testing.assert_allclose(read_cloud(done[0]), read_cloud(scan), atol=1e-6)


def test_a_camera_gives_a_picture_and_one_that_is_absent_a_sentence(tmp_path: Path) -> None:
    """A video file stands for the camera: OpenCV reads both alike."""
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    for k in range(60):
        film.write(np.full((240, 320, 3), 40 + k, np.uint8))
    film.release()
    sensor = webcam(str(tmp_path / "film.avi"))
    grey = load_grey(sensor.take(tmp_path))
    sensor.close()
    assert grey is not None
    assert grey.shape == (240, 320)
    with pytest.raises(InputError, match="cannot be opened"):
        webcam(str(tmp_path / "none.avi"))


def test_an_open_direction_does_not_stop_the_page(run: CaptureRun) -> None:
    """Uncertainties without end are no numbers of JSON."""
    for before, after in ((np.inf, np.inf), (np.inf, 1e-3), (2e-3, 1e-3)):
        advice = Advice(X_BF=None, words="", sigma_before_m=before, sigma_after_m=after)
        run.verdict = CaptureVerdict(symbol="X_BC", said=(), advice=advice)
        gain = json.loads(json.dumps(run.values(), allow_nan=False))["gain"]
        assert gain == (0.5 if before == 2e-3 else None)


def test_the_page_of_a_scanner_on_a_link_jogs_its_joints(browser: Browser, tmp_path: Path) -> None:
    cell, task = cell_and_task("eye_on_arm", 2)
    with closing(CaptureRun(CaptureSession(tmp_path / "s", task), cell, cell, 0.4, "demo")) as run:
        view = CaptureView(task.scene.arm if isinstance(task, CarriedTask) else None)
        with closing(Dashboard(run, view.url, page="capture")) as page:
            browser.open(page.url, wait_for="document.querySelectorAll('#jogs button').length > 12")
            for k in range(4):
                browser.run("[...document.querySelectorAll('#jogs button')].find(b => b.id === 'go').click()")
                until(lambda k=k: run.state == READY and run.verdict.advice is not None)  # type: ignore[misc]
                browser.run("document.querySelector('#capture').click()")
                until(lambda k=k: len(run.session.captures) == k + 1 and run.state == READY)  # type: ignore[misc]
                view.show(run)
            until(lambda: "X_LC" in browser.run("return document.getElementById('matrix').textContent"))
            assert "Turn the joints: J" in browser.run("return document.getElementById('advice').textContent")
            assert browser.run("return document.getElementById('ur_pose').textContent")[0] == "["
            browser.screenshot(tmp_path / "page.png")
