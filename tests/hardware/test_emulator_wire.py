"""The emulator's ports, byte for byte, as the public protocol guides describe them."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.hardware.emulator_process import HOST, Emulator, running_emulator
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.tools.ur_emulator.dh import dh_parameters
from weldcal.tools.ur_emulator.rtde_fields import inputs, outputs


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulator]:
    with running_emulator() as made:
        yield made


class Rtde:
    """A bare RTDE client."""

    def __init__(self, version: int = 2) -> None:
        self.socket = socket.create_connection((HOST, 30004), timeout=5.0)
        assert self.send(b"V", struct.pack(">H", version)) == b"\x01"

    def exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self.socket.recv(count - len(data))
            assert piece, "the controller closed the connection"
            data += piece
        return data

    def receive(self, kind: bytes) -> bytes:
        while True:
            size, found = struct.unpack(">HB", self.exactly(3))
            payload = self.exactly(size - 3)
            if bytes([found]) == kind:
                return payload

    def send(self, kind: bytes, payload: bytes = b"") -> bytes:
        self.put(kind, payload)
        return self.receive(kind)

    def put(self, kind: bytes, payload: bytes = b"") -> None:
        self.socket.sendall(struct.pack(">H", len(payload) + 3) + kind + payload)

    def __enter__(self) -> Rtde:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def test_the_first_words_are_those_of_the_guide(shared: Emulator) -> None:
    with socket.create_connection((HOST, 30004), timeout=5.0) as raw:
        raw.sendall(bytes.fromhex("0005560002"))
        assert raw.recv(16) == bytes.fromhex("00045601")
        raw.sendall(bytes.fromhex("000376"))
        answer = raw.recv(64)
    assert answer[:3] == bytes.fromhex("001376")
    assert struct.unpack(">4I", answer[3:]) == (5, 21, 1, 0)


def test_the_whole_public_table_is_served(shared: Emulator) -> None:
    # 82 values and 2 x 162 registers out, 162 registers and 13 others in, as the guide's newest edition lists them
    assert (len(outputs()), len(inputs())) == (82 + 2 * 162, 162 + 13)
    with Rtde() as client:
        for name, field in outputs().items():
            answer = client.send(b"O", struct.pack(">d", 125.0) + name.encode())
            newer = name == "actual_current_as_torque"  # 5.23
            assert answer[1:].decode() == ("NOT_FOUND" if newer else field.type)
        for name, entry in inputs().items():
            assert client.send(b"I", name.encode())[1:].decode() == entry.type


def test_recipes_take_a_trailing_comma_and_refuse_unknown_names(shared: Emulator) -> None:
    with Rtde() as client:
        assert client.send(b"S") == b"\x00"  # there is nothing to send yet
        good = client.send(b"O", struct.pack(">d", 500.0) + b"timestamp,actual_q,")
        assert good == b"\x01DOUBLE,VECTOR6D"
        assert client.send(b"I", b"input_int_register_3,input_double_register_3,") == b"\x01INT32,DOUBLE"
        assert client.send(b"I", b"input_int_register_4") == b"\x02INT32"
        bad = client.send(b"O", struct.pack(">d", 500.0) + b"timestamp,no_such_name")
        assert bad == b"\x00DOUBLE,NOT_FOUND"
        assert client.send(b"S") == b"\x00"


def test_protocol_1_has_neither_frequency_nor_recipe_number(shared: Emulator) -> None:
    with Rtde(version=1) as client:
        assert client.send(b"O", b"timestamp,robot_mode") == b"DOUBLE,INT32"
        assert client.send(b"S") == b"\x01"
        assert struct.unpack(">di", client.receive(b"U"))[1] == 7


@pytest.mark.parametrize("every", [1, 4, 50])
def test_packages_come_at_an_integer_share_of_500_hz(shared: Emulator, every: int) -> None:
    with Rtde() as client:
        client.send(b"O", struct.pack(">d", 500.0 / every) + b"timestamp")
        client.send(b"S")
        stamps = [struct.unpack(">Bd", client.receive(b"U"))[1] for _ in range(5)]
    assert np.diff(stamps) == pytest.approx([0.002 * every] * 4, abs=1e-9)
    assert stamps[0] > 100.0  # some clients wait until a controller has been on for 40 s


def test_an_input_has_one_owner_and_keeps_its_value_when_the_owner_leaves(shared: Emulator) -> None:
    with Rtde() as first, Rtde() as second:
        assert first.send(b"I", b"input_int_register_7") == b"\x01INT32"
        assert second.send(b"I", b"input_int_register_7,input_int_register_8") == b"\x00IN_USE,INT32"
        assert second.send(b"I", b"input_int_register_8") == b"\x01INT32"
        first.put(b"U", struct.pack(">Bi", 1, -42))
        time.sleep(0.05)
    time.sleep(0.05)
    with Rtde() as third:
        assert third.send(b"I", b"input_int_register_7") == b"\x01INT32"
        third.send(b"O", struct.pack(">d", 125.0) + b"input_int_register_7")
        third.send(b"S")
        assert struct.unpack(">Bi", third.receive(b"U"))[1] == -42


def test_a_register_that_a_fieldbus_holds_is_in_use(shared: Emulator) -> None:
    shared.fault("registers_in_use", names=["input_int_register_11"], latch=False)
    with Rtde() as client:
        assert client.send(b"I", b"input_int_register_11") == b"\x00IN_USE"
        shared.ask(do="registers_free")
        assert client.send(b"I", b"input_int_register_11") == b"\x01INT32"


def dashboard(*commands: str) -> list[str]:
    with socket.create_connection((HOST, 29999), timeout=5.0) as raw, raw.makefile("rw") as file:
        greeting = file.readline()
        assert greeting == "Connected: Universal Robots Dashboard Server\n"
        answers = []
        for command in commands:
            file.write(command + "\n")
            file.flush()
            answers.append(file.readline().rstrip("\n"))
        return answers


def test_the_dashboard_speaks_as_the_manual_says(shared: Emulator) -> None:
    version, model, mode, safety, running, remote, missing, loaded = dashboard(
        *("PolyscopeVersion", "get robot model", "robotmode", "safetymode", "running", "is in remote control"),
        *("load missing.urp", "load cell.urp"),
    )
    assert version.startswith("URSoftware 5.21.1.0 (")
    assert (model, mode, safety) == ("UR10", "Robotmode: RUNNING", "Safetymode: NORMAL")
    assert (running, remote) == ("Program running: false", "true")
    assert missing == "File not found: missing.urp"
    assert loaded.startswith("Loading program: /programs/cell.urp")
    assert dashboard("play", "programState", "pause") == ["Starting program", "PLAYING cell.urp", "Pausing program"]
    shared.wait("runtime_state", "PAUSED")
    assert dashboard("programState", "stop", "quit") == ["PAUSED cell.urp", "Stopped", "Disconnected"]
    shared.wait("runtime_state", "STOPPED")


def test_a_protective_stop_unlocks_only_after_five_seconds(shared: Emulator) -> None:
    shared.fault("protective_stop", latch=False)
    assert dashboard("unlock protective stop", "safetymode") == [
        "Cannot unlock protective stop until 5s after occurrence. "
        "Always inspect cause of protective stop before unlocking",
        "Safetymode: PROTECTIVE_STOP",
    ]
    shared.ask(do="clear_pstop_timer")
    assert dashboard("unlock protective stop", "safetymode") == ["Protective stop releasing", "Safetymode: NORMAL"]


def packages(port: int, count: int) -> list[bytes]:
    with socket.create_connection((HOST, port), timeout=5.0) as raw, raw.makefile("rb") as file:
        found = []
        for _ in range(count):
            (size,) = struct.unpack(">i", file.read(4))
            found.append(file.read(size - 4))
        return found


def kinematics_of(state: bytes) -> tuple[np.ndarray, int]:
    """theta, a, d, alpha (4, 6) and the calibration status in a robot state package."""
    at = 1
    while at < len(state):
        size, kind = struct.unpack_from(">IB", state, at)
        if kind == 5:
            assert size == 225
            numbers = struct.unpack_from(">6I24dI", state, at + 5)
            return np.array(numbers[6:30]).reshape(4, 6), int(numbers[30])
        at += size
    raise AssertionError("no KinematicsInfo in the state")


def chain(dh: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The flange pose by the plain product of Denavit-Hartenberg matrices."""
    X = np.eye(4)
    for theta, a, d, alpha in zip(dh[0] + q, *dh[1:], strict=True):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        X = X @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return X


