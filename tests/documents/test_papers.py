"""The page of the five papers: each row names what shows it, and each figure that it states is printed."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import pytest

from tests.golden.calls import LIVE, RECORDED
from tests.places import ROOT, SHARED_DATA, require_data

PAGE = ROOT / "docs" / "papers.md"
COLUMNS = 6
_NUMBER = re.compile(r"[-−]?\d+(?:\.\d+)?")
ABSENT_AT_MOST = 4
"""Falls with each row that comes back; the issue of the papers allows six."""


@dataclass(frozen=True)
class Row:
    """One item of a paper."""

    item: str
    where: str
    shown_by: str
    paper: str
    weldcal: str
    why: str


def _tables() -> Iterator[list[str]]:
    """The cells of each line of a table, without the lines of dashes."""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("| "):
            yield [cell.strip() for cell in line[1:].split("|")]


COMMANDS = {cells[0]: cells[1].strip("`") for cells in _tables() if len(cells) == 2 and cells[0] != "name"}
ROWS = [Row(*cells, *[""] * (COLUMNS - len(cells))) for cells in _tables() if len(cells) > 2 and cells[0] != "item"]
KEPT = {name for name, command in COMMANDS.items() if command.startswith("weldcal ")}
STATED = [(row, value) for row in ROWS for value in re.findall("`([^`]+)`", row.weldcal)]


@cache
def printed(name: str) -> list[str]:
    """The lines that the short form of a command prints."""
    words = shlex.split(COMMANDS[name].replace("../shared", str(SHARED_DATA.parent)))[1:]
    module = "tests.figures" if words[0] == "figures" else "weldcal.tools"
    command = [sys.executable, "-m", module, *words[words[0] == "figures" :]]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
    assert done.returncode == 0, done.stderr[-2000:]
    return [line.replace("−", "-") for line in done.stdout.splitlines()]


def holds(value: str, line: str) -> bool:
    """Whether a line has the words before the colon, and then the numbers in this order, to one of the last digit."""
    label, _, numbers = value.rpartition(": ")
    for word in label.split(", ") if label else ():
        _, found, line = line.partition(word)
        if not found:
            return False
    there = iter(float(text) for text in _NUMBER.findall(line))
    for text in numbers.split(", "):
        unit = 10.0 ** -len(text.partition(".")[2])
        if not any(abs(float(text) - other) <= 1.001 * unit for other in there):
            return False
    return True


def test_each_row_has_a_place_and_something_that_shows_it_or_says_why_not() -> None:
    assert len(ROWS) >= 88
    for row in ROWS:
        if row.shown_by == "absent":
            assert row.why, row
            continue
        assert (ROOT / row.where.strip("`")).exists(), row
        named = row.shown_by.strip("`")
        assert named in COMMANDS or (named.startswith("tests/") and (ROOT / named).is_file()), row
        assert named in COMMANDS or not row.weldcal, f"nothing compares the figure of {row}"
    assert {row.shown_by for row in ROWS} >= set(COMMANDS), "a command that no row needs"
    assert sum(row.shown_by == "absent" for row in ROWS) <= ABSENT_AT_MOST


def test_a_long_command_is_the_one_whose_figures_are_kept() -> None:
    for name in KEPT:
        call = (RECORDED | LIVE)[name].replace("{made}/", "")
        assert COMMANDS[name] == f"weldcal {call}"


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - KEPT))
def test_what_the_page_states_is_printed(name: str) -> None:
    require_data(SHARED_DATA)
    stated = [value for row, value in STATED if row.shown_by == name]
    assert stated or any(row.shown_by == name for row in ROWS)
    missing = [value for value in stated if not any(holds(value, line) for line in printed(name))]
    assert not missing


def test_what_the_page_states_of_a_long_command_is_kept() -> None:
    for row, value in STATED:
        if row.shown_by not in KEPT:
            continue
        kept = json.loads((ROOT / "tests/golden/results" / f"{row.shown_by}.json").read_text(encoding="utf-8"))
        for key, text in (part.rsplit(" ", 1) for part in value.split(", ")):
            assert holds(text, f"{kept[key]:.9f}"), (row, key)


def test_a_wrong_figure_is_found() -> None:
    line = "|   ours, their verification | 0.54 | 1.65 | -0.41 | 0.10 |"
    assert holds("ours, their verification: 0.54, 1.65, -0.41", line)
    assert not holds("ours, their verification: 0.54, 1.62, -0.41", line)
    assert not holds("theirs: 0.54, 1.65, -0.41", line)
    assert not holds("0.54, -0.41, 1.65", line)
