"""What the robot link does when something fails: the arm stops within 0.3 s, stays, says why, and starts again when
asked."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from tests.ur_rtde import NEEDS_UR_RTDE
from tests.worlds.robot.bench import Bench
from tests.worlds.robot.cases import AT_START, GO, REFUSE, RUNNING, STOP, FaultCase
from tests.worlds.robot.fault_run import recover, run_case, run_sequence
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.wire.transport import NATIVE, UR_RTDE
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

CASES = [case for case in RUNNING + AT_START if case.short]


@pytest.fixture(scope="module", params=[NATIVE, pytest.param(UR_RTDE, marks=NEEDS_UR_RTDE)])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """One controller for all faults: that each one starts is what the one before must leave behind."""
    with emulator_process(lockstep=LOCKSTEP_S) as emulator:
        yield Bench(emulator, transport=request.param)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_fault_is_answered(bench: Bench, case: FaultCase) -> None:
    outcome = run_case(bench, case, hasty=True, attempts=1)
    assert outcome.problems == ()


def test_the_last_fault_left_a_controller_that_can_be_started(bench: Bench) -> None:
    bench.start(look=True)
    bench.cruise()
    bench.end()
    bench.emulator.wait("runtime_state", "STOPPED")


@pytest.mark.parametrize("closed", [False, True], ids=["watched", "closed"])
def test_a_second_fault_while_the_arm_brakes_leaves_no_paused_program_behind(bench: Bench, closed: bool) -> None:
    bench.start()
    bench.cruise()
    at = bench.send(lambda qd: None, 1e9)  # the cell falls silent: the arm brakes
    while bench.link.state().fault is Fault.NONE:
        time.sleep(0.0005)
    bench.emulator.fault("protective_stop")  # which pauses the program, and a paused program can be played again
    if closed:
        time.sleep(0.05)
        bench.end()
    else:
        bench.emulator.wait("runtime_state", "STOPPED", limit_s=2.0)
        assert bench.press_play().startswith("Failed")
        bench.end(kill=True)
    assert bench.emulator.wait("runtime_state", "STOPPED", limit_s=2.0)["program"] is None
    assert bench.at_rest_after(at, 0.3)["ok"]
    recover(bench)


def test_random_faults_repairs_and_restarts_never_move_the_arm(bench: Bench) -> None:
    sequence = run_sequence(bench, seed=7, seconds=5.0)
    recover(bench)  # the last fault may still be there
    assert sequence.thrown.total() >= 1
    assert sequence.verdict == "0 moves without a command, 0 after a fault, 0.000 s unattended, not reported: none"


def test_every_way_of_failing_is_in_the_matrix() -> None:
    names = [case.name for case in RUNNING + AT_START]
    assert len(set(names)) == len(names)
    assert {case.must for case in RUNNING} >= {GO, STOP}
    assert {case.must for case in AT_START} == {REFUSE}
    assert all(case.says for case in AT_START)
    assert all(case.faults or case.elsewhere for case in RUNNING if case.must == STOP)


def test_the_checker_would_see_an_arm_that_does_not_stop(bench: Bench) -> None:
    # nothing is done to it, and it is said to have to stop
    calm = FaultCase(
        name="nothing", throw=lambda b: b.emulator.ask(ask="state")["time"], must=STOP, faults=RUNNING[-1].faults
    )
    outcome = run_case(bench, calm, hasty=True)
    assert not outcome.ok
    assert any("not at rest" in problem for problem in outcome.problems)
