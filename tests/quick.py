"""Measure which test files are quick, for `./tools/run test -m quick`: `python -m tests.quick` writes the list.

A file is quick when its tests take QUICK_S of processor time together, with the processes that they start. quick.txt is
the list; a new file belongs to it when it is measured.
"""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping

import pytest

from tests.places import ROOT

QUICK_S = 2.0  # a choice: all that are below it take three minutes on two slow cores
LIST = ROOT / "tests" / "quick.txt"


def quick_files() -> frozenset[str]:
    """The listed files, by their paths in the project."""
    return frozenset(LIST.read_text().split())


class Measured:
    """Take the processor time of each file; what is left of a file that is not quick is skipped."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Time one test with its fixtures."""
        begun = sum(os.times()[:4])
        try:
            return (yield)
        finally:
            self.seconds[item.path.relative_to(ROOT).as_posix()] += sum(os.times()[:4]) - begun

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Skip a test of a file that is known not to be quick."""
        if self.seconds[item.path.relative_to(ROOT).as_posix()] > QUICK_S:
            pytest.skip("its file is not quick")


def listed(seconds: Mapping[str, float], known: frozenset[str]) -> str:
    """Write the list: what was measured by its time, other files as they are known."""
    kept = {file for file in known if file not in seconds and (ROOT / file).is_file()}
    return "".join(f"{file}\n" for file in sorted(kept | {file for file, s in seconds.items() if s <= QUICK_S}))


def main(*words: str) -> int:
    """Measure the tests of files or folders, or all, and write the list."""
    measured = Measured()
    code = pytest.main(["-q", *words], plugins=[measured])
    LIST.write_text(listed(measured.seconds, quick_files()))
    return int(code)


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
