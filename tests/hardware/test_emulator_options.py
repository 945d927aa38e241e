"""Options of `emulate-ur`: the start pose, the joint limits that are reported and obeyed, the operational mode."""

from __future__ import annotations

import socket
import struct

import numpy as np
import pytest
from typer.testing import CliRunner

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import RuntimeState, SafetyMode
from weldcal.tools.emulators.ur.main import HOME, narrowed
from weldcal.tools.emulators.ur.process import emulator_process
from weldcal.tools.emulators.ur.versions import parse_version

RANGES = "-90:45,-180:0,0:150,-360:360,-360:360,-10:10"
DEGREES = [(-90.0, 45.0), (-180.0, 0.0), (0.0, 150.0), (-360.0, 360.0), (-360.0, 360.0), (-10.0, 10.0)]
STATE, MASTERBOARD, CONFIGURATION = 16, 3, 6  # package and sub-packages of the primary interface
MODE_FROM_END = 3  # of MasterboardData: the operational mode, then two bytes


def parts(stream: bytes) -> dict[int, bytes]:
    """The bodies of the sub-packages of the first robot state in a stream of the primary port."""
    while True:
        size, kind = struct.unpack_from(">iB", stream)
        package, stream = stream[5:size], stream[size:]
        if kind == STATE:
            break
    found = {}
    while package:
        length, number = struct.unpack_from(">IB", package)
        found[number], package = package[5:length], package[length:]
    return found


def limited() -> Controller:
    """A controller whose last joint may turn by 10 degrees to either side."""
    return Controller(narrowed(load_arm(), RANGES), np.array(HOME), parse_version("5.21"))


def run(made: Controller, body: str, frames: int) -> None:
    """Some frames of a program."""
    assert made.start(f"def go():\n{body}\nend\n")
    for _ in range(frames):
        made.step()


def test_start_pose_limits_and_mode_are_reported_by_the_ports() -> None:
    q = [0.1, -1.2, 1.3, -1.4, -1.5, 0.0]
    with emulator_process(q=q, safety_limits=RANGES, operational_mode="manual") as made:
        assert made.state()["q"] == q
        with socket.create_connection((made.host, 30001), timeout=5.0) as port:
            data = b""
            while len(data) < 2000:
                data += port.recv(4096)
        with socket.create_connection((made.host, 29999), timeout=5.0) as port, port.makefile("rw") as dashboard:
            dashboard.readline()
            dashboard.write("get operational mode\n")
            dashboard.flush()
            assert dashboard.readline().strip() == "MANUAL"
    found = parts(data)
    # UR's client library, ConfigurationData: for each joint its lower and its upper limit, then speeds and
    # accelerations
    limits = np.rad2deg(struct.unpack_from(">12d", found[CONFIGURATION])).reshape(6, 2)
    np.testing.assert_allclose(limits, DEGREES, atol=1e-9)
    assert len(found[CONFIGURATION]) == 8 * (12 + 12 + 5 + 24) + 4 * 4
    assert found[MASTERBOARD][-MODE_FROM_END] == 1


def test_a_target_outside_the_safety_limits_ends_the_program() -> None:
    made = limited()
    run(made, "movej([0, -1.57, 1.57, -1.57, -1.57, 0.2])", 3)
    assert made.program is None
    assert "joint 5 of the target is outside its limits" in made.log[-2]


def test_a_velocity_stops_before_the_safety_limit() -> None:
    made = limited()
    run(made, "speedj([0, 0, 0, 0, 0, 0.5], 5.0, 3.0)", 1000)
    assert made.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert made.runtime_state == RuntimeState.PAUSED
    assert np.deg2rad(9.5) < made.arm.q[5] <= np.deg2rad(10.0)


def test_inverse_kinematics_stays_inside_the_safety_limits() -> None:
    made = limited()
    turned = "movej(get_inverse_kin(pose_trans(get_actual_tcp_pose(), p[0, 0, 0, 0, 0, {}])))"
    run(made, turned.format(0.1), 1000)
    assert made.arm.q[5] == pytest.approx(0.1, abs=1e-6)
    far = limited()
    run(far, "write_output_boolean_register(0, is_within_safety_limits(p[0.5, -0.2, 0.6, 0, 3.14, 0]))", 3)
    pose = "pose_trans(get_actual_tcp_pose(), p[0, 0, 0, 0, 0, 0.5])"
    run(far, f"write_output_boolean_register(0, is_within_safety_limits({pose}))\nsleep(1)", 3)
    assert far.outputs.bits[0] is False
    wide = Controller(load_arm(), np.array(HOME), parse_version("5.21"))
    run(wide, f"write_output_boolean_register(0, is_within_safety_limits({pose}))\nsleep(1)", 3)
    assert wide.outputs.bits[0] is True


@pytest.mark.parametrize(
    "ranges", ["-90:45", "1,2,3,4,5,6", RANGES.replace("-10:10", "10:-10"), RANGES.replace("-10:10", "-10:370"), "a:b"]
)
def test_what_is_no_set_of_joint_ranges_is_one_sentence(ranges: str) -> None:
    with pytest.raises(InputError, match="six joint ranges"):
        narrowed(load_arm(), ranges)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--q", "0", "1", "2", "3", "4", "nan"], "Give six joint angles, in radians"),
        (["--q", "0", "-90", "90", "-90", "-90", "0"], "looks like degrees"),
        (["--safety-limits", "0:1"], "six joint ranges"),
        (["--operational-mode", "sideways"], "Give none, manual or automatic"),
    ],
)
def test_a_wrong_option_of_emulate_ur_is_one_sentence(arguments: list[str], sentence: str) -> None:
    finished = CliRunner().invoke(app, ["emulate-ur", "--host", "127.5.6.7", *arguments])
    assert finished.exit_code == 1
    assert sentence in " ".join(finished.output.split())
