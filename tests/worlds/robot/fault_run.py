"""Faults of the robot link on the test bench, one at a time or in random sequences: injected, observed and repaired."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tests.worlds.robot.bench import OUTPUT, SPEED_M_S, Bench, StoppedUnasked
from tests.worlds.robot.cases import GO, GO_OR_STOP, REFUSE, REST_S, RUNNING, STOP, FaultCase, RepairStep
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import WeldcalError
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde
from weldcal.systems.drivers.ur.wire.transport import UR_RTDE

GOING_S = 0.4
TURN_S = 0.5  # in which an arm that goes on is at its speed again
STARTS = 3
LATE_S = 0.012  # from one command to the next, which are 8 ms apart: the guard slows the arm without a new number
# faults of a loaded computer: a wrong result with one of these is tried again, and counted
LOADED = ("LINK_STALE", "COMMAND_LATE", "WORKER_DIED")
PLAYED_S = 0.25
HASTE_S = 0.1
STILL_RAD = 0.0005
_SPEED_OFF = 0.1 * SPEED_M_S
ENDED_S = 3.0  # a worker without its cell brakes, ends the program and closes its connections


@dataclass(frozen=True, kw_only=True)
class FaultOutcome:
    """The result of one fault. Times count from the fault; `problems` is empty where the result is as required."""

    name: str
    must: str
    did: str  # stopped, went on, refused
    fault: str
    sentence: str
    rest_after_ms: float | None = None
    travel_mm: float | None = None
    seen_after_ms: float | None = None
    played: str = ""  # what the dashboard said to Play after the repair
    problems: tuple[str, ...] = ()
    retries: int = 0  # attempts that the load of this computer ended; also among `unasked_stops`

    @property
    def ok(self) -> bool:
        """Whether the result is as required."""
        return not self.problems

    @property
    def line(self) -> str:
        """The outcome as one line of text."""
        parts = [] if self.ok else ["WRONG"]
        parts.append(self.did)
        if self.rest_after_ms is not None and self.travel_mm is not None:
            parts.append(f"at rest after {self.rest_after_ms:.0f} ms and {self.travel_mm:.1f} mm")
        return ", ".join(parts) + (f": {self.sentence}" if self.sentence else "")


def run_case(bench: Bench, case: FaultCase, *, hasty: bool = False, attempts: int = STARTS) -> FaultOutcome:
    """Injects one fault and observes; leaves the controller in order, without a link.

    `hasty`: after a stop the worker is killed instead of asked to end, and it is watched for less long. `attempts`: how
    often a case may be tried where the load of this computer spoils it.
    """
    if bench.transport == UR_RTDE and case.over_ur_rtde:
        case = replace(case, must=GO_OR_STOP if case.must == GO else case.must, faults=case.faults | case.over_ur_rtde)
    for retries in range(attempts):
        overruns = bench.emulator.state()["overruns"]
        try:
            outcome = _at_start(bench, case) if case.must == REFUSE else _running(bench, case, hasty)
            busy = outcome.fault in LOADED or bench.emulator.state()["overruns"] > overruns
            # commands that this process sent late are no answer of the link
            late = case.must == GO and bench.stream.gap_s > LATE_S
            if not outcome.ok and ((busy and retries < attempts - 1) or (late and retries < STARTS - 1)):
                continue
            return replace(outcome, retries=retries)
        except StoppedUnasked as error:
            reason = str(error)
        except WeldcalError as error:
            reason = str(error)
            break
        finally:
            bench.end(kill=hasty)
            recover(bench)
    return FaultOutcome(
        name=case.name, must=case.must, did="failed", fault="", sentence=reason, problems=(reason,), retries=retries
    )


def recover(bench: Bench) -> None:
    emulator = bench.emulator
    emulator.do("recover")
    load = UrRtde().load()
    emulator.do("set_payload", mass=load.mass_kg, cog=list(load.cog_m))
    emulator.wait("runtime_state", "STOPPED")
    emulator.do("set_q", q=bench.home.tolist())


def _running(bench: Bench, case: FaultCase, hasty: bool) -> FaultOutcome:
    children: list[int] = []
    if case.wrist_3:
        bench.emulator.do("set_q", q=[*bench.home[:5].tolist(), case.wrist_3])
    if case.elsewhere:
        children = bench.start_elsewhere()
    else:
        bench.start(wired=case.wired, process=case.process)
    bench.cruise()
    if not case.elsewhere:
        bench.stream.gap_s = 0.0
    at = case.throw(bench)
    time.sleep(GOING_S)
    if case.must != STOP:
        paused = case.must == GO and not case.may_rest and bench.at_rest_after(at, REST_S)["rest_after_s"] is not None
        if not paused and bench.stream.state.fault is Fault.NONE:
            speed = _speed_of_the_way(bench)
            problems = [] if abs(speed - SPEED_M_S) < _SPEED_OFF else [f"its speed is {speed:.4f} m/s"]
            problems += _burnt(bench, case, at)
            return FaultOutcome(
                name=case.name, must=case.must, did="went on", fault="", sentence="", problems=tuple(problems)
            )
    time.sleep(max(0.0, case.watch_s - GOING_S - (HASTE_S if hasty else 0.0)))
    return _stopped(bench, case, at, children, PLAYED_S - (HASTE_S if hasty else 0.0))


def _speed_of_the_way(bench: Bench) -> float:
    """Return the tool's speed; on a busy computer the arm may be in one of its turns by now, which take 0.2 s."""
    until = time.monotonic() + TURN_S
    while abs((speed := bench.tool_speed()) - SPEED_M_S) >= _SPEED_OFF and time.monotonic() < until:
        time.sleep(0.01)
    return speed


