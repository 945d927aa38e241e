"""The probe of the computer's timing counts wake-ups on every core and sees a pause."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

from tests.worlds.robot.timing import watched_host
from weldcal.systems.pacing import TICK_S
from weldcal.systems.wall_clock import Lateness

PAUSE_S = 0.1


def test_every_core_is_watched_and_a_pause_is_seen() -> None:
    cores = len(os.sched_getaffinity(0))
    others = multiprocessing.active_children()
    with watched_host() as host:
        probes = [child for child in multiprocessing.active_children() if child not in others]
        assert len(probes) == cores
        time.sleep(10.0 * TICK_S)
        os.kill(probes[0].pid or 0, signal.SIGSTOP)
        time.sleep(PAUSE_S)
        os.kill(probes[0].pid or 0, signal.SIGCONT)
    late = host.lateness
    assert sum(late.counts) >= cores
    assert late.worst_ms > 1e3 * (PAUSE_S - TICK_S) * 0.9
    assert host.summary()["over_8_ms"] == late.over(8.0) > 0
    begin, end = max(late.delays, key=lambda delay: delay[1] - delay[0])
    job = Lateness()
    job.add(20.0, begin + 0.5 * (end - begin))  # while the computer paused
    job.add(20.0, begin - 10.0)  # long before
    job.add(5.0, begin + 0.5 * (end - begin))  # too little late to be judged
    assert job.over(8.0) == 2
    assert host.caused([job]) == 1
    assert host.judged([job]) == "2 of 3 velocities over 8 ms late, 1 of them by this computer itself"


def test_the_probes_end_with_the_watch() -> None:
    others = multiprocessing.active_children()
    with watched_host():
        probes = [child for child in multiprocessing.active_children() if child not in others]
    assert probes
    assert not any(probe.is_alive() for probe in probes)
