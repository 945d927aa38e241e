"""Control channel: a line of JSON injects a fault or asks a question, a line of JSON answers."""

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.checker import Checker
from weldcal.tools.emulators.ur.controller.arm import ElasticContact, ForceSensor
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.motions import STEP_S
from weldcal.tools.emulators.ur.controller.registers import RobotMode, SafetyMode
from weldcal.tools.emulators.ur.lockstep import Lockstep
from weldcal.tools.emulators.ur.wire.dashboard import IDLE_PROGRAM
from weldcal.tools.emulators.ur.wire.net import Connection, LinkFaults, Network, Server
from weldcal.tools.emulators.ur.wire.robot_api import RobotApiServer
from weldcal.tools.emulators.ur.wire.rtde_server import RtdeServer
from weldcal.tools.emulators.ur.wire.script_ports import CLIENT_PORT, ExternalControl

Request = Mapping[str, Any]
LARGEST = 1e9  # of the numbers that a request may hold


class LoopWorld:
    """Hold what the loop itself needs: how long it pauses, is unplugged, jitters, and when it ends."""

    def __init__(self) -> None:
        self.frozen_until = 0.0
        self.unplugged_until: float | None = None
        self.jitter_s = 0.0
        self.quit = False
        self.overruns = 0


class ControlServer(Server):
    """{"fault": name, ...}, {"check": ...}, {"ask": "state" | "log" | "program" | "connections"}, {"do": ...}."""

    kind = "control"

    def __init__(
        self,
        controller: Controller,
        network: Network,
        rtde: RtdeServer,
        api: RobotApiServer,
        external: ExternalControl,
        checker: Checker,
        lockstep: Lockstep,
        world: LoopWorld,
        more_faults: Mapping[str, Callable[[Request, float], None]] | None = None,
    ) -> None:
        self._controller, self._network, self._external = controller, network, external
        self._rtde, self._checker, self._lockstep, self._world = rtde, checker, lockstep, world
        self._api = api
        c = controller
        self._faults: dict[str, Callable[[Request, float], None]] = {
            "drop": lambda r, now: self._each(r, drop_until=now + _number(r, "seconds")),
            "drop_p": lambda r, now: self._each(r, drop_share=_number(r, "p")),
            "delay": self._delay,
            "freeze": self._freeze,
            "mute_input": self._mute,
            "corrupt": lambda r, now: self._each(r, corrupt=int(_number(r, "n", 1))),
            "wrong_size": lambda r, now: self._each(r, wrong_size=int(_number(r, "n", 1))),
            "partial_writes": lambda r, now: self._each(r, piece=int(_number(r, "bytes", 7))),
            "half_open": lambda r, now: self._each(r, half_open=True),
            "reset_tcp": lambda r, now: self._close(r, reset=True),
            "close_tcp": lambda r, now: self._close(r, reset=False),
            "protective_stop": lambda r, now: c.protective_stop("injected"),
            "estop": lambda r, now: c.set_safety_mode(
                SafetyMode.SYSTEM_EMERGENCY_STOP if r.get("system") else SafetyMode.ROBOT_EMERGENCY_STOP
            ),
            "safeguard": lambda r, now: c.set_safety_mode(SafetyMode.SAFEGUARD_STOP),
            "reduced": lambda r, now: c.set_safety_mode(SafetyMode.REDUCED),
            "safety_mode": lambda r, now: c.set_safety_mode(SafetyMode(int(_number(r, "value")))),
            "robot_mode": lambda r, now: self._robot_mode(RobotMode(int(_number(r, "value")))),
            "stop_program": lambda r, now: c.stop_program(),
            "pause_program": lambda r, now: c.pause_program(),
            "replace_program": lambda r, now: self._start(str(r.get("script") or IDLE_PROGRAM.format(name="foreign"))),
            "foreign_program": lambda r, now: self._start(str(r.get("script") or IDLE_PROGRAM.format(name="foreign"))),
            "local_mode": lambda r, now: setattr(c, "remote", False),
            "registers_in_use": lambda r, now: rtde.claim_elsewhere([str(n) for n in r.get("names", ())]),
            "speed_scaling": self._slider,
            "set_digital_out": self._foreign_output,
            "set_analog_out": self._foreign_analog,
            "limiter": lambda r, now: setattr(c.terminals, "limiter", _number(r, "value")),
            "timestamp_jump": lambda r, now: setattr(c, "timestamp", max(0.0, c.timestamp + _number(r, "seconds"))),
            "clock_skew": lambda r, now: setattr(c, "clock_rate", max(0.0, 1.0 + _number(r, "ppm") * 1e-6)),
            "jitter": lambda r, now: setattr(self._world, "jitter_s", min(10.0, _number(r, "seconds"))),
            "reboot": self._reboot,
            "refuse_upload": lambda r, now: setattr(c, "refuse_upload", bool(r.get("on", True))),
            "slow_start": lambda r, now: setattr(c, "start_delay_s", _number(r, "seconds")),
            "tracking_lag": lambda r, now: setattr(c.arm, "lag_s", _number(r, "seconds")),
            "wrong_tcp": lambda r, now: c.set_tcp(_several(r, "pose", 6, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])),
            "set_q": lambda r, now: c.arm.displace(np.array(_several(r, "q", 6))),
            "wrong_number": self._wrong_number,
            "robot_api": lambda r, now: self._robot_api(str(r.get("what"))),
            "tool_contact": lambda r, now: setattr(c, "tool_contact_steps", int(_number(r, "n", 1))),
        }
        self._faults |= more_faults or {}
        self._actions: dict[str, Callable[[Request, float], None]] = {
            "estop_release": lambda r, now: c.set_safety_mode(SafetyMode.NORMAL),
            "safeguard_release": lambda r, now: c.set_safety_mode(SafetyMode.NORMAL),
            "normal": lambda r, now: c.set_safety_mode(SafetyMode.NORMAL),
            "resume_program": lambda r, now: _required(c.resume_program(), "there is nothing that can be resumed"),
            "remote": lambda r, now: setattr(c, "remote", bool(r.get("on", True))),
            "registers_free": lambda r, now: rtde.release_elsewhere(),
            "clear_pstop_timer": lambda r, now: setattr(c, "protective_since", -(10**9)),
            "unlock": lambda r, now: _required(c.unlock_protective_stop(), "the protective stop is younger than 5 s"),
            "power_on": lambda r, now: c.release_brakes(),
            "external_control": self._external_control,
            "set_tcp": lambda r, now: c.set_tcp(_several(r, "pose", 6)),
            "set_q": lambda r, now: c.arm.place(np.array(_several(r, "q", 6))),
            "set_payload": self._payload,
            "set_digital_in": self._digital_input,
            "set_gravity": lambda r, now: setattr(c, "gravity", _several(r, "gravity", 3)),
            "clear_links": self._clear_links,
            "recover": self._recover,
            "expect_silence": lambda r, now: lockstep.expect_silence(),
            "contact_plane": lambda r, now: c.surroundings.place(
                _several(r, "point", 3), _several(r, "normal", 3), _number(r, "stiffness")
            ),
            "push": lambda r, now: setattr(c.surroundings, "push", np.array(_several(r, "wrench", 6))),
            "note_fault": lambda r, now: checker.fault(str(r["what"]), now),
            "reset_checker": lambda r, now: checker.reset(),
            "quit": lambda r, now: setattr(self._world, "quit", True),
        }
        self._checks: dict[str, Callable[[Request], dict[str, Any]]] = {
            "at_rest_after": lambda r: checker.at_rest_after(
                _number(r, "fault_time"), _number(r, "within", 0.3), _number(r, "speed", 1e-3)
            ),
            "output_after": lambda r: checker.output_after(_number(r, "fault_time"), int(_number(r, "output"))),
            "output_on_after": lambda r: checker.output_on_after(_number(r, "fault_time"), int(_number(r, "output"))),
            "summary": lambda r: checker.summary(),
        }
        self._questions: dict[str, Callable[[Request], dict[str, Any]]] = {
            "state": lambda r: c.state() | {"overruns": world.overruns, "lockstep": lockstep.state()},
            "time": lambda r: {"timestamp": c.timestamp},
            "log": lambda r: {"log": list(c.log)},
            "program": lambda r: {"source": c.program.source if c.program else None},
            "connections": lambda r: {"connections": [link.kind for link in network.of_kind("all")]},
        }

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        for line in connection.lines(data):
            if line.strip():
                connection.send(json.dumps(self.answer(line, now)).encode() + b"\n", now)

    def answer(self, line: bytes, now: float) -> dict[str, Any]:
        """Return the reply to one line; `ok` is false and `error` says why where it cannot be done."""
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise InputError("Send one JSON object a line.")
            return {"ok": True, "time": now, **self._act(request, now)}
        except Exception as error:  # nonsense must not end the controller
            return {"ok": False, "time": now, "error": str(error) or type(error).__name__}

    def _act(self, request: Request, now: float) -> dict[str, Any]:
        for kind, known in (("fault", self._faults), ("do", self._actions)):
            if kind in request:
                if (name := str(request[kind])) not in known:
                    raise InputError(f"There is no {kind} {name!r}; choose one of: {', '.join(sorted(known))}.")
                known[name](request, now)
                if kind == "fault" and request.get("latch", True):
                    self._checker.fault(name, now)
                return {}
        for kind, questions in (("check", self._checks), ("ask", self._questions)):
            if request.get(kind) in questions:
                return questions[request[kind]](request)
        raise InputError(
            "Send fault, do, check (at_rest_after, output_after, output_on_after, summary) or ask (state, log, program,"
            " connections)."
        )

    def _links(self, request: Request) -> list[Connection]:
        """Connections of the protocol that the request names (rtde unless it says so), or the one at `index`."""
        found = self._network.of_kind(str(request.get("kind", "rtde")))
        if "index" not in request or not found:
            return found
        index = int(request["index"])
        if not 0 <= index < len(found):
            raise InputError(f"There is no connection {index}: {len(found)} are open.")
        return [found[index]]

    def _each(self, request: Request, **values: Any) -> None:
        for connection in self._links(request):
            for name, value in values.items():
                setattr(connection.faults, name, value)

    def _delay(self, request: Request, now: float) -> None:
        self._each(
            request,
            delay_s=_number(request, "seconds"),
            jitter_s=_number(request, "jitter", 0.0),
            delay_until=now + _number(request, "for", math.inf),
            delay_clock=(lambda: self._controller.timestamp) if request.get("clock") == "controller" else None,
        )

    def _mute(self, request: Request, now: float) -> None:
        """For so long of the controller's own time: a busy host makes no frames in which its guard could notice."""

        def own() -> float:
            return self._controller.frame * STEP_S

        self._each(request, deaf_until=own() + _number(request, "seconds", math.inf), deaf_clock=own)

    def _freeze(self, request: Request, now: float) -> None:
        until = now + _number(request, "seconds")
        if "kind" in request:
            self._each(request, freeze_until=until)
        else:
            self._world.frozen_until = until

    def _clear_links(self, request: Request, now: float) -> None:
        self._world.jitter_s = 0.0
        self._rtde.wrong.clear()
        self._robot_api("")
        for connection in self._links({"kind": "all"} | dict(request)):
            connection.faults = LinkFaults()

    def _recover(self, request: Request, now: float) -> None:
        """Everything right again at once, the program stopped and the arm where it is; the checker keeps its latch."""
        c = self._controller
        self._clear_links({}, now)
        self._rtde.release_elsewhere()
        c.stop_program()
        while c.sidekicks:
            c.sidekicks.pop().close()
        c.set_safety_mode(SafetyMode.NORMAL)
        c.robot_mode, c.remote, c.refuse_upload = RobotMode.RUNNING, True, False
        c.start_delay_s, c.clock_rate, c.tool_contact_steps = 0.0, 1.0, 0
        c.terminals.speed_slider, c.terminals.limiter, c.arm.lag_s = 1.0, 1.0, 0.0
        c.set_tcp([0.0] * 6)
        c.terminals.foreign.clear()
        c.terminals.analog_foreign.clear()
        c.terminals.digital_inputs = 0
        c.surroundings, c.sensor = ElasticContact(), ForceSensor()

    def _close(self, request: Request, *, reset: bool) -> None:
        for connection in self._links(request):
            connection.close(reset=reset)

    def _external_control(self, request: Request, now: float) -> None:
        address = (str(request.get("host", "127.0.0.1")), int(_number(request, "port", CLIENT_PORT)))
        try:
            self._network.dial(self._external, address, now)
        except OSError as error:
            raise InputError(f"No script sender listens on {address[0]}:{address[1]} ({error}).") from error

    def _robot_mode(self, mode: RobotMode) -> None:
        self._controller.robot_mode = mode
        if mode != RobotMode.RUNNING:
            self._controller.stop_program()

    def _start(self, script: str) -> None:
        if not self._controller.start(script):
            raise InputError(f"The program did not start: {self._controller.log[-1]}")

    def _slider(self, request: Request, now: float) -> None:
        value, ramp = _number(request, "value"), _number(request, "ramp", 0.0)
        start, steps = self._controller.terminals.speed_slider, max(1, round(ramp / STEP_S))

        def step(i: int) -> None:
            self._controller.terminals.speed_slider = start + (value - start) * i / steps
            if i < steps:
                self._controller.later(STEP_S, lambda: step(i + 1))

        self._controller.later(STEP_S, lambda: step(1))

    def _payload(self, request: Request, now: float) -> None:
        """As the installation has it."""
        payload = self._controller.payload
        payload.mass = _number(request, "mass")
        payload.center = _several(request, "cog", 3, [0.0, 0.0, 0.0])

    def _foreign_output(self, request: Request, now: float) -> None:
        frames = max(1, round(_number(request, "seconds", 0.0) / STEP_S))
        until = self._controller.frame + frames
        self._controller.terminals.foreign[_count(request, "n", 18)] = (bool(request.get("on", True)), until)

    def _digital_input(self, request: Request, now: float) -> None:
        """The level of a standard input, by whoever is wired there."""
        n, terminals = _count(request, "n", 8), self._controller.terminals
        terminals.digital_inputs = terminals.digital_inputs & ~(1 << n) | int(bool(request.get("on", True))) << n

    def _foreign_analog(self, request: Request, now: float) -> None:
        until = self._controller.frame + max(1, round(_number(request, "seconds", 0.0) / STEP_S))
        self._controller.terminals.analog_foreign[_count(request, "n", 2)] = (_number(request, "share"), until)

    def _wrong_number(self, request: Request, now: float) -> None:
        name = str(request.get("output"))
        if name not in self._rtde.real_outputs():
            raise InputError(f"There is no output of real numbers {name!r}.")
        self._rtde.wrong[name] = float(request.get("value", math.nan))  # not finite: that is the fault

    def _robot_api(self, what: str) -> None:
        """One of the faults of the Robot API, or `refused`; "" ends it."""
        self._api.inject("" if what == "refused" else what)
        if what == "refused":
            self._network.unplug(*(server for server in self._network.listening() if server is not self._api))
        elif self._world.unplugged_until is None:
            self._network.plug()

    def _reboot(self, request: Request, now: float) -> None:
        self._network.unplug(self)
        self._controller.reboot()
        self._world.unplugged_until = now + _number(request, "seconds", 2.0)


def _number(request: Request, key: str, default: float | None = None) -> float:
    if key not in request and default is not None:
        return default
    return _finite(request.get(key), f"a number as {key!r}")


def _finite(value: Any, what: str) -> float:
    if type(value) not in (int, float) or not abs(value) <= LARGEST:
        raise InputError(f"Give {what}.")
    return float(value)


def _count(request: Request, key: str, count: int) -> int:
    """Return a whole number from 0 to count - 1."""
    if request.get(key) not in range(count):
        raise InputError(f"Give a number from 0 to {count - 1} as {key!r}.")
    return int(request[key])


def _several(request: Request, key: str, count: int, default: list[float] | None = None) -> list[float]:
    value = request.get(key, default)
    what = f"{'six' if count == 6 else 'three'} numbers as {key!r}"
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"Give {what}.")
    return [_finite(v, what) for v in value]


def _required(done: bool, problem: str) -> None:
    if not done:
        raise InputError(f"Not done: {problem}.")
