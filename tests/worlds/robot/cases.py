"""The faults that are injected into the hardware link: how, what must follow, and the repair."""

import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tests.worlds.robot.bench import OUTPUT, Bench
from weldcal.models.arrays import Array
from weldcal.systems.drivers.ur.faults import Fault

STOP, GO, GO_OR_STOP, REFUSE = "stop", "go on", "go on or stop", "refuse"
REST_S = 0.3

LINK = frozenset({Fault.LINK_STALE, Fault.LINK_CLOSED, Fault.CONTROLLER_DEAF})
DEAF = LINK | {Fault.GUARD_LATCHED}
ALL = frozenset(Fault) - {Fault.NONE}


@dataclass(frozen=True)
class RepairStep:
    """One step of a repair, and how long it takes (s)."""

    name: str
    after_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class FaultCase:
    """A fault.

    `must` is STOP (at rest within `rest_s`, one of `faults` reported, nothing moves until a new start), GO, either, or
    REFUSE: thrown in before the start, which must be refused. The arm begins with its last joint at `wrist_3` (rad).
    """

    name: str
    throw: Callable[[Bench], float]
    must: str
    faults: frozenset[Fault] = frozenset()
    repair: tuple[RepairStep, ...] = ()
    watch_s: float = 0.6
    rest_s: float = REST_S
    wrist_3: float = 0.0
    may_rest: bool = False  # GO, and the arm may rest for a moment
    slow_s: float = 0.0  # STOP, and how long the arm may rest for a moment and go on before the fault is latched
    wired: bool = False  # with a process output
    process: bool = False  # with a process output that is on
    burns_s: float = 0.0  # how long after the fault the process output may be on
    resumes: bool = False  # Play resumes the program
    elsewhere: bool = False  # link and commands in a process of their own
    says: str = ""  # what a refusal's sentence must contain
    random: bool = True  # also in the random sequences
    short: bool = True  # also in the tests
    over_ur_rtde: frozenset[Fault] = frozenset()  # what may be reported in addition with that transport


def _fault(name: str, **values: object) -> Callable[[Bench], float]:
    return lambda bench: bench.emulator.fault(name, latch=False, **values)


def _sends(twist: Callable[[Array], Array], seconds: float = 0.05) -> Callable[[Bench], float]:
    return lambda bench: bench.send(twist, seconds)


FOREIGN_S = 0.2
SETS_OUTPUT = f"sec theirs():\n  set_standard_digital_out({OUTPUT}, True)\nend\n"


def _into_the_limit(bench: Bench) -> float:
    """Turn joint 6 until the link refuses it: the limit is 0.15 s away, and until then a busy computer may rest the arm."""
    at = bench.send(lambda qd: qd + _joint(5, 0.2), 0.5)
    while bench.stream.state.fault is Fault.NONE and time.monotonic() < at + 0.5:
        time.sleep(0.002)
    return bench.stream.state.fault_time if bench.stream.state.fault is not Fault.NONE else at


def _output(on: bool) -> Callable[[Bench], float]:
    """Another client writes the output in every frame."""
    return _fault("set_digital_out", n=OUTPUT, on=on, seconds=FOREIGN_S)


def _dies_and_is_paused(bench: Bench) -> float:
    at = bench.computer_dies()
    bench.emulator.fault("pause_program", latch=False)
    return at


def _is_paused_and_dies(bench: Bench) -> float:
    """The worker may send one number more, which the paused program reads when it is resumed."""
    at = bench.emulator.fault("pause_program", latch=False)
    time.sleep(0.001)
    bench.computer_dies()
    return at


def _stands_still(seconds: float) -> Callable[[Bench], float]:
    """The worker does not run for so long."""

    def throw(bench: Bench) -> float:
        at = bench.signal_worker(signal.SIGSTOP)
        time.sleep(seconds)
        bench.signal_worker(signal.SIGCONT)
        return at

    return throw


