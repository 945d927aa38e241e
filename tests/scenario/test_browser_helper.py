"""The headless browser that other tests rely on really draws 3D scenes, and really has no network."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Box, Meshcat, MeshcatParams, Rgba

from tests.browser import Browser, Pixels, colours


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A Meshcat page of one large red box, as a file of its own."""
    meshcat = Meshcat(MeshcatParams(host="localhost", port=None))
    meshcat.SetObject("box", Box(2, 2, 2), Rgba(1, 0, 0, 1))
    path = tmp_path / "recording.html"
    path.write_text(meshcat.StaticHtml())
    return path


def shows_red(pixels: Pixels) -> bool:
    """Whether more than a hundredth of the picture is red."""
    red, green, blue = np.moveaxis(pixels, 2, 0)
    return bool(np.mean((red > 0.4) & (green < 0.25) & (blue < 0.25)) > 0.01)


def test_a_meshcat_file_is_drawn_without_a_network(browser: Browser, recording: Path, tmp_path: Path) -> None:
    browser.open(recording, wait_for="document.querySelector('canvas')")
    pixels = browser.screenshot(tmp_path / "recording.png", until=shows_red)
    assert shows_red(pixels), "the red box should fill a part of the picture"
    assert colours(pixels) > 8
    assert browser.console_messages() == []


def test_a_page_that_needs_the_network_is_caught(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text('<p>text</p><script src="http://localhost:9/missing.js"></script>')
    browser.open(page)
    assert browser.outside_addresses() == ["http://localhost:9/missing.js"]
    messages: list[str] = []
    until = time.monotonic() + 10.0
    while not any("missing.js" in message for message in messages) and time.monotonic() < until:
        messages += browser.console_messages()  # the browser's log comes in its own time
    assert any("missing.js" in message for message in messages)


def test_a_blank_page_has_one_colour(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "blank.html"
    page.write_text("<html><body></body></html>")
    browser.open(page)
    assert colours(browser.screenshot(tmp_path / "blank.png")) == 1
