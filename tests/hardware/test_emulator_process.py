"""An emulator as a child process: one owner per address, clear refusals, and nothing left behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext

import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import UrLink
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.run import chosen_robot
from weldcal.tools.emulators.ur import process
from weldcal.tools.emulators.ur.process import PORTS, Emulator, emulator_process, first_taken, free_address, lock_path


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> str:
    """The address that the next emulator of this process would take, away from those that other tests take."""
    monkeypatch.setattr(process, "OWN", f"127.{128 + os.getpid() % 100}.{{}}.{{}}")
    return process.OWN.format(0, 1)


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    with emulator_process() as made:
        yield made


def test_an_address_has_one_owner_and_the_next_is_told_so(emulator: Emulator) -> None:
    with (
        pytest.raises(InputError, match=f"has held the ports of {emulator.host} for"),
        emulator_process(host=emulator.host, wait_for_lock_s=0.1),
    ):
        pass
    assert emulator.state()["runtime_state"] == "STOPPED"
    assert lock_path(emulator.host) != lock_path("127.0.0.1")


def test_without_an_address_every_emulator_gets_one_of_its_own(emulator: Emulator) -> None:
    with emulator_process() as second:
        assert second.host != emulator.host
        second.close()
        with pytest.raises(InputError, match=r"has ended|does not answer"):
            second.state()
    assert emulator.state()["runtime_state"] == "STOPPED"


def test_an_address_on_which_something_listens_is_passed_over(mine: str) -> None:
    with free_address(PORTS) as first:
        assert first == mine
    with socket.create_server((mine, 30004)), emulator_process() as made:
        assert made.host not in (mine, "127.0.0.1")
        assert made.state()["runtime_state"] == "STOPPED"


def test_a_port_that_is_taken_on_every_address_is_one_sentence() -> None:
    with socket.create_server(("0.0.0.0", 0)) as everywhere:
        port = everywhere.getsockname()[1]
        with pytest.raises(InputError, match=f"Port {port} is taken on every loopback address"), free_address((port,)):
            pass


def test_a_listener_on_the_usual_address_is_in_nobodys_way() -> None:
    usual = socket.create_server(("127.0.0.1", 30004)) if not first_taken("127.0.0.1", (30004,)) else nullcontext()
    with usual, emulator_process() as made:
        assert first_taken("127.0.0.1", (30004,)) == 30004
        scenario = load_scenario("straight_groove")
        with chosen_robot("emulated", scenario, dry_run=True) as robot:
            assert robot.prepared is not None
        link = UrLink.start(made.host, load_arm(), UrRtde(host=made.host).limits(load_arm()))
        assert link.state().fault is Fault.NONE
        link.close()


def test_when_a_link_is_closed_its_program_has_ended() -> None:
    """On a controller whose frame takes 40 ms: what runs on afterwards would be nobody's."""
    with emulator_process(pace=0.05) as made:
        config = UrRtde(host=made.host, pace=0.05)
        link = UrLink.start(made.host, load_arm(), config.limits(load_arm()))
        assert made.state()["program"] is not None
        link.close()
        assert made.state()["program"] is None


def test_a_taken_port_and_wrong_arguments_are_one_sentence(mine: str) -> None:
    with (
        socket.create_server((mine, 30003)),
        pytest.raises(InputError, match=r"Port 30003 .* is taken"),
        emulator_process(host=mine),
    ):
        pass
    for wrong, why in (({"pace": 3.0}, "Give a pace"), ({"polyscope": "7"}, "not a PolyScope version")):
        with pytest.raises(InputError, match=why), emulator_process(**wrong):  # type: ignore[arg-type]
            pass


def test_the_emulator_ends_with_a_parent_that_is_killed() -> None:
    script = (
        "import os, time\n"
        "from weldcal.tools.emulators.ur.process import emulator_process\n"
        "with emulator_process() as made:\n"
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
