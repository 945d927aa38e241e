"""Factory kinematics: read off the wire however it comes, turned into an arm that is the plain DH chain, or refused."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, link_frames, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.readiness.kinematics_info import (
    KINEMATICS_TOLERANCE_M,
    KINEMATICS_TOLERANCE_RAD,
    JointLimits,
    KinematicsInfo,
    calibrated_arm,
    cross_check,
    limited_arm,
    read_kinematics,
)

Array = NDArray[np.float64]

ARM = load_arm("ur10e")
D = np.array([0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655])
A = np.array([0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0])
ALPHA = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])
CHECKSUM = (1, 2, 3, 4, 5, 0xFFFFFFFF)


def nominal_info() -> KinematicsInfo:
    return KinematicsInfo(np.zeros(6), A, D, ALPHA, calibrated=False, checksum="")


def factory_info(seed: int = 0) -> KinematicsInfo:
    """What a calibration looks like: fractions of a millimetre and of a milliradian, and axes 2 to 4 nearly parallel.

    The common normals of nearly parallel axes lie hundreds of metres away, so d_2 to d_4 hold lengths that cancel.
    """
    rng = np.random.default_rng(seed)
    theta, a, alpha = rng.normal(0.0, 3e-4, 6), A + rng.normal(0.0, 3e-4, 6), ALPHA + rng.normal(0.0, 5e-4, 6)
    d = D + rng.normal(0.0, 3e-4, 6)
    a[5] = alpha[5] = 0.0
    d[1:4] += [439.0, -446.0, 7.0]
    # 439 m along an axis that is tilted by a microradian end up 0.4 mm aside
    alpha[1:3] = np.array([1e-6, -2e-6])
    theta[1:3] = rng.normal(0.0, 1e-6, 2)
    return KinematicsInfo(theta, a, d, alpha, calibrated=True, checksum="calib_1")


def plain_chain(info: KinematicsInfo, q: Array) -> Array:
    """The product of Denavit and Hartenberg's matrices, in the order RotZ Tz Tx RotX."""
    X = np.eye(4)
    for angle, d, a, alpha in zip(q + info.theta, info.d, info.a, info.alpha, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        X = X @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return X


def body(info: KinematicsInfo) -> bytes:
    numbers = np.concatenate([info.theta, info.a, info.d, info.alpha])
    return struct.pack(">6I24dI", *CHECKSUM, *numbers, 0)


def package(kind: int, content: bytes) -> bytes:
    return struct.pack(">iB", len(content) + 5, kind) + content


def part(kind: int, content: bytes) -> bytes:
    return struct.pack(">IB", len(content) + 5, kind) + content


@contextmanager
def listener(talk: Callable[[socket.socket], object]) -> Iterator[int]:
    """A port on loopback behind which `talk` answers one visitor."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            visitor, _ = server.accept()
            with visitor:
                try:
                    talk(visitor)
                    visitor.settimeout(5.0)
                    visitor.recv(1)  # until the visitor hangs up
                except OSError:
                    pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        thread.join(timeout=6.0)
        assert not thread.is_alive()


@pytest.mark.parametrize("seed", range(5))
def test_the_flange_is_the_plain_chains_and_the_links_stay_where_links_are(seed: int) -> None:
    info = factory_info(seed)
    arm = calibrated_arm(ARM, info)
    for q in np.random.default_rng(seed).uniform(-2 * np.pi, 2 * np.pi, (200, 6)):
        np.testing.assert_allclose(forward_kinematics(arm, q).GetAsMatrix4(), plain_chain(info, q), rtol=0, atol=1e-9)
    for own, nominal in zip(link_frames(arm, np.zeros(6)), link_frames(ARM, np.zeros(6)), strict=True):
        assert np.linalg.norm(own.translation() - nominal.translation()) < 0.01
    assert arm.calibration == "calib_1"


def test_nominal_numbers_give_the_nominal_arm() -> None:
    arm = calibrated_arm(ARM, nominal_info())
    np.testing.assert_allclose(arm.stack, ARM.stack, atol=1e-9)  # the file's angles have ten digits
    assert arm.calibration is None


def test_another_arm_is_refused() -> None:
    # a UR5e: the same angles, shorter links
    d = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
    a = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"mm from a nominal ur10e: connect a ur10e"):
        calibrated_arm(ARM, KinematicsInfo(np.zeros(6), a, d, ALPHA, calibrated=False, checksum=""))


def test_numbers_that_are_none_are_refused_too() -> None:
    info = factory_info()
    theta = info.theta.copy()
    theta[2] = np.nan
    with pytest.raises(InputError, match="not finite"):
        calibrated_arm(ARM, KinematicsInfo(theta, info.a, info.d, info.alpha, calibrated=True, checksum=""))


def test_an_offset_after_the_last_joint_is_refused() -> None:
    a = A.copy()
    a[5] = 0.01
    with pytest.raises(InputError, match="after its last joint"):
        calibrated_arm(ARM, KinematicsInfo(np.zeros(6), a, D, ALPHA, calibrated=True, checksum=""))


def controllers_pose(arm: ArmModel, q: Array, offset: Array) -> Array:
    """actual_TCP_pose as a controller with this arm and TCP would say it."""
    X_BF = forward_kinematics(arm, q)
    turn = Rotation.from_matrix(X_BF.rotation().matrix()) * Rotation.from_rotvec(offset[3:])
    return np.concatenate([X_BF @ offset[:3], turn.as_rotvec()])


def test_the_same_kinematics_agree_under_any_tcp() -> None:
    arm = calibrated_arm(ARM, factory_info())
    rng = np.random.default_rng(1)
    for q in rng.uniform(-np.pi, np.pi, (20, 6)):
        offset = np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, 1.0, 3)])
        error_m, error_rad = cross_check(arm, q, controllers_pose(arm, q, offset), offset)
        assert error_m < 1e-12
        assert error_rad < 1e-7  # the angle of a rotation matrix near identity has half the digits


def test_nominal_kinematics_do_not_pass_for_a_robots_own() -> None:
    robot = calibrated_arm(ARM, factory_info())
    q = np.array([0.3, -1.2, 1.4, -1.7, -1.5, 0.2])
    error_m, _ = cross_check(ARM, q, controllers_pose(robot, q, np.zeros(6)), np.zeros(6))
    assert error_m > 2 * KINEMATICS_TOLERANCE_M


def test_a_tcp_that_the_controller_does_not_tell_is_seen() -> None:
    q = np.array([0.3, -1.2, 1.4, -1.7, -1.5, 0.2])
    offset = np.array([0.0, 0.0, 1e-4, np.deg2rad(0.03), 0.0, 0.0])
    error_m, error_rad = cross_check(ARM, q, controllers_pose(ARM, q, offset), np.zeros(6))
    assert error_m == pytest.approx(1e-4)
    assert error_rad == pytest.approx(np.deg2rad(0.03))
    assert error_m > KINEMATICS_TOLERANCE_M
    assert error_rad > KINEMATICS_TOLERANCE_RAD


def test_the_numbers_come_off_the_wire_unchanged_however_the_bytes_drip() -> None:
    info = factory_info()
    state = package(16, part(0, b"\0" * 20) + part(5, body(info)) + part(6, b"\0" * 9))
    stream = package(20, b"a message") + package(16, part(0, b"\0" * 20)) + state

    def drip(visitor: socket.socket) -> None:
        for i in range(0, len(stream), 7):
            visitor.sendall(stream[i : i + 7])
            time.sleep(0.001)

    with listener(drip) as port:
        read, limits = read_kinematics("127.0.0.1", 2.0, port)
    for name in ("theta", "a", "d", "alpha"):
        np.testing.assert_array_equal(getattr(read, name), getattr(info, name))
    assert limits is None
    assert read.calibrated
    assert read.checksum == "calib_0000000100000002000000030000000400000005ffffffff"


def test_exact_numbers_are_not_called_a_calibration() -> None:
    with listener(lambda visitor: visitor.sendall(package(16, part(5, body(nominal_info()))))) as port:
        assert not read_kinematics("127.0.0.1", 2.0, port)[0].calibrated


NARROW = np.deg2rad([[-90.0, 45.0], [-180.0, 0.0], [0.0, 150.0], [-360.0, 360.0], [-720.0, 720.0], [-10.0, 10.0]])
MOVES = np.array([[1.0, 40.0]] * 6)


def configured(limits: Array, moves: Array = MOVES) -> bytes:
    """ConfigurationData as UR's client library reads it: limits by joint, then speed and acceleration by joint."""
    return struct.pack(">24d", *limits.ravel(), *moves.ravel()) + b"\0" * 256


def read_with(configuration: bytes) -> JointLimits | None:
    state = package(16, part(6, configuration) + part(5, body(nominal_info())))
    with listener(lambda visitor: visitor.sendall(state)) as port:
        return read_kinematics("127.0.0.1", 2.0, port)[1]


def test_planning_stays_within_the_arms_limits_and_the_controllers() -> None:
    arm = limited_arm(ARM, read_with(configured(NARROW)))
    np.testing.assert_allclose(np.rad2deg(arm.position_lower), [-90.0, -180.0, 0.0, -360.0, -360.0, -10.0])
    np.testing.assert_allclose(np.rad2deg(arm.position_upper), [45.0, 0.0, 150.0, 360.0, 360.0, 10.0])
    np.testing.assert_allclose(arm.velocity_limit, 1.0)
    reachable = inverse_kinematics(ARM, forward_kinematics(ARM, [0.1, -1.2, 1.3, -1.4, -1.5, 0.3]))
    assert any(abs(q[5]) > np.deg2rad(10.0) for q in reachable)
    for q in inverse_kinematics(arm, forward_kinematics(ARM, [0.1, -1.2, 1.3, -1.4, -1.5, 0.3])):
        assert np.all((q >= arm.position_lower) & (q <= arm.position_upper))


@pytest.mark.parametrize("numbers", [NARROW * np.nan, NARROW * 0.0, NARROW[:, ::-1]], ids=["nan", "zero", "reversed"])
def test_numbers_that_are_no_limits_are_none(numbers: Array) -> None:
    assert read_with(configured(numbers)) is None
    assert limited_arm(ARM, None) is ARM


def test_limits_of_another_arm_are_refused() -> None:
    far = NARROW.copy()
    far[2] = np.deg2rad([200.0, 300.0])
    with pytest.raises(InputError, match="elbow_joint that are outside the ur10e's own"):
        limited_arm(ARM, read_with(configured(far)))


def test_an_arm_without_power_has_no_kinematics_yet() -> None:
    nothing = KinematicsInfo(np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), calibrated=False, checksum="")
    with (
        listener(lambda visitor: visitor.sendall(package(16, part(5, body(nothing))))) as port,
        pytest.raises(RobotRefused, match="switch the arm on"),
    ):
        read_kinematics("127.0.0.1", 2.0, port)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (b"", "sends no data"),
        (package(20, b"only messages"), "sends no data"),
        (package(16, part(5, body(nominal_info())))[:100], "sends no data"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "not a UR controller"),
        (package(16, part(5, b"too short")), "not a UR controller"),
        (package(16, struct.pack(">IB", 0, 0) * 3), "not a UR controller"),
    ],
)
def test_nonsense_and_silence_end_in_a_sentence_and_in_time(said: bytes, words: str) -> None:
    def talk(visitor: socket.socket) -> None:
        if said:
            visitor.sendall(said)

    with listener(talk) as port, pytest.raises(RobotUnreachable, match=words):
        read_kinematics("127.0.0.1", 0.3, port)


def test_a_controller_that_drips_for_ever_is_left_in_time() -> None:
    def drip(visitor: socket.socket) -> None:
        for _ in range(200):
            visitor.sendall(package(20, b"again"))
            time.sleep(0.01)

    with listener(drip) as port, pytest.raises(RobotUnreachable, match="sends no data"):
        read_kinematics("127.0.0.1", 0.3, port)
