"""A source in a process of its own.

A device's library that crashes, or keeps Python's lock, does not touch the control loop.
"""

import multiprocessing
import os
import weakref
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from weldcal.systems.background import require_guard
from weldcal.systems.drivers.sensors.acquisition import POLL_S, Delivery, DeviceFault, DeviceLost, Garbage, Source
from weldcal.systems.interrupts import deferred

Datum = TypeVar("Datum")
OPEN_S = 30.0  # the process imports its libraries first
END_S = 1.0  # a choice: longer than a frame takes to be read; a process that hangs is killed after it


class SourceProcess(Source[Datum]):
    """What `make(*arguments)` returns, used from a spawned process; frames come through a pipe.

    The process stays over a lost device and opens it again. One that has ended is started again.
    """

    def __init__(self, name: str, make: Callable[..., Source[Datum]], *arguments: Any) -> None:
        self.name = name
        self._make, self._arguments = make, arguments
        self._pipe: Connection | None = None
        self._process: BaseProcess | None = None
        self._end: Callable[[], object] = lambda: None

    def open(self) -> None:
        """See Source."""
        if self._process is None or not self._process.is_alive():
            self._start()
        self._send(("open", 0))
        if self._answer(OPEN_S) is not None:
            raise DeviceLost("the process that reads it is out of step")

    def ask(self, request: int) -> None:
        """See Source."""
        self._send(("ask", request))

    def next(self, timeout_s: float) -> Delivery[Datum] | None:
        """See Source."""
        assert self._pipe is not None
        try:
            if not self._pipe.poll(timeout_s):
                return None
        except OSError:
            raise self._ended() from None
        return self._answer(0.0)

    def close(self) -> None:
        """Let the device go; the process stays."""
        with suppress(DeviceLost):
            self._send(("close", 0))
            while self._pipe is not None and self._pipe.poll(END_S):
                kind, _ = self._pipe.recv()
                if kind == "closed":
                    return
        self.end()

    def end(self) -> None:
        """End the process; a second call has no effect."""
        self._end()
        self._pipe = self._process = None

    def _start(self) -> None:
        self.end()
        require_guard()
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._make, self._arguments), daemon=True)
        with deferred():
            process.start()
        theirs.close()
        self._process = process
        self._end = weakref.finalize(self, _stop, process, self._pipe)

    def _send(self, command: tuple[str, int]) -> None:
        try:
            if self._pipe is None:
                raise OSError
            self._pipe.send(command)
        except OSError:
            raise self._ended() from None

    def _answer(self, timeout_s: float) -> Delivery[Datum] | None:
        """Return the frame, or None for `opened`, that the process sent. Raises what the source raised there."""
        assert self._pipe is not None
        try:
            if not self._pipe.poll(timeout_s):
                raise DeviceLost(f"the process that reads it did not answer within {timeout_s:.0f} s")
            kind, said = self._pipe.recv()
        except (EOFError, OSError):
            raise self._ended() from None
        if kind == "frame":
            found: Delivery[Datum] = said
            return found
        if kind == "opened":
            return None
        raise (Garbage if kind == "garbage" else DeviceLost)(said)

    def _ended(self) -> DeviceLost:
        code = None
        if self._process is not None:
            self._process.join(0.2)
            code = self._process.exitcode
        return DeviceLost(f"the process that reads it has ended (exit code {code})")


def _stop(process: BaseProcess, pipe: Connection) -> None:
    with suppress(OSError, ValueError):
        pipe.send(("end", 0))
    pipe.close()  # a process that waits for its frame to be read goes on
    process.join(END_S)
    if process.is_alive():
        process.kill()
        process.join()


def _serve(pipe: Connection, make: Callable[..., Source[Any]], arguments: tuple[Any, ...]) -> None:
    """Follow the commands of the pipe until the command to end, or until its other end is closed."""
    source, is_open = make(*arguments), False
    parent = os.getppid()
    with suppress(EOFError, OSError):
        while os.getppid() == parent:
            try:
                if pipe.poll(0.0 if is_open else 0.2):
                    command, number = pipe.recv()
                    if command == "end":
                        break
                    if command == "open":
                        source.open()
                        is_open = True
                        pipe.send(("opened", None))
                    elif command == "ask":
                        source.ask(number)
                    elif command == "close":
                        source.close()
                        is_open = False
                        pipe.send(("closed", None))
                if is_open and (found := source.next(POLL_S)) is not None:
                    pipe.send(("frame", found))
            except Garbage as error:
                pipe.send(("garbage", str(error)))
            except (EOFError, OSError):
                raise
            except Exception as error:  # whatever the device's library raises is told, and the process goes on
                with suppress(Exception):
                    source.close()
                is_open = False
                said = str(error) if isinstance(error, DeviceFault) else f"{type(error).__name__}: {error}"
                pipe.send(("lost", said))
    with suppress(Exception):
        source.close()
