"""Every fault that is thrown at the hardware link: how, what must follow, and how the world is put right again."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from weldcal.systems.drivers.ur.faults import Fault
from weldcal.tools.studies.robot.bench import Array, Bench

STOP, GO, GO_OR_STOP, REFUSE = "stop", "go on", "go on or stop", "refuse"
REST_S = 0.3

LINK = frozenset({Fault.LINK_STALE, Fault.LINK_CLOSED, Fault.CONTROLLER_DEAF})
ALL = frozenset(Fault) - {Fault.NONE}


@dataclass(frozen=True)
class Deed:
    """One step of putting the world right, and how long it takes."""

    name: str
    after_s: float = 0.0


@dataclass(frozen=True)
class Case:
    """A fault. `must` is STOP (at rest within `rest_s`, one of `faults` reported, nothing moves until a new start), GO, either,
    or REFUSE: thrown in before the start, which must be refused. The arm begins with its last joint at `wrist_3` (rad)."""

    name: str
    throw: Callable[[Bench], float]
    must: str
    faults: frozenset[Fault] = frozenset()
    repair: tuple[Deed, ...] = ()
    watch_s: float = 0.6
    rest_s: float = REST_S
    wrist_3: float = 0.0
    elsewhere: bool = False  # link and commands in a process of their own
    says: str = ""  # what a refusal's sentence must contain
    random: bool = True  # also in the random sequences
    short: bool = True  # also in the tests


def _fault(name: str, **values: object) -> Callable[[Bench], float]:
    return lambda bench: bench.emulator.fault(name, latch=False, **values)


def _nan(qd: Array) -> Array:
    return np.full(6, np.nan)


def _fast(qd: Array) -> Array:
    return np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def _jump(qd: Array) -> Array:
    jump: Array = np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    return qd + jump


def _turn_wrist_3(qd: Array) -> Array:
    turn: Array = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2])
    return qd + turn


CLEAR = (Deed("clear_links"),)
UNLOCK = (Deed("clear_pstop_timer"), Deed("unlock"))
POWER = (Deed("normal"), Deed("power_on", 1.15))

RUNNING: tuple[Case, ...] = (
    # the link
    Case("no state for 20 ms", _fault("drop", seconds=0.02), GO, short=False),
    Case("state 30 ms late for 0.3 s", _fault("delay", seconds=0.03, **{"for": 0.3}), GO, repair=CLEAR),
    Case("10 % of the states lost", _fault("drop_p", p=0.1), GO, repair=CLEAR),
    # ur_rtde drops a whole package when the beginning of the next one has come with it: it goes deaf, and is stopped
    Case("states in torn pieces", _fault("partial_writes", bytes=7), GO_OR_STOP, LINK, CLEAR),
    Case("controller's frames jitter by 5 ms", _fault("jitter", seconds=0.005), GO, repair=CLEAR),
    Case("controller's clock 100 ppm fast", _fault("clock_skew", ppm=100), GO),
    Case("dashboard connection reset", _fault("reset_tcp", kind="dashboard"), GO, short=False),
    Case("script connection reset", _fault("reset_tcp", kind="script"), GO_OR_STOP, LINK),
    Case("no state for 100 ms", _fault("drop", seconds=0.1), STOP, LINK),
    Case("no state any more", _fault("drop", seconds=1e9), STOP, LINK, CLEAR, short=False),
    Case("state 100 ms late", _fault("delay", seconds=0.1), STOP, LINK, CLEAR),
    Case("state late by up to 200 ms", _fault("delay", seconds=0.05, jitter=0.15), STOP, LINK, CLEAR, short=False),
    Case("half-open connections", _fault("half_open"), STOP, LINK, CLEAR),
    Case("RTDE stands still for 200 ms", _fault("freeze", seconds=0.2, kind="rtde"), STOP, LINK),
    Case("controller stands still for 200 ms", _fault("freeze", seconds=0.2), STOP, LINK),
    # chance decides when a frame is 40 ms late, and a controller that lives so slowly hears a stop late too
    Case(
        "controller's frames jitter by 60 ms",
        _fault("jitter", seconds=0.06),
        STOP,
        LINK,
        CLEAR,
        watch_s=1.5,
        rest_s=1.0,
        short=False,
    ),
    Case("RTDE connections reset", _fault("reset_tcp"), STOP, LINK),
    Case("RTDE connections closed", _fault("close_tcp"), STOP, LINK, short=False),
    Case("receiving connection reset", _fault("reset_tcp", index=0), STOP, LINK),
    Case("commanding connection reset", _fault("reset_tcp", index=1), STOP, LINK),
    Case("receiving connection closed", _fault("close_tcp", index=0), STOP, LINK, short=False),
    Case("commanding connection closed", _fault("close_tcp", index=1), STOP, LINK, short=False),
    Case("every connection reset", _fault("reset_tcp", kind="all"), STOP, LINK),
    Case("controller ignores commands", _fault("mute_input"), STOP, LINK | {Fault.GUARD_LATCHED}, CLEAR),
    Case(
        "controller ignores commands for 60 ms",
        _fault("mute_input", seconds=0.06),
        STOP,
        LINK | {Fault.GUARD_LATCHED},
        short=False,
    ),
    Case("one byte wrong in a package", _fault("corrupt", n=1), GO_OR_STOP, ALL, CLEAR),
    Case("bytes wrong in 20 packages", _fault("corrupt", n=20), GO_OR_STOP, ALL, CLEAR, short=False),
    Case("one package of a wrong size", _fault("wrong_size", n=1), GO_OR_STOP, ALL, CLEAR),
    Case("controller restarts", _fault("reboot", seconds=0.5), STOP, ALL, (Deed("power_on", 1.15),)),
    Case(
        "controller's clock jumps 10 s ahead",
        _fault("timestamp_jump", seconds=10.0),
        STOP,
        frozenset({Fault.CLOCK_JUMPED}),
        short=False,
    ),
    Case(
        "controller's clock jumps 10 s back",
        _fault("timestamp_jump", seconds=-10.0),
        STOP,
        frozenset({Fault.CLOCK_JUMPED}),
    ),
    # the robot
    Case("reduced mode", _fault("reduced"), GO, repair=(Deed("normal"),)),
    Case("tool contact", _fault("tool_contact", n=1), GO, short=False),
    Case("pendant switched to local", _fault("local_mode"), GO_OR_STOP, ALL, (Deed("remote"),)),
    Case("protective stop", _fault("protective_stop"), STOP, frozenset({Fault.PROTECTIVE_STOP}), UNLOCK),
    Case("emergency stop on the robot", _fault("estop"), STOP, frozenset({Fault.EMERGENCY_STOP}), POWER),
    Case(
        "emergency stop of the cell",
        _fault("estop", system=True),
        STOP,
        frozenset({Fault.EMERGENCY_STOP}),
        POWER,
        short=False,
    ),
    Case("safeguard stop", _fault("safeguard"), STOP, frozenset({Fault.SAFEGUARD_STOP}), (Deed("safeguard_release"),)),
    Case("recovery mode", _fault("safety_mode", value=4), STOP, frozenset({Fault.RECOVERY_MODE}), (Deed("normal"),)),
    Case("safety violation", _fault("safety_mode", value=8), STOP, frozenset({Fault.SAFETY_VIOLATION}), POWER),
    Case("safety fault", _fault("safety_mode", value=9), STOP, frozenset({Fault.SAFETY_VIOLATION}), POWER, short=False),
    Case(
        "arm without power",
        _fault("robot_mode", value=3),
        STOP,
        frozenset({Fault.ROBOT_NOT_RUNNING}),
        (Deed("power_on", 1.15),),
    ),
    Case(
        "brakes on",
        _fault("robot_mode", value=5),
        STOP,
        frozenset({Fault.ROBOT_NOT_RUNNING}),
        (Deed("power_on", 0.6),),
        short=False,
    ),
    Case("program stopped", _fault("stop_program"), STOP, frozenset({Fault.PROGRAM_STOPPED})),
    Case(
        "program paused",
        _fault("pause_program"),
        STOP,
        frozenset({Fault.PROGRAM_PAUSED}),
    ),
    Case("program replaced", _fault("replace_program"), STOP, ALL),
    Case(
        "speed slider to 50 % in 0.2 s",
        _fault("speed_scaling", value=0.5, ramp=0.2),
        STOP,
        frozenset({Fault.SPEED_SLIDER}),
    ),
    Case("speed slider to 0", _fault("speed_scaling", value=0.0), STOP, frozenset({Fault.SPEED_SLIDER}), short=False),
    Case(
        "arm follows 0.1 s late",
        _fault("tracking_lag", seconds=0.1),
        GO_OR_STOP,
        frozenset({Fault.TRACKING}),
        short=False,
    ),
    Case("arm is held fast", _fault("tracking_lag", seconds=1e6), STOP, frozenset({Fault.TRACKING}), watch_s=1.0),
    Case("another TCP is set", _fault("wrong_tcp"), STOP, frozenset({Fault.POSE_MISMATCH})),
    Case(
        "joints jump",
        _fault("set_q", q=[0.5, -1.6, 1.6, -1.6, -1.6, 0.0]),
        STOP,
        frozenset({Fault.STATE_IMPLAUSIBLE}),
    ),
    # this computer
    Case("cell silent for 0.3 s", lambda b: b.send(lambda qd: None, 0.3), STOP, frozenset({Fault.COMMAND_LATE})),
    Case(
        "cell silent for ever",
        lambda b: b.send(lambda qd: None, 1e9),
        STOP,
        frozenset({Fault.COMMAND_LATE}),
        short=False,
    ),
    Case("a velocity that is no number", lambda b: b.send(_nan, 0.05), STOP, frozenset({Fault.COMMAND_NOT_FINITE})),
    Case("a velocity of 5 rad/s", lambda b: b.send(_fast, 0.05), STOP, frozenset({Fault.COMMAND_TOO_FAST})),
    Case("a velocity that jumps by 0.9 rad/s", lambda b: b.send(_jump, 0.05), STOP, frozenset({Fault.COMMAND_JUMPED})),
    Case(
        "a velocity into a joint's limit",
        lambda b: b.send(_turn_wrist_3, 0.5),
        STOP,
        frozenset({Fault.JOINT_LIMIT}),
        wrist_3=2.0 * np.pi - 0.05,
        random=False,
    ),
    Case("worker killed", lambda b: b.signal_worker(signal.SIGKILL), STOP, frozenset({Fault.WORKER_DIED})),
    Case(
        "worker crashes", lambda b: b.signal_worker(signal.SIGSEGV), STOP, frozenset({Fault.WORKER_DIED}), short=False
    ),
    Case("worker stopped (SIGSTOP)", lambda b: b.signal_worker(signal.SIGSTOP), STOP, frozenset({Fault.WORKER_DIED})),
    Case("cell's process killed", lambda b: b.kill_child(), STOP, elsewhere=True, random=False, watch_s=1.0),
)

AT_START: tuple[Case, ...] = (
    Case("start in local mode", _fault("local_mode"), REFUSE, says="Remote Control"),
    Case("start beside a foreign program", _fault("foreign_program"), REFUSE, says="busy"),
    Case(
        "start with registers in use",
        _fault("registers_in_use", names=["input_int_register_24"]),
        REFUSE,
        says="in use",
    ),
    Case(
        "start where uploads are refused",
        _fault("refuse_upload"),
        REFUSE,
        says="did not start our program",
        short=False,
    ),
    Case(
        "start where scripts begin 10 s late",
        _fault("slow_start", seconds=10.0),
        REFUSE,
        says="did not start our program",
        short=False,
    ),
    Case("start in a protective stop", _fault("protective_stop"), REFUSE, says="protective stop"),
    Case("start in an emergency stop", _fault("estop"), REFUSE, says="emergency stop"),
    Case("start in recovery mode", _fault("safety_mode", value=4), REFUSE, says="recovery", short=False),
    Case("start without power", _fault("robot_mode", value=3), REFUSE, says="no power", short=False),
    Case("start with another TCP", _fault("wrong_tcp"), REFUSE, says="TCP"),
    Case("start with the speed slider at 50 %", _fault("speed_scaling", value=0.5), REFUSE, says="slider"),
)