def _slider(percent: int) -> Callable[[Bench], float]:
    """Return the slider alone: the scaling that a controller reports beside it stays at 100 %."""
    return _fault("speed_scaling", value=0.01 * percent)


def _grows_late(bench: Bench) -> float:
    """States 60 ms late, then 120 ms: no gap between two of them is a fault."""
    at = bench.emulator.fault("delay", latch=False, seconds=0.06)
    time.sleep(0.07)
    bench.emulator.fault("delay", latch=False, seconds=0.12)
    return at


def _joint(number: int, speed: float) -> Array:
    qd: Array = speed * np.eye(6)[number]
    return qd


CLEAR = (RepairStep("clear_links"),)
UNLOCK = (RepairStep("clear_pstop_timer"), RepairStep("unlock"))
POWER = (RepairStep("normal"), RepairStep("power_on", 1.15))


def _stops(
    name: str,
    throw: Callable[[Bench], float],
    faults: Fault | frozenset[Fault],
    repair: tuple[RepairStep, ...] = (),
    *,
    short: bool = True,
    **settings: Any,
) -> FaultCase:
    """Return a fault that must stop the arm and be reported as one of these."""
    named = frozenset({faults}) if isinstance(faults, Fault) else faults
    return FaultCase(name=name, throw=throw, must=STOP, faults=named, repair=repair, short=short, **settings)


def _paused(name: str, throw: Callable[[Bench], float], play_s: float, *, short: bool = True) -> FaultCase:
    """Nobody stops the program, and Play resumes it: nothing may move."""
    return _stops(name, throw, frozenset(), elsewhere=True, resumes=True, random=False, watch_s=play_s, short=short)


def _either(
    name: str, throw: Callable[[Bench], float], faults: Iterable[Fault], *repair: RepairStep, short: bool = True
) -> FaultCase:
    """Return a fault in which the arm may go on, or stop and report one of these."""
    return FaultCase(name=name, throw=throw, must=GO_OR_STOP, faults=frozenset(faults), repair=repair, short=short)


def _refused(name: str, throw: Callable[[Bench], float], says: str, *, short: bool = True) -> FaultCase:
    """Return a state of the controller in which a start must be refused with a sentence that contains `says`."""
    return FaultCase(name=f"start {name}", throw=throw, must=REFUSE, says=says, short=short)


REAL_OUTPUTS = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "speed_scaling",
    "target_speed_fraction",
    "output_double_register_36",
    "output_double_register_37",
    "output_double_register_38",
)
SHORT_NUMBERS = ("nan as actual_q", "inf as actual_TCP_pose", "nan as speed_scaling", "nan as timestamp")


def _no_number(output: str, value: str, **settings: Any) -> FaultCase:
    """Return an output of real numbers that is not a finite number."""
    name, throw = f"{value} as {output}", _fault("wrong_number", output=output, value=float(value))
    named = name in SHORT_NUMBERS
    return _stops(name, throw, Fault.STATE_NOT_FINITE, CLEAR, **({"random": named, "short": named} | settings))


