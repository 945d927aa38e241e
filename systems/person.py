"""Holds a run, and lets it go on, when a person at this computer's terminal says so."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

HOLD, GO_ON = "h", "g"
KEYS = f"Type {HOLD} and Enter to hold the arm, {GO_ON} and Enter to go on, Ctrl-C to end."


class Person:
    """What the person wants. Only the terminal sets it: any page of this computer's browsers can reach the viewer."""

    def __init__(self) -> None:
        self._holds = threading.Event()

    @property
    def holds(self) -> bool:
        """Whether the run is to stand still."""
        return self._holds.is_set()

    def hold(self) -> None:
        """Bring the arm to rest on its path and stop the job's time."""
        self._holds.set()

    def go_on(self) -> None:
        """Go on along the same path, from where the arm stands."""
        self._holds.clear()

    def says(self, line: str) -> None:
        """Take a line of the terminal; lines other than HOLD and GO_ON are ignored."""
        word = line.strip().lower()
        if word == HOLD:
            self.hold()
        elif word == GO_ON:
            self.go_on()


@contextmanager
def person_at(terminal: TextIO | None = None) -> Iterator[Person]:
    """Listen to a terminal (None: standard input, where it is one) for the duration of the block."""
    person, stream = Person(), sys.stdin if terminal is None else terminal
    if terminal is not None or (stream is not None and stream.isatty()):

        def listen() -> None:
            for line in stream:
                person.says(line)

        threading.Thread(target=listen, daemon=True, name="terminal").start()
    yield person
