"""Answers Ctrl-C and SIGTERM from the start of the program to its end.

One sentence, one exit code, no traceback, no process left.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:  # what is not loaded before the handlers are there cannot be interrupted
    import subprocess
    from collections.abc import Iterator

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C or SIGTERM ended."""
NOTHING_BEGUN = (
    "Ctrl-C or SIGTERM ended the command before it began its work. Nothing was written and nothing has moved."
)
AGAIN_S = 0.01  # a choice: the destructor has returned by then, and the operator notices no delay
SIGTERM = "SIGTERM"
"""Argument of the KeyboardInterrupt of that signal."""


_BEFORE = 0  # the program imports and reads its arguments: it ends at once
_WORK = 1  # KeyboardInterrupt is raised
_AFTER = 2  # the outcome is known: it is printed first


class _Now:
    """What the handler must know."""

    time = _BEFORE
    deferred = 0  # depth of the blocks in which a signal waits
    waiting: ClassVar[set[int]] = set()
    count = 0


def answer_signals() -> None:
    """Install the handlers. To be called before the imports that take seconds."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _handle)
    sys.unraisablehook = _again


def ignore_signals() -> None:
    """Let nothing interrupt the end of the interpreter, which would put the system's own handlers back."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    # `python -m` ends by SIGINT where the last exec of a text met a KeyboardInterrupt, as a dataclass that was being
    # made; the next exec takes the mark back (CPython, run_eval_code_obj).
    exec("")


def received() -> bool:
    """Return whether a signal has come. A library in C may make another exception of the KeyboardInterrupt."""
    return _Now.count > 0


@contextmanager
def work() -> Iterator[None]:
    """The work of a command: a signal raises KeyboardInterrupt within the block.

    After it, the outcome is printed first.
    """
    _Now.time = _WORK
    try:
        yield
    finally:
        _Now.time = _AFTER


@contextmanager
def deferred() -> Iterator[None]:
    """Let signals wait until the end of the block.

    A process that is started within it never gets a Ctrl-C of the terminal.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a started process inherits this
    _Now.deferred += 1
    try:
        yield
    finally:
        _Now.deferred -= 1
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if not _Now.deferred:
            for number in tuple(_Now.waiting):
                _Now.waiting.discard(number)
                os.kill(os.getpid(), number)


def started(*arguments: Any, **named: Any) -> subprocess.Popen[Any]:
    """subprocess.Popen, for a process that Ctrl-C must not reach."""
    import subprocess

    with deferred():
        return subprocess.Popen(*arguments, **named)


def _handle(number: int, _: object) -> None:
    if _Now.deferred:
        _Now.waiting.add(number)
        return
    _Now.count += 1
    if _Now.time == _BEFORE:
        if "--json" in sys.argv:
            import json

            os.write(1, (json.dumps({"state": "failed", "reason": NOTHING_BEGUN}) + "\n").encode())
        os.write(2, f"weldcal: {NOTHING_BEGUN}\n".encode())
    elif _Now.time == _WORK:
        raise KeyboardInterrupt(*([SIGTERM] if number == signal.SIGTERM else []))
    elif _Now.count < 3:
        return
    os._exit(INTERRUPTED)


def _again(problem: Any) -> None:
    """A KeyboardInterrupt that Python met where it cannot raise, as in a destructor, comes once more."""
    import threading

    if isinstance(problem.exc_value, KeyboardInterrupt):
        number = signal.SIGTERM if SIGTERM in problem.exc_value.args else signal.SIGINT
        threading.Timer(AGAIN_S, os.kill, (os.getpid(), number)).start()
    elif not received():
        sys.__unraisablehook__(problem)
