"""What weldcal relies on at every UR controller, emulated, simulated or real. The last tests turn wrist 3 by a degree.

`./tools/run test tests/hardware --controller ADDRESS` runs them at a controller that is switched on, in Remote Control
and at rest.
"""

from __future__ import annotations

import re
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from tests.hardware.bare_rtde import Rtde
from tests.places import ROOT
from weldcal.models.arms.kinematics import ArmModel, known_arms, load_arm
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import UrLink
from weldcal.systems.drivers.ur.readiness.preflight import CHECKS, preflight
from weldcal.systems.drivers.ur.rtde import UrRtde

STATE, MESSAGE, KINEMATICS, CONFIGURATION, RUNTIME_EXCEPTION = 16, 20, 5, 6, 10
STOPPED, PLAYING = 1, 2
TURN_RAD_S = 0.05


class Primary:
    """The stream of port 30001."""

    def __init__(self, host: str) -> None:
        self.socket = socket.create_connection((host, 30001), timeout=10.0)
        self._data = b""

    def next(self) -> tuple[int, bytes]:
        """Type and payload of the next package."""
        while len(self._data) < 5 or len(self._data) < struct.unpack_from(">i", self._data)[0]:
            piece = self.socket.recv(65536)
            assert piece, "the controller closed the connection"
            self._data += piece
        size, kind = struct.unpack_from(">iB", self._data)
        payload, self._data = self._data[5:size], self._data[size:]
        return kind, payload

    def part(self, wanted: int) -> bytes:
        """The body of a sub-package of the robot's state."""
        for _ in range(100):
            kind, payload = self.next()
            while kind == STATE and payload:
                size, number = struct.unpack_from(">IB", payload)
                if number == wanted:
                    return payload[5:size]
                payload = payload[size:]
        raise AssertionError(f"no sub-package {wanted}")


@pytest.fixture
def primary(controller_address: str) -> Iterator[Primary]:
    """A connection to the primary port."""
    made = Primary(controller_address)
    with made.socket:
        yield made


@pytest.fixture(scope="module")
def arm(controller_address: str) -> ArmModel:
    """The model whose upper arm and forearm are as long as those that the controller reports."""
    made = Primary(controller_address)
    with made.socket:
        a = struct.unpack_from(">6d", made.part(CONFIGURATION), 8 * 29)
    return min(map(load_arm, known_arms()), key=lambda model: abs(model.dh.a2 - a[1]) + abs(model.dh.a3 - a[2]))


@pytest.fixture
def ready(controller_address: str, arm: ArmModel) -> None:
    """The controller lets a program move its arm."""
    problem = preflight(controller_address, nominal=arm).first_problem
    assert problem is None, f"{problem.name}: {problem.found}. {problem.operator_action}"


def flange(dh: np.ndarray, q: list[float]) -> np.ndarray:
    """The chain RotZ(q + theta) Tz(d) Tx(a) RotX(alpha) of DH rows theta, a, d, alpha."""
    X = np.eye(4)
    for (theta, a, d, alpha), angle in zip(dh.T, q, strict=True):
        c, s, ca, sa = np.cos(angle + theta), np.sin(angle + theta), np.cos(alpha), np.sin(alpha)
        X = X @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return X


