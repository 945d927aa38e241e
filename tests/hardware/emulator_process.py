"""The emulator for tests: a fresh controller as a fixture, and ur_rtde's classes in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from weldcal.tools.emulators.ur.process import CONTROL_PORT, LOCKSTEP_S, Emulator, emulator_process

__all__ = ["CONTROL_PORT", "LOCKSTEP_S", "Emulator", "emulator", "emulator_process", "run_client", "start_client"]


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    """A fresh PolyScope 5.21 controller whose time waits for a client that is late."""
    with emulator_process(lockstep=LOCKSTEP_S) as made:
        yield made


def run_client(host: str, script: str, limit_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Runs Python text that uses ur_rtde's classes in a process of its own: they hold the GIL and may crash.

    The text finds `host` in sys.argv[1].
    """
    return subprocess.run(
        [sys.executable, "-c", script, host], capture_output=True, text=True, timeout=limit_s, check=False
    )


def start_client(host: str, script: str, *arguments: str) -> subprocess.Popen[str]:
    """Like `run_client`, left running."""
    return subprocess.Popen([sys.executable, "-c", script, host, *arguments], stdout=subprocess.PIPE, text=True)
