"""The unmodified client classes of ur_rtde against the emulator, each in a process of its own."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.hardware.bare_rtde import Rtde
from tests.hardware.emulator_process import Emulator, emulator, emulator_process, run_client, start_client
from tests.hardware.test_emulator_wire import calibrated, chain, kinematics_of, packages
from tests.ur_rtde import NEEDS_UR_RTDE
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.models.arms.kinematics import forward_kinematics, jacobian, load_arm
from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.main import HOME

__all__ = ["emulator"]
pytestmark = NEEDS_UR_RTDE

SPEED_M_S = 0.02
CONNECT = """
import json, sys, time
import rtde_control, rtde_receive, rtde_io, dashboard_client
HOST = sys.argv[1]
"""
STREAM = (
    CONNECT
    + """
control = rtde_control.RTDEControlInterface(HOST, 500.0)
if {watchdog}: control.setWatchdog({watchdog})
print("moving", flush=True)
while True:
    start = control.initPeriod()
    control.speedL([0.02, 0, 0, 0, 0, 0], 0.5, 0.002)
    control.waitPeriod(start)
"""
)


def moving_client(emulator: Emulator, watchdog: float = 0.0) -> subprocess.Popen[str]:
    """A client that streams 20 mm/s, at full speed."""
    client = start_client(emulator.host, STREAM.format(watchdog=watchdog))
    assert client.stdout is not None
    assert client.stdout.readline() == "moving\n"
    until = time.monotonic() + 5.0
    while emulator.state()["tcp_speed"][0] < 0.99 * SPEED_M_S:
        assert time.monotonic() < until, emulator.log()
        time.sleep(0.01)
    return client


def test_all_four_classes_connect_and_the_arm_goes_where_it_is_told(emulator: Emulator) -> None:
    goal = [0.1, -1.5, 1.5, -1.5, -1.5, 0.1]
    done = run_client(
        emulator.host,
        CONNECT
        + f"""
receive = rtde_receive.RTDEReceiveInterface(HOST)
control = rtde_control.RTDEControlInterface(HOST, 500.0)
io = rtde_io.RTDEIOInterface(HOST)
dashboard = dashboard_client.DashboardClient(HOST)
dashboard.connect()
def once(holds):  # the receiver's thread hears of it in its own time
    until = time.monotonic() + 5.0
    while not holds() and time.monotonic() < until:
        time.sleep(0.01)
out = dict(home=receive.getActualQ(), playing=dashboard.running(), state=dashboard.programState())
out["move_j"] = control.moveJ({goal}, 1.0, 3.0)
once(lambda: max(abs(a - b) for a, b in zip({goal}, receive.getActualQ())) < 1e-12)
out["arrived"] = receive.getActualQ()
pose = receive.getActualTCPPose()
pose[2] += 0.03
out["move_l"] = control.moveL(pose, 0.25, 1.0)
once(lambda: max(abs(a - b) for a, b in zip(pose[:3], receive.getActualTCPPose())) < 1e-9)
out["line_error"] = max(abs(a - b) for a, b in zip(pose[:3], receive.getActualTCPPose()))
for _ in range(100):
    start = control.initPeriod()
    control.speedJ([0.2, 0, 0, 0, 0, -0.2], 4.0, 0.002)
    control.waitPeriod(start)
out["speed_j"] = receive.getActualQd()
out["speed_stop"] = control.speedStop()
q, chase = receive.getActualQ(), []
for i in range(200):
    start = control.initPeriod()
    control.servoJ([q[0] + 0.0002 * i, *q[1:]], 0, 0, 0.002, 0.05, 300)
    chase.append((receive.getTimestamp(), q[0] + 0.0002 * i, receive.getActualQ()[0]))
    control.waitPeriod(start)
