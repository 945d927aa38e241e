"""The client of PolyScope X's Robot API (HTTP), which takes the dashboard's commands and answers in its words.

Facts from Universal Robots' client library (`dashboard_client_implementation_x`, read in 2026) and its user manual of
software 10.12: JSON under BASE on port 80; 10.11 brought states to command, 10.12 (version 3.1.4 of the API) brought
modes to read. Paths have moved, and old ones redirect. A command is refused with 403 unless the control is remote.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import json
import socket
import threading
import time
from typing import Any
from urllib.parse import urljoin, urlsplit

from weldcal.systems.addresses import controller_address, is_loopback
from weldcal.systems.drivers.ur.faults import RobotUnreachable
from weldcal.systems.drivers.ur.wire.line import Ask, ask, resolve

BASE = "/universal-robots/robot-api"
ROBOT_API_PORT = 80
LOOPBACK_PORT = 30080  # of an emulator: a user's process may not open 80
OLDEST = (10, 12)  # PolyScope X from which modes can be read
OLDEST_API = (3, 1, 4)  # the version that the API states there
LIMIT_S = 0.8  # a choice for one command with its redirects: with RTDE's answers a check ends within 2 s
MOST_HOPS = 2
REMOTE_ONLY = "refused: this needs remote control mode"  # contains what the dashboard says then

# command of the dashboard: path, and the answers by the `mode` (or `state`) that the API names
READS: dict[str, tuple[str, str, dict[str, str]]] = {
    "is in remote control": ("/system/v1/controlmode", "mode", {"REMOTE": "true", "LOCAL": "false"}),
    "get operational mode": ("/system/v1/operationalmode", "mode", {"AUTOMATIC": "AUTOMATIC", "MANUAL": "MANUAL"}),
    "programState": ("/program/v1/state", "state", {name: name for name in ("PLAYING", "PAUSED", "STOPPED")}),
    "safetymode": (
        "/robotstate/v1/safetymode",
        "mode",
        {k: f"Safetymode: {k}" for k in ("NORMAL", "REDUCED", "PROTECTIVE_STOP", "EMERGENCY_STOP", "FAULT")},
    ),
    "robotmode": (
        "/robotstate/v1/robotmode",
        "mode",
        {
            k: f"Robotmode: {k}"
            for k in (
                *("NO_CONTROLLER", "DISCONNECTED", "CONFIRM_SAFETY", "BOOTING", "POWER_OFF"),
                *("POWER_ON", "IDLE", "BACKDRIVE", "RUNNING", "UPDATING"),
            )
        },
    ),
}
# command of the dashboard: path, action, and the answer where the API takes it
ACTIONS = {
    "stop": ("/program/v1/state", "stop", "Stopped"),
    "power on": ("/robotstate/v1/state", "POWER_ON", "Powering on"),
    "brake release": ("/robotstate/v1/state", "BRAKE_RELEASE", "Brake releasing"),
}


class RobotApiFailed(RobotUnreachable):
    """The Robot API does not answer as it should; the message says what to do."""


def asker(version: tuple[int, ...]) -> Ask | None:
    """Return what asks a controller of this version in the dashboard's words; None where nothing does.

    PolyScope 5 has the dashboard, PolyScope X from 10.12 on the Robot API, and nothing before.
    """
    if version[:1] < (10,):
        return ask
    return ask_robot_api if version[:2] >= OLDEST else None


def ask_robot_api(host: str, command: str, timeout_s: float = LIMIT_S) -> str:
    """Return the Robot API's answer to a command of READS or ACTIONS, in the words of the dashboard.

    Args:
        host: name or address of the controller.
        command: such as `is in remote control`.
        timeout_s: longest time; LIMIT_S where it is longer.

    Raises:
        RobotApiFailed: nothing answers in time, or not as specified.
    """
    exchange = _Exchange(host, min(timeout_s, LIMIT_S))
    if command in ACTIONS:
        path, action, answer = ACTIONS[command]
        told = exchange.json("PUT", path, {"action": action})
        return REMOTE_ONLY if told is None else answer
    path, key, answers = READS[command]
    exchange.require_version()
    value = (exchange.json("GET", path) or {}).get(key)
    if not isinstance(value, str) or value not in answers:
        raise exchange.failed(f"names {str(value)[:40]!r} as {key} at {path}", "update weldcal, or report it")
    return answers[value]


class _Exchange:
    """Requests of one command, which end together within the time limit."""

    def __init__(self, host: str, timeout_s: float) -> None:
        self._host, self._until = controller_address(host), time.monotonic() + timeout_s
        self._port = LOOPBACK_PORT if is_loopback(self._host) else ROBOT_API_PORT

    def failed(self, what: str, action: str = "restart the control box") -> RobotApiFailed:
        return RobotApiFailed(f"The Robot API of {self._host} (port {self._port}) {what}: {action}.")

    def require_version(self) -> None:
        """The API is one that reads modes, as the version that RTDE states has it."""
        info = (self.json("GET", "/openapi.json") or {}).get("info")
        told = info.get("version") if isinstance(info, dict) else None
        numbers = tuple(int(part) if part.isdigit() else -1 for part in str(told).split("."))
        if numbers < OLDEST_API:
            raise self.failed(
                f"states version {str(told)[:40]}, older than the 3.1.4 of PolyScope X 10.12 that RTDE states",
                "compare the address with the pendant's, and update PolyScope X",
            )

    def json(self, method: str, path: str, body: dict[str, str] | None = None) -> dict[str, Any] | None:
        """The object that the API answers; None where it refuses because the control is local."""
        status, told = self._follow(method, BASE + path, None if body is None else json.dumps(body).encode())
        if status == http.client.FORBIDDEN and method == "PUT":
            return None
        if status == http.client.NOT_FOUND:
            raise self.failed(f"has no {path} (404)", "install PolyScope X 10.12 or newer")
        if status != http.client.OK:
            raise self.failed(f"answers with the error {status} at {path}")
        if not told:
            raise self.failed(f"answers nothing at {path}")
        try:
            found = json.loads(told)
        except (ValueError, RecursionError):
            raise self.failed(f"answers no JSON at {path}", "compare the address with the pendant's") from None
        if not isinstance(found, dict):
            raise self.failed(f"answers a {type(found).__name__} and no object at {path}", "report it")
        return found

    def _follow(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        own = f"http://{self._host}:{self._port}"
        for _ in range(MOST_HOPS + 1):
            status, place, told = self._once(method, path, body)
            if not 300 <= status < 400:
                return status, told
            there = urlsplit(urljoin(own + path, place))
            if there.scheme != "http" or (there.hostname, there.port or 80) != (self._host.lower(), self._port):
                raise self.failed(f"sends to another address, {place[:60]!r}", "compare the address with the pendant's")
            path = there.path
        raise self.failed("sends from one path to another without an end")

    def _once(self, method: str, path: str, body: bytes | None) -> tuple[int, str, bytes]:
        left = self._until - time.monotonic()
        if left <= 0.0:
            raise self.failed("does not answer in time")
        connection = http.client.HTTPConnection(*resolve(self._host, self._port, left), timeout=left)
        try:
            connection.connect()
            # a read has a time limit for each piece only: the line is cut when the time of all has elapsed
            alarm = threading.Timer(self._until - time.monotonic(), functools.partial(_cut, connection.sock))
            alarm.start()
            try:
                headers = {"Accept": "application/json", "Content-Type": "application/json", "Connection": "close"}
                connection.request(method, path, body, headers)
                with connection.getresponse() as answer:
                    return answer.status, answer.getheader("Location", ""), answer.read()
            finally:
                alarm.cancel()
        except ConnectionRefusedError as error:
            raise self.failed(
                "is closed", "wait until PolyScope X has started, and look at Settings > Security > Services"
            ) from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            late = time.monotonic() >= self._until or isinstance(error, TimeoutError)
            raise self.failed("does not answer in time" if late else "hangs up or answers no HTTP") from error
        finally:
            connection.close()


def _cut(line: socket.socket) -> None:
    with contextlib.suppress(OSError):
        line.shutdown(socket.SHUT_RDWR)
