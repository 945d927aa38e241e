"""URScript functions of the controller, as far as the client's script and a guard script call them.

Motions and the reads of sockets are generators that take frames; all other functions answer at once. What the emulator
has no physics for (friction, conveyors) is accepted and noted in the log.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from weldcal.tools.emulators.ur.controller.registers import register_index
from weldcal.tools.emulators.ur.controller.state import ControllerState
from weldcal.tools.emulators.ur.script.answers import (
    CALCULATIONS,
    DIGITAL,
    READS,
    REGISTERS,
    Answers,
    TerminalFunctions,
)
from weldcal.tools.emulators.ur.script.arithmetic import TEXTS
from weldcal.tools.emulators.ur.script.forces import Dynamics, Forces
from weldcal.tools.emulators.ur.script.motions import Motions
from weldcal.tools.emulators.ur.script.program import Program
from weldcal.tools.emulators.ur.script.sockets import Sockets

BLOCKING = frozenset(
    {
        *("movej", "movel", "movep", "movec", "optimovej", "optimovel", "speedj", "speedl", "servoj", "servoc"),
        *("stopj", "stopl", "direct_torque", "sync", "sleep", "popup"),
        *("socket_open", "socket_get_var"),
        *(f"socket_read_{what}" for what in ("line", "string", "ascii_float", "binary_integer", "byte_list")),
    }
)
# The first 5.x and 10.x that know a function, where that is later than any version emulated here.
FIRST = ((0, 0), (10, 0))
SINCE = {
    **dict.fromkeys(
        ("set_target_payload", "get_inverse_kin_has_solution", "get_target_payload_inertia"), ((5, 10), FIRST[1])
    ),
    **dict.fromkeys((name for name in vars(Dynamics) if not name.startswith("_")), ((5, 23), (10, 9))),
    **dict.fromkeys(("optimovej", "optimovel"), ((5, 21), (10, 8))),
    "direct_torque": ((5, 23), (10, 9)),
}
MATH = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sqrt")
NO_EFFECT = ("set_friction_scales", "set_safety_mode_transition_hardness", "set_conveyor_tick_count")


def script_functions(
    controller: ControllerState, program: Program
) -> tuple[Mapping[str, Callable[..., Any]], Iterable[str]]:
    """All functions by their URScript name, and the names of those that are generators."""
    functions = Motions(controller, program)

    def known(name: str) -> bool:
        return controller.version.at_least(*SINCE.get(name, FIRST))

    named: dict[str, Callable[..., Any]] = {name: partial(_no_effect, controller, name) for name in NO_EFFECT}
    named |= {
        name: getattr(functions, name)
        for kind in (Motions, Sockets, Forces, Dynamics, TerminalFunctions, Answers)
        for name in vars(kind)
        if not name.startswith("_") and known(name)
    }
    named |= {name: partial(read, controller) for name, read in READS.items() if known(name)}
    named |= {f"set_{kind}_out": partial(functions._set, *group) for kind, group in DIGITAL.items()}
    for way in ("in", "out"):
        named |= {
            f"get_{kind}_{way}": partial(functions._get, f"digital_{way}puts", *group)
            for kind, group in DIGITAL.items()
        }
    named |= {name: partial(_register, controller, *bank) for name, bank in REGISTERS.items()}
    named |= {name: getattr(math, name) for name in MATH} | CALCULATIONS | TEXTS
    return named, BLOCKING


def _no_effect(controller: ControllerState, name: str, *arguments: Any, **keywords: Any) -> None:
    if not any(line.endswith(name) for line in controller.log):
        controller.note(f"no effect here: {name}")


def _register(controller: ControllerState, bank: str, kind: str, count: int, index: int) -> Any:
    return getattr(getattr(controller, bank), kind)[register_index(index, count)]
