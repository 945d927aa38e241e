"""Dashboard server on port 29999: one reply per command line."""

from collections.abc import Callable

from weldcal.models.robots import CONTROLLER_MODELS
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import OPERATIONAL_MODES, RobotMode, RuntimeState, SafetyMode
from weldcal.tools.emulators.ur.wire.net import Connection, Server

FIRST_IS_ONE = ("ur10e", *(name for name in CONTROLLER_MODELS if name != "ur10e"))
GREETING = "Connected: Universal Robots Dashboard Server"
TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)
IDLE_PROGRAM = "def {name}():\n  while True:\n    sync()\n  end\nend\n"


def serial_number(arm: str) -> str:
    """Return a serial number for an emulated arm, another for each model."""
    return f"202355{1 + FIRST_IS_ONE.index(arm):05d}"


class DashboardServer(Server):
    """Commands that an operator or a client may give."""

    kind = "dashboard"

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._loaded: str | None = None
        self._installation = "default.installation"
        self._count = 0
        c = controller
        v = c.version
        self._fixed: dict[str, Callable[[], str]] = {
            "polyscopeversion": lambda: f"URSoftware {v.major}.{v.minor}.{v.bugfix}.{v.build} (Jan 01 2025)",
            "version": lambda: f"{v.major}.{v.minor}.{v.bugfix}.{v.build}",
            "get serial number": lambda: serial_number(c.arm.model.name),
            "get robot model": lambda: CONTROLLER_MODELS[c.arm.model.name][0],
            "is in remote control": lambda: str(c.remote).lower(),
            "robotmode": lambda: f"Robotmode: {c.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {c.safety_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {c.safety_mode.name}",
            "running": lambda: f"Program running: {str(self._running()).lower()}",
            "programstate": self._program_state,
            "isprogramsaved": lambda: f"true {self._name()}",
            "get loaded program": lambda: f"Loaded program: {self._loaded}" if self._loaded else "No program loaded",
            "get operational mode": lambda: c.operational_mode,
            "getloadedprogram": lambda: f"Loaded program: {self._loaded}" if self._loaded else "No program loaded",
            "stop": self._stop,
            "play": self._play,
            "pause": self._pause,
            "unlock protective stop": self._unlock,
            "power on": lambda: self._do(c.power_on, "Powering on"),
            "power off": lambda: self._do(c.power_off, "Powering off"),
            "brake release": lambda: self._do(c.release_brakes, "Brake releasing"),
            "restart safety": self._restart_safety,
            "close safety popup": lambda: "closing safety popup",
            "close popup": self._close_popup,
            "savelog": lambda: "Log saved to disk",
            "shutdown": lambda: "Shutting down",
            "clear operational mode": self._clear_operational_mode,
        }

    def opened(self, connection: Connection, now: float) -> None:
        connection.send(f"{GREETING}\n".encode(), now)

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        for line in connection.lines(data):
            text = line.decode("utf-8", "replace").strip()
            connection.send(f"{self.answer(text)}\n".encode(), now)
            if text.lower() in ("quit", "exit"):
                connection.flush(now)
                connection.close(reset=False)
                return

    def answer(self, command: str) -> str:
        """Return the reply to one command, without its newline."""
        lower = command.lower()
        if lower in self._fixed:
            return self._fixed[lower]()
        word, _, argument = command.partition(" ")
        match word.lower():
            case "quit" | "exit":
                return "Disconnected"
            case "load":
                return self._load(argument)
            case "popup":
                return "showing popup"
            case "addtolog":
                self._controller.note(f"dashboard: {argument}")
                return "Added log message"
            case "set" if argument.lower().startswith("operational mode "):
                return self._set_operational_mode(argument.rpartition(" ")[2])
            case "generate":
                return self._generate(argument)
        return f"could not understand: '{command}'"

    def _running(self) -> bool:
        return self._controller.runtime_state in (RuntimeState.PLAYING, RuntimeState.RESUMING)

    def _name(self) -> str:
        return (self._loaded or "").rpartition("/")[2] or self._controller.program_name or "<unnamed>"

    def _program_state(self) -> str:
        state = self._controller.runtime_state
        if state in (RuntimeState.PLAYING, RuntimeState.RESUMING):
            return f"PLAYING {self._name()}"
        if state in (RuntimeState.PAUSED, RuntimeState.PAUSING):
            return f"PAUSED {self._name()}"
        return f"STOPPED {self._name()}"

    def _do(self, action: Callable[[], None], reply: str) -> str:
        if not self._controller.remote:
            return f"Failed to execute: {reply.lower()}: the robot is in local mode"
        action()
        return reply

    def _stop(self) -> str:
        if not self._controller.remote:
            return "Failed to execute: stop"
        self._controller.stop_program()
        return "Stopped"

    def _play(self) -> str:
        c = self._controller
        if c.runtime_state in (RuntimeState.PAUSED, RuntimeState.PAUSING):
            return "Starting program" if c.resume_program() else "Failed to execute: play"
        if self._running():
            return "Starting program"
        ready = c.remote and self._loaded is not None
        if ready and c.start(IDLE_PROGRAM.format(name=self._name().removesuffix(".urp"))):
            return "Starting program"
        return "Failed to execute: play"

    def _pause(self) -> str:
        if not self._controller.remote or self._controller.program is None:
            return "Failed to execute: pause"
        self._controller.pause_program()
        return "Pausing program"

    def _load(self, name: str) -> str:
        if name.startswith("installation "):
            return self._load_installation(name.removeprefix("installation ").strip())
        if not name.endswith(".urp") or "missing" in name:
            return f"File not found: {name}"
        self._loaded = name
        path = name if name.startswith("/") else f"/programs/{name}"
        return f"Loading program: {path}, {self._installation}"

    def _unlock(self) -> str:
        return "Protective stop releasing" if self._controller.unlock_protective_stop() else TOO_EARLY

    def _restart_safety(self) -> str:
        c = self._controller
        if c.safety_mode in (SafetyMode.VIOLATION, SafetyMode.FAULT, SafetyMode.RECOVERY):
            c.stop_program()
            c.set_safety_mode(SafetyMode.NORMAL)
            c.robot_mode = RobotMode.POWER_OFF
        return "Restarting safety"

    def _load_installation(self, name: str) -> str:
        if not name.endswith(".installation") or "missing" in name:
            return f"File not found: {name}"
        self._installation = name
        return f"Loading installation: {name}"

    def _close_popup(self) -> str:
        self._controller.popup_open = False
        return "closing popup"

    def _set_operational_mode(self, mode: str) -> str:
        if mode.upper() not in OPERATIONAL_MODES[1:]:
            return f"Failed setting operational mode: {mode}"
        self._controller.operational_mode = mode.upper()
        return f"Operational mode {mode.upper()} is set"

    def _clear_operational_mode(self) -> str:
        self._controller.operational_mode = "NONE"
        return "No longer controlling the operational mode."

    def _generate(self, what: str) -> str:
        """Return a report or a support file: the answers of a controller, without a file."""
        self._count += 1
        if what.startswith("flight report"):
            return f"Flight Report generated with id: {self._count}"
        if what.startswith("support file"):
            return (
                f"Completed successfully: ursupport_{serial_number(self._controller.arm.model.name)}_{self._count}.zip"
            )
        return f"could not understand: 'generate {what}'"
