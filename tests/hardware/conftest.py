"""The option --controller of these tests; and one process beside all cells with a robot, because each takes seconds to
start.

`./tools/run test tests/hardware --controller ADDRESS` runs the tests that hold for every UR controller against the one
at that address. All others are skipped, and say why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

from weldcal.systems import background
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

HERE = Path(__file__).parent
OTHERS = "injects faults, looks inside the emulator or sets one up: this cannot be done at --controller"


def pytest_addoption(parser: pytest.Parser) -> None:
    """--controller."""
    parser.addoption("--controller", metavar="ADDRESS", help="test the UR controller at this address; its arm moves")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """At a controller that is not ours only what holds for every controller is tested."""
    if config.getoption("--controller", None):
        for item in items:
            if HERE in item.path.parents and "controller_address" not in getattr(item, "fixturenames", ()):
                item.add_marker(pytest.mark.skip(reason=OTHERS))


@pytest.fixture(scope="session")
def controller_address(request: pytest.FixtureRequest) -> Iterator[str]:
    """The address of --controller, or of an emulator."""
    if address := request.config.getoption("--controller", None):
        yield address
        return
    with emulator_process(lockstep=LOCKSTEP_S) as made:
        yield made.host


class Kept:
    """The pool of one cell: it takes the process of the cell before it, and leaves it to the next one."""

    _process: ProcessPoolExecutor | None = None

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        self._arguments, self._settings = arguments, settings
        self._asked: list[Future[Any]] = []

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """A question to the kept process; to a new one where that has ended."""
        try:
            if Kept._process is None:
                raise BrokenProcessPool
            future = Kept._process.submit(function, *arguments)
        except BrokenProcessPool:
            Kept._process = ProcessPoolExecutor(*self._arguments, **self._settings)
            future = Kept._process.submit(function, *arguments)
        self._asked.append(future)
        return future

    def shutdown(self, *, wait: bool, cancel_futures: bool) -> None:
        """Give up what this cell has asked; the process stays."""
        assert cancel_futures
        assert not wait
        for future in self._asked:
            future.cancel()


@pytest.fixture(scope="module", autouse=True)
def one_background_process() -> Iterator[None]:
    """All cells of these tests compute in one process."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(background, "ProcessPoolExecutor", Kept)
        yield
