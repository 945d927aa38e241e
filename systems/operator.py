"""What an operator asks of a run: to hold, to go on, to end, to keep a pace.

From the terminal, the dashboard or the 3D view.
"""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

HOLD, GO_ON = "h", "g"
YES, NO = ("yes", "y", GO_ON), ("no", "n")
KEYS = f"Type {HOLD} and Enter to hold the arm, {GO_ON} and Enter to go on, Ctrl-C to end."
ANSWERS = "Type yes (or y, g) and Enter to start. Type no and Enter, or Ctrl-C, to refuse: no arc is lit."
SLOWEST, FASTEST = 0.0, 3.0
"""Real-time rates of a simulation that may be asked for; 0 is as fast as it goes."""


class Operator:
    """The wishes of an operator; thread-safe.

    The Diagram reads them in its OperatorPanel, which makes them an input of the run.

    `stands`: the run loop keeps the arm at rest now. `held_by`, `ended_by`: from where that was asked for. `question`:
    what the run asks; the hold lasts until it is answered. `answered`: the question that `go_on` answered last.
    """

    def __init__(self) -> None:
        self._holds, self._ends = threading.Event(), threading.Event()
        self._pace: float | None = None
        self.held_by, self.ended_by = "", ""
        self.stands = False
        self.question, self.answered = "", ""

    @property
    def holds(self) -> bool:
        """Whether the run is to stand still."""
        return self._holds.is_set()

    @property
    def ends(self) -> bool:
        """Whether the run is to end; never taken back."""
        return self._ends.is_set()

    @property
    def pace(self) -> float | None:
        """The real-time rate that was asked for last; None: nobody asked."""
        return self._pace

    def hold(self, by: str = "the terminal") -> None:
        """Turn the process off, bring the arm to rest on its path and stop the job's time."""
        if not self.holds:
            self.held_by = by
        self._holds.set()

    def ask(self, question: str) -> None:
        """Hold the run until an operator answers a question with `go_on`."""
        self.question = question
        self.hold("a question")

    def go_on(self) -> None:
        """Continue along the same path, from where the arm is; a weld goes back a little first."""
        self.answered, self.question = self.question or self.answered, ""
        self._holds.clear()

    def end(self, by: str = "the terminal") -> None:
        """End the run: the process goes off and the arm comes to rest."""
        if not self.ends:
            self.ended_by = by
        self._ends.set()

    def ask_pace(self, pace: float) -> None:
        """Ask for a real-time rate of a simulation; a number that is no such rate is ignored."""
        if SLOWEST <= pace <= FASTEST:
            self._pace = float(pace)

    def says(self, line: str) -> None:
        """Take a line of the terminal: HOLD, GO_ON, or the answer to a question; others are ignored."""
        word = line.strip().lower()
        if word == HOLD:
            self.hold()
        elif word == GO_ON or (self.question and word in YES):
            self.go_on()
        elif self.question and word in NO:
            self.end()


@contextmanager
def operator_at(terminal: TextIO | None = None) -> Iterator[Operator]:
    """Listen to a terminal (None: standard input, where it is one) for the duration of the block."""
    operator, stream = Operator(), sys.stdin if terminal is None else terminal
    if terminal is not None or (stream is not None and stream.isatty()):

        def listen() -> None:
            for line in stream:
                operator.says(line)

        threading.Thread(target=listen, daemon=True, name="terminal").start()
    yield operator
