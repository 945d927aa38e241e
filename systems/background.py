"""Run computations that take longer than a tick beside the control loop, and output their answers."""

import ast
import importlib
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, State

from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.interrupts import deferred
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message

Found = TypeVar("Found")
NICE = -10  # nine times the share of an ordinary program, and no precedence over a robot's peer that wakes up


GUARD = 'if __name__ == "__main__":'
"""The line below which a script starts its job: the process beside it imports the script."""


class BackgroundFailed(WeldcalError):
    """The process that computes for the cell has ended."""


@dataclass(frozen=True, eq=False)
class Answer(Message, Generic[Found]):
    """Hold a running computation: a system has it in its state and checks at each update whether it is ready."""

    future: "Future[Found]"

    @property
    def ready(self) -> bool:
        """Whether the value is there. Never blocks."""
        return self.future.done()

    @property
    def value(self) -> Found:
        """The computed value; waits for it where it is not ready.

        Raises:
            BackgroundFailed: the computing process has ended. Otherwise what the function raised.
        """
        try:
            return self.future.result()
        except BrokenProcessPool as error:
            raise BackgroundFailed(
                "The process that computes beside the control loop has ended, perhaps for want of memory: "
                f"close other programs and start again. Or the script starts its job outside {GUARD}"
            ) from error


class Background(Protocol):
    """Computes functions of immutable, picklable arguments for the systems of a cell."""

    @property
    def waiting_since(self) -> float | None:
        """Wall clock (s, monotonic) of the newest question while it has no answer, else None."""

    def prepare(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Run a function once before the arm moves, for what its first call costs: imports and compiled loops."""

    def ask(self, function: Callable[..., Found], *arguments: Any) -> Answer[Found]:
        """Start a computation of a module's function. Never blocks, except in a simulation."""

    def settle(self) -> None:
        """Wait until everything that is prepared has run."""

    def close(self) -> None:
        """End what runs; a second call has no effect."""


class Inline:
    """Computes at once, in the caller's thread.

    The Diagram's time does not pass meanwhile, so the same seed gives the same run on any computer.
    """

    waiting_since: float | None = None

    def prepare(self, function: Callable[..., Any], *arguments: Any) -> None:
        """See Background."""
        function(*arguments)

    def ask(self, function: Callable[..., Found], *arguments: Any) -> Answer[Found]:
        """See Background."""
        future: Future[Found] = Future()
        try:
            future.set_result(function(*arguments))
        except WeldcalError as error:
            future.set_exception(error)
        return Answer(future)

    def settle(self) -> None:
        """See Background."""

    def close(self) -> None:
        """See Background."""


@dataclass(eq=False)
class OwnProcess:
    """Computes in one process without real-time priority, beside a Diagram that keeps the pace of a robot.

    A thread would share the interpreter's lock with the Diagram: each tick would wait for it. The process is spawned,
    not forked, because a fork copies the locks of the link's and the renderer's threads.
    """

    _pool: ProcessPoolExecutor = field(
        default_factory=lambda: ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_process
        )
    )
    waits: bool = False  # whether the caller may wait for its answers, because its robot waits for it
    _preparing: "list[Future[Any]]" = field(default_factory=list)
    _newest: "tuple[Future[Any], float] | None" = None  # the newest question, and when it was asked

    def __post_init__(self) -> None:
        require_guard()

    def prepare(self, function: Callable[..., Any], *arguments: Any) -> None:
        """See Background."""
        with deferred():  # the first one starts the process
            self._preparing.append(self._pool.submit(function, *arguments))

    def ask(self, function: Callable[..., Found], *arguments: Any) -> Answer[Found]:
        """See Background."""
        with deferred():
            future = self._pool.submit(function, *arguments)
        self._newest = (future, time.monotonic())
        if self.waits:
            wait([future])
        return Answer(future)

    @property
    def waiting_since(self) -> float | None:
        """See Background."""
        if self._newest is None or self._newest[0].done():
            return None
        return self._newest[1]

    def settle(self) -> None:
        """See Background."""
        for future in self._preparing:
            _ = Answer(future).value
        self._preparing.clear()

    def close(self) -> None:
        """See Background."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def require_guard() -> None:
    """Check that a new process can import the program's script, as it does, without running its job a second time.

    Raises:
        InputError: the script has no GUARD, or it starts a job while such a process imports it.
    """
    main = sys.modules["__main__"]
    file, package = getattr(main, "__file__", None), getattr(main.__spec__, "name", "").endswith("__main__")
    guarded = file is None or package  # neither a notebook nor a package's own __main__ is imported
    if not guarded:
        try:
            tests = [
                node.test for node in ast.walk(ast.parse(Path(str(file)).read_bytes())) if isinstance(node, ast.If)
            ]
        except (OSError, SyntaxError, ValueError):  # a program in an archive
            return
        guarded = any(getattr(node, "id", "") == "__name__" for test in tests for node in ast.walk(test))
    if not guarded or getattr(multiprocessing.current_process(), "_inheriting", False):
        raise InputError(
            f"The process that computes beside the robot imports '{file}', which would start its job a second time:"
            f" put what the script runs below {GUARD}"
        )


def import_module(name: str) -> None:
    """Import a module by name, for Background.prepare."""
    importlib.import_module(name)


def _begin_process() -> None:
    """Prepare the process: before other programs, and with one thread for linear algebra.

    The fits' matrices are small. On a loaded computer two threads wait busily for each other: a fit of 3 s took 40 s,
    longer than an emulated robot waits for its cell.
    """
    importlib.import_module("scipy.linalg")  # its linear algebra is not NumPy's, and only what is loaded can be limited
    importlib.import_module("threadpoolctl").threadpool_limits(1, user_api="blas")
    before_other_programs()
    threading.Thread(target=_end_with_program, daemon=True).start()


def _end_with_program() -> None:
    """End this process when its program is killed: it holds the queue's both ends, and would wait for ever."""
    program = multiprocessing.parent_process()
    assert program is not None
    program.join()
    os._exit(1)