out["chase"] = chase
out["servo_stop"] = control.servoStop()
out["tcp"] = (control.setTcp([0, 0, 0.1, 0, 0, 0]), control.getTCPOffset())
found = control.getInverseKinematics(receive.getActualTCPPose())
out["inverse"] = max(abs(a - b) for a, b in zip(found, receive.getActualQ()))
out["io"] = (io.setStandardDigitalOut(3, True), io.setSpeedSlider(0.5))
once(lambda: receive.getDigitalOutState(3) and receive.getTargetSpeedFraction() == 0.5)
out["seen"] = (receive.getDigitalOutState(3), receive.getTargetSpeedFraction())
control.stopScript()
out["stopped"] = dashboard.programState()
print(json.dumps(out), flush=True)
""",
    )
    assert done.returncode == 0, done.stderr + emulator.log()
    out = json.loads(done.stdout.splitlines()[-1])
    assert out["home"] == pytest.approx(HOME)
    assert out["playing"] is True
    assert out["state"] == "PLAYING rtde_control"
    assert out["move_j"] is out["move_l"] is out["speed_stop"] is out["servo_stop"] is True
    assert out["arrived"] == pytest.approx(goal, abs=1e-12)
    assert out["line_error"] < 1e-9
    assert out["speed_j"] == pytest.approx([0.2, 0, 0, 0, 0, -0.2], abs=1e-9)
    # A first-order chase moves by the integral of its distance from the target over its time constant, which is the
    # look-ahead, 0.05 s. Integrated over the robot's time, however late the client looks.
    t, target, q = np.array(out["chase"]).T
    moved = q[-1] - q[0]
    assert moved > 0.01
    assert np.trapezoid(target - q, t) / moved == pytest.approx(0.05, abs=0.01)
    assert out["tcp"] == [True, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]]
    assert out["inverse"] < 1e-8
    assert out["io"] == [True, True]
    assert out["seen"] == [True, 0.5]
    assert out["stopped"].startswith("STOPPED")
    summary = emulator.ask(check="summary")
    assert summary["ok"], summary


@pytest.mark.parametrize("watchdog", [0.0, 20.0])
def test_a_killed_client_leaves_the_arm_moving_unless_it_set_a_watchdog(emulator: Emulator, watchdog: float) -> None:
    client = moving_client(emulator, watchdog)
    fault = emulator.ask(ask="state")["time"]
    client.send_signal(signal.SIGKILL)
    client.wait()
    time.sleep(1.0)
    verdict = emulator.ask(check="at_rest_after", fault_time=fault, within=0.15)
    if watchdog:
        assert verdict["ok"], verdict
        assert verdict["moved_again_s"] is None
        assert emulator.state()["runtime_state"] == "STOPPED"
    else:
        # the time of speedL is no deadman: the stock script repeats its last target for ever
        assert not verdict["ok"]
        assert verdict["rest_after_s"] is None
        assert emulator.state()["tcp_speed"][0] == pytest.approx(SPEED_M_S, rel=1e-3)
        assert emulator.ask(check="summary")["unattended_s"] > 0.5


def test_a_protective_stop_pauses_the_program_and_the_checker_sees_it_go_on(emulator: Emulator) -> None:
    client = moving_client(emulator)
    fault = emulator.fault("protective_stop")
    emulator.wait("runtime_state", "PAUSED")
    client.kill()
    client.wait()
    assert emulator.ask(check="at_rest_after", fault_time=fault, within=0.05)["ok"]
    emulator.ask(do="clear_pstop_timer")
    emulator.ask(do="unlock")
    time.sleep(0.3)  # longer than the checker waits for a client that has just gone
    emulator.ask(do="resume_program")
    time.sleep(0.3)
    # nobody is connected, and the arm moves with what the registers still hold
    assert emulator.ask(ask="connections")["connections"] == []
    verdict = emulator.ask(check="at_rest_after", fault_time=fault, within=0.05)
    assert not verdict["ok"]
    assert verdict["moved_again_s"] is not None
    summary = emulator.ask(check="summary")
    assert summary["moves_after_a_fault"] == 1
    assert summary["moves_without_a_command"] == 1


def lose_connection(emulator: Emulator, fault: str) -> tuple[Any, float] | None:
    """A streaming client loses its connection: itself and when, once the arm moves again; None if it crashed or
    hung."""
    client = moving_client(emulator, watchdog=20.0)
    lost = emulator.fault(fault)
    until = time.monotonic() + 3.0
    while not emulator.ask(check="summary")["moves_after_a_fault"]:
        if client.poll() is not None or time.monotonic() > until:
            client.kill()
            client.wait()
            return None
        time.sleep(0.02)
    return client, lost


@pytest.mark.parametrize("fault", ["reset_tcp", "close_tcp"])
def test_the_stock_client_runs_away_after_a_lost_connection_and_the_checker_says_so(
    emulator: Emulator, fault: str
) -> None:
    # the client reconnects and sends its command again, into a fresh script that has no watchdog any more
    for _ in range(4):
        if (found := lose_connection(emulator, fault)) is not None:
            break
        # now and then it crashes or hangs instead
        emulator.do("recover")
        emulator.wait("runtime_state", "STOPPED")
        emulator.do("reset_checker")
    assert found is not None, emulator.log()
    client, lost = found
    assert emulator.state()["watchdogs"] == []
    client.kill()
    client.wait()
    time.sleep(0.5)
    # it stopped, moved again by itself, and goes on with nobody connected
    verdict = emulator.ask(check="at_rest_after", fault_time=lost, within=0.3)
    assert not verdict["ok"]
    assert verdict["rest_after_s"] < 0.3
    assert verdict["moved_again_s"] is not None
    assert emulator.ask(ask="connections")["connections"] == []
    assert emulator.state()["tcp_speed"][0] == pytest.approx(SPEED_M_S, rel=1e-3)
    summary = emulator.ask(check="summary")
    assert not summary["ok"]
    assert summary["unattended_s"] > 0.0


# what the client's newer versions ask of a script: matrices, which 5.23 and 10.9 brought
MECHANICS = (
    CONNECT
    + """