def test_states_come_500_times_a_second_and_are_finite(controller_address: str) -> None:
    names = ("timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "speed_scaling", "target_speed_fraction")
    with Rtde(controller_address).watch(*names) as client:
        found = client.during(1.0)
    stamps = np.array([state["timestamp"] for state in found])
    assert np.median(np.diff(stamps)) == pytest.approx(0.002, abs=1e-6)
    assert all(np.isfinite(np.hstack([state[name] for name in names])).all() for state in found)


def test_the_registers_of_the_driver_are_free_and_have_one_owner(controller_address: str) -> None:
    names = ",".join(
        [f"input_int_register_{n}" for n in (24, 25)] + [f"input_double_register_{n}" for n in range(24, 34)]
    )
    with Rtde(controller_address) as first, Rtde(controller_address) as second:
        assert first.send(b"I", names.encode())[1:] == b",".join([b"INT32"] * 2 + [b"DOUBLE"] * 10)
        assert b"IN_USE" in second.send(b"I", names.encode())


def test_joint_limits_are_reported(primary: Primary) -> None:
    body = primary.part(CONFIGURATION)
    limits = np.array(struct.unpack_from(">12d", body)).reshape(6, 2)
    speeds = np.array(struct.unpack_from(">12d", body, 96)).reshape(6, 2)
    assert (limits[:, 0] < limits[:, 1]).all()
    assert (np.abs(limits) <= 2.1 * np.pi).all()
    assert (speeds > 0.0).all()


def test_the_reported_chain_ends_at_the_reported_pose(controller_address: str, primary: Primary) -> None:
    dh = np.array(struct.unpack_from(">24d", primary.part(KINEMATICS), 24)).reshape(4, 6)
    with Rtde(controller_address).watch("actual_q", "actual_TCP_pose", "tcp_offset") as client:
        state = client.next()
    X = flange(dh, state["actual_q"])
    tcp = X[:3, 3] + X[:3, :3] @ np.array(state["tcp_offset"][:3])
    np.testing.assert_allclose(tcp, state["actual_TCP_pose"][:3], atol=1e-4)


def test_the_look_before_a_job_reads_every_line(controller_address: str, arm: ArmModel) -> None:
    report = preflight(controller_address, nominal=arm)
    assert [check.name for check in report.checks] == list(CHECKS)
    assert all(check.checked for check in report.checks), report.first_problem


def test_a_wrong_program_is_a_runtime_exception_and_nothing_ends(controller_address: str, primary: Primary) -> None:
    primary.part(CONFIGURATION)
    primary.socket.sendall(b"def wrong():\n  x = no_such_function_of_ur(1)\nend\n")
    until = time.monotonic() + 10.0
    while True:
        kind, payload = primary.next()
        if kind == MESSAGE and payload[9] == RUNTIME_EXCEPTION:
            break
        assert time.monotonic() < until, "no runtime exception"
    assert b"no_such_function_of_ur" in payload
    with Rtde(controller_address).watch("runtime_state") as client:
        assert client.next()["runtime_state"] == STOPPED


@pytest.mark.usefixtures("ready")
def test_the_guard_starts_turns_a_joint_and_ends(controller_address: str, arm: ArmModel) -> None:
    link = UrLink.start(controller_address, arm, UrRtde(host=controller_address).limits(arm))
    try:
        with Rtde(controller_address).watch("runtime_state", "actual_q", "actual_qd") as client:
            before = client.until("runtime_state", PLAYING)["actual_q"]
            direction = -np.sign(before[5]) or 1.0
            turn, until = TURN_RAD_S * direction * np.eye(6)[5], time.monotonic() + 0.4
            while time.monotonic() < until:
                link.command(turn)
                time.sleep(0.004)
            stop = time.monotonic()
            while time.monotonic() < stop + 0.5:
                link.command(np.zeros(6))
                time.sleep(0.004)
            state = client.during(0.05)[-1]
            travel = (np.array(state["actual_q"]) - before) * direction
            assert 0.005 < travel[5] < 0.03
            np.testing.assert_allclose(travel[:5], 0.0, atol=1e-3)
            np.testing.assert_allclose(state["actual_qd"], 0.0, atol=1e-2)
            assert link.state().fault is Fault.NONE
    finally:
        link.close()
    with Rtde(controller_address).watch("runtime_state") as client:
        client.until("runtime_state", STOPPED)


@pytest.mark.usefixtures("ready")
def test_the_guard_stops_an_arm_whose_client_falls_silent(controller_address: str, arm: ArmModel) -> None:
    link = UrLink.start(controller_address, arm, UrRtde(host=controller_address).limits(arm))
    try:
        with Rtde(controller_address).watch("runtime_state", "actual_q", "actual_qd") as client:
            direction = -np.sign(client.until("runtime_state", PLAYING)["actual_q"][5]) or 1.0
            until = time.monotonic() + 0.3
            while time.monotonic() < until:
                link.command(TURN_RAD_S * direction * np.eye(6)[5])
                time.sleep(0.004)
            states = client.during(0.8)
        assert max(abs(state["actual_qd"][5]) for state in states) > 0.5 * TURN_RAD_S
        np.testing.assert_allclose(states[-1]["actual_qd"], 0.0, atol=1e-2)
        assert link.state().fault is not Fault.NONE
    finally:
        link.close()


def test_at_a_controller_of_a_user_all_other_tests_are_skipped_by_name() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs", "--controller", "127.99.9.9"]
    finished = subprocess.run(
        [*command, "tests/hardware/test_emulator_options.py"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert finished.returncode == 0, finished.stdout
    assert re.search(r"SKIPPED .*test_emulator_options.py.*: injects faults", finished.stdout)
    assert re.fullmatch(r"\d+ skipped in .*", finished.stdout.splitlines()[-1])
