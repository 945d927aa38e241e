"""The page of JSON keys has every key that the commands print, and no other."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.documents.props import lay_out, needs_data
from tests.places import ROOT, SHARED_DATA, require_data
from tests.short_job import ShortJobs
from weldcal.tools.cli.app import app
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, Next

PAGE = (ROOT / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
EVERYWHERE = {"state", "first_screen"}
COMMANDS = {
    "calibrate": ("`calibrate FOLDER`", "calibrate three_scans --out my-calibration"),
    "carried": ("`calibrate FOLDER` of a scanner that an arm carries", "calibrate my_wrist_scans --out carried"),
    "verify": ("`verify RESULT FOLDER`", "verify my-calibration other_scans"),
    "verify pairs": ("`verify RESULT PAIRS`", "verify eMc.yaml pairs.npz"),
    "compare": ("`compare RESULT RESULT`", "compare my-calibration my-calibration"),
    "import": ("`import`", "import samples.npz"),
    "hand-eye": ("`hand-eye`", "hand-eye ax-yb samples.npz"),
    "two cameras": ("`hand-eye ax-yb` with several files", "hand-eye ax-yb camera1.npz camera2.npz"),
    "two robots": ("`hand-eye`", "hand-eye axb-ycz two_robots.npz"),
}
OTHERS = {
    "new": "new another_cell",
    "part": "part bracket.step",
    "robots": "robots ur10e",
    "print-board": "print-board",
    "doctor": "doctor three_scans",
    "tool measure": (
        "tool measure shown/scans --calibration torch_result --tool my_tool.yaml --touches wire_touches.csv"
    ),
    "profiler edge": "profiler edge edge.npz",
    "profiler seam": "profiler seam groove.npz --calibration my-profiler",
    "profiler bead": "profiler bead bead.npz --calibration my-profiler",
}


def keys_of(title: str) -> tuple[set[str], set[str]]:
    """The keys of a section's table that are always there, and those that are there under a condition."""
    section = PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`[^|]+) \| [^|]+ \| ([^|]+) \|$", section, re.MULTILINE)
    found: tuple[set[str], set[str]] = (set(), set())
    for names, condition in rows:
        found[condition != "-"].update(re.findall(r"`(\w+)`", names))
    return found


def printed(words: str, place: Path) -> set[str]:
    """The keys of the JSON object that a command prints."""
    if needs_data(words):
        require_data(SHARED_DATA)
    lay_out(words, place, ("my-calibration",) if "--out" in words else ())
    finished = CliRunner().invoke(app, [*words.split(), "--json"])
    assert finished.exit_code == 0, finished.output
    return set(json.loads(finished.stdout.splitlines()[-1]))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for all commands."""
    return tmp_path_factory.mktemp("json")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_prints_the_keys_of_its_table(name: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    title, words = COMMANDS[name]
    always, sometimes = keys_of(title)
    keys = printed(words, place) - EVERYWHERE
    assert always - keys == set(), "the page has a key that is not printed"
    assert keys - always - sometimes == set(), "a key is not in the page"


@pytest.mark.parametrize("name", OTHERS)
def test_the_keys_of_a_small_command_are_in_one_line(name: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    row = re.search(rf"^\| `{name}` \| (.+) \|$", PAGE.partition("\n## Others\n")[2], re.MULTILINE)
    assert row is not None
    line = row[1].partition("Each cause: ")[0]
    assert set(re.findall(r"`(\w+)`", line)) == printed(OTHERS[name], place) - EVERYWHERE


def test_a_demo_prints_the_keys_of_its_table(short_jobs: ShortJobs) -> None:
    always, sometimes = keys_of("`demo` and `weld`")
    keys = set(short_jobs.summary()) - EVERYWHERE
    assert always - keys == set()
    assert keys - always - sometimes == set()


def test_the_first_screen_has_the_keys_of_its_table() -> None:
    always, sometimes = keys_of("The first screen")
    screen = FirstScreen(Findings(), ExpectedError("error", "1 mm", "by nothing"), Next("Verify."))
    assert always | sometimes == set(screen.document())


def test_a_failure_has_its_two_keys(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    finished = CliRunner().invoke(app, ["calibrate", "nothing_here", "--json"])
    assert finished.exit_code == 1
    assert set(json.loads(finished.stdout.splitlines()[-1])) == set.union(*keys_of("Every command"))
