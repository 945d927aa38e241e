"""The README's promises, kept: its commands run as they are written and leave what it says."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from tests.browser import Browser, colours
from tests.conftest import FinishedRun, run_weldcal


@pytest.fixture(scope="module")
def readme(repository: Path) -> str:
    """The README's text."""
    return (repository / "README.md").read_text()


def test_the_demo_ends_done_and_leaves_the_files_that_the_readme_names(finished_demo: FinishedRun, readme: str) -> None:
    assert finished_demo.returncode == 0, finished_demo.stderr
    assert finished_demo.summary["state"] == "done"
    promised = set(
        re.findall(r"`([a-z_]+\.(?:html|yaml|csv))`", readme.split("## What the demo shows")[1].split("##")[0])
    )
    assert len(promised) >= 4
    assert promised <= {path.name for path in finished_demo.folder.iterdir()}


@pytest.mark.parametrize("name", ["report.html", "recording.html"])
def test_its_pages_open_without_a_network(
    finished_demo: FinishedRun, browser: Browser, tmp_path: Path, name: str
) -> None:
    ready = "document.querySelector('canvas')" if name == "recording.html" else "document.querySelector('.verdict')"
    browser.open(finished_demo.folder / name, wait_for=ready)
    pixels = browser.screenshot(tmp_path / "page.png", until=lambda picture: colours(picture) > 8)
    assert colours(pixels) > 8, "the page is not blank"
    assert browser.console_messages() == []
    assert browser.outside_addresses() == []


def test_the_report_says_first_whether_it_worked(finished_demo: FinishedRun, browser: Browser) -> None:
    browser.open(finished_demo.folder / "report.html")
    verdict = str(browser.run("return document.querySelector('.verdict').innerText"))
    assert verdict
    assert browser.text().index(verdict) < 300, "the verdict stands near the top"
    assert browser.run("return [...document.images].every(image => image.naturalWidth > 100 && image.alt)")


def test_the_real_data_command_calibrates(repository: Path, shared_data: Path, readme: str, tmp_path: Path) -> None:
    line = next(line for line in readme.splitlines() if line.startswith("./tools/run calibrate"))
    words = shlex.split(line)[1:]
    words[words.index("--out") + 1] = str(tmp_path / "result")
    words = [str((repository / word).resolve()) if word.startswith("../shared/") else word for word in words]
    finished = run_weldcal(*words, folder=tmp_path / "result")
    assert finished.returncode == 0, finished.stderr
    assert finished.summary["n_used"] + len(finished.summary["refused"]) == len(list(Path(words[1]).glob("clouds/*")))
    assert {"calibration.yaml", "report.html"} <= {path.name for path in finished.folder.iterdir()}
