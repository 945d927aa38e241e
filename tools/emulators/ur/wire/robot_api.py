"""The Robot API of PolyScope X on HTTP: the state and the actions of the emulated dashboard, as JSON.

Facts as in `systems/drivers/ur/wire/robot_api.py`, and from UR's tests of its client. A command that powers the arm is
answered when the arm has got there. [M] version 3.0.0 before 10.12; unlocking needs no 5 s.
"""

import io
import json
from collections.abc import Callable
from email import message_from_bytes
from email.message import Message
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import unquote

from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import POWERLESS, RobotMode, SafetyMode
from weldcal.tools.emulators.ur.wire.dashboard import IDLE_PROGRAM, DashboardServer
from weldcal.tools.emulators.ur.wire.net import MAX_QUEUED, Connection, Server

BASE = "/universal-robots/robot-api"
JSON = dict[str, Any]
Answer = tuple[int, JSON]
FIRST_PROGRAM = "Default program"
# SafetyMode by the names that the API has for several of them
SAFETY = {mode: "EMERGENCY_STOP" if "EMERGENCY" in mode.name else "FAULT" for mode in POWERLESS} | {
    SafetyMode.SAFEGUARD_STOP: "PROTECTIVE_STOP",
    SafetyMode.RECOVERY: "FAULT",
}
POWERS = {  # action: the dashboard's command, and the mode in which it has been done
    "POWER_ON": ("power on", RobotMode.IDLE),
    "POWER_OFF": ("power off", RobotMode.POWER_OFF),
    "BRAKE_RELEASE": ("brake release", RobotMode.RUNNING),
    "RESTART_SAFETY": ("restart safety", RobotMode.POWER_OFF),
}
LONGEST_POWER_S = 10.0  # [M]
SLOW_S = 0.3  # between the bytes of a slow answer
FAULTS = ("slow", "cut", "no_json", "wrong_type", "missing", "error", "old", "redirect", "elsewhere", "empty")


class _Request(BaseHTTPRequestHandler):
    """One request in memory, parsed and answered by the standard library."""

    protocol_version = "HTTP/1.1"

    def __init__(self, data: bytes) -> None:
        self.written = io.BytesIO()
        self.rfile, self.wfile = io.BytesIO(data), self.written
        self.client_address = ("", 0)
        self.raw_requestline = self.rfile.readline(65537)
        self.parsed = self.parse_request()
        wanted = self.headers.get("Content-Length", "0") if self.parsed else "0"
        self.body = self.rfile.read(int(wanted) if wanted.isdigit() else 0)
        self.whole = not wanted.isdigit() or len(self.body) == int(wanted)

    def log_message(self, *_: object) -> None:
        """Nothing goes to the terminal."""

    def answer(self, status: int, body: bytes, place: str = "") -> bytes:
        """The bytes of an answer."""
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        if place:
            self.send_header("Location", place)
        self.end_headers()
        self.wfile.write(body)
        return self.written.getvalue()


