"""A minimal UR controller at a loopback address: `python -m tests.hardware.independent --host 127.40.0.1`.

Ports 29999, 30001 to 30004 as on a robot; 30095 takes one JSON object a line, with which a test asks for faults (see
`Hooks`).
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import select
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from tests.hardware.independent.machine import HOME, STEP_S, Machine
from tests.hardware.independent.ports import Client, real_time_package, state_package
from tests.hardware.independent.rtde import Rtde, RtdeClient

CONTROL_PORT = 30095
PORTS = (29999, 30001, 30002, 30003, 30004, CONTROL_PORT)
STATE_EACH = 50  # frames: the client interface has 10 Hz
CATCHES_UP_S = 0.010  # later frames are not made up for: the controller's time then runs slower than the computer's
UNFAULTY = ("state", "repair", "play", "mark", "place", "inputs", "vary")
PRIORITY = 3  # of SCHED_RR, above that of its client's processes
SECOND_PROGRAM = "def second():\n  while True:\n    sync()\n  end\nend\n"


class Hooks:
    """The control channel: each method is a request by its name."""

    def __init__(self, machine: Machine, rtde: Rtde) -> None:
        self._machine, self._rtde = machine, rtde
        self.fault: dict[str, float] = {}  # time and speed of the arm at the newest fault
        self.late: dict[str, float] = {"frames": 0, "worst_ms": 0.0, "slipped_ms": 0.0, "slips": 0}

    def ask(self, text: str) -> dict[str, Any]:
        """Answer one line: {"do": name, ...}."""
        try:
            request = json.loads(text)
            name = request.pop("do")
            if name not in UNFAULTY:
                self.fault = {"at": self._machine.time, "speed": max(map(abs, self._machine.qd))}
            method: Callable[..., dict[str, Any] | None] = getattr(self, f"do_{name}")
            return method(**request) or {"ok": True}
        except Exception as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}

    def do_state(self) -> dict[str, Any]:
        """What the controller knows of itself."""
        m = self._machine
        return {
            "time": m.time, "q": m.q, "qd": m.qd, "pose": m.pose, "runtime_state": m.state, "safety_mode": m.safety_mode,
            "robot_mode": m.robot_mode, "program": m.name if m.program else None, "started": m.programs_started,
            "travel": m.travel, "moved_at": m.moved_at, "fault": self.fault, "digital_out": m.digital_out, "analog_out": m.analog_out, "command": m.ints_in[24],
            "tcp": m.tcp, "payload": m.payload, "log": m.log[-20:], "late": self.late,
            "modules": sorted({name.partition(".")[0] for name in sys.modules} - sys.stdlib_module_names),
        }  # fmt: skip

    def do_pause(self) -> None:
        """The operator presses Pause."""
        self._machine.pause("by the operator")

    def do_play(self) -> dict[str, Any]:
        """The operator presses Play."""
        return {"ok": True, "resumed": self._machine.play()}

    def do_stop(self) -> None:
        """The operator presses Stop."""
        self._machine.stop("by the operator")

    def do_protective_stop(self) -> None:
        """The safety system stops the arm."""
        self._machine.protective_stop()

    def do_emergency_stop(self) -> None:
        """The button is pressed."""
        self._machine.emergency_stop()

    def do_repair(self) -> None:
        """The operator repairs everything, without Play or Stop."""
        self._machine.repair()
        self._rtde.wrong.clear()
        self._rtde.delay_s = self._rtde.silent_until = self._rtde.mute_until = 0.0

    def do_second_program(self, text: str = SECOND_PROGRAM) -> None:
        """Somebody sends another program."""
        self._machine.upload(text)

    def do_wrong(self, name: str, value: float = math.nan, seconds: float = 1.0) -> None:
        """An output is reported wrong."""
        self._rtde.wrong[name] = (value, self._machine.time + seconds)

    def do_delay(self, seconds: float) -> None:
        """Outputs leave later."""
        self._rtde.delay_s = seconds

    def do_silent(self, seconds: float) -> None:
        """No outputs leave."""
        self._rtde.silent_until = self._machine.time + seconds

    def do_mute(self, seconds: float) -> None:
        """Inputs are ignored."""
        self._rtde.mute_until = self._machine.time + seconds

    def do_reset(self) -> None:
        """RTDE connections are reset."""
        for client in list(self._rtde.clients):
            client.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
            client.close()

    def do_slider(self, fraction: float) -> None:
        """The operator moves the speed slider."""
        self._machine.slider = fraction

    def do_remote(self, on: bool) -> None:
        """Remote or local control."""
        self._machine.remote = on

    def do_place(self, q: list[float]) -> None:
        """Put the arm somewhere, while no program runs."""
        if self._machine.program is not None:
            raise ValueError("a program runs")
        self._machine.q = [float(x) for x in q]
        self._machine.qd = [1e-12] * 6  # the next frame computes the pose

    def do_vary(self, choice: str, value: float) -> None:
        """Choose otherwise where the manuals are silent."""
        if choice not in ("keeps_outputs_in_pause", "starts_s", "target_speeds_late", "noise_rad_s"):
            raise ValueError(f"there is no choice {choice}")
        setattr(self._machine, choice, type(getattr(self._machine, choice))(value))

    def do_mark(self) -> None:
        """Count the arm's travel from now on."""
        self._machine.mark()

    def do_inputs(self, bits: int) -> None:
        """Set the digital inputs."""
        self._machine.digital_in = bits