def test_the_primary_port_says_version_and_kinematics(shared: Emulator) -> None:
    version, state = packages(30001, 2)
    assert (version[0], version[10]) == (20, 3)
    assert version[12:21] == b"URControl"
    assert version[21:23] == bytes([5, 21])
    assert state[0] == 16
    dh, status = kinematics_of(state)
    assert status == 0
    q = np.array([0.3, -1.2, 1.1, -0.4, 0.7, 2.0])
    # the same arm, written twice: equal to rounding of lengths of 1 m
    assert np.abs(chain(dh, q) - forward_kinematics(load_arm(), q).GetAsMatrix4()).max() < 1e-12


def test_the_real_time_port_streams_1220_bytes(shared: Emulator) -> None:
    first, second = packages(30003, 2)
    assert len(first) == 1216
    assert struct.unpack_from(">d", second)[0] - struct.unpack_from(">d", first)[0] == pytest.approx(0.002)
    assert struct.unpack_from(">6d", first, 8) == tuple(shared.state()["q_target"])


def calibrated(folder: Path) -> Path:
    """A factory calibration of the kind a robot has: tenths of a millimetre and of a milliradian, axes not parallel."""
    text = (Path(__file__).parents[2] / "models/arms/ur10e/default_kinematics.yaml").read_text()
    forearm = "x: {}\n    y: 0.0\n    z: 0.0\n    roll: {}"
    text = text.replace(forearm.format("-0.6127", "0.0"), forearm.format("-0.6131", "3e-4"))
    text = text.replace("z: 0.1807", "z: 0.1810")
    path = folder / "calibration.yaml"
    path.write_text(text.replace("kinematics:", "kinematics:\n  hash: calib_1", 1))
    return path


def test_a_calibrated_chain_is_written_as_a_robot_writes_it(tmp_path: Path) -> None:
    arm = load_arm("ur10e", calibrated(tmp_path))
    dh = dh_parameters(arm)
    numbers = np.array([dh.theta, dh.a, dh.d, dh.alpha])
    for q in np.random.default_rng(0).uniform(-3, 3, (20, 6)):
        # rounding of lengths that cancel: 1e-16 of up to 1 km
        assert np.abs(chain(numbers, q) - forward_kinematics(arm, q).GetAsMatrix4()).max() < 1e-9
    assert arm.calibration == "calib_1"
