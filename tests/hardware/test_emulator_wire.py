"""The emulator's ports, byte for byte, as the public protocol guides describe them."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.hardware.bare_rtde import Rtde
from tests.hardware.emulator_process import Emulator, emulator_process
from tests.places import ROOT
from weldcal.models.arms.dh import dh_parameters
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.wire.rtde_fields import inputs, outputs


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulator]:
    with emulator_process() as made:
        yield made


def test_the_first_words_are_those_of_the_guide(shared: Emulator) -> None:
    with socket.create_connection((shared.host, 30004), timeout=5.0) as raw:
        raw.sendall(bytes.fromhex("0005560002"))
        assert raw.recv(16) == bytes.fromhex("00045601")
        raw.sendall(bytes.fromhex("000376"))
        answer = raw.recv(64)
    assert answer[:3] == bytes.fromhex("001376")
    assert struct.unpack(">4I", answer[3:]) == (5, 21, 1, 0)


# Universal Robots' RTDE guide and the exhaustive recipe of its client library, by type; registers are counted below.
TABLE = {
    "DOUBLE": """timestamp actual_execution_time target_execution_time speed_scaling target_speed_fraction
        actual_momentum actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0
        standard_analog_input1 standard_analog_output0 standard_analog_output1 io_current actual_robot_energy_consumed
        actual_robot_braking_energy_dissipated euromap67_24V_voltage euromap67_24V_current tool_analog_input0
        tool_analog_input1 tool_output_current tool_temperature tcp_force_scalar joint_position_deviation_ratio
        collision_detection_ratio payload""",
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
        actual_current_window actual_current_as_torque joint_control_output actual_TCP_pose actual_TCP_speed
        actual_TCP_force target_TCP_pose target_TCP_speed tcp_offset actual_TCP_acceleration target_TCP_acceleration
        joint_temperatures actual_joint_voltage ft_raw_wrench wrench_calc_from_currents payload_inertia
        target_base_acceleration target_base_wrench""",
    "VECTOR3D": "actual_tool_accelerometer elbow_position elbow_velocity payload_cog target_gravity",
    "VECTOR6INT32": "joint_mode",
    "INT32": """robot_mode safety_mode safety_status encoder0_raw encoder1_raw tool_output_voltage
        time_scale_source""",
    "UINT32": """runtime_state robot_status_bits safety_status_bits analog_io_types euromap67_input_bits
        euromap67_output_bits tool_mode tool_analog_input_types script_control_line""",
    "UINT64": """actual_digital_input_bits actual_configurable_digital_input_bits actual_digital_output_bits
        actual_configurable_digital_output_bits control_step""",
    "UINT8": "tool_output_mode tool_digital_output0_mode tool_digital_output1_mode",
}
INPUT_TABLE = {
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "UINT32": "speed_slider_mask",
    "UINT8": """standard_digital_output_mask standard_digital_output configurable_digital_output_mask
        configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
    "VECTOR6D": "external_force_torque",
}


def by_name(table: dict[str, str], *banks: str) -> dict[str, str]:
    """Type by name, with the general purpose registers of these banks."""
    types = {name: kind for kind, names in table.items() for name in names.split()}
    for bank in banks:
        types |= {f"{bank}_bit_registers0_to_31": "UINT32", f"{bank}_bit_registers32_to_63": "UINT32"}
        types |= {f"{bank}_bit_register_{i}": "BOOL" for i in range(64, 128)}
        types |= {f"{bank}_{kind}_register_{i}": code for kind, code in REGISTERS.items() for i in range(48)}
    return types


REGISTERS = {"int": "INT32", "double": "DOUBLE"}


def answered(client: Rtde, kind: bytes, names: list[str], head: bytes = b"") -> dict[str, str]:
    """The controller's types of these names, asked for 40 at a time."""
    types: list[str] = []
    for i in range(0, len(names), 40):
        types += client.send(kind, head + ",".join(names[i : i + 40]).encode())[1:].decode().split(",")
    return dict(zip(names, types, strict=True))


def test_the_whole_public_table_is_served(shared: Emulator) -> None:
    out, into = by_name(TABLE, "input", "output"), by_name(INPUT_TABLE, "input")
    assert (len(out), len(into)) == (82 + 2 * 162, 162 + 13)
    assert {name: field.type for name, field in outputs().items()} == out
    assert {name: field.type for name, field in inputs().items()} == into
    with Rtde(shared.host) as client:
        # 5.23 brought one more
        assert answered(client, b"O", list(out), struct.pack(">d", 125.0)) == out | {
            "actual_current_as_torque": "NOT_FOUND"
        }
        assert answered(client, b"I", list(into)) == into


def test_recipes_take_a_trailing_comma_and_refuse_unknown_names(shared: Emulator) -> None:
    with Rtde(shared.host) as client:
        assert client.send(b"S") == b"\x00"  # there is nothing to send yet
        good = client.send(b"O", struct.pack(">d", 500.0) + b"timestamp,actual_q,")
        assert good == b"\x01DOUBLE,VECTOR6D"
        assert client.send(b"I", b"input_int_register_3,input_double_register_3,") == b"\x01INT32,DOUBLE"
        assert client.send(b"I", b"input_int_register_4") == b"\x02INT32"
        bad = client.send(b"O", struct.pack(">d", 500.0) + b"timestamp,no_such_name")
        assert bad == b"\x00DOUBLE,NOT_FOUND"
        assert client.send(b"S") == b"\x00"


def test_protocol_1_has_neither_frequency_nor_recipe_number(shared: Emulator) -> None:
    with Rtde(shared.host, version=1) as client:
        assert client.send(b"O", b"timestamp,robot_mode") == b"DOUBLE,INT32"
        assert client.send(b"S") == b"\x01"
        assert struct.unpack(">di", client.receive(b"U"))[1] == 7


@pytest.mark.parametrize("every", [1, 4, 50])
def test_packages_come_at_an_integer_share_of_500_hz(shared: Emulator, every: int) -> None:
    with Rtde(shared.host) as client:
        client.send(b"O", struct.pack(">d", 500.0 / every) + b"timestamp")
        client.send(b"S")
        stamps = [struct.unpack(">Bd", client.receive(b"U"))[1] for _ in range(5)]
    assert np.diff(stamps) == pytest.approx([0.002 * every] * 4, abs=1e-9)
    assert stamps[0] > 100.0  # some clients wait until a controller has been on for 40 s


def test_an_input_has_one_owner_and_keeps_its_value_when_the_owner_leaves(shared: Emulator) -> None:
    with Rtde(shared.host) as first, Rtde(shared.host) as second:
        assert first.send(b"I", b"input_int_register_7") == b"\x01INT32"
        assert second.send(b"I", b"input_int_register_7,input_int_register_8") == b"\x00IN_USE,INT32"
        assert second.send(b"I", b"input_int_register_8") == b"\x01INT32"
        first.put(b"U", struct.pack(">Bi", 1, -42))
    with Rtde(shared.host) as third:
        until = time.monotonic() + 5.0  # the controller hears in its own time that the owner has gone
        while (answer := third.send(b"I", b"input_int_register_7")) != b"\x01INT32" and time.monotonic() < until:
            time.sleep(0.01)
        assert answer == b"\x01INT32"
        third.send(b"O", struct.pack(">d", 125.0) + b"input_int_register_7")
        third.send(b"S")
        assert struct.unpack(">Bi", third.receive(b"U"))[1] == -42


def test_a_register_that_a_fieldbus_holds_is_in_use(shared: Emulator) -> None:
    shared.fault("registers_in_use", names=["input_int_register_11"], latch=False)
    with Rtde(shared.host) as client:
        assert client.send(b"I", b"input_int_register_11") == b"\x00IN_USE"
        shared.ask(do="registers_free")
        assert client.send(b"I", b"input_int_register_11") == b"\x01INT32"


def dashboard(robot: Emulator, *commands: str) -> list[str]:
    with socket.create_connection((robot.host, 29999), timeout=5.0) as raw, raw.makefile("rw") as file:
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
        shared,
        *("PolyscopeVersion", "get robot model", "robotmode", "safetymode", "running", "is in remote control"),
        *("load missing.urp", "load cell.urp"),
    )
    assert version.startswith("URSoftware 5.21.1.0 (")
    assert (model, mode, safety) == ("UR10", "Robotmode: RUNNING", "Safetymode: NORMAL")
    assert (running, remote) == ("Program running: false", "true")
    assert missing == "File not found: missing.urp"
    assert loaded.startswith("Loading program: /programs/cell.urp")
    assert dashboard(shared, "play", "programState", "pause") == [
        "Starting program",
        "PLAYING cell.urp",
        "Pausing program",
    ]
    shared.wait("runtime_state", "PAUSED")
    assert dashboard(shared, "programState", "stop", "quit") == ["PAUSED cell.urp", "Stopped", "Disconnected"]
    shared.wait("runtime_state", "STOPPED")


