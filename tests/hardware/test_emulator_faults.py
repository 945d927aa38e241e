"""Every fault of the control channel does on the wire what docs/ur_emulator.md says of it."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.hardware.bare_rtde import Rtde
from tests.hardware.emulator_process import Emulator, emulator_process
from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.main import HOME

PORTS = {"rtde": 30004, "script": 30003, "primary": 30001, "secondary": 30002, "dashboard": 29999}
SPEED_RAD_S = 0.1
FRAME_S = 0.002


@pytest.fixture(scope="module")
def process() -> Iterator[Emulator]:
    with emulator_process() as made:
        yield made


@pytest.fixture
def robot(process: Emulator) -> Iterator[Emulator]:
    """The one emulator of this file, at home, healthy and stopped."""
    process.do("recover")
    process.wait("runtime_state", "STOPPED")
    process.do("set_q", q=list(HOME))
    process.do("reset_checker")
    yield process
    process.do("recover")


def connect(robot: Emulator, kind: str) -> socket.socket:
    return socket.create_connection((robot.host, PORTS[kind]), timeout=2.0)


def run(robot: Emulator, script: str) -> None:
    """One program to the secondary port."""
    with connect(robot, "secondary") as port:
        port.sendall(script.encode() + b"\n")
        time.sleep(0.01)


def logged(robot: Emulator, words: str) -> bool:
    """Whether the controller writes this down; what it is sent takes a moment to reach it."""
    until = time.monotonic() + 5.0
    while words not in robot.log() and time.monotonic() < until:
        time.sleep(0.005)
    return words in robot.log()


def least_lag(robot: Emulator, client: Rtde) -> float:
    """How old the newest state is (s), the least of ten: a busy computer only adds to it."""
    lags = []
    for _ in range(10):
        newest = client.during(0.01)[-1]["timestamp"]
        lags.append(robot.state()["timestamp"] - newest)
    return min(lags)


def move(robot: Emulator) -> None:
    """The base turns at a constant speed until somebody stops it."""
    run(robot, f"speedj([{SPEED_RAD_S}, 0, 0, 0, 0, 0], a=10, t=1000)")
    until = time.monotonic() + 2.0
    while robot.state()["qd"][0] < 0.999 * SPEED_RAD_S:
        assert time.monotonic() < until, robot.log()
        time.sleep(0.005)


def at_rest(robot: Emulator, fault_time: float, within: float = 0.1) -> None:
    """Waits as long as the arm may take, then asks the checker."""
    time.sleep(within)
    verdict = robot.ask(check="at_rest_after", fault_time=fault_time, within=within)
    assert verdict["ok"], verdict


# faults of a connection


def test_half_open_says_nothing_hears_nothing_and_does_not_close(robot: Emulator) -> None:
    with Rtde(robot.host) as dead, Rtde(robot.host).watch("input_int_register_20") as alive:
        dead.watch("timestamp")
        assert dead.send(b"I", b"input_int_register_20") == b"\x01INT32"
        robot.fault("half_open", index=0)
        dead.socket.settimeout(0.05)
        with pytest.raises(TimeoutError):  # not a closed connection
            dead.during(1.0)
        dead.put(b"U", struct.pack(">Bi", 1, 77))
        assert {row["input_int_register_20"] for row in alive.during(0.05)} == {0}


def test_partial_writes_tear_packages_and_lose_nothing(robot: Emulator) -> None:
    with Rtde(robot.host) as client:
        client.watch("timestamp", "target_q")
        robot.fault("partial_writes", bytes=7)
        sizes = [len(client.socket.recv(4096)) for _ in range(20)]
        robot.do("clear_links")
        assert any(size % 60 for size in sizes)  # 3 of header, 1 of recipe, 7 x 8: a whole package is 60 bytes
        rest = -sum(sizes) % 60
        client.exactly(rest)
        stamps = [row["timestamp"] for row in client.during(0.05)]
    assert np.diff(stamps) == pytest.approx(FRAME_S)


def test_dropped_packages_leave_a_gap_and_the_connection_stays(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        first = client.next()
        robot.fault("drop", seconds=0.1)
        gaps = np.diff([row["timestamp"] for row in [first, *client.during(0.2)]])
        assert client.send(b"v")[:4] == struct.pack(">I", 5)
    # one gap of the time asked for, to the frame it began and ended in and the lateness of a loaded machine
    assert (gaps > 1.5 * FRAME_S).sum() == 1
    assert gaps.max() == pytest.approx(0.1, abs=0.03)


def test_a_share_of_the_packages_is_lost(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        robot.fault("drop_p", p=0.5)
        client.during(0.02)
        stamps = [client.next()["timestamp"] for _ in range(150)]
    # of 300 packages 150 came, within five standard deviations of the binomial
    assert (stamps[-1] - stamps[0]) / FRAME_S == pytest.approx(300, abs=5 * math.sqrt(300))


def test_delay_makes_packages_late_and_keeps_their_order(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        robot.fault("delay", seconds=0.05, jitter=0.02)
        stamps = [row["timestamp"] for row in client.during(0.15)]
        lag = least_lag(robot, client)
    assert np.diff(stamps) == pytest.approx(FRAME_S)
    assert 0.048 < lag < 0.09  # 50 to 70 ms, a frame of grid, and the moment at which the test asks


def test_a_delay_may_end(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        fault = robot.fault("delay", seconds=0.02, **{"for": 0.05})
        client.during(fault + 0.15 - time.monotonic())
        assert least_lag(robot, client) < 0.015


def test_a_frozen_connection_delivers_everything_afterwards(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        client.next()
        begin = robot.fault("freeze", kind="rtde", seconds=0.1)
        rows, longest, before = [], 0.0, time.monotonic()
        while time.monotonic() < begin + 0.2:
            rows.append(client.next()["timestamp"])
            now = time.monotonic()
            longest, before = max(longest, now - before), now
    assert longest > 0.08
    assert np.diff(rows) == pytest.approx(FRAME_S)


def test_a_frozen_controller_stands_still_with_its_clock(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        first = client.next()["timestamp"]
        begin = time.monotonic()
        robot.fault("freeze", seconds=0.15)
        stamps = [first, *(row["timestamp"] for row in client.during(0.3))]
        elapsed = time.monotonic() - begin
    assert np.diff(stamps) == pytest.approx(FRAME_S)
    assert stamps[-1] - first == pytest.approx(elapsed - 0.15, abs=0.04)


def test_muted_inputs_are_lost(robot: Emulator) -> None:
    with Rtde(robot.host).watch("input_int_register_21") as client:
        client.send(b"I", b"input_int_register_21")
        robot.fault("mute_input", seconds=0.15)
        client.put(b"U", struct.pack(">Bi", 1, 5))
        assert {row["input_int_register_21"] for row in client.during(0.2)} == {0}
        client.put(b"U", struct.pack(">Bi", 1, 6))
        client.until("input_int_register_21", 6)


def test_corrupt_spoils_that_many_packages_and_wrong_size_one_header(robot: Emulator) -> None:
    with Rtde(robot.host) as client:
        client.watch("actual_q")
        good = client.receive(b"U")
        robot.fault("corrupt", n=3)
        until, spoiled = time.monotonic() + 0.1, 0
        while time.monotonic() < until:
            package = client.exactly(3 + len(good))
            spoiled += package[3:] != good
        assert spoiled == 3
        robot.fault("wrong_size")
        sizes = [struct.unpack(">H", client.exactly(3 + len(good))[:2])[0] for _ in range(50)]
    assert sorted(set(sizes)) == [3 + len(good), 3 + len(good) + 5]
    assert sizes.count(3 + len(good) + 5) == 1


@pytest.mark.parametrize("kind", PORTS)
@pytest.mark.parametrize(("fault", "reset"), [("reset_tcp", True), ("close_tcp", False)])
def test_each_connection_can_be_reset_or_closed(robot: Emulator, kind: str, fault: str, reset: bool) -> None:
    with connect(robot, kind) as port, connect(robot, "dashboard" if kind != "dashboard" else "primary") as other:
        while kind not in robot.ask(ask="connections")["connections"]:
            time.sleep(0.005)
        robot.fault(fault, kind=kind)
        ended = contextlib.nullcontext() if not reset else pytest.raises(ConnectionResetError)
        with ended:
            while port.recv(65536):
                pass
        assert other.recv(1)


def test_all_connections_at_once_but_the_control_channel(robot: Emulator) -> None:
    with connect(robot, "rtde"), connect(robot, "script"), connect(robot, "primary"):
        while len(robot.ask(ask="connections")["connections"]) < 3:
            time.sleep(0.005)
        robot.fault("reset_tcp", kind="all")
        assert robot.ask(ask="connections")["connections"] == []


# faults of the robot

# fault, safety mode, its bit and what it implies (7: emergency stop, 10: stopped due to safety), power stays on
SAFETY = [
    ({"name": "protective_stop"}, 3, {2, 10}, True),
    ({"name": "estop"}, 7, {6, 7, 10}, False),
    ({"name": "estop", "system": True}, 6, {5, 7, 10}, False),
    ({"name": "safeguard"}, 5, {4, 10}, True),
    ({"name": "safety_mode", "value": 4}, 4, {3}, True),
    ({"name": "safety_mode", "value": 8}, 8, {8, 10}, False),
    ({"name": "safety_mode", "value": 9}, 9, {9, 10}, False),
]


@pytest.mark.parametrize(("fault", "mode", "bits", "power"), SAFETY)
def test_a_safety_stop_halts_the_arm_and_pauses_its_program(
    robot: Emulator, fault: dict[str, Any], mode: int, bits: set[int], power: bool
) -> None:
    move(robot)
    with Rtde(robot.host).watch("safety_mode", "safety_status_bits", "robot_mode", "runtime_state") as client:
        injected = robot.fault(**fault)
        seen = client.until("safety_mode", mode)
        assert seen["safety_status_bits"] == sum(1 << bit for bit in bits)
        assert seen["robot_mode"] == (7 if power else 3)
        client.until("runtime_state", 4)
    at_rest(robot, injected)


def test_reduced_mode_goes_on_moving(robot: Emulator) -> None:
    move(robot)
    with Rtde(robot.host).watch("safety_mode", "safety_status_bits", "actual_qd") as client:
        robot.fault("reduced", latch=False)
        assert client.until("safety_mode", 2)["safety_status_bits"] == 1 << 1
        assert client.next()["actual_qd"][0] == pytest.approx(SPEED_RAD_S)


@pytest.mark.parametrize("mode", [3, 4, 5, 6])
def test_a_robot_that_is_not_running_has_no_program(robot: Emulator, mode: int) -> None:
    move(robot)
    injected = robot.fault("robot_mode", value=mode)
    with Rtde(robot.host).watch("robot_mode", "runtime_state") as client:
        client.until("robot_mode", mode)
        client.until("runtime_state", 1)
    at_rest(robot, injected)
    run(robot, "movej([0, 0, 0, 0, 0, 0])")
    assert logged(robot, "the robot is not running")


@pytest.mark.parametrize(("fault", "state"), [("stop_program", 1), ("pause_program", 4)])
def test_a_program_that_is_stopped_or_paused_leaves_the_arm_at_rest(robot: Emulator, fault: str, state: int) -> None:
    move(robot)
    injected = robot.fault(fault)
    with Rtde(robot.host).watch("runtime_state") as client:
        client.until("runtime_state", state)
    at_rest(robot, injected)


def test_a_replaced_program_leaves_the_arm_to_one_that_does_not_move_it(robot: Emulator) -> None:
    move(robot)
    injected = robot.fault("replace_program")
    at_rest(robot, injected)
    state = robot.state()
    assert (state["runtime_state"], state["program"]) == ("PLAYING", "foreign")


def test_a_foreign_program_may_hold_the_answer_register(robot: Emulator) -> None:
    script = "def theirs():\nwrite_output_integer_register(0, 1)\nwhile True:\nsync()\nend\nend\n"
    robot.fault("foreign_program", script=script)
    with Rtde(robot.host).watch("runtime_state", "output_int_register_0") as client:
        assert client.until("output_int_register_0", 1)["runtime_state"] == 2


def test_local_mode_ignores_scripts_and_refuses_the_dashboard(robot: Emulator) -> None:
    robot.fault("local_mode")
    run(robot, "movej([0, 0, 0, 0, 0, 0])")
    with connect(robot, "dashboard") as port, port.makefile("rw") as file:
        file.write("is in remote control\nstop\npower off\n")
        file.flush()
        _, remote, stop, power = (file.readline().strip() for _ in range(4))
    assert remote == "false"
    assert stop.startswith("Failed")
    assert power.startswith("Failed")
    assert logged(robot, "local mode")
    assert robot.state()["runtime_state"] == "STOPPED"


def test_the_speed_slider_ramps_and_scales_the_motion(robot: Emulator) -> None:
    move(robot)
    with Rtde(robot.host).watch("timestamp", "speed_scaling", "target_speed_fraction", "actual_qd") as client:
        client.next()
        robot.fault("speed_scaling", value=0.25, ramp=0.1, latch=False)
        rows = client.during(0.2)
    scaling = np.array([row["target_speed_fraction"] for row in rows])
    assert (scaling[0] > 0.9, scaling[-1]) == (True, 0.25)
    assert np.diff([row["timestamp"] for row in rows]) == pytest.approx(FRAME_S)
    # 0.75 over 50 frames, the first of them too
    assert np.diff([1.0, *scaling]).min() == pytest.approx(-0.015)
    assert np.diff(scaling).max() <= 0.0
    assert {row["speed_scaling"] for row in rows} == {1.0}  # the limiter's, in which no controller shows its slider
    assert rows[-1]["actual_qd"][0] == pytest.approx(0.25 * SPEED_RAD_S, rel=1e-3)


def test_the_trajectory_limiter_scales_the_motion_too(robot: Emulator) -> None:
    move(robot)
    robot.fault("speed_scaling", value=0.5, latch=False)
    robot.fault("limiter", value=0.5, latch=False)
    with Rtde(robot.host).watch("speed_scaling", "target_speed_fraction", "actual_qd") as client:
        row = client.during(0.2)[-1]
    assert (row["speed_scaling"], row["target_speed_fraction"]) == (0.5, 0.5)
    assert row["actual_qd"][0] == pytest.approx(0.25 * SPEED_RAD_S, rel=1e-3)


def test_another_client_writes_an_output_in_every_frame_for_a_while(robot: Emulator) -> None:
    robot.fault("replace_program", script="def p():\nwhile True:\nset_standard_digital_out(2, False)\nsync()\nend\nend")
    at = robot.fault("set_digital_out", n=2, on=True, seconds=0.1, latch=False)
    time.sleep(0.25)
    found = robot.ask(check="output_on_after", fault_time=at, output=2)
    assert found["on_s"] == pytest.approx(0.1, abs=0.005)
    assert found["last_on_s"] == pytest.approx(0.1, abs=0.02)
    assert robot.ask(check="output_on_after", fault_time=at, output=5)["last_on_s"] is None


def test_the_clock_may_jump_and_run_fast(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp", "control_step") as client:
        first = client.next()
        robot.fault("timestamp_jump", seconds=-50.0)
        jumps = np.diff([row["timestamp"] for row in [first, *client.during(0.05)]])
        assert jumps.min() == pytest.approx(FRAME_S - 50.0)
        robot.fault("clock_skew", ppm=1000.0)
        client.during(0.02)
        rows = client.during(0.1)
    frames = rows[-1]["control_step"] - rows[0]["control_step"]
    assert rows[-1]["timestamp"] - rows[0]["timestamp"] == pytest.approx(1.001 * FRAME_S * frames, rel=1e-9)


def test_jitter_makes_frames_late_and_the_count_catches_up(robot: Emulator) -> None:
    with Rtde(robot.host).watch("timestamp") as client:
        robot.fault("jitter", seconds=0.02)
        client.next()
        rows = []
        begin = time.monotonic()
        while time.monotonic() < begin + 0.5:
            rows.append((client.next()["timestamp"], time.monotonic()))
    stamps, arrivals = np.array(rows).T
    assert np.diff(stamps) == pytest.approx(FRAME_S)
    assert np.diff(arrivals).max() > 0.01
    assert stamps[-1] - stamps[0] == pytest.approx(arrivals[-1] - arrivals[0], abs=0.06)


def test_a_reboot_takes_the_ports_away_and_forgets(robot: Emulator) -> None:
    with Rtde(robot.host) as client:
        client.watch("timestamp")
        client.send(b"I", b"input_int_register_22")
        client.put(b"U", struct.pack(">Bi", 1, 9))
        robot.fault("reboot", seconds=0.3)
        with pytest.raises(ConnectionError):
            client.during(2.0)
    with pytest.raises(ConnectionRefusedError):
        connect(robot, "rtde")
    until = time.monotonic() + 5.0
    while time.monotonic() < until:
        with contextlib.suppress(ConnectionError), connect(robot, "rtde"):
            break
        time.sleep(0.01)
    with Rtde(robot.host).watch("timestamp", "input_int_register_22", "robot_mode", "runtime_state") as client:
        found = client.next()
    assert found["timestamp"] < 1.0
    assert (found["input_int_register_22"], found["robot_mode"], found["runtime_state"]) == (0, 3, 1)


def test_a_refused_upload_is_dropped_and_a_slow_one_starts_late(robot: Emulator) -> None:
    before = robot.state()["programs_started"]
    robot.fault("refuse_upload")
    run(robot, "def one():\nsync()\nend")
    assert logged(robot, "uploads are refused")
    robot.fault("refuse_upload", on=False)
    robot.fault("slow_start", seconds=0.1)
    begin = robot.state()
    run(robot, "def two():\nwhile True:\nsync()\nend\nend")
    started = robot.wait("runtime_state", "PLAYING")
    assert started["programs_started"] == before + 1
    assert started["timestamp"] - begin["timestamp"] >= 0.1


def test_tracking_lag_trails_the_target_by_speed_times_lag(robot: Emulator) -> None:
    robot.fault("tracking_lag", seconds=0.05)
    move(robot)
    begin = robot.state()["timestamp"]
    while robot.state()["timestamp"] < begin + 0.3:  # six time constants, of the robot's time
        time.sleep(0.01)
    with Rtde(robot.host).watch("target_q", "actual_q") as client:
        row = client.next()
    assert row["target_q"][0] - row["actual_q"][0] == pytest.approx(0.05 * SPEED_RAD_S, rel=0.02)


def test_a_wrong_tcp_is_in_the_pose_and_in_the_offset(robot: Emulator) -> None:
    with Rtde(robot.host).watch("actual_TCP_pose", "tcp_offset") as client:
        before = client.next()["actual_TCP_pose"]
        robot.fault("wrong_tcp", pose=[0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
        after = client.until("tcp_offset", [0.0, 0.0, 0.01, 0.0, 0.0, 0.0])["actual_TCP_pose"]
    assert math.dist(before[:3], after[:3]) == pytest.approx(0.01)
    assert before[3:] == pytest.approx(after[3:])


def test_the_arm_may_be_somewhere_else(robot: Emulator) -> None:
    q = [0.1, -1.0, 1.0, -1.0, -1.0, 0.2]
    robot.fault("set_q", q=q)
    with Rtde(robot.host).watch("actual_q", "actual_qd") as client:
        assert client.until("actual_q", q)["actual_qd"] == [0.0] * 6


def test_an_arm_whose_joints_jump_moves_on_from_there(robot: Emulator) -> None:
    move(robot)
    at = robot.fault("set_q", q=[1.0, *HOME[1:]], latch=False)
    with Rtde(robot.host).watch("actual_q", "actual_qd") as client:
        seen = [row for row in (client.next() for _ in range(20)) if row["actual_q"][0] > 0.99]
    assert [row["actual_qd"][0] for row in seen] == pytest.approx([SPEED_RAD_S] * len(seen))
    assert len(seen) > 10
    assert robot.ask(check="at_rest_after", fault_time=at, within=0.3)["rest_after_s"] is None


def test_tool_contact_is_what_a_script_sees(robot: Emulator) -> None:
    robot.fault("tool_contact", n=7)
    run(robot, "def touch():\nwrite_output_integer_register(3, tool_contact())\nend")
    with Rtde(robot.host).watch("output_int_register_3") as client:
        client.until("output_int_register_3", 7)


@pytest.mark.parametrize(
    ("q", "script", "why"),
    [
        ([6.25, *HOME[1:]], "speedj([0.3, 0, 0, 0, 0, 0], a=10, t=10)", "at its limit"),
        ([0.0, -1.5, 0.02, -1.5, -1.5, 0.0], "speedl([0, 0, 0.05, 0, 0, 0], a=1, t=10)", "singularity"),
        ([*HOME[:4], 0.005, 0.0], "speedl([0, 0.05, 0, 0, 0, 0], a=1, t=10)", "singularity"),
    ],
)
def test_limits_and_singular_poses_are_protective_stops(robot: Emulator, q: list[float], script: str, why: str) -> None:
    robot.fault("set_q", q=q, latch=False)
    with Rtde(robot.host).watch("safety_mode") as client:
        run(robot, script)
        client.until("safety_mode", 3)
    assert why in robot.log()
    robot.wait("runtime_state", "PAUSED")


def test_what_is_not_a_fault_is_refused_with_a_sentence(robot: Emulator) -> None:
    with pytest.raises(InputError, match="choose one of"):
        robot.fault("earthquake")
    with pytest.raises(InputError, match="Give a number as 'seconds'"):
        robot.fault("drop")
    with pytest.raises(InputError, match="Give six numbers as 'q'"):
        robot.fault("set_q", q=[*HOME[:5], None])
