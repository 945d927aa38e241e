"""The emulator as a process of its own on loopback, one at a time on this machine, and always ended."""

from __future__ import annotations

import fcntl
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

HOST = "127.0.0.1"
CONTROL_PORT = 30090
START_LIMIT_S = 30.0
LOCK_LIMIT_S = 120.0


class Emulator:
    """A running emulator and its control channel."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self._socket = socket.create_connection((HOST, CONTROL_PORT), timeout=10.0)
        self._file = self._socket.makefile("rw")

    def ask(self, **request: Any) -> dict[str, Any]:
        """One request, one answer; fails where the emulator refuses."""
        self._file.write(json.dumps(request) + "\n")
        self._file.flush()
        answer: dict[str, Any] = json.loads(self._file.readline())
        assert answer["ok"] or "check" in request, answer
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

    def wait(self, key: str, value: Any, limit_s: float = 5.0) -> dict[str, Any]:
        """The state once `key` has this value."""
        until = time.monotonic() + limit_s
        while (state := self.state())[key] != value:
            assert time.monotonic() < until, f"{key} is {state[key]!r} after {limit_s} s, not {value!r}"
            time.sleep(0.01)
        return state

    def close(self) -> None:
        """Ends the process, whatever it does."""
        self._socket.close()
        self.process.terminate()
        try:
            self.process.wait(timeout=3.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


@contextmanager
def running_emulator(*arguments: str) -> Iterator[Emulator]:
    """An emulator that listens, under the lock that keeps the ports for one test at a time.

    The process ends with this one (`--parent`), so that a crashed test leaves nothing behind.
    """
    lock = Path(tempfile.gettempdir()) / f"weldcal-ur-emulator-{os.getuid()}.lock"
    with lock.open("w") as handle:
        until = time.monotonic() + LOCK_LIMIT_S
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                assert time.monotonic() < until, f"another test has held the emulator's ports for {LOCK_LIMIT_S} s"
                time.sleep(0.05)
        command = [sys.executable, "-m", "weldcal.tools.ur_emulator", "--parent", str(os.getpid()), *arguments]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        try:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], START_LIMIT_S)
            line = process.stdout.readline() if ready else ""
            assert line.startswith("ready"), f"the emulator did not start within {START_LIMIT_S} s"
            emulator = Emulator(process)
        except BaseException:
            process.kill()
            process.wait()
            raise
        try:
            yield emulator
        finally:
            emulator.close()


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    """A fresh PolyScope 5.21 controller."""
    with running_emulator() as made:
        yield made


def run_client(script: str, limit_s: float = 20.0) -> subprocess.CompletedProcess[str]:
    """Runs Python text that uses ur_rtde's classes in a process of its own: they hold the GIL and may crash."""
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=limit_s, check=False)


def start_client(script: str) -> subprocess.Popen[str]:
    """Like `run_client`, left running."""
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
