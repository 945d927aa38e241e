"""A report is one file: it is readable, in light and dark, and asks for nothing from anywhere."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from jinja2 import UndefinedError
from matplotlib.figure import Figure

from tests.browser import Browser, colours
from weldcal.tools.report import render as rendering

EXAMPLE = """{% extends "base.html.j2" %}
{% from "macros.html.j2" import verdict, card, figure, table, facts %}
{% block title %}Scanner calibration of {{ robot }}{% endblock %}
{% block subtitle %}18 scans, eye on base, 21 November 2026{% endblock %}
{% block verdict %}
{{ verdict("good", "The scanner is calibrated.", "On poses it never saw, the flange was found 0.09 mm (median) off.") }}
{% endblock %}
{% block cards %}
{{ card("Held-out error, median", 0.0912 | fixed(2), "mm", "good", "required: 0.15 mm") }}
{{ card("Held-out error, 95 %", 0.21 | fixed(2), "mm", "warn", "required: 0.20 mm") }}
{{ card("Scans used", 17, "of 18") }}
{{ card("Tilt, median", nothing | fixed(3), "deg") }}
{% endblock %}
{% block body %}
<h2>What the scanner saw</h2>
<p>The error is what remains at a pose when the calibration was computed from all the others.</p>
{{ figure(picture, "Error at each pose, computed without that pose; the line is the required error.", "Bar chart") }}
{{ table([["pose02", "0.081", "0.02", ""], ["pose04", "0.102", "0.03", "fewer points than usual"]],
         header=["Pose", "Error (mm)", "Tilt (deg)", "Remark"], caption="Every scan", text=(0, 3)) }}
{% endblock %}
{% block provenance %}
{{ facts([("weldcal", "0.2.0"), ("dataset", "sha256 " + "0123456789abcdef" * 4), ("seed", 0)]) }}
{% endblock %}
"""


@pytest.fixture
def page() -> str:
    """The example report, rendered with the real base, pieces and look."""
    return rendering.environment().from_string(EXAMPLE).render(robot="<b>UR10e</b>", picture=plot(), nothing=None)


def plot() -> bytes:
    """A small plot as PNG bytes."""
    with mpl.rc_context({"font.size": 11}):
        figure = Figure(figsize=(9, 3.2), dpi=140)
        axes = figure.add_subplot()
        axes.bar(np.arange(18), np.linspace(0.05, 0.14, 18), color="#1d5f8a")
        axes.axhline(0.15, color="#b3261e")
        axes.set_xlabel("pose")
        axes.set_ylabel("error (mm)")
        out = io.BytesIO()
        figure.savefig(out, format="png", bbox_inches="tight")
    return out.getvalue()


def test_what_comes_from_outside_is_escaped(page: str) -> None:
    assert "<b>UR10e</b>" not in page
    assert "&lt;b&gt;UR10e&lt;/b&gt;" in page


def test_a_missing_number_is_a_dash_and_a_missing_name_an_error(page: str) -> None:
    assert "–" in page
    with pytest.raises(UndefinedError):
        rendering.environment().from_string("{{ never_given }}").render()


@pytest.mark.parametrize(
    ("value", "text"), [(-0.001, "0.00"), (-1.5, "−1.50"), (float("nan"), "–"), (float("inf"), "∞"), (None, "–")]
)
def test_numbers_are_written_as_a_person_writes_them(value: float | None, text: str) -> None:
    assert rendering.fixed(value, 2) == text


def test_only_pictures_become_pictures() -> None:
    assert rendering.data_uri(plot()).startswith("data:image/png;base64,")
    assert rendering.data_uri(b"<?xml version='1.0'?><svg/>").startswith("data:image/svg+xml;base64,")
    with pytest.raises(ValueError, match="PNG, JPEG or SVG"):
        rendering.data_uri(b"text")


def test_a_report_needs_no_network_and_is_readable_light_and_dark(browser: Browser, page: str, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    rendering.write_atomic(path, page)
    shots = []
    for dark in (False, True):
        browser.dark(dark)
        browser.open(path)
        assert browser.console_messages() == []
        assert browser.outside_addresses() == []
        shots.append(browser.screenshot(tmp_path / f"report-{dark}.png", until=lambda picture: colours(picture) > 8))
    browser.dark(False)
    light, night = shots
    assert light.mean() > 0.8 > 0.4 > night.mean()
    assert colours(light) > 8
    assert "The scanner is calibrated." in browser.text()
    assert browser.run("return document.documentElement.scrollWidth <= innerWidth"), "nothing runs off the side"


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "report.html"
    rendering.write_atomic(path, "first")
    rendering.write_atomic(path, "second")
    with pytest.raises(UnicodeEncodeError):
        rendering.write_atomic(path, "\ud800")
    assert path.read_text() == "second"
    assert [file.name for file in path.parent.iterdir()] == ["report.html"]
    assert path.stat().st_mode & 0o400
