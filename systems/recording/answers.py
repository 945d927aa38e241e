"""Records when computations beside the control loop were answered, and answers them at the same moment again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, TypeVar

from weldcal.systems.background import Answer, Background, Inline

Found = TypeVar("Found")
Note = Callable[[int, int], None]
"""Takes the number of a question and how often it was looked at before its answer was there."""


def _no_note(number: int, looks: int) -> None:
    """Take no note."""


@dataclass(frozen=True, eq=False)
class _NotedAnswer(Answer[Found]):
    """An answer that counts how often it was looked at in vain; `answer` says when it is there."""

    answer: Answer[Found]
    number: int
    note: Note
    looks: list[int] = field(default_factory=lambda: [0])

    @property
    def ready(self) -> bool:
        """See Answer."""
        if not self.answer.ready:
            self.looks[0] += 1
            return False
        if self.looks[0] >= 0:
            self.note(self.number, self.looks[0])
            self.looks[0] = -1
        return True


@dataclass(frozen=True, eq=False)
class _LateAnswer(Answer[Found]):
    """An answer that is there after as many looks as in the recording; never where it was not answered there."""

    looks: list[int]

    @property
    def ready(self) -> bool:
        """See Answer."""
        if self.looks[0] == 0:
            return True
        self.looks[0] -= 1
        return False


@dataclass(eq=False)
class NotedBackground:
    """A background whose answers are noted."""

    background: Background
    note: Note = _no_note
    asked: int = 0

    @property
    def waiting_since(self) -> float | None:
        """See Background."""
        return self.background.waiting_since

    def prepare(self, function: Callable[..., Any], *arguments: Any) -> None:
        """See Background."""
        self.background.prepare(function, *arguments)

    def ask(self, function: Callable[..., Found], *arguments: Any) -> Answer[Found]:
        """See Background."""
        self.asked += 1
        answer = self.background.ask(function, *arguments)
        return _NotedAnswer(answer.future, answer, self.asked - 1, self._noted)

    def _noted(self, number: int, looks: int) -> None:
        self.note(number, looks)

    def settle(self) -> None:
        """See Background."""
        self.background.settle()

    def close(self) -> None:
        """See Background."""
        self.background.close()


@dataclass(eq=False)
class RepeatedBackground(Inline):
    """Computes at once and gives the answers as late as in a recording; `looks`: by the number of the question."""

    looks: Mapping[int, int] = field(default_factory=dict)
    asked: int = 0

    def ask(self, function: Callable[..., Found], *arguments: Any) -> Answer[Found]:
        """See Background."""
        number, self.asked = self.asked, self.asked + 1
        if number not in self.looks:
            return _LateAnswer(Future(), [-1])
        return _LateAnswer(super().ask(function, *arguments).future, [self.looks[number]])