def before_other_programs(thread: int = 0) -> None:
    """Give a thread (0: the caller's) more of the processor than other programs have, where the system allows it."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, NICE)


@dataclass(frozen=True, eq=False)
class _Work(Message):
    """The newest value of the output, and the answer that will replace it."""

    newest: Any
    asked: Answer[Any] | None = None


class BackgroundSystem(LeafSystem):
    """Asks for one computation at a time and outputs its answer at the first update after it is ready.

    A subclass declares its input ports and implements `ask`. In a simulation the answer is there at once, so the
    output does not depend on the computer.
    """

    def __init__(self, port: str, first: Message, background: Background | None, period_s: float) -> None:
        super().__init__()
        self.background = background or Inline()
        self.background.prepare(import_module, type(self).__module__)
        self._work = self.DeclareAbstractState(AbstractValue.Make(_Work(first)))
        ticket = {self.abstract_state_ticket(self._work)}
        self.DeclareAbstractOutputPort(port, lambda: AbstractValue.Make(first), self._output, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def ask(self, context: Context, newest: Any) -> Answer[Any] | None:
        """Start the computation that the inputs call for; None where they call for none.

        `newest` is the present output.
        """
        raise NotImplementedError

    def newest(self, context: Context) -> Any:
        """Return the present output in this system's context."""
        return context.get_abstract_state(self._work).get_value().newest

    def _update(self, context: Context, state: State) -> None:
        old: _Work = context.get_abstract_state(self._work).get_value()
        asked = old.asked or self.ask(context, old.newest)
        if asked is None or (asked is old.asked and not asked.ready):
            return
        new = _Work(asked.value) if asked.ready else _Work(old.newest, asked)
        state.get_mutable_abstract_state(self._work).set_value(new)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(self.newest(context))
