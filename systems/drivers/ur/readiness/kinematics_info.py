"""Read a robot's factory kinematics and joint limits from its primary port, and check them by the flange pose."""

import re
import struct
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, with_link_transforms
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.robots import CONTROLLER_MODELS
from weldcal.systems.drivers.ur.faults import RobotRefused
from weldcal.systems.drivers.ur.readiness import operator_actions as actions
from weldcal.systems.drivers.ur.wire.line import SocketLine

PRIMARY_PORT = 30001
# With the right calibration FK agrees with the controller to 10-20 um; without it, to millimetres.
KINEMATICS_TOLERANCE_M = 5e-5
KINEMATICS_TOLERANCE_RAD = float(np.deg2rad(0.02))

_ROBOT_STATE, _KINEMATICS_INFO, _CONFIGURATION = 16, 5, 6
_ROBOT_MODEL = re.compile(r"\bUR\d+", re.IGNORECASE)
_HEADER, _PART = struct.Struct(">iB"), struct.Struct(">IB")
_BODY = struct.Struct(">6I24dI")
_LIMITS = struct.Struct(">24d")  # at the begin of ConfigurationData, as in UR's client library
_LONGEST_PACKAGE = 1 << 20
# Nominal kinematics has joint axes that are exactly parallel or square; a calibration has none.
_EXACT = 1e-9


@dataclass(frozen=True, eq=False)
class KinematicsInfo:
    """Denavit-Hartenberg numbers (6,) rad and m: link i is RotZ(q_i + theta_i) Tz(d_i) Tx(a_i) RotX(alpha_i).

    `calibrated`: the numbers are a factory calibration of one robot; `checksum` identifies them. Nearly parallel axes
    make d_2 and d_3 hundreds of metres that cancel. Multiply the plain chain, or use `calibrated_arm`, whose link
    frames lie in the links.
    """

    theta: Array
    a: Array
    d: Array
    alpha: Array
    calibrated: bool
    checksum: str


@dataclass(frozen=True, eq=False)
class JointLimits:
    """What the controller reports for its joints, each (6,), rad, rad/s and rad/s^2.

    It is not proven that these are the safety limits that are set on the pendant: those may be narrower.
    """

    lower: Array
    upper: Array
    speed: Array
    acceleration: Array


def read_kinematics(
    host: str, timeout_s: float = 2.0, port: int = PRIMARY_PORT
) -> tuple[KinematicsInfo, JointLimits | None]:
    """Read the kinematics that the controller at `host` computes with, and its joint limits.

    They are in the packages KinematicsInfo and ConfigurationData of the primary port. The limits are None where the
    controller reports none, or numbers that are no limits.

    Raises:
        RobotUnreachable: nothing answers in time, or what answers is not the primary interface.
        RobotRefused: the controller does not report its arm yet, because the arm has no power.
    """
    with SocketLine(host, port, "Primary Client Interface", timeout_s) as line:
        until = line.deadline()
        while True:
            size, kind = _HEADER.unpack(line.read(_HEADER.size, until))
            if not _HEADER.size <= size <= _LONGEST_PACKAGE:
                raise line.nonsense()
            package = line.read(size - _HEADER.size, until)
            if kind == _ROBOT_STATE and (body := _part(package, _KINEMATICS_INFO, line)) is not None:
                if len(body) < _BODY.size:
                    raise line.nonsense()
                return _parse(body), _limits(_part(package, _CONFIGURATION, line))


def _part(package: bytes, wanted: int, line: SocketLine) -> bytes | None:
    """Return the body of one sub-package of a robot state; None where the state does not contain it."""
    at = 0
    while at + _PART.size <= len(package):
        size, kind = _PART.unpack_from(package, at)
        if size < _PART.size:
            raise line.nonsense()
        if kind == wanted:
            return package[at + _PART.size : at + size]
        at += size
    return None


def _parse(body: bytes) -> KinematicsInfo:
    # The status word at the end is not documented; the numbers themselves show whether the arm is calibrated.
    numbers = _BODY.unpack_from(body)
    theta, a, d, alpha = (np.array(numbers[i : i + 6]) for i in range(6, 30, 6))
    for values in (theta, a, d, alpha):
        values.setflags(write=False)
    if not np.isfinite([theta, a, d, alpha]).all() or not (np.any(a) and np.any(d)):
        raise RobotRefused(
            "The controller does not report the arm's kinematics yet: switch the arm on (Initialize at the lower left"
            " of the pendant, ON) and try again."
        )
    square = alpha / (np.pi / 2.0)
    exact = max(np.abs(theta).max(), np.abs(square - np.round(square)).max(), abs(d[1]), abs(d[2]), abs(a[0])) < _EXACT
    checksum = "calib_" + "".join(f"{number:08x}" for number in numbers[:6])
    return KinematicsInfo(theta, a, d, alpha, calibrated=not exact, checksum=checksum)


