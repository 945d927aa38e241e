"""Starts an emulated controller as a child process on a loopback address of its own, and always ends it."""

import fcntl
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from weldcal.models.errors import InputError
from weldcal.systems.interrupts import started

PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT, RTDE_PORT, DASHBOARD_PORT = 30001, 30002, 30003, 30004, 29999
ROBOT_API_PORT, HTTP_PORT = 30080, 80  # a controller's is 80, which few users may open
PORTS = (DASHBOARD_PORT, PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT, RTDE_PORT, ROBOT_API_PORT)
DEFAULT = "127.0.0.1"
OWN = "127.29.{}.{}"  # where an emulator without an address looks for one
TRIED = 64
CONTROL_PORT = 30090
READY = "ready"
LOCKSTEP_S = 2.0  # where nobody measures real time
START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0


@contextmanager
def take_address(host: str, limit_s: float) -> Iterator[str]:
    """The address, for this process alone; waits for another owner.

    Raises:
        InputError: another process holds it for limit_s.
    """
    with lock_path(host).open("w") as handle:
        until = time.monotonic() + limit_s
        while not _locked(handle):
            if time.monotonic() > until:
                raise InputError(
                    f"Another emulated controller has held the ports of {host} for {limit_s:.0f} s; "
                    "wait for it, stop it, or use another loopback address."
                )
            time.sleep(0.05)
        yield host


@contextmanager
def free_address(ports: Sequence[int]) -> Iterator[str]:
    """The first loopback address that has no owner and on which all these ports are free.

    Raises:
        InputError: a port is taken on every address.
    """
    taken = 0
    for k in range(TRIED):
        host = OWN.format(k // 250, 1 + k % 250)
        with lock_path(host).open("w") as handle:
            if not _locked(handle):
                continue
            taken = first_taken(host, ports)
            if taken:
                continue
            yield host
            return
    raise InputError(
        f"Port {taken} is taken on every loopback address; stop the program that listens on all addresses (0.0.0.0)."
    )


def first_taken(host: str, ports: Sequence[int]) -> int:
    """Return the first of these ports on which something listens at this address; 0 where all are free."""
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                return port
    return 0


def lock_path(host: str) -> Path:
    """Return the file whose lock keeps the ports of one address for one owner."""
    name = f"weldcal-ur-emulator-{os.getuid()}" + ("" if host == DEFAULT else f"-{host}")
    return Path(tempfile.gettempdir()) / f"{name}.lock"


def _locked(handle: IO[str]) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class Emulator:
    """A running emulator and its control channel; one thread at a time may use it."""

    def __init__(self, process: subprocess.Popen[str], host: str, control_port: int) -> None:
        self.process = process
        self.host = host
        self.control_port = control_port
        self._socket = socket.create_connection((host, control_port), timeout=ANSWER_LIMIT_S)
        self._file = self._socket.makefile("rw")

    def ask(self, **request: Any) -> dict[str, Any]:
        """One request, one answer; a check that fails is an answer too.

        Raises:
            InputError: the emulator refuses, or it does not answer any more.
        """
        try:
            self._file.write(json.dumps(request) + "\n")
            self._file.flush()
            line = self._file.readline()
        except OSError as error:
            raise InputError(f"The emulated controller on {self.host} does not answer ({error}).") from error
        if not line:
            raise InputError(f"The emulated controller on {self.host} has ended. {self._last_words()}".rstrip())
        answer: dict[str, Any] = json.loads(line)
        if not answer["ok"] and "check" not in request:
            raise InputError(str(answer["error"]))
        return answer

    def state(self) -> dict[str, Any]:
        """Joint angles, modes, program, registers that matter."""
        return self.ask(ask="state")

    def log(self) -> str:
        """What the controller wrote down."""
        return "\n".join(self.ask(ask="log")["log"])

    def fault(self, name: str, **values: Any) -> float:
        """Injects a fault; its time on the host's monotonic clock."""
        return float(self.ask(fault=name, **values)["time"])

    def do(self, name: str, **values: Any) -> float:
        """Puts something right; its time on the host's monotonic clock."""
        return float(self.ask(do=name, **values)["time"])

    def wait(self, key: str, value: Any, limit_s: float = 5.0) -> dict[str, Any]:
        """The state once `key` has this value.

        Raises:
            InputError: it has another one for limit_s.
        """
        until = time.monotonic() + limit_s
        while (state := self.state())[key] != value:
            if time.monotonic() > until:
                raise InputError(f"{key} is {state[key]!r} after {limit_s} s, not {value!r}.")
            time.sleep(0.01)
        return state

    def leave(self) -> None:
        """Closes the control channel; the process goes on."""
        with suppress(OSError):
            self._file.close()
            self._socket.close()

    def close(self) -> None:
        """Ends the process, whatever it does; may be called again."""
        with suppress(OSError):
            self._socket.close()
        _end(self.process)

    def _last_words(self) -> str:
        if self.process.poll() is None or self.process.stdout is None or self.process.stdout.closed:
            return ""
        return self.process.stdout.read().strip().rpartition("\n")[2]


@contextmanager
def emulator_process(
    *,
    host: str | None = None,
    control_port: int = CONTROL_PORT,
    q: Sequence[float] | None = None,
    wait_for_lock_s: float = 120.0,
    **options: Any,
) -> Iterator[Emulator]:
    """An emulator that listens, under the lock that keeps its address's ports for one owner at a time.

    The child ends with the block, and with this process (`--parent`) where that is killed. It has a session of its own,
    so that Ctrl-C reaches its user and not the controller.

    Args:
        host: the loopback address, each with its own lock; None: one that nobody uses.
        control_port: port of the control channel.
        q: joint angles at the start (6,) (rad); the emulator's home where None.
        wait_for_lock_s: how long to wait for another owner of `host` to finish (s).
        options: polyscope, robot, safety_limits and others of `run_emulator`; one that is None is left out.

    Raises:
        InputError: the lock or a port is taken, or an argument is not one.
    """
    ports = (*PORTS, control_port)
    with take_address(host, wait_for_lock_s) if host is not None else free_address(ports) as address:
        command = [sys.executable, "-m", "weldcal.tools.emulators.ur", "--parent", str(os.getpid()), "--host", address]
        options |= {"control_port": control_port}
        command += [f"--{name.replace('_', '-')}={value}" for name, value in options.items() if value is not None]
        if q is not None:
            command += ["--q", *(repr(float(angle)) for angle in q)]
        emulator = _started(command, address, control_port)
        try:
            yield emulator
        finally:
            emulator.close()


def _started(command: list[str], host: str, control_port: int) -> Emulator:
    process = started(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], START_LIMIT_S)
        line = process.stdout.readline() if ready else ""
        if not line.startswith(READY):
            process.kill()
            words = (line + process.stdout.read()).strip().rpartition("\n")[2]
            raise InputError(words or f"The emulated controller did not start within {START_LIMIT_S:.0f} s.")
        return Emulator(process, host, control_port)
    except BaseException:
        process.kill()
        _end(process)
        raise


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(timeout=3.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