RUNNING: tuple[FaultCase, ...] = (
    # the link
    FaultCase(name="no state for 20 ms", throw=_fault("drop", seconds=0.02), must=GO, short=False),
    FaultCase(
        name="state 30 ms late for 0.3 s", throw=_fault("delay", seconds=0.03, **{"for": 0.3}), must=GO, repair=CLEAR
    ),
    FaultCase(name="10 % of the states lost", throw=_fault("drop_p", p=0.1), must=GO, repair=CLEAR),
    # ur_rtde drops a state as soon as the next one's header has arrived, and so never has a whole one
    FaultCase(
        name="states in torn pieces", throw=_fault("partial_writes", bytes=7), must=GO, repair=CLEAR, over_ur_rtde=LINK
    ),
    FaultCase(name="controller's frames jitter by 5 ms", throw=_fault("jitter", seconds=0.005), must=GO, repair=CLEAR),
    FaultCase(name="controller's clock 100 ppm fast", throw=_fault("clock_skew", ppm=100), must=GO),
    FaultCase(name="dashboard connection reset", throw=_fault("reset_tcp", kind="dashboard"), must=GO, short=False),
    _either("script connection reset", _fault("reset_tcp", kind="script"), LINK),
    _stops("no state for 100 ms", _fault("drop", seconds=0.1), LINK),
    _stops("no state any more", _fault("drop", seconds=1e9), LINK, CLEAR, short=False),
    _stops("state 100 ms late", _fault("delay", seconds=0.1), LINK, CLEAR),
    _stops("state later and later", _grows_late, LINK, CLEAR, rest_s=0.6, slow_s=0.4),
    _stops("state late by up to 200 ms", _fault("delay", seconds=0.05, jitter=0.15), LINK, CLEAR, short=False),
    _stops("half-open connections", _fault("half_open"), LINK, CLEAR),
    _stops("RTDE stands still for 200 ms", _fault("freeze", seconds=0.2, kind="rtde"), LINK),
    _stops("controller stands still for 200 ms", _fault("freeze", seconds=0.2), LINK),
    # chance decides when a frame is 40 ms late, and a controller that lives so slowly hears a stop late too
    _stops(
        "controller's frames jitter by 120 ms",
        _fault("jitter", seconds=0.12),
        LINK,
        CLEAR,
        watch_s=1.5,
        rest_s=1.0,
        short=False,
    ),
    _stops("RTDE connection reset", _fault("reset_tcp"), LINK),
    _stops("RTDE connection closed", _fault("close_tcp"), LINK, short=False),
    _stops("every connection reset", _fault("reset_tcp", kind="all"), LINK),
    _stops("controller ignores commands", _fault("mute_input"), DEAF, CLEAR),
    # the guard slows the arm, and the next number gives it its speed back
    FaultCase(name="numbers 15 ms late", throw=_fault("mute_input", seconds=0.015), must=GO, may_rest=True),
    FaultCase(
        name="numbers 30 ms late", throw=_fault("mute_input", seconds=0.030), must=GO, may_rest=True, short=False
    ),
    FaultCase(
        name="numbers 60 ms late", throw=_fault("mute_input", seconds=0.060), must=GO, may_rest=True, short=False
    ),
    FaultCase(name="numbers 120 ms late", throw=_fault("mute_input", seconds=0.120), must=GO, may_rest=True),
    _either("one byte wrong in a package", _fault("corrupt", n=1), ALL, *CLEAR),
    _either("bytes wrong in 20 packages", _fault("corrupt", n=20), ALL, *CLEAR, short=False),
    _either("one package of a wrong size", _fault("wrong_size", n=1), ALL, *CLEAR),
    _stops("controller restarts", _fault("reboot", seconds=0.5), ALL, (RepairStep("power_on", 1.15),)),
    _stops(
        "controller's clock jumps 10 s ahead", _fault("timestamp_jump", seconds=10.0), Fault.CLOCK_JUMPED, short=False
    ),
    _stops("controller's clock jumps 10 s back", _fault("timestamp_jump", seconds=-10.0), Fault.CLOCK_JUMPED),
    # each output of real numbers that the driver reads; those of a register are the number, the time and the passes of
    # the guard
    *(_no_number(output, value) for output in REAL_OUTPUTS for value in ("nan", "inf")),
    replace(_no_number("speed_scaling", "nan", process=True, burns_s=0.06, short=True), name="nan, process on"),
    # the robot
    FaultCase(name="reduced mode", throw=_fault("reduced"), must=GO, repair=(RepairStep("normal"),)),
    FaultCase(name="tool contact", throw=_fault("tool_contact", n=1), must=GO, short=False),
    _either("pendant switched to local", _fault("local_mode"), ALL, RepairStep("remote")),
    _stops("protective stop", _fault("protective_stop"), Fault.PROTECTIVE_STOP, UNLOCK),
    _stops("emergency stop on the robot", _fault("estop"), Fault.EMERGENCY_STOP, POWER),
    _stops("emergency stop of the cell", _fault("estop", system=True), Fault.EMERGENCY_STOP, POWER, short=False),
    _stops("safeguard stop", _fault("safeguard"), Fault.SAFEGUARD_STOP, (RepairStep("safeguard_release"),)),
    _stops("recovery mode", _fault("safety_mode", value=4), Fault.RECOVERY_MODE, (RepairStep("normal"),)),
    _stops("safety violation", _fault("safety_mode", value=8), Fault.SAFETY_VIOLATION, POWER),
    _stops("safety fault", _fault("safety_mode", value=9), Fault.SAFETY_VIOLATION, POWER, short=False),
    _stops(
        "arm without power", _fault("robot_mode", value=3), Fault.ROBOT_NOT_RUNNING, (RepairStep("power_on", 1.15),)
    ),
    _stops(
        "brakes on", _fault("robot_mode", value=5), Fault.ROBOT_NOT_RUNNING, (RepairStep("power_on", 0.6),), short=False
    ),
    _stops("program stopped", _fault("stop_program"), Fault.PROGRAM_STOPPED),
    _stops("program paused", _fault("pause_program"), Fault.PROGRAM_PAUSED),
    _stops("program replaced", _fault("replace_program"), ALL),
    _stops("speed slider to 50 % in 0.2 s", _fault("speed_scaling", value=0.5, ramp=0.2), Fault.SPEED_SLIDER),
    *(
        # the guard holds an arm that suddenly has less than half of its speed until the next number
        _stops(
            f"speed slider to {percent} %", _slider(percent), Fault.SPEED_SLIDER, short=percent in (10, 90), slow_s=0.06
        )
        for percent in (10, 30, 50, 70, 90)
    ),
    _stops("trajectory limiter at 60 %", _fault("limiter", value=0.6), Fault.SPEED_SLIDER, short=False),
    _stops("speed slider to 0", _fault("speed_scaling", value=0.0), Fault.SPEED_SLIDER, short=False),
    _either("arm follows 0.1 s late", _fault("tracking_lag", seconds=0.1), {Fault.TRACKING}, short=False),
    _stops("arm is held fast", _fault("tracking_lag", seconds=1e6), Fault.TRACKING, watch_s=1.0),
    _stops("another TCP is set", _fault("wrong_tcp"), Fault.POSE_MISMATCH),
    _stops("joints jump", _fault("set_q", q=[0.5, -1.6, 1.6, -1.6, -1.6, 0.0]), Fault.STATE_IMPLAUSIBLE),
    # the process output
    _stops(
        "process on by somebody else",
        _output(True),
        Fault.PROCESS_OUTPUT,
        wired=True,
        burns_s=FOREIGN_S + 0.01,
        random=False,
    ),
    _stops(
        "process off by somebody else", _output(False), Fault.PROCESS_OUTPUT, process=True, burns_s=0.01, random=False
    ),
    # the guard writes the output in the same frame: it never goes on
    FaultCase(
        name="process on in another program",
        throw=_fault("foreign_program", script=SETS_OUTPUT),
        must=GO,
        wired=True,
        random=False,
    ),
    FaultCase(
        name="numbers 30 ms late, process on",
        throw=_fault("mute_input", seconds=0.030),
        must=GO,
        process=True,
        burns_s=1e9,
        random=False,
        short=False,
    ),
    _stops(
        "numbers 60 ms late, process on",
        _fault("mute_input", seconds=0.060),
        Fault.GUARD_LATCHED,
        process=True,
        burns_s=0.06,
        random=False,
    ),
    # this computer
    FaultCase(name="cell silent for 0.2 s", throw=lambda b: b.send(lambda qd: None, 0.2), must=GO, may_rest=True),
    _stops("cell silent for 0.7 s", lambda b: b.send(lambda qd: None, 0.7), Fault.COMMAND_LATE, watch_s=1.0),
    _stops(
        "cell silent for ever", lambda b: b.send(lambda qd: None, 1e9), Fault.COMMAND_LATE, short=False, watch_s=1.0
    ),
    _stops("a velocity that is no number", _sends(lambda qd: np.full(6, np.nan)), Fault.COMMAND_NOT_FINITE),
    _stops("a velocity of 5 rad/s", _sends(lambda qd: _joint(0, 5.0)), Fault.COMMAND_TOO_FAST),
    _stops("a velocity that jumps by 0.9 rad/s", _sends(lambda qd: qd + _joint(0, 0.9)), Fault.COMMAND_JUMPED),
    _stops(
        "a velocity into a joint's limit", _into_the_limit, Fault.JOINT_LIMIT, wrist_3=2.0 * np.pi - 0.05, random=False
    ),
    _stops("worker killed", lambda b: b.signal_worker(signal.SIGKILL), Fault.WORKER_DIED),
    _stops("worker crashes", lambda b: b.signal_worker(signal.SIGSEGV), Fault.WORKER_DIED, short=False),
    _stops("worker stopped (SIGSTOP)", lambda b: b.signal_worker(signal.SIGSTOP), Fault.WORKER_DIED),
    FaultCase(name="worker stands still for 60 ms", throw=_stands_still(0.060), must=GO, may_rest=True, random=False),
    FaultCase(
        name="worker stands still for 120 ms",
        throw=_stands_still(0.120),
        must=GO,
        may_rest=True,
        random=False,
        short=False,
    ),
    # No process is left that could stop the paused program: old commands must have no effect when an operator presses
    # Play.
    _paused("computer dies, pause, Play after 3 s", _dies_and_is_paused, 3.0),
    _paused("pause, computer dies, Play after 3 s", _is_paused_and_dies, 3.0),
    _paused("computer dies, pause, Play after 0.5 s", _dies_and_is_paused, 0.5, short=False),
    _paused("pause, computer dies, Play after 0.5 s", _is_paused_and_dies, 0.5, short=False),
    _stops("cell's process killed", lambda b: b.kill_child(), frozenset(), elsewhere=True, random=False, watch_s=1.0),
)

