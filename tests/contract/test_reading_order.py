"""The reading order in docs/developers.md names files that run, and what it leaves out is little."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

from tests.places import ROOT

PAGE = ROOT / "docs" / "developers.md"
LEAST_SHARE = 0.75  # of the functions that run; 0.80 and 0.82 when the page was written
# flow: its heading, its command of tests.traced, most files, and the fewest calls of a function that takes part
FLOWS = {"calibrate": ("Calibrate a folder", 25, 1), "tick": ("One servo tick on a robot", 22, 10)}


def named(heading: str) -> tuple[list[str], tuple[str, ...]]:
    """The files of a flow in the page's order, and its shared basics: files and folders."""
    (part,) = re.findall(rf"\n### {heading}\n(.*?)(?=\n##)", PAGE.read_text(), re.DOTALL)
    table, _, basics = part.partition("Shared basics:")
    return re.findall(r"^\| `([^`]+\.py)` \|", table, re.MULTILINE), tuple(re.findall(r"`([^`]+)`", basics))


@pytest.mark.parametrize(("heading", "most", "_fewest"), FLOWS.values(), ids=FLOWS)
def test_the_reading_order_names_few_files_that_exist(heading: str, most: int, _fewest: int) -> None:
    files, basics = named(heading)
    assert 0 < len(files) <= most
    assert len(set(files)) == len(files)
    assert [path for path in (*files, *basics) if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("flow", FLOWS)
def test_the_files_of_the_reading_order_are_those_that_run(flow: str) -> None:
    heading, _, fewest = FLOWS[flow]
    files, basics = named(heading)
    done = subprocess.run(
        [sys.executable, "-m", "tests.traced", flow], cwd=ROOT, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr[-2000:]
    calls = json.loads(done.stdout)
    ran = {path: sum(n >= fewest for n in functions.values()) for path, functions in calls.items()}
    assert [path for path in files if not ran.get(path)] == [], "named in docs/developers.md, and does not run"
    counted = {path: n for path, n in ran.items() if not path.startswith(basics)}
    share = sum(counted.get(path, 0) for path in files) / sum(counted.values())
    missing = sorted((n, path) for path, n in counted.items() if path not in files)[-8:]
    assert share >= LEAST_SHARE, f"docs/developers.md leaves out much of what runs, such as {missing}"
