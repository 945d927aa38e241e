"""Every report of a command that computes a pose: one well-formed file without a network, with the same first
screen."""

from __future__ import annotations

import io
import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from pydrake.math import RotationMatrix

from tests.browser import Browser
from tests.tools.report.small_outcomes import PAGES, Made
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.tools.report.first_screen import CARE, DO_NOT, USE
from weldcal.tools.report.pictures import scan_pictures
from weldcal.tools.report.render import inline_svg

VERDICTS = {"calibrate": CARE, "verify": CARE, "monitor": DO_NOT, "hand_eye": CARE, "demo": CARE, "held": DO_NOT}
VERDICTS |= {
    "profiler": DO_NOT,
    "seam": CARE,
    "bead": CARE,
    "tablet": USE,
    "camera": CARE,
    "finger": CARE,
    "mounting": USE,
    "profiler_live": CARE,
}
VERDICTS |= {"motion": CARE, "unbegun": DO_NOT}
VOID = {"meta", "img", "br", "hr", "link", "input"}


@cache
def made(name: str) -> Made:
    """The first screen and the page of a command."""
    return PAGES[name]()


class Reader(HTMLParser):
    """Reads a page: its text, ids, and addresses; raises AssertionError where elements are not nested."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.copies: list[str] = []
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Opens an element."""
        found = dict(attrs)
        self.ids += [v for k, v in attrs if k == "id" and v]
        self.addresses += [v for k, v in attrs if k in ("src", "href", "xlink:href", "action") and v]
        if "data-copies" in found:
            self.copies.append(str(found["data-copies"]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Reads an element without content."""
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        """Closes the element that was opened last."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Collects the text."""
        if not {"style", "script"} & set(self.open):
            self.text += data


@pytest.mark.parametrize("name", PAGES)
def test_a_report_is_one_file_with_the_first_screen_first(name: str) -> None:
    first, page = made(name)
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    text = " ".join(reader.text.split())
    verdict, error = first.verdict, first.expected.what
    assert verdict == VERDICTS[name]
    at = [text.index(words) for words in (verdict[1:], error[1:], "What could be wrong", "Next")]
    assert at == sorted(at)
    assert at[-1] < 1800
    assert " ".join(first.reason.split()) in text
    assert len(first.concerns) <= 3
    assert ("Good to know" in text) is bool(first.notes)
    for pose in first.poses:
        assert f"{pose.symbol}: {pose.words}" in text
        assert all(" ".join(form.split()) in text for _, _, form in pose.forms)
    assert len(reader.copies) == 3 * len(first.poses) + bool(first.next.command)
    assert set(reader.copies) <= set(reader.ids)
    assert len(set(reader.ids)) == len(reader.ids)
    inside = [a for a in reader.addresses if not a.startswith(("#", "data:image/"))]
    assert set(inside) <= {"recording.html"}
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL))


@pytest.mark.parametrize("name", PAGES)
def test_the_terminal_says_what_the_page_says(name: str) -> None:
    first, _ = made(name)
    rows = first.rows()
    assert rows["verdict"] == f"{first.verdict}. {first.reason}"
    assert first.expected.figure in rows[first.expected.what]
    assert all(text in rows["could be wrong"] for text in first.concerns)
    assert all(text in rows["good to know"] for text in first.notes)
    for pose in first.poses:
        assert pose.symbol in {row.rstrip() for row in rows}


def test_a_plot_takes_the_colours_of_the_page() -> None:
    _, page = made("calibrate")
    plots = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert plots
    for plot in plots:
        assert "#000000" not in plot
        assert "fill: #ffffff" not in plot
        assert "currentColor" in plot
        assert "aria-label=" in plot
    assert "var(--plot-ours)" in page


def test_a_name_in_a_plot_is_text_and_no_markup() -> None:
    kept = inline_svg(
        '<?xml version="1.0"?><svg width="1pt" xmlns="x"><!-- <b> --><g id="a" style="fill: #000"/></svg>', "<i>"
    )
    assert "<b>" not in kept
    assert 'aria-label="&lt;i&gt;"' in kept


@pytest.mark.parametrize("name", ["calibrate", "hand_eye"])
def test_a_page_fits_a_phone_is_dark_at_night_and_copies(name: str, browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text(made(name)[1], encoding="utf-8")
    browser.resize(360, 740)
    browser.open(path)
    assert browser.console_messages() == []
    assert browser.outside_addresses() == []
    assert browser.run("return document.documentElement.scrollWidth") == 360
    boxes = "[...document.querySelectorAll('.table, .picture, pre')]"
    assert browser.run(f"return {boxes}.every(box => box.getBoundingClientRect().right <= 360)")
    browser.run("document.querySelector('.pose button.copy').focus()")
    key = {"key": "Enter", "code": "Enter", "windowsVirtualKeyCode": 13, "text": "\r"}
    browser.devtools("Input.dispatchKeyEvent", type="keyDown", **key)
    browser.devtools("Input.dispatchKeyEvent", type="keyUp", **key)
    browser.wait("document.querySelector('.pose button.copy').textContent === 'Copied'", timeout_s=5)
    browser.dark(True)
    try:
        browser.run("document.querySelector('figure').scrollIntoView()")
        assert browser.screenshot(tmp_path / "night.png").mean() < 0.4
    finally:
        browser.dark(False)
        browser.resize(1280, 800)


def test_the_picture_of_a_scan_shows_the_found_edge_where_the_points_end() -> None:
    normal = np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    R = RotationMatrix.MakeFromOneVector(normal, 2).matrix()
    angle = np.linspace(0.0, 2.0 * np.pi, 1400)
    centre = np.array([0.1, -0.2, 0.9])
    ring = centre + 0.03 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle]) @ R.T + 2e-4 * normal
    fit = FlangeFit(
        center_C=centre,
        normal_C=normal,
        center_covariance=np.eye(3),
        normal_sigma=0.0,
        plane_rms_m=0.0,
        rim_rms_m=0.0,
        outer_radius_m=0.036,
        bore_radius_m=None,
        n_points=1400,
        coverage=1.0,
    )
    pixels = imread(io.BytesIO(scan_pictures({"p0": ring, "unfitted": ring}, {"p0": fit})))[20:, :, :3]
    black, coloured = pixels.max(axis=2) < 0.3, pixels[:, :, 0] > pixels[:, :, 2] + 0.3
    (low, high), (inner, outer) = (np.nonzero(found.any(axis=0))[0][[0, -1]] for found in (black, coloured))
    assert abs((low + high) - (inner + outer)) <= 4, "the ring of points is about the found centre"
    assert (outer - inner) / (high - low) == pytest.approx(0.03 / 0.036, abs=0.05)