def test_a_protective_stop_unlocks_only_after_five_seconds(shared: Emulator) -> None:
    shared.fault("protective_stop", latch=False)
    assert dashboard(shared, "unlock protective stop", "safetymode") == [
        "Cannot unlock protective stop until 5s after occurrence. "
        "Always inspect cause of protective stop before unlocking",
        "Safetymode: PROTECTIVE_STOP",
    ]
    shared.ask(do="clear_pstop_timer")
    assert dashboard(shared, "unlock protective stop", "safetymode") == [
        "Protective stop releasing",
        "Safetymode: NORMAL",
    ]


def packages(host: str, port: int, count: int) -> list[bytes]:
    with socket.create_connection((host, port), timeout=5.0) as raw, raw.makefile("rb") as file:
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
    version, state = packages(shared.host, 30001, 2)
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
    first, second = packages(shared.host, 30003, 2)
    assert len(first) == 1216
    assert struct.unpack_from(">d", second)[0] - struct.unpack_from(">d", first)[0] == pytest.approx(0.002)
    assert struct.unpack_from(">6d", first, 8) == tuple(shared.state()["q_target"])


def calibrated(folder: Path) -> Path:
    """A factory calibration of the kind a robot has: tenths of a millimetre and of a milliradian, axes not parallel."""
    text = (ROOT / "models/arms/ur10e/default_kinematics.yaml").read_text()
    changes = {
        "z: 0.1807": "z: 0.1810",
        "x: -0.6127\n    y: 0.0\n    z: 0.0\n    roll: 0.0\n    pitch: 0.0\n    yaw: 0.0": (
            "x: -0.6131\n    y: 2e-4\n    z: 1e-4\n    roll: 3e-4\n    pitch: -1.2e-3\n    yaw: 4e-4"
        ),
        "z: 0.17415\n    roll: 0.0\n    pitch: 0.0": "z: 0.1743\n    roll: -5e-4\n    pitch: 2e-4",
        "y: -0.11985\n    z: 0.0\n    roll: 1.5707963267948966\n    pitch: 0.0": (
            "y: -0.1199\n    z: 1e-4\n    roll: 1.5712\n    pitch: 3e-4"
        ),
    }
    for nominal, robots in changes.items():
        assert text.count(nominal) == 1
        text = text.replace(nominal, robots)
    path = folder / "calibration.yaml"
    path.write_text(text.replace("kinematics:", "kinematics:\n  hash: calib_1", 1))
    return path