def _limits(body: bytes | None) -> JointLimits | None:
    if body is None or len(body) < _LIMITS.size:
        return None
    numbers = np.array(_LIMITS.unpack_from(body)).reshape(2, 6, 2)
    lower, upper, speed, acceleration = (numbers[i, :, j] for i in range(2) for j in range(2))
    if not (
        np.isfinite(numbers).all() and (lower < upper).all() and (speed > 0.0).all() and (acceleration > 0.0).all()
    ):
        return None
    return JointLimits(lower, upper, speed, acceleration)


def limited_arm(arm: ArmModel, limits: JointLimits | None) -> ArmModel:
    """Return the arm within its own limits and those that the controller reports; the same where that reports none.

    Raises:
        InputError: the two leave a joint nothing.
    """
    if limits is None:
        return arm
    lower, upper = np.maximum(arm.position_lower, limits.lower), np.minimum(arm.position_upper, limits.upper)
    if (none := np.flatnonzero(lower >= upper)).size:
        raise InputError(
            f"The controller reports limits of {arm.joint_names[none[0]]} that are outside the {arm.name}'s own: "
            f"connect a {arm.name}, or correct the joint limits under Installation > Safety on the pendant."
        )
    speed = np.minimum(arm.velocity_limit, limits.speed)
    return replace(arm, position_lower=lower, position_upper=upper, velocity_limit=speed)


def model_finding(told: str, wanted: str) -> tuple[bool, str, str]:
    """Return whether the controller's name of its arm, such as UR10, fits the scenario's arm.

    What was found; the operator action.
    """
    if not (found := _ROBOT_MODEL.search(told)):
        return True, f"the dashboard says {told!r}; the kinematics tell", ""
    same = found[0].upper() in (CONTROLLER_MODELS[wanted][0], wanted.upper().rstrip("E"))
    return same, found[0] if same else f"{found[0]}, not a {wanted}", actions.model(found[0], wanted)


def calibrated_arm(nominal: ArmModel, info: KinematicsInfo) -> ArmModel:
    """The arm with the robot's own kinematics; its flange is the plain DH chain's, its link frames lie in the links.

    Raises:
        InputError: the kinematics are another arm's, not finite, or end in a bent link, which no UR arm has.
    """
    if not np.isfinite([info.theta, info.a, info.d, info.alpha]).all():
        raise InputError("The controller's kinematics holds numbers that are not finite: restart the control box.")
    if max(abs(info.a[5]), abs(info.alpha[5])) > _EXACT:
        raise InputError(
            "The controller's kinematics has an offset after its last joint: this arm is not supported; "
            f"connect a {nominal.name}."
        )
    stack = np.tile(np.eye(4), (6, 1, 1))
    for i in range(6):
        # Tx(a) RotX(alpha) of the previous link, then Tz(d) RotZ(theta) of this one, which commutes with the joint
        # angle
        a, alpha = (info.a[i - 1], info.alpha[i - 1]) if i else (0.0, 0.0)
        before = RigidTransform(RotationMatrix.MakeXRotation(alpha), [a, 0.0, 0.0])
        turn = RigidTransform(RotationMatrix.MakeZRotation(info.theta[i]), [0.0, 0.0, info.d[i]])
        stack[i] = (before @ turn).GetAsMatrix4()
    calibration = info.checksum if info.calibrated else None
    return with_link_transforms(nominal, stack, calibration, "The robot's kinematics")


def cross_check(arm: ArmModel, q: ArrayLike, tcp_pose: ArrayLike, tcp_offset: ArrayLike) -> tuple[float, float]:
    """Distance of the flange pose computed here at q (6,) rad from the controller's: (m, rad).

    Args:
        arm: the arm in use.
        q: the controller's actual_q.
        tcp_pose: its actual_TCP_pose of the same control step, in B: x, y, z (m) and a rotation vector (rad).
        tcp_offset: its tcp_offset, the TCP in F, likewise.
    """
    X_BF = _pose(tcp_pose) @ _pose(tcp_offset).inverse()
    error = forward_kinematics(arm, q).inverse() @ X_BF
    angle = float(Rotation.from_matrix(error.rotation().matrix()).magnitude())
    return float(np.linalg.norm(error.translation())), angle


def _pose(six: ArrayLike) -> RigidTransform:
    values = np.asarray(six, dtype=np.float64)
    return RigidTransform(RotationMatrix(Rotation.from_rotvec(values[3:]).as_matrix()), values[:3])