control = rtde_control.RTDEControlInterface(HOST)
tcp = [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]
out = dict(moved=control.moveJ({goal}, 1.0, 3.0))
if {newer}:
    for name in ("Jacobian", "MassMatrix", "CoriolisAndCentrifugalTorques"):
        get = getattr(control, "get" + name)
        get()
        time.sleep(0.03)  # the client waits for one package only, which may still hold the answer to another question
        out[name] = get()
else:
    for _ in range(100):
        out["pressed"] = control.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -20.0, 0, 0, 0], 2, [0.1] * 6)
        time.sleep(0.005)
    out["ended"] = control.forceModeStop()
out["forward"] = control.getForwardKinematics({goal}, tcp)
control.stopScript()
print(json.dumps(out), flush=True)
"""
)


@pytest.mark.parametrize("version", ["5.12", "5.23", "10.12"])
def test_older_and_newer_controllers_take_the_stock_client(version: str) -> None:
    goal = [0.1, -1.5, 1.5, -1.5, -1.5, 0.1]
    newer = version != "5.12"
    arm = load_arm()
    X_BF = forward_kinematics(arm, goal)
    with emulator_process(polyscope=version) as other:
        plane = X_BF.translation() - [0.0, 0.0, 0.002]
        other.do("contact_plane", point=plane.tolist(), normal=[0.0, 0.0, 1.0], stiffness=4e4)
        done = run_client(other.host, MECHANICS.format(goal=goal, newer=newer))
        assert done.returncode == 0, done.stderr + other.log()
        state = other.state()
    out = json.loads(done.stdout.splitlines()[-1])
    assert out["moved"] is True
    if newer:
        assert state["q"] == pytest.approx(goal, abs=1e-12)
    else:
        # 20 N on 40 N/mm
        assert (out["pressed"], out["ended"]) == (True, True)
        assert state["tcp_pose"][:2] == pytest.approx(plane[:2].tolist(), abs=1e-6)
        assert plane[2] - state["tcp_pose"][2] == pytest.approx(0.0005, abs=1e-5)
    tool = X_BF @ RigidTransform([0.0, 0.0, 0.1])
    assert out["forward"][:3] == pytest.approx(tool.translation(), abs=1e-12)
    if newer:
        J = jacobian(arm, goal)
        # the client hands out columns one after the other
        assert pytest.approx(np.concatenate([J[3:], J[:3]]), abs=1e-12) == np.reshape(out["Jacobian"], (6, 6)).T
        M = np.reshape(out["MassMatrix"], (6, 6))
        assert pytest.approx(M.T, abs=1e-12) == M
        assert np.linalg.eigvalsh(M).min() > 0.0
        assert out["CoriolisAndCentrifugalTorques"] == [0.0] * 6  # at rest


EXTERNAL = (
    CONNECT
    + """
Control = rtde_control.RTDEControlInterface
control = Control(HOST, 500.0, Control.FLAG_USE_EXT_UR_CAP, int(sys.argv[2]))
print(control.moveJ([0.05, -1.57, 1.57, -1.57, -1.57, 0.0], 1.0, 3.0), flush=True)
control.stopScript()
"""
)


def external_client(emulator: Emulator) -> subprocess.Popen[str]:
    """A client for External Control whose script sender listens on a port of its own, and an operator who presses play."""
    with socket.create_server(("", 0)) as free:
        port = free.getsockname()[1]
    client = start_client(emulator.host, EXTERNAL, str(port))
    press_play(emulator, port)
    return client


def press_play(emulator: Emulator, port: int) -> None:
    """What an operator does at the pendant, as soon as the client's script sender listens."""
    until = time.monotonic() + 20.0
    while True:
        try:
            emulator.do("external_control", port=port)
            return
        except InputError:
            assert time.monotonic() < until, "the client's script sender does not listen"
            time.sleep(0.05)


