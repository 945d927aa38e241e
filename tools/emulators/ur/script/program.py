"""Runs one URScript program: its threads, one slice each per frame, and which thread moves the arm."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from weldcal.tools.emulators.ur.script.arithmetic import EFFORT, Effort
from weldcal.tools.emulators.ur.script.compiler import SOURCE_NAME, Halted, Hooks, Slices, Translation, bind, translate
from weldcal.tools.emulators.ur.script.parser import parse_program
from weldcal.tools.emulators.ur.script.syntax import ScriptError

MOST_THREADS = 50  # [M] at a time
LONGEST_SCRIPT = 1_000_000  # [M] characters


@dataclass
class Thread:
    """One thread of the script."""

    number: int
    name: str
    slices: Slices


class Program:
    """A compiled program and its threads; `step` runs one frame.

    Args:
        source: the text of one program.
        builtins: the controller's functions by their URScript name, made for this program.
        blocking: names of those that are generators and may take more than one frame.
    """

    def __init__(
        self, source: str, builtins: Callable[[Program], tuple[Mapping[str, Callable[..., Any]], Iterable[str]]]
    ) -> None:
        self.source = source
        self.current: Thread | None = None
        self.owner: Thread | None = None
        self.sockets: dict[str, Any] = {}
        self._threads: dict[int, Thread] = {}
        self._count = 0
        functions, blocking = builtins(self)
        hooks = Hooks(self._run, self._kill, self._alive)
        Effort.left = EFFORT
        try:
            if len(source) > LONGEST_SCRIPT:
                raise ScriptError(f"The script has more than {LONGEST_SCRIPT} characters.")
            self._compiled = bind(_translated(source, frozenset(functions), frozenset(blocking)), functions, hooks)
        except ScriptError:
            raise
        except Exception as error:  # whatever Python's own compiler refuses
            deep = isinstance(error, RecursionError | MemoryError | IndentationError) or "nested" in str(error)
            raise ScriptError("The script is nested too deeply." if deep else _plain(error)) from error
        self.name = self._compiled.name
        self.kind = self._compiled.kind
        self._main = self._run(self._compiled.main(), "main")

    @property
    def finished(self) -> bool:
        """The main body has ended; the real controller then ends the other threads, and so do we."""
        return self._main not in self._threads

    @property
    def line(self) -> int:
        """Return the URScript line at which the main body is."""
        thread = self._threads.get(self._main)
        frame = getattr(thread.slices, "gi_frame", None) if thread else None
        return self._script_line(frame.f_lineno) if frame is not None else 0

    def step(self) -> None:
        """One slice of every thread, the main body first; together they may spend the effort of one frame.

        Raises:
            ScriptError: the script made a mistake, with its line.
        """
        Effort.left = EFFORT
        for thread in list(self._threads.values()):
            self._slice(thread)
            if self.finished:
                break

    def close(self) -> None:
        """Ends every thread, which gives the arm back, and closes the program's sockets."""
        for thread in list(self._threads.values()):
            self._end(thread)
        while self.sockets:
            self.sockets.popitem()[1].close()

    def claim(self) -> Thread:
        """The current thread takes the arm.

        Raises:
            ScriptError: another thread has it.
        """
        assert self.current is not None
        if self.owner is not None and self.owner is not self.current:
            raise ScriptError("Another thread is already controlling the robot")
        self.owner = self.current
        return self.current

    def release(self, thread: Thread) -> None:
        """Gives the arm back."""
        if self.owner is thread:
            self.owner = None

    def _slice(self, thread: Thread) -> None:
        if thread.number not in self._threads:
            return
        self.current = thread
        try:
            next(thread.slices)
        except StopIteration:
            self._end(thread)
        except Halted:
            self.close()
        except ScriptError as error:
            raise self._located(error) from error
        except RecursionError as error:
            raise self._located(ScriptError("The script calls itself too deeply."), error) from error
        except Exception as error:  # a mistake of the script: it must not end the controller
            raise self._located(ScriptError(_plain(error)), error) from error
        finally:
            self.current = None

    def _located(self, error: ScriptError, cause: BaseException | None = None) -> ScriptError:
        frames = [f for f in traceback.extract_tb((cause or error).__traceback__) if f.filename == SOURCE_NAME]
        line = self._script_line(frames[-1].lineno or 0) if frames else error.line
        return ScriptError(str(error), line, error.column)

    def _script_line(self, generated: int) -> int:
        lines = self._compiled.lines
        return lines[generated - 1] if 0 < generated <= len(lines) else 0

    def _end(self, thread: Thread) -> None:
        self._threads.pop(thread.number, None)
        if thread is not self.current:
            thread.slices.close()
        self.release(thread)

    def _run(self, slices: Slices, name: str) -> int:
        if len(self._threads) >= MOST_THREADS:
            raise ScriptError(f"A program has no more than {MOST_THREADS} threads.")
        self._count += 1
        self._threads[self._count] = Thread(self._count, name, slices)
        return self._count

    def _kill(self, number: Any) -> None:
        thread = self._threads.get(number)
        if thread is not None and thread is self.current:
            raise ScriptError("A thread cannot kill itself.")
        if thread is not None:
            self._end(thread)

    def _alive(self, number: Any) -> bool:
        return number in self._threads


# a client sends the same script again and again, and a frame has no time for 45 ms of translation
@lru_cache(maxsize=8)
def _translated(source: str, builtins: frozenset[str], blocking: frozenset[str]) -> Translation:
    return translate(parse_program(source), builtins, blocking)


def _plain(error: BaseException) -> str:
    if isinstance(error, NameError):
        return f"A variable is read before it is set: {str(getattr(error, 'name', '') or '').removeprefix('v_')}"
    return f"Wrong arguments: {str(error).replace('b_', '').replace('v_', '') or type(error).__name__}"