class Asked:
    """A connection of the control channel."""

    def __init__(self, hooks: Hooks, connection: socket.socket) -> None:
        self._hooks, self.connection, self._text, self.open = hooks, connection, b"", True

    def received(self, data: bytes) -> None:
        """Answer every whole line."""
        self._text += data
        while b"\n" in self._text:
            line, _, self._text = self._text.partition(b"\n")
            answer = self._hooks.ask(line.decode("utf-8", "replace"))
            self.connection.setblocking(True)
            self.connection.sendall(json.dumps(answer).encode() + b"\n")
            self.connection.setblocking(False)

    def close(self) -> None:
        """End the connection."""
        self.open = False
        self.connection.close()


class Controller:
    """The servers and the loop of frames."""

    def __init__(self, host: str, q: list[float]) -> None:
        self.machine = Machine(q)
        self.rtde = Rtde(self.machine)
        self.hooks = Hooks(self.machine, self.rtde)
        self._servers = {socket.create_server((host, port)): port for port in PORTS}
        for server in self._servers:
            server.setblocking(False)
        self._clients: dict[socket.socket, Client | RtdeClient | Asked] = {}

    def run(self) -> None:
        """Compute frames for ever."""
        due, count = time.monotonic(), 0
        while True:
            due += STEP_S
            late = time.monotonic() - due
            if late > CATCHES_UP_S:
                # this computer was late: the next frame is one step later, so that the program does not see many frames
                # at once
                self.hooks.late["slips"] += 1
                self.hooks.late["slipped_ms"] += 1e3 * late
                due += late
            self.hooks.late["worst_ms"] = max(self.hooks.late["worst_ms"], 1e3 * late)
            self.hooks.late["frames"] += 1
            self._listen(due)
            self.machine.frame()
            self.rtde.publish(time.monotonic())
            count += 1
            self._stream(count)

    def _listen(self, until: float) -> None:
        """Handle what arrives until this time, at least once."""
        while True:
            self._forget()
            left = max(until - time.monotonic(), 0.0)
            ready, _, _ = select.select([*self._servers, *self._clients], [], [], left)
            for one in ready:
                if one in self._servers:
                    self._accept(one, self._servers[one])
                else:
                    self._read(one)
            if left == 0.0 or not ready:
                return

    def _accept(self, server: socket.socket, port: int) -> None:
        connection, _ = server.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if port == 30004:
            self._clients[connection] = self.rtde.accept(connection)
        elif port == CONTROL_PORT:
            self._clients[connection] = Asked(self.hooks, connection)
        else:
            self._clients[connection] = Client(self.machine, connection, port)

    def _read(self, connection: socket.socket) -> None:
        client = self._clients.get(connection)
        if client is None:
            return
        try:
            data = connection.recv(65536) if client.open else b""
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            client.received(data)
        else:
            client.close()
        self._forget()

    def _forget(self) -> None:
        self._clients = {connection: client for connection, client in self._clients.items() if client.open}

    def _stream(self, count: int) -> None:
        self._forget()
        real_time = [c for c in self._clients.values() if isinstance(c, Client) and c.port == 30003]
        if real_time:
            package = real_time_package(self.machine)
            for client in real_time:
                client.send(package)
        if count % STATE_EACH == 0:
            state = [c for c in self._clients.values() if isinstance(c, Client) and c.port in (30001, 30002)]
            package = state_package(self.machine) if state else b""
            for client in state:
                client.send(package)


def main() -> None:
    """Serve until the process is ended."""
    parser = argparse.ArgumentParser(description="A minimal UR controller at a loopback address.")
    parser.add_argument("--host", default="127.40.0.1")
    parser.add_argument("--q", type=float, nargs=6, default=list(HOME), help="rad")
    parser.add_argument(
        "--payload", type=float, nargs=4, default=[1.4, 0.03, 0.0, 0.05], help="of the installation: kg, m"
    )
    parser.add_argument(
        "--own-computer",
        action="store_true",
        help=(
            "take real-time priority where the system allows it, as a controller that shares no processor with its"
            " client"
        ),
    )
    given = parser.parse_args()
    if not given.host.startswith("127."):
        parser.error("the address must be a loopback address")
    controller = Controller(given.host, given.q)
    controller.machine.payload, controller.machine.cog = given.payload[0], given.payload[1:]
    if given.own_computer:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    gc.collect()
    gc.freeze()
    print(f"ready {given.host}", flush=True)
    controller.run()


if __name__ == "__main__":
    main()
