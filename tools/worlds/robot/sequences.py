"""Random faults at random times, with random repairs and restarts: the arm must never move without a command."""

import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.tools.worlds.robot.bench import Bench
from weldcal.tools.worlds.robot.cases import RUNNING, STOP, FaultCase, RepairStep

SEEN_S = 1.2  # a fault that must stop the arm is reported by then
ANY_REPAIR = tuple({action.name: action for case in RUNNING for action in case.repair}.values())


@dataclass(kw_only=True)
class Sequence:
    """What happened in one sequence, and what the emulator's checker has counted."""

    seed: int
    seconds: float = 0.0
    thrown: Counter[str] = field(default_factory=Counter)
    reported: Counter[str] = field(default_factory=Counter)
    starts: int = 0
    starts_refused: int = 0
    unasked_stops: int = 0  # stops before any fault was thrown in: the load of this computer
    moves_without_a_command: int = 0
    moves_after_a_fault: int = 0
    unattended_s: float = 0.0
    unseen: list[str] = field(default_factory=list)  # faults that must be reported and were not

    @property
    def ok(self) -> bool:
        """Nothing moved without a command, and no fault passed in silence."""
        return not (self.moves_without_a_command or self.moves_after_a_fault or self.unattended_s or self.unseen)

    @property
    def verdict(self) -> str:
        """In words."""
        return (
            f"{self.moves_without_a_command} moves without a command, {self.moves_after_a_fault} after a fault, "
            f"{self.unattended_s:.3f} s unattended, not reported: {', '.join(self.unseen) or 'none'}"
        )


def run_sequence(bench: Bench, seed: int, seconds: float) -> Sequence:
    """Inject random faults for this long; the result is what the checker counted."""
    before = bench.emulator.ask(check="summary")
    rng, done = np.random.default_rng(seed), Sequence(seed=seed)
    cases = [case for case in RUNNING if case.random]
    started = time.monotonic()
    while time.monotonic() < started + seconds:
        if bench.link is None and not _start(bench, rng, done):
            continue
        time.sleep(rng.uniform(0.1, 1.2))
        if bench.stream.state.fault is Fault.NONE:
            _throw(bench, rng, done, [cases[k] for k in rng.choice(len(cases), 2, replace=False)])
        else:
            done.unasked_stops += 1
        if bench.stream.state.fault is not Fault.NONE:
            _end(bench, rng, done)
    bench.end()
    summary = bench.emulator.ask(check="summary")
    done.seconds = time.monotonic() - started
    done.moves_without_a_command = summary["moves_without_a_command"] - before["moves_without_a_command"]
    done.moves_after_a_fault = summary["moves_after_a_fault"] - before["moves_after_a_fault"]
    done.unattended_s = summary["unattended_s"] - before["unattended_s"]
    return done


def _start(bench: Bench, rng: np.random.Generator, done: Sequence) -> bool:
    """Repair everything, in one of five cases only in part, and start."""
    if rng.random() < 0.8:
        bench.emulator.do("recover")
        time.sleep(0.05)
    try:
        done.starts += 1
        bench.start(look=bool(rng.random() < 0.7))
    except WeldcalError:
        done.starts_refused += 1
        bench.end()
        bench.emulator.do("recover")
        return False
    return True


def _throw(bench: Bench, rng: np.random.Generator, done: Sequence, cases: list[FaultCase]) -> None:
    first, second = cases
    if not _injected(bench, done, first):
        return
    double = rng.random() < 0.25
    if double:
        time.sleep(rng.uniform(0.0, 0.05))
        _injected(bench, done, second)
    until = time.monotonic() + SEEN_S
    while bench.stream.state.fault is Fault.NONE and time.monotonic() < until:
        time.sleep(0.005)
    fault = bench.stream.state.fault
    if fault is not Fault.NONE:
        done.reported[fault.name] += 1
    elif STOP in {first.must, second.must if double else first.must} and not double:
        done.unseen.append(first.name)
    if fault is Fault.NONE:
        bench.emulator.do("clear_links")


def _injected(bench: Bench, done: Sequence, case: FaultCase) -> bool:
    """Inject it; False where the robot is not ready for it: no program starts, for one, where a fault has just taken
    the power.

    Raises:
        WeldcalError: the robot was ready, and the fault could not be injected.
    """
    try:
        case.throw(bench)
    except WeldcalError:
        state = bench.emulator.state()
        if state["robot_mode"] == "RUNNING" and state["safety_mode"] in ("NORMAL", "REDUCED"):
            raise
        return False
    done.thrown[case.name] += 1
    return True


def _end(bench: Bench, rng: np.random.Generator, done: Sequence) -> None:
    """After a fault: from here on nothing may move, whatever is repaired and pressed, while commands keep coming."""
    # the arm brakes now; that it is at rest from then on is what the checker sees to
    bench.emulator.fault("tool_contact", n=0)
    time.sleep(rng.uniform(0.05, 0.6))
    deeds: list[RepairStep | None] = [None, *(ANY_REPAIR[k] for k in rng.choice(len(ANY_REPAIR), 4, replace=False))]
    for k in rng.permutation(len(deeds)):
        action = deeds[k]
        if action is None:
            bench.press_play()
        else:
            try:
                bench.emulator.do(action.name)
            except WeldcalError:
                continue  # a protective stop is too young to be unlocked, or there is none
        time.sleep(rng.uniform(0.0, 0.25))
    bench.end(kill=bool(rng.random() < 0.3))
