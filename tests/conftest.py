"""What every test may ask for: the repository, the measured data, a headless browser."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.browser import RUNNING, browser
from tests.compiling import compile_one_by_one
from tests.places import SHARED_DATA, require_data
from tests.quick import quick_files
from tests.scheduling import Scheduling, order, processes
from tests.short_job import finished_demo, short_jobs

__all__ = ["browser", "finished_demo", "short_jobs"]

compile_one_by_one()
# Imports and collected tests stay for good: to look through all of them again and again takes a third of what
# collecting takes.
gc.disable()


def pytest_configure(config: pytest.Config) -> None:
    """The marks `needs_data` of tests.places and `quick`."""
    config.addinivalue_line("markers", "needs_data(path): skipped where the measured data are absent, and failed in CI")
    config.addinivalue_line("markers", "quick: of a file that takes two seconds or less (tests/quick.py)")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before any fixture is made, the data must be there."""
    for mark in item.iter_markers("needs_data"):
        require_data(*mark.args)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """The browser leaves a test's page.

    A run of a cell has unfrozen all objects; when its file has ended, those that are left are frozen again.
    """
    last = nextitem is None or nextitem.path != item.path
    running = item.session.stash.get(RUNNING, None)
    if running is not None and "browser" in getattr(item, "fixturenames", ()):
        running.rest()
    yield
    if last:
        gc.collect()
        gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """What `-n auto` means."""
    return processes()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """File by file; what streams to an emulated robot one by one."""
    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files are dealt to the processes one by one, in this order; quick ones have their mark."""
    items.sort(key=order)
    quick = quick_files()
    for item in items:
        if item.nodeid.partition("::")[0] in quick:
            item.add_marker("quick")


def pytest_collection_finish() -> None:
    """From here on garbage is collected, of what the tests themselves make; not after each 700 objects, which takes
    twice the time."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root folder of the repository."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data(repository: Path) -> Path:
    """The folder of measured data beside the repository; where there is none the test is skipped, and fails in CI."""
    require_data(SHARED_DATA)
    return SHARED_DATA


@dataclass(frozen=True)
class FinishedRun:
    """What a command left: its exit code, what it said, its JSON object and its result folder."""

    returncode: int
    stderr: str
    summary: dict[str, Any]
    folder: Path


def run_weldcal(*arguments: str, folder: Path, timeout_s: float = 1200) -> FinishedRun:
    """Runs a weldcal command with --json in a process of its own, as an operator would."""
    command = [sys.executable, "-P", "-m", "weldcal.tools", *arguments, "--json"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=timeout_s)
    lines = finished.stdout.splitlines()
    return FinishedRun(finished.returncode, finished.stderr, json.loads(lines[-1]) if lines else {}, folder)
