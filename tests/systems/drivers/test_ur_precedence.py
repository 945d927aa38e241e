"""Thread priorities: a thread that ends while they are set is no error."""

from __future__ import annotations

import os

import pytest

from weldcal.systems.drivers.ur.precedence import poll_beside_the_cell

NOBODY = 2**22 + 1  # beyond the greatest number of a process


def test_a_thread_that_ends_meanwhile_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(os, "listdir", lambda _: [str(NOBODY)])
    with pytest.raises(ProcessLookupError):
        os.sched_getscheduler(NOBODY)
    poll_beside_the_cell()
