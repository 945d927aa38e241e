"""The unmodified client classes of ur_rtde against the emulator, each in a process of its own."""

from __future__ import annotations

import json
import signal
import socket
import time

import pytest

from tests.hardware.emulator_process import HOST, Emulator, emulator, run_client, running_emulator, start_client
from weldcal.tools.ur_emulator.main import HOME

__all__ = ["emulator"]

SPEED_M_S = 0.02
CONNECT = """
import json, sys, time
import rtde_control, rtde_receive, rtde_io, dashboard_client
HOST = "127.0.0.1"
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


def moving_client(emulator: Emulator, watchdog: float = 0.0) -> object:
    """A client that streams 20 mm/s, at full speed."""
    client = start_client(STREAM.format(watchdog=watchdog))
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
        CONNECT
        + f"""
receive = rtde_receive.RTDEReceiveInterface(HOST)
control = rtde_control.RTDEControlInterface(HOST, 500.0)
io = rtde_io.RTDEIOInterface(HOST)
dashboard = dashboard_client.DashboardClient(HOST)
dashboard.connect()
out = dict(home=receive.getActualQ(), playing=dashboard.running(), state=dashboard.programState())
out["move_j"] = control.moveJ({goal}, 1.0, 3.0)
time.sleep(0.02)
out["arrived"] = receive.getActualQ()
pose = receive.getActualTCPPose()
pose[2] += 0.03
out["move_l"] = control.moveL(pose, 0.25, 1.0)
time.sleep(0.02)
out["line_error"] = max(abs(a - b) for a, b in zip(pose[:3], receive.getActualTCPPose()))
for _ in range(100):
    start = control.initPeriod()
    control.speedJ([0.2, 0, 0, 0, 0, -0.2], 4.0, 0.002)
    control.waitPeriod(start)
out["speed_j"] = receive.getActualQd()
out["speed_stop"] = control.speedStop()
q = receive.getActualQ()
for i in range(100):
    start = control.initPeriod()
    control.servoJ([q[0] + 0.0002 * i, *q[1:]], 0, 0, 0.002, 0.05, 300)
    control.waitPeriod(start)
out["servo"] = receive.getActualQ()[0] - q[0]
out["servo_stop"] = control.servoStop()
out["tcp"] = (control.setTcp([0, 0, 0.1, 0, 0, 0]), control.getTCPOffset())
found = control.getInverseKinematics(receive.getActualTCPPose())
out["inverse"] = max(abs(a - b) for a, b in zip(found, receive.getActualQ()))
out["io"] = (io.setStandardDigitalOut(3, True), io.setSpeedSlider(0.5))
time.sleep(0.1)
out["seen"] = (receive.getDigitalOutState(3), receive.getTargetSpeedFraction())
control.stopScript()
out["stopped"] = dashboard.programState()
print(json.dumps(out), flush=True)
"""
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
    # the target ran 0.02 rad in 0.2 s; the chase trails by speed times the look-ahead, 0.1 rad/s x 0.05 s
    assert out["servo"] == pytest.approx(0.02 - 0.005, abs=0.002)
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
    client.send_signal(signal.SIGKILL)  # type: ignore[attr-defined]
    client.wait()  # type: ignore[attr-defined]
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
    client.kill()  # type: ignore[attr-defined]
    client.wait()  # type: ignore[attr-defined]
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


def test_polyscope_10_has_no_dashboard_and_its_script_port_moves_the_arm() -> None:
    with running_emulator("--polyscope", "10.7") as new:
        with socket.create_connection((HOST, 30003), timeout=5.0) as script:
            script.sendall(b"movej([0.05, -1.57, 1.57, -1.57, -1.57, 0.0], a=3, v=1)\n")
            new.wait("runtime_state", "PLAYING")
        new.wait("runtime_state", "STOPPED")
        done = run_client(
            CONNECT
            + """
print(rtde_receive.RTDEReceiveInterface(HOST).getActualQ()[0], flush=True)
try:
    dashboard_client.DashboardClient(HOST).connect()
except RuntimeError:
    print("no dashboard", flush=True)
"""
        )
        angle, dashboard = done.stdout.split(maxsplit=1)
        assert float(angle) == pytest.approx(0.05)
        assert dashboard == "no dashboard\n"


def test_polyscope_5_12_takes_the_client_too() -> None:
    with running_emulator("--polyscope", "5.12") as old:
        done = run_client(
            CONNECT
            + "control = rtde_control.RTDEControlInterface(HOST)\nprint(control.isConnected())\ncontrol.stopScript()"
        )
        assert "True" in done.stdout, done.stderr + old.log()