def test_a_calibrated_chain_is_written_as_a_robot_writes_it(tmp_path: Path) -> None:
    arm = load_arm("ur10e", calibrated(tmp_path))
    numbers = dh_parameters(arm).T[[3, 0, 2, 1]]  # theta, a, d, alpha
    assert np.abs(numbers[2, 1:4]).max() > 100.0
    for q in np.random.default_rng(0).uniform(-3, 3, (20, 6)):
        # rounding of lengths that cancel: 1e-16 of up to 1 km
        assert np.abs(chain(numbers, q) - forward_kinematics(arm, q).GetAsMatrix4()).max() < 1e-9
    assert arm.calibration == "calib_1"


def test_nominal_numbers_come_out_as_they_are_published() -> None:
    half = np.pi / 2.0
    assert dh_parameters(load_arm()).T[[3, 0, 2, 1]] == pytest.approx(
        np.array(
            [
                [0.0] * 6,
                [0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0],
                [0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655],
                [half, 0.0, 0.0, half, -half, 0.0],
            ]
        ),
        abs=1e-12,
    )


def test_a_first_axis_that_is_not_the_bases_cannot_be_said(tmp_path: Path) -> None:
    tilted = calibrated(tmp_path)
    tilted.write_text(tilted.read_text().replace("z: 0.1810\n    roll: 0.0", "z: 0.1810\n    roll: 1e-4"))
    with pytest.raises(InputError, match="first joint"):
        dh_parameters(load_arm("ur10e", tilted))


def test_idle_connections_keep_no_client_away_and_end_nothing(shared: Emulator) -> None:
    client = Rtde(shared.host).watch("timestamp", hz=125.0)
    with client.socket, contextlib.ExitStack() as idle:
        for port in (29999, 30001, 30002, 30003, 30004):
            for _ in range(60):
                with contextlib.suppress(OSError):
                    idle.enter_context(socket.create_connection((shared.host, port), timeout=0.2))
        late = socket.create_connection((shared.host, 30004), timeout=5.0)
        late.sendall(bytes.fromhex("0005560002"))
        late.settimeout(5.0)
        assert late.recv(16) == bytes.fromhex("00045601")
        assert client.during(0.1), "a client that has asked for something stays"
        late.close()


def test_a_plane_and_a_hand_are_put_on_the_control_channel(shared: Emulator) -> None:
    height = shared.state()["tcp_pose"][2]
    shared.do("contact_plane", point=[0.0, 0.0, height + 0.001], normal=[0.0, 0.0, 2.0], stiffness=1000.0)
    shared.do("push", wrench=[2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    felt = Rtde(shared.host).watch("actual_TCP_force").next()["actual_TCP_force"]
    assert felt == pytest.approx([2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="stiffness from 0 to"):
        shared.do("contact_plane", point=[0.0] * 3, normal=[0.0, 0.0, 1.0], stiffness=1e9)
    shared.do("recover")
