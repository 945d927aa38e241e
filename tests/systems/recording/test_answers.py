"""Answers of computations beside the control loop come as late in a replay as they came in the run, also when they are
noted again."""

from __future__ import annotations

import time
from concurrent.futures import Future
from typing import Any

import pytest

from weldcal.systems.background import Answer, Inline
from weldcal.systems.recording.answers import NotedBackground, RepeatedBackground


class Slow(Inline):
    """Answers after a while."""

    def ask(self, function: Any, *arguments: Any) -> Answer[Any]:
        self.future: Future[Any] = Future()
        return Answer(self.future)


def looked_at(answer: Answer[Any], times: int) -> list[bool]:
    return [answer.ready for _ in range(times)]


def test_looks_in_vain_are_noted_once_the_answer_is_there() -> None:
    noted: list[tuple[int, int]] = []
    slow = Slow()
    background = NotedBackground(slow, lambda number, looks: noted.append((number, looks)))
    answer = background.ask(time.time)
    assert looked_at(answer, 3) == [False] * 3
    slow.future.set_result(7)
    assert looked_at(answer, 2) == [True, True]
    assert noted == [(0, 3)]
    assert answer.value == 7


@pytest.mark.parametrize("again", [False, True], ids=["replayed", "replayed and noted again"])
def test_an_answer_comes_after_as_many_looks_as_in_the_run(again: bool) -> None:
    repeated = RepeatedBackground(looks={0: 2, 1: 0})
    noted: list[tuple[int, int]] = []
    background = NotedBackground(repeated, lambda number, looks: noted.append((number, looks))) if again else repeated
    first, second, never = (background.ask(abs, -k) for k in (3, 4, 5))
    assert looked_at(first, 4) == [False, False, True, True]
    assert looked_at(second, 1) == [True]
    assert looked_at(never, 50) == [False] * 50
    assert (first.value, second.value) == (3, 4)
    assert noted == ([(0, 2), (1, 0)] if again else [])
