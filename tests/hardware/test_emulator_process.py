"""An emulator as a child process: one owner per address, clear refusals, and nothing left behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.process import emulator_process, lock_path

# not the address of the other tests: these want to find it free, and taken by themselves
ALONE = "127.0.0.9"


def test_an_address_has_one_owner_and_the_next_is_told_so() -> None:
    with emulator_process(host=ALONE) as first:
        assert first.state()["runtime_state"] == "STOPPED"
        with (
            pytest.raises(InputError, match=r"has held the ports of 127\.0\.0\.9"),
            emulator_process(host=ALONE, wait_for_lock_s=0.1),
        ):
            pass
    with pytest.raises(InputError, match="has ended"):
        first.state()
    assert lock_path(ALONE) != lock_path("127.0.0.1")


def test_a_taken_port_and_wrong_arguments_are_one_sentence() -> None:
    with (
        socket.create_server((ALONE, 30003)),
        pytest.raises(InputError, match=r"Port 30003 .* is taken"),
        emulator_process(host=ALONE),
    ):
        pass
    for wrong, why in (({"pace": 3.0}, "Give a pace"), ({"polyscope": "7"}, "not a PolyScope version")):
        with pytest.raises(InputError, match=why), emulator_process(host=ALONE, **wrong):  # type: ignore[arg-type]
            pass


def test_the_emulator_ends_with_a_parent_that_is_killed() -> None:
    script = (
        "import os, time\n"
        "from weldcal.tools.emulators.ur.process import emulator_process\n"
        f"with emulator_process(host={ALONE!r}) as made:\n"
        "    print(made.process.pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until = time.monotonic() + 5.0
    while True:
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            break
        with open(f"/proc/{child}/stat") as stat:
            if stat.read().rpartition(")")[2].split()[0] == "Z":
                break
        assert time.monotonic() < until, "the emulator outlives its parent"
        time.sleep(0.05)
    parent.stdout.close()
