"""The site builds without a warning, has every page in its navigation, and is read and searched without a network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

import weldcal
from tests.browser import Browser, colours
from tests.documents.blocks import DOCUMENTS
from tests.places import ROOT
from weldcal.tools.cli.app import app

PAGES = [page.relative_to(ROOT / "docs").with_suffix("") for page in DOCUMENTS if page.name != "README.md"]
LOADED = re.compile(r"<(?:script|img|iframe)[^>]*\bsrc=\"([^\"]+)\"|<link[^>]*\bhref=\"([^\"]+)\"")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-P", "-m", "sphinx", "-q", "--fail-on-warning", "--keep-going", "docs", str(folder)]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert finished.returncode == 0, finished.stderr
    return folder


def test_every_page_is_built_and_loads_nothing_from_a_network(site: Path) -> None:
    for page in PAGES:
        text = (site / f"{page}.html").read_text()
        outside = [a or b for a, b in LOADED.findall(text) if re.match(r"(https?:)?//", a or b)]
        assert outside == [], page


def test_the_six_parts_are_in_the_navigation(site: Path) -> None:
    text = (site / "arms.html").read_text()
    assert re.findall(r'<li class="toctree-l1[^>]*><a[^>]*>([^<]+)</a>', text) == [
        "Start: the first hour",
        "Tutorials",
        "How-to",
        "Concepts",
        "Methods",
        "Reference",
    ]


def test_a_search_without_a_network_finds_the_page_that_explains_a_word(site: Path, browser: Browser) -> None:
    browser.open(site / "search.html")
    browser.run("location.search = '?q=charuco'")
    # the results come one after the other
    found = (
        "[...document.querySelectorAll('#search-results li a')].some(link =>"
        " link.href.split('?')[0].endsWith('/sensors.html'))"
    )
    browser.wait(found, 60)
    assert [name for name in browser.outside_addresses() if not name.startswith("file:")] == []


def test_no_block_of_code_is_wider_than_its_column(site: Path, browser: Browser) -> None:
    wide = "return [...document.querySelectorAll('pre')].filter(e => e.scrollWidth > e.clientWidth).map(e => e.textContent)"
    cut = {}
    for page in PAGES:
        browser.open(site / f"{page}.html")
        cut[page] = browser.run(wide)
    assert {page: blocks for page, blocks in cut.items() if blocks} == {}


def test_a_page_fits_a_phone(site: Path, browser: Browser, tmp_path: Path) -> None:
    browser.resize(390, 844)
    try:
        browser.open(site / "first_hour" / "your_scans.html")
        assert browser.run("return document.documentElement.scrollWidth <= 390")
        assert colours(browser.screenshot(tmp_path / "phone.png")) > 4
    finally:
        browser.resize(1280, 800)


def test_the_reference_has_every_command_with_every_option(site: Path) -> None:
    text = (site / "reference" / "command_line.html").read_text()
    groups = [("weldcal", typer.main.get_command(app))]
    while groups:
        name, command = groups.pop()
        if hasattr(command, "commands"):
            groups += [(f"{name} {word}", child) for word, child in command.commands.items()]
            continue
        section = text.partition(f"<h2>{name}<")[2].partition("<h2>")[0]
        missing = [
            option for p in command.params for option in p.opts if option.startswith("--") and option not in section
        ]
        assert section, name
        assert missing == [], name


def test_the_reference_has_every_function_with_what_it_raises(site: Path) -> None:
    text = (site / "reference" / "python_functions.html").read_text()
    assert [name for name in weldcal.__all__ if f'id="weldcal.{name}"' not in text] == []
    assert "TooFewPoses" in text
