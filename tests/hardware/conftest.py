"""Cells with a robot compute in a process beside them; the cells of these tests share one, because each takes seconds to start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import pytest

from weldcal.systems import background


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