AT_START: tuple[FaultCase, ...] = (
    _refused("in local mode", _fault("local_mode"), "Remote Control"),
    _refused("beside a foreign program", _fault("foreign_program"), "busy"),
    _refused("with registers in use", _fault("registers_in_use", names=["input_int_register_24"]), "in use"),
    _refused("where uploads are refused", _fault("refuse_upload"), "did not start the guard script", short=False),
    _refused(
        "where scripts begin 10 s late",
        _fault("slow_start", seconds=10.0),
        "did not start the guard script",
        short=False,
    ),
    _refused("in a protective stop", _fault("protective_stop"), "protective stop"),
    _refused("in an emergency stop", _fault("estop"), "emergency stop"),
    _refused("in recovery mode", _fault("safety_mode", value=4), "recovery", short=False),
    _refused("without power", _fault("robot_mode", value=3), "no power", short=False),
    _refused("with another TCP", _fault("wrong_tcp"), "TCP"),
    _refused("with another payload", lambda b: b.emulator.do("set_payload", mass=0.0), "payload"),
    *(
        _refused(
            f"with nan as {name}",
            _fault("wrong_number", output=name),
            name.partition("_cog")[0],
            short=name == "tcp_offset",
        )
        for name in ("actual_q", "speed_scaling", "tcp_offset", "payload_cog")
    ),
    _refused("with the speed slider at 50 %", _fault("speed_scaling", value=0.5), "slider"),
)
