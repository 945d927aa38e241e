"""The control loop is given the processor: no long garbage collections, and short turns for other threads."""

from __future__ import annotations

import gc
import os
import sys

import pytest

from weldcal.systems.pacing import SWITCH_S, no_long_garbage_collections, real_time_priority, short_turns


def test_garbage_of_the_run_is_still_collected_and_the_rest_is_left_alone() -> None:
    class Knot:
        alive = 0

        def __init__(self) -> None:
            self.me = self
            Knot.alive += 1

        def __del__(self) -> None:
            Knot.alive -= 1

    gc.unfreeze()  # what the test run froze
    with no_long_garbage_collections():
        assert gc.isenabled()
        assert gc.get_freeze_count() > 10_000, "what the libraries made is out of sight"
        for _ in range(10):
            Knot()
        assert gc.collect() >= 10
        assert Knot.alive == 0
    assert gc.get_freeze_count() == 0


def test_an_error_inside_leaves_the_collector_as_it_was() -> None:
    with pytest.raises(ValueError, match="broken"), no_long_garbage_collections():
        raise ValueError("broken")
    assert gc.get_freeze_count() == 0


def test_other_threads_have_short_turns_for_the_duration_of_the_block() -> None:
    before = sys.getswitchinterval()
    with short_turns():
        assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
    assert sys.getswitchinterval() == before


def test_the_priority_is_taken_back_and_given_again_and_ends_with_the_block() -> None:
    before = os.sched_getscheduler(0)
    with real_time_priority() as give:
        if not os.sched_getscheduler(0) & os.SCHED_RR:
            pytest.skip("this user may not have real-time priority (ulimit -r)")
        give(False)
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
        give(False)
        give(True)
        assert os.sched_getscheduler(0) & os.SCHED_RR
    assert os.sched_getscheduler(0) == before


def test_a_user_without_privilege_gets_ordinary_priority_back(monkeypatch: pytest.MonkeyPatch) -> None:
    policies = [os.SCHED_OTHER]

    def as_the_kernel(_: int, policy: int, __: object) -> None:
        if policies[-1] & os.SCHED_RESET_ON_FORK and not policy & os.SCHED_RESET_ON_FORK:
            raise PermissionError("only CAP_SYS_NICE clears the flag")
        policies.append(policy)

    monkeypatch.setattr(os, "sched_setscheduler", as_the_kernel)
    with real_time_priority():
        assert policies[-1] & os.SCHED_RR
    assert policies[-1] == os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
