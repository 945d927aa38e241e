"""The capture page in a real browser: an emulated arm is jogged and scanned until X_BC is known, by keys and buttons."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.browser import Browser
from weldcal.calibration.capture.session import CaptureSession
from weldcal.calibration.capture.tasks import FlangeTask
from weldcal.calibration.recorded_flange import calibrate_flange
from weldcal.tools.dashboard.capture_demo import ROBOT, DemoCell
from weldcal.tools.dashboard.capture_run import READY, CaptureRun, FolderSensor
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
            browser.run(f"[...document.querySelectorAll('#jogs button')].find(b => b.textContent === '{name}').click()")
            before = cell.pose()
            until(lambda before=before: max(cell.pose().moved(before)) >= 0.0)  # type: ignore[misc]
            time.sleep(0.4)
        assert run.problem == ""
        browser.screenshot(tmp_path / "page.png")
    assert run.verdict.X is not None
    assert run.verdict.error_95_m is not None
    off = np.linalg.norm(run.verdict.X.translation() - cell.X_BC.translation())
    assert off < 2e-4
    again = calibrate_flange(tmp_path / "s")
    assert (again.result.X_BC.GetAsMatrix4() == run.verdict.X.GetAsMatrix4()).all()


def test_only_a_file_from_after_the_press_counts(tmp_path: Path) -> None:
    """A scan that lay there before is of a pose that nobody knows."""
    (tmp_path / "in").mkdir()
    sensor, cell = FolderSensor(tmp_path / "in"), DemoCell(1)
    old = cell.take(tmp_path).rename(tmp_path / "in" / "old.npz")
    time.sleep(0.5)
    done: list[Path] = []
    waiting = threading.Thread(target=lambda: done.append(sensor.take(tmp_path)))
    waiting.start()
    time.sleep(0.6)
    assert not done
    new = cell.take(tmp_path).rename(tmp_path / "in" / "new.npz")
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
        browser.resize(390, 800)
        time.sleep(0.5)
        assert browser.run("return document.documentElement.scrollWidth") == 390
        browser.resize(1280, 800)
