"""Times of the robot link: what passes between an arm's LeafSystem and its link, and how late the computer wakes up.

A module of its own: its processes import it, and must be ready within seconds on a busy computer.
"""

from __future__ import annotations

import contextlib
import os
import time
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from weldcal.systems.drivers.ur.link import LinkState, UrLink
from weldcal.systems.pacing import TICK_S
from weldcal.systems.wall_clock import Lateness

STEP_RAD_S = 0.2
STEP_JOINT = 5


@dataclass(kw_only=True)
class Tap:
    """Sit between the arm's LeafSystem and its link, and record when what passes.

    Times in s of the monotonic clock.
    """

    link: UrLink
    command_times: array[float] = field(default_factory=lambda: array("d"))
    ages: array[float] = field(default_factory=lambda: array("d"))
    echoes: array[float] = field(default_factory=lambda: array("d"))
    motions: array[float] = field(default_factory=lambda: array("d"))
    state_now: LinkState | None = None
    starts: list[int] = field(default_factory=lambda: [0])  # how many commands had been sent when a link began
    _heard: float = -1.0
    _wanted: float = 0.0
    _stepped: tuple[float, float, float] | None = None  # when, from, to

    def restart(self, link: UrLink) -> None:
        """Go on with another link."""
        self.link, self.state_now = link, None
        self.starts.append(len(self.command_times))
        self._heard, self._wanted, self._stepped = -1, 0.0, None

    @property
    def periods(self) -> NDArray[np.float64]:
        """From each command to the next, s; NaN over the pause in which a link was made anew."""
        found = np.diff(np.array(self.command_times))
        for start in self.starts[1:]:
            found[start - 1 : start] = np.nan
        return found

    def state(self) -> LinkState:
        """As the link's."""
        found = self.link.state()
        self.state_now = found
        if not self.command_times:
            return found
        self.ages.append(found.age_s)
        if found.echo != self._heard:
            if self._heard >= 0:  # a link's first state may know of no command yet
                self.echoes.append(found.echo_latency)
            self._heard = found.echo
        if self._stepped is not None:
            when, before, after = self._stepped
            if (found.qd[STEP_JOINT] - before) / (after - before) > 0.5:
                self.motions.append(time.monotonic() - when)
                self._stepped = None
        return found

    def command(self, qd: NDArray[np.float64], process: bool = False) -> int:
        """As the link's."""
        number, now = self.link.command(qd, process), time.monotonic()
        self.command_times.append(now)
        # a late computer slows the path: its small changes are no steps
        if abs(qd[STEP_JOINT] - self._wanted) > 0.5 * STEP_RAD_S:
            self._stepped = (now, self._wanted, float(qd[STEP_JOINT]))
            self._wanted = float(qd[STEP_JOINT])
        return number


ABOVE_ALL = 50  # of SCHED_FIFO; cell, worker and emulated controller have SCHED_RR 1 to 3
ANSWERS_WITHIN_S = 10.0


@dataclass
class HostLateness:
    """Wake-ups asked for every TICK_S on each core; `lateness` holds their delays once the watch is over."""

    lateness: Lateness = field(default_factory=Lateness)
    precedence: bool = True  # whether the system gave it

    @property
    def line(self) -> str:
        """One row of a table."""
        late = self.lateness
        return (
            f"{late.on_time_percent:.3f} % of {sum(late.counts)} wake-ups of a program above all others under 4 ms, "
            f"{late.over(8.0)} over 8 ms, latest {late.worst_ms:.1f} ms"
        )

    def caused(self, jobs: Sequence[Lateness]) -> int:
        """Count the velocities of these jobs that were over 8 ms late by this computer's own doing.

        The program above all others was not woken up in time either.
        """
        return sum(job.shared_with(self.lateness, 8.0) for job in jobs)

    def judged(self, jobs: Sequence[Lateness]) -> str:
        """State how many velocities of these jobs were over 8 ms late.

        And for how many this computer itself was the cause.
        """
        late, all_of = sum(job.over(8.0) for job in jobs), sum(sum(job.counts) for job in jobs)
        return f"{late} of {all_of} velocities over 8 ms late, {self.caused(jobs)} of them by this computer itself"

    def summary(self) -> dict[str, object]:
        """Return the JSON object."""
        late = self.lateness
        found = {"wake_ups": sum(late.counts), "under_4_ms_percent": late.on_time_percent, "over_8_ms": late.over(8.0)}
        return {**found, "worst_ms": late.worst_ms, "histogram": list(late.counts), "precedence": self.precedence}


@contextlib.contextmanager
def watched_host() -> Iterator[HostLateness]:
    """Watch every core of this process for the duration of the block; the result is complete at its end."""
    found, context = HostLateness(), get_context("spawn")
    probes = []
    for core in sorted(os.sched_getaffinity(0)):
        ours, its = context.Pipe()
        process = context.Process(target=probe, args=(core, its), daemon=True)
        process.start()
        its.close()
        probes.append((process, ours))
    try:
        for _, pipe in probes:
            if pipe.poll(ANSWERS_WITHIN_S):
                found.precedence = pipe.recv() and found.precedence
        yield found
    finally:
        for process, pipe in probes:
            with contextlib.suppress(OSError, EOFError):
                pipe.send("end")
                if pipe.poll(ANSWERS_WITHIN_S):
                    one, late = pipe.recv(), found.lateness
                    late.counts = [a + b for a, b in zip(late.counts, one.counts, strict=True)]
                    late.worst_ms = max(late.worst_ms, one.worst_ms)
                    late.delays += one.delays
            process.terminate()
            process.join()


def probe(core: int, pipe: Connection) -> None:
    """Wake up every TICK_S on one core until something comes through the pipe.

    Says first whether it has precedence, and at the end its lateness.
    """
    os.sched_setaffinity(0, {core})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(ABOVE_ALL))
        precedence = True
    except OSError:
        precedence = False
    pipe.send(precedence)
    late = Lateness()
    while not pipe.poll(0.0):
        due = time.monotonic() + TICK_S
        time.sleep(TICK_S)
        now = time.monotonic()
        late.add(1e3 * max(now - due, 0.0), now)
    pipe.send(late)