class RobotApiServer(Server):
    """Robot and program states of PolyScope X 10.11, and its modes and programs of 10.12."""

    kind = "robot_api"

    def __init__(self, controller: Controller, dashboard: DashboardServer) -> None:
        self._controller, self._dashboard = controller, dashboard
        self._new = controller.version.at_least((99, 0), (10, 12))
        self._loaded = FIRST_PROGRAM
        self._programs: dict[str, bytes] = {FIRST_PROGRAM: b"{}", "wait_program": b"{}"}
        self._powering: list[tuple[Connection, _Request, RobotMode, int]] = []
        self._slow: list[tuple[Connection, bytes, float]] = []
        self.fault = ""
        c = controller
        self._reads: dict[str, Callable[[], JSON]] = {"/program/v1/state": self._program_state}
        if self._new:
            self._reads |= {
                "/program/v1/loaded": lambda: {"name": self._loaded},
                "/robotstate/v1/robotmode": lambda: {"mode": c.robot_mode.name.removesuffix("_FIRMWARE")},
                "/robotstate/v1/safetymode": lambda: {"mode": SAFETY.get(c.safety_mode, c.safety_mode.name)},
                "/system/v1/controlmode": lambda: {"mode": "REMOTE" if c.remote else "LOCAL"},
                "/system/v1/operationalmode": lambda: {"mode": c.operational_mode.replace("NONE", "AUTOMATIC")},
                "/programs/v1/": lambda: {"programs": [_listed(name) for name in self._programs]},
            }

    def inject(self, fault: str) -> None:
        """One of FAULTS until the next call; "" for none.

        Raises:
            InputError: there is no such fault.
        """
        if fault and fault not in FAULTS:
            raise InputError(f"There is no fault {fault!r} of the Robot API; choose one of: {', '.join(FAULTS)}.")
        self.fault = fault

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        connection.inbox += data
        if b"\r\n\r\n" not in connection.inbox and len(connection.inbox) < MAX_QUEUED:
            return
        request = _Request(bytes(connection.inbox))
        if not request.whole and len(connection.inbox) < MAX_QUEUED:
            return
        connection.inbox.clear()
        if not request.parsed:  # what was wrong has been written already
            self._send(connection, request.written.getvalue(), now)
            return
        self._answer(connection, request, now)

    def frame(self, now: float) -> None:
        waiting, self._powering = self._powering, []
        for entry in waiting:
            connection, request, mode, until = entry
            done = self._controller.robot_mode == mode or (mode, self._controller.robot_mode) == (
                RobotMode.IDLE,
                RobotMode.RUNNING,
            )
            if done or self._controller.frame >= until:
                body = {"state": self._controller.robot_mode.name, "message": "Robot state changed"}
                self._send(connection, request.answer(200 if done else 500, json.dumps(body).encode()), now)
            else:
                self._powering.append(entry)
        slow, self._slow = self._slow, []
        for connection, rest, due in slow:
            if now >= due:
                connection.send(rest[:1], now)
                rest, due = rest[1:], now + SLOW_S
            if rest:
                self._slow.append((connection, rest, due))

    def gone(self, connection: Connection) -> None:
        self._powering = [entry for entry in self._powering if entry[0] is not connection]
        self._slow = [entry for entry in self._slow if entry[0] is not connection]

    def _send(self, connection: Connection, data: bytes, now: float) -> None:
        if self.fault == "slow":
            self._slow.append((connection, data, now))
            return
        connection.send(data[: len(data) - 5] if self.fault == "cut" else data, now)
        if self.fault == "cut":
            connection.flush(now)
            connection.close(reset=False)

    def _answer(self, connection: Connection, request: _Request, now: float) -> None:
        place, _, _ = request.path.partition("?")
        path = unquote(place.removeprefix(BASE)) if place.startswith(f"{BASE}/") else ""
        if self.fault == "redirect" or (path.endswith("/") and path != "/programs/v1/"):  # paths that have moved
            moved = place if self.fault == "redirect" else place.rstrip("/")
            self._send(connection, request.answer(307, b"", moved), now)
            return
        if self.fault == "elsewhere":
            self._send(connection, request.answer(307, b"", f"http://192.0.2.1{place}"), now)
            return
        if request.command == "PUT" and path == "/robotstate/v1/state" and not self.fault:
            action = _field(request.body, "action")
            if action in POWERS and self._controller.remote:
                word, mode = POWERS[action]
                self._dashboard.answer(word)
                until = self._controller.frame + round(LONGEST_POWER_S / 0.002)
                self._powering.append((connection, request, mode, until))
                return
        status, found = self._act(request.command, path, request)
        body = found if isinstance(found, bytes) else json.dumps(found).encode()
        wrong = {"no_json": b"<html>PolyScope X</html>", "wrong_type": _mistyped(body), "empty": b""}
        status = {"missing": 404, "error": 500}.get(self.fault, status)
        self._send(connection, request.answer(status, wrong.get(self.fault, body)), now)

    def _act(self, method: str, path: str, request: _Request) -> tuple[int, JSON | bytes]:
        if path == "/openapi.json" and method == "GET":
            version = "3.1.4" if self._new and self.fault != "old" else "3.0.0"
            return 200, {"openapi": "3.1.0", "info": {"title": "Robot API", "version": version}}
        if method == "GET" and path in self._reads:
            return 200, self._reads[path]()
        if self._new and path.startswith("/programs/v1/"):
            return self._program_files(method, path.removeprefix("/programs/v1/"), request)
        if method != "PUT":
            return 404, {"detail": "Not Found"}
        if not self._controller.remote:
            return 403, {"detail": "the robot must be in remote mode"}
        match path, _field(request.body, "action"):
            case "/program/v1/state", ("play" | "pause" | "resume" | "stop") as action:
                return self._command(action)
            case "/robotstate/v1/state", "UNLOCK_PROTECTIVE_STOP":
                self._controller.unlock_protective_stop(at_once=True)
                return 200, {"message": "unlocked"}
            case (("/program/v1/loaded" | "/program/v1/load"), _):
                return self._load(_field(request.body, "name" if path.endswith("loaded") else "programName"))
        return 404, {"detail": "Not Found"}

    def _program_state(self) -> JSON:
        state = self._dashboard.answer("programState").partition(" ")[0]
        return {"state": state, "message": f"Program state: {state}", "details": ""}

    def _command(self, action: str) -> Answer:
        c = self._controller
        if action == "play" and c.program is None:
            done = c.start(IDLE_PROGRAM.format(name="program"))
        else:
            answer = self._dashboard.answer("play" if action == "resume" else action)
            done = not answer.startswith("Failed")
        return (200 if done else 409), self._program_state()

    def _load(self, name: str) -> Answer:
        if name not in self._programs:
            return 404, {"message": f"There is no program {name}"}
        self._loaded = name
        return 200, {"name": name}

    def _program_files(self, method: str, name: str, request: _Request) -> tuple[int, JSON | bytes]:
        if method == "GET":
            return (200, self._programs[name]) if name in self._programs else (404, {"message": "not found"})
        content = _uploaded(request.headers, request.body)
        try:
            name = str(json.loads(content)["program"]["programInformation"]["name"])
        except (ValueError, KeyError, TypeError):
            return 400, {"message": "not a program"}
        if (method == "POST") == (name in self._programs):
            return 400, {"message": f"The program {name} {'exists' if method == 'POST' else 'does not exist'}"}
        self._programs[name] = content
        return 200, {"programName": name}


def _field(body: bytes, key: str) -> str:
    try:
        return str(json.loads(body)[key])
    except (ValueError, KeyError, TypeError):
        return ""


def _mistyped(body: bytes) -> bytes:
    """The answer with numbers in place of its modes."""
    found = json.loads(body)
    return json.dumps(found | {key: 7 for key in ("mode", "state") if key in found}).encode()


def _uploaded(headers: Message, body: bytes) -> bytes:
    """The first file of a form."""
    form = message_from_bytes(f"Content-Type: {headers.get('Content-Type', '')}\r\n\r\n".encode() + body)
    parts = form.get_payload() if form.is_multipart() else [form]
    content = parts[0].get_payload(decode=True) if isinstance(parts, list) and isinstance(parts[0], Message) else b""
    return content if isinstance(content, bytes) else b""


def _listed(name: str) -> JSON:
    dates = {"createdDate": 0, "lastModifiedDate": None, "lastSavedDate": None}
    return {"name": name, "description": "", "programState": "FINAL"} | dates
