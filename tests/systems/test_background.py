"""What is computed beside the control loop arrives when it is ready, and the loop never waits for it."""

from __future__ import annotations

import dataclasses as dc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from threadpoolctl import threadpool_info

from weldcal.systems.addresses import AddressError, controller_address
from weldcal.systems.background import Answer, Background, BackgroundFailed, BackgroundSystem, Inline, OwnProcess
from weldcal.systems.messages import Scan

# functions of installed modules: the process of its own does not know this one
doubled = partial(dc.replace, capture_time=2.0)


@pytest.fixture(scope="module")
def own_process() -> Iterator[OwnProcess]:
    made = OwnProcess()
    yield made
    made.close()


SCAN = Scan(3, 0.5, np.ones((4, 5, 3), dtype=np.float32))


def test_both_kinds_give_the_same_answer(own_process: OwnProcess) -> None:
    for background in (Inline(), own_process):
        answer = background.ask(doubled, SCAN).value
        assert (answer.sequence, answer.capture_time) == (3, 2.0)
        assert np.array_equal(answer.points_C, SCAN.points_C)
        with pytest.raises(AddressError, match="nowhere at all"):
            _ = background.ask(controller_address, "nowhere at all").value


def test_a_simulation_has_its_answer_at_once_and_a_robots_cell_has_a_process_for_it(own_process: OwnProcess) -> None:
    assert Inline().ask(os.getpid).ready
    assert Inline().ask(os.getpid).value == os.getpid()
    assert own_process.ask(os.getpid).value != os.getpid()


def test_asking_does_not_wait_for_the_answer(own_process: OwnProcess) -> None:
    own_process.prepare(os.getpid)
    own_process.settle()
    asked = own_process.ask(time.sleep, 0.3)
    assert not asked.ready
    assert asked.value is None
    assert asked.ready


def test_the_answer_to_an_older_question_leaves_the_newest_open(own_process: OwnProcess) -> None:
    first = own_process.ask(time.sleep, 0.2)
    asked = time.monotonic()
    newest = own_process.ask(time.sleep, 0.6)
    _ = first.value
    time.sleep(0.05)
    assert not newest.ready
    assert own_process.waiting_since == pytest.approx(asked, abs=0.1)
    _ = newest.value
    assert own_process.waiting_since is None


def test_the_process_uses_one_thread_for_linear_algebra(own_process: OwnProcess) -> None:
    pools = own_process.ask(threadpool_info).value
    assert [pool["num_threads"] for pool in pools if pool["user_api"] == "blas"] != []
    assert {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"} == {1}


def test_a_process_that_ends_is_named() -> None:
    background = OwnProcess()
    try:
        asked = background.ask(time.sleep, 60.0)
        while not background._pool._processes:
            time.sleep(0.01)
        for child in background._pool._processes:
            os.kill(child, signal.SIGKILL)
        with pytest.raises(BackgroundFailed, match="start again"):
            _ = asked.value
    finally:
        background.close()


KILLED = """
import os, signal
from weldcal.systems.background import OwnProcess
print(OwnProcess().ask(os.getpid).value, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_process_ends_with_a_killed_program() -> None:
    # It has the program's output too: while it lives, that has no end.
    done = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, timeout=60.0)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert int(done.stdout)


@dataclass
class ByHand(Inline):
    """A background whose answers a test gives."""

    asked: list[Any] = field(default_factory=list)

    def ask(self, function: Any, *arguments: Any) -> Answer[Any]:
        future: Future[Any] = Future()
        self.asked.append((future, arguments))
        return Answer(future)


class Doubling(BackgroundSystem):
    """Asks for each whole second's number."""

    def __init__(self, background: Background) -> None:
        super().__init__("doubled", Scan(), background, 0.1)

    def ask(self, context: Context, newest: Scan) -> Answer[Any] | None:
        second = int(context.get_time() + 1e-9)
        return self.background.ask(doubled, Scan(second, second)) if second > newest.sequence else None


def test_the_diagram_goes_on_with_its_last_output_until_the_answer_is_there() -> None:
    background = ByHand()
    simulator = Simulator(Doubling(background))
    port = simulator.get_system().GetOutputPort("doubled")

    def output_at(time_s: float) -> Scan:
        simulator.AdvanceTo(time_s)
        scan: Scan = port.Eval(simulator.get_context())
        return scan

    assert output_at(2.55).sequence == 0
    assert len(background.asked) == 1, "one computation at a time"
    future, (scan,) = background.asked[0]
    assert scan.sequence == 1, "it was asked as soon as there was something to ask"
    future.set_result(doubled(scan))
    assert output_at(2.65).capture_time == 2.0
    assert output_at(2.75).sequence == 1
    assert [arguments[0].sequence for _, arguments in background.asked] == [1, 2], "the newest input is next"