def _stopped(bench: Bench, case: FaultCase, at: float, children: Sequence[int], played_s: float) -> FaultOutcome:
    found = bench.at_rest_after(at + case.slow_s, case.rest_s - case.slow_s)
    problems: list[str] = []
    rest, travel = found["rest_after_s"], found["travel_m"]
    if not found["ok"]:
        problems.append(f"not at rest within {case.rest_s} s, or moved again: {found}")
    if case.must == GO:
        problems.append(f"it should have gone on (longest gap of the commands {bench.stream.gap_s:.3f} s)")
    fault, sentence, seen = Fault.NONE, "", None
    if case.elsewhere:
        while (left := [number for number in children if _alive(number)]) and time.monotonic() < at + ENDED_S:
            time.sleep(0.02)
        if left:
            problems.append(f"processes were left behind: {left}")
    else:
        state = bench.stream.state
        fault, sentence, seen = state.fault, state.status.fault or "", 1e3 * (state.fault_time - at)
        if fault not in case.faults:
            problems.append(f"it said {fault.name}, not {' or '.join(sorted(f.name for f in case.faults))}")
    q_before = np.array(bench.emulator.state()["q"])
    played = _repair_and_play(bench, case, played_s)
    turned = float(np.abs(np.array(bench.emulator.state()["q"]) - q_before).max())
    if turned > STILL_RAD:
        problems.append(f"a joint turned by {turned:.4f} rad when Play was pressed")
    if case.resumes and not played.startswith("Starting"):
        problems.append(f"the controller answered Play with {played!r}")
    again = bench.at_rest_after(at + case.slow_s, case.rest_s - case.slow_s)
    if again["moved_again_s"] is not None and found["moved_again_s"] is None:
        problems.append(f"it moved {again['moved_again_s']:.3f} s after the fault, when Play was pressed: {played}")
    summary = bench.emulator.ask(check="summary")
    if summary["moves_without_a_command"]:
        problems.append("it moved without a command")
    problems += _burnt(bench, case, at)
    rest_ms, travel_mm = (None if value is None else 1e3 * float(value) for value in (rest, travel))
    name = fault.name if fault else ""
    return FaultOutcome(
        name=case.name,
        must=case.must,
        did="stopped",
        fault=name,
        sentence=sentence,
        rest_after_ms=rest_ms,
        travel_mm=travel_mm,
        seen_after_ms=seen,
        played=played,
        problems=tuple(problems),
    )


def _burnt(bench: Bench, case: FaultCase, at: float) -> list[str]:
    """What is wrong with the process output, where the case has one."""
    if not (case.wired or case.process):
        return []
    last = bench.emulator.ask(check="output_on_after", fault_time=at, output=OUTPUT)["last_on_s"]
    wrong = last is not None and last > case.burns_s
    return [f"the process output was on {last:.3f} s after the fault"] if wrong else []


def _repair_and_play(bench: Bench, case: FaultCase, watch_s: float) -> str:
    """Repair the fault and press Play without a new start, while commands continue to arrive."""
    for action in case.repair:
        bench.emulator.do(action.name)
        time.sleep(action.after_s)
    played = bench.press_play()
    time.sleep(watch_s)
    return played


def _at_start(bench: Bench, case: FaultCase) -> FaultOutcome:
    bench.emulator.do("reset_checker")
    at = case.throw(bench)
    problems: list[str] = []
    sentence = ""
    try:
        prepared = PrepareRobot(UrRtde(host=bench.host, transport=bench.transport), load_arm())
        if prepared.handle is not None:
            prepared.handle.close()
        problems.append("it started")
    except WeldcalError as error:
        sentence = str(error)
        if case.says.lower() not in sentence.lower():
            problems.append(f"its sentence does not say {case.says!r}")
    found = bench.at_rest_after(at, REST_S)
    if not found["ok"]:
        problems.append("it moved")
    return FaultOutcome(
        name=case.name, must=case.must, did="refused", fault="", sentence=sentence, problems=tuple(problems)
    )


def _alive(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] not in ("Z", "X")
    except OSError:
        return False


SEEN_S = 1.2  # a fault that must stop the arm is reported by then
ANY_REPAIR = tuple({action.name: action for case in RUNNING for action in case.repair}.values())


@dataclass(kw_only=True)
class FaultSequence:
    """What happened in one sequence, and what the emulator's checker has counted."""

    seed: int
    seconds: float = 0.0
    thrown: Counter[str] = field(default_factory=Counter)
    reported: Counter[str] = field(default_factory=Counter)
    starts: int = 0
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


def run_sequence(bench: Bench, seed: int, seconds: float) -> FaultSequence:
    """Inject random faults for this long; the result is what the checker counted."""
    before = bench.emulator.ask(check="summary")
    rng, done = np.random.default_rng(seed), FaultSequence(seed=seed)
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


def _start(bench: Bench, rng: np.random.Generator, done: FaultSequence) -> bool:
    """Repair everything, in one of five cases only in part, and start."""
    if rng.random() < 0.8:
        bench.emulator.do("recover")
        time.sleep(0.05)
    try:
        done.starts += 1
        bench.start(look=bool(rng.random() < 0.7))
    except WeldcalError:
        bench.end()
        bench.emulator.do("recover")
        return False
    return True


def _throw(bench: Bench, rng: np.random.Generator, done: FaultSequence, cases: list[FaultCase]) -> None:
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


def _injected(bench: Bench, done: FaultSequence, case: FaultCase) -> bool:
    """Inject it; False where the robot is not ready for it.

    No program starts, for one, where a fault has just taken the power.

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


def _end(bench: Bench, rng: np.random.Generator, done: FaultSequence) -> None:
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