def test_polyscope_x_before_10_10_takes_the_client_through_external_control_only() -> None:
    with emulator_process(polyscope="10.9") as new:
        with socket.create_connection((new.host, 30003), timeout=5.0) as script:
            script.sendall(b"movej([0.05, -1.57, 1.57, -1.57, -1.57, 0.0], a=3, v=1)\n")
            time.sleep(0.05)
        assert "use External Control" in new.log()
        refused = run_client(
            new.host,
            CONNECT
            + """
control = rtde_control.RTDEControlInterface(HOST)
print(control.isConnected(), control.moveJ([0, -1.57, 1.57, -1.57, -1.57, 0.0], 1.0, 3.0), flush=True)
try:
    dashboard_client.DashboardClient(HOST).connect()
except RuntimeError:
    print("no dashboard", flush=True)
""",
        )
        # it connects, uploads nothing and says so by False
        assert refused.stdout == "True False\nno dashboard\n"
        assert new.state()["programs_started"] == 0
        client = external_client(new)
        # the client's script sender does not end by itself
        assert client.stdout is not None
        said = [client.stdout.readline() for _ in range(2)]
        assert said[-1] == "True\n", said
        new.wait("runtime_state", "STOPPED")
        client.kill()
        client.wait()
        assert new.state()["q"][0] == pytest.approx(0.05)


def test_the_clients_script_asks_polyscope_10_7_for_more_than_it_has() -> None:
    with emulator_process(polyscope="10.7") as new:
        client = external_client(new)
        until = time.monotonic() + 5.0
        while "compile_error_name_not_found" not in new.log():
            assert time.monotonic() < until, new.log()
            time.sleep(0.02)
        client.kill()
        client.wait()


def test_on_polyscope_x_the_client_dies_of_a_lost_connection() -> None:
    # its reconnection uses the dashboard client that it has not made; the watchdog of the script stops the arm
    with emulator_process(polyscope="10.12") as new:
        client = moving_client(new, watchdog=20.0)
        lost = new.fault("reset_tcp")
        assert client.wait(timeout=60.0) == -signal.SIGSEGV
        time.sleep(0.2)
        assert new.ask(check="at_rest_after", fault_time=lost, within=0.2)["ok"]
        assert new.state()["runtime_state"] == "STOPPED"


def test_a_calibrated_robot_publishes_the_numbers_of_its_own_pose(tmp_path: Path) -> None:
    with (
        emulator_process(kinematics=calibrated(tmp_path)) as robot,
        Rtde(robot.host).watch("actual_q", "actual_TCP_pose") as rtde,
    ):
        numbers, status = kinematics_of(packages(robot.host, 30001, 2)[1])
        assert status == 2  # calibrated
        assert np.abs(numbers[2, 1:4]).max() > 100.0  # axes that are nearly parallel meet far away
        for q in np.random.default_rng(1).uniform(-2.0, 2.0, (5, 6)):
            robot.do("set_q", q=q.tolist())
            pose = rtde.until("actual_q", q.tolist())["actual_TCP_pose"]
            X = chain(numbers, q)
            # 1e-16 of the hundreds of metres that cancel, with room
            assert pose[:3] == pytest.approx(X[:3, 3], abs=1e-9)
            assert np.abs(exp_rotation(np.array(pose[3:])) - X[:3, :3]).max() < 1e-9
        assert np.linalg.norm(pose[:3] - forward_kinematics(load_arm(), q).translation()) > 1e-4  # not the nominal arm


def test_at_a_fifth_of_the_pace_everything_takes_five_times_as_long() -> None:
    with emulator_process(pace=0.2) as slow:
        begin = slow.state()
        with socket.create_connection((slow.host, 30002), timeout=5.0) as script:
            script.sendall(b"movej([0.05, -1.5707963, 1.5707963, -1.5707963, -1.5707963, 0.0], a=40, v=0.5)\n")
            slow.wait("runtime_state", "PLAYING")
            slow.wait("runtime_state", "STOPPED")
        end = slow.state()
    moved = end["timestamp"] - begin["timestamp"]
    assert moved == pytest.approx(0.2 * (end["time"] - begin["time"]), abs=0.01)
    # 0.05 rad at 0.5 rad/s, two ramps of 12.5 ms, and the frames in which the program starts and ends
    assert 0.1 < moved < 0.15
