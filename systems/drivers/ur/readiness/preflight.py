"""Checks before the first motion whether a robot is ready, in the order in which an operator corrects the failures.

Nothing moves, nothing is written, nothing is uploaded: outputs are read, and input registers are claimed and released.
The operator actions use the menu names of the controller's PolyScope, 5 or X.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.faults import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.readiness import operator_actions as actions
from weldcal.systems.drivers.ur.readiness.kinematics_info import (
    KINEMATICS_TOLERANCE_M,
    KINEMATICS_TOLERANCE_RAD,
    KinematicsInfo,
    calibrated_arm,
    cross_check,
    limited_arm,
    model_finding,
    read_kinematics,
)
from weldcal.systems.drivers.ur.readiness.load import (
    GRAVITY_OUTPUT,
    PAYLOAD_OUTPUTS,
    ExpectedLoad,
    mode_finding,
    mounting_finding,
    payload_finding,
)
from weldcal.systems.drivers.ur.wire.robot_api import asker
from weldcal.systems.drivers.ur.wire.rtde_client import (
    DOUBLES,
    IN_USE,
    NOT_FOUND,
    RTDE_PORT,
    SET_POINTS,
    UPPER_OFFSET,
    RtdeProbe,
    Value,
    ranges,
    register_names,
)

POLYSCOPE_X = 10
OLDEST_5, OLDEST_X = (5, 12), (10, 10)


def is_supported(version: tuple[int, ...]) -> bool:
    """Return whether it is PolyScope 5.12 or newer, or PolyScope X 10.10 or newer."""
    return OLDEST_X <= version[:2] < (11, 0) or OLDEST_5 <= version[:2] < (6, 0)


OUTPUTS = (
    "runtime_state",
    "robot_mode",
    "safety_mode",
    "speed_scaling",
    "target_speed_fraction",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "tcp_offset",
)
# Without power there are no joint positions and no kinematics; without a dashboard remote control cannot be checked.
WAITS_FOR = {
    "standstill": ("power",),
    "joint limits": ("power",),
    "kinematics": ("power",),
    "flange pose": ("power", "kinematics"),
    "model": ("program",),
    "operational mode": ("program",),
    "remote control": ("program",),
}


RUNNING, NORMAL, REDUCED, STOPPED = 7, 1, 2, 1
FULL_SPEED = 0.99  # a choice: full but for rounding; a slider at 98 % is reported
TCP_ZERO = 1e-6  # m or rad: rounding; a pendant sets steps of 0.01 mm
LOCAL = "LOCAL"
LIMIT_MARGIN_RAD = float(np.deg2rad(5.0))
REST_RAD_S = 0.005  # a choice: 0.3 deg/s; a jogged arm turns at some deg/s, and twice as much would still find it

CHECKS = (
    "answer",
    "version",
    "safety",
    "power",
    "program",
    "standstill",
    "joint limits",
    "TCP",
    "payload",
    "mounting",
    "speed slider",
    "registers",
    "model",
    "kinematics",
    "flange pose",
    "operational mode",
    "remote control",
)


@dataclass(frozen=True)
class Check:
    """One check: what was found, and the operator action where it failed.

    `checked` is False where an earlier failure prevented the check; then `ok` is False and `operator_action` is empty.
    """

    name: str
    ok: bool
    found: str
    operator_action: str = ""
    checked: bool = True


@dataclass(eq=False, kw_only=True)
class Preflight:
    """All checks, and the values read for them (None where not read).

    ``arm_q`` (6,) rad, tcp_pose and tcp_offset (6,) as x, y, z (m) and a rotation vector (rad), the controller's
    version, the robot's kinematics and the arm with it, the distance of the computed flange pose from the controller's,
    and the register range for the driver.
    """

    host: str
    checks: tuple[Check, ...] = ()
    arm_q: Array | None = None
    tcp_pose: Array | None = None
    tcp_offset: Array | None = None
    version: tuple[int, ...] | None = None
    kinematics: KinematicsInfo | None = None
    arm: ArmModel | None = None
    pose_error_m: float | None = None
    pose_error_rad: float | None = None
    upper_registers: bool = True

    @property
    def ok(self) -> bool:
        """The robot is ready."""
        return all(check.ok for check in self.checks)

    @property
    def first_problem(self) -> Check | None:
        """The first check that failed."""
        return next((check for check in self.checks if check.checked and not check.ok), None)


def preflight(
    host: str,
    *,
    upper_registers: bool | None = None,
    timeout_s: float = 2.0,
    nominal: ArmModel | None = None,
    load: ExpectedLoad | None = None,
    set_points: bool = False,
) -> Preflight:
    """Check the robot at `host` without changing anything on it.

    Args:
        host: name or address of the controller.
        upper_registers: whether the driver will use the registers from 24 on, which fieldbuses do not use; None: it
            will.
        timeout_s: longest time of each request to the controller.
        nominal: the expected arm; a UR10e where None.
        load: the payload that the job needs; shown and not compared where None.
        set_points: whether the driver will also write those of the power source, for which it needs two more registers.

    Raises:
        InputError: the host is empty or not an address. All other problems are failed checks.
    """
    look = _Look(host, timeout_s, nominal or load_arm("ur10e"), load, DOUBLES + (SET_POINTS if set_points else 0))
    look.run(upper_registers)
    return look.report()


def require_ready(report: Preflight) -> None:
    """Raise for a robot that is not ready.

    Raises:
        RobotUnreachable: nothing answers at the address.
        RobotRefused: a check failed; the message is the operator action of the first one.
    """
    problem = report.first_problem
    if problem is not None:
        raise (RobotUnreachable if problem.name == "answer" else RobotRefused)(problem.operator_action)


class _Look:
    """Performs the checks, one method each; each stores its result in `_done`."""

    def __init__(self, host: str, timeout_s: float, nominal: ArmModel, load: ExpectedLoad | None, doubles: int) -> None:
        self._load, self._doubles = load, doubles
        self._found, self._timeout_s, self._nominal = Preflight(host=host), timeout_s, nominal
        self._done: dict[str, Check] = {}
        self._seen: Mapping[str, Value] = {}
        self._whose_limits = "the controller reports none"
        self._dashboard = True

    def report(self) -> Preflight:
        """Return all checks in their order, including those not made."""
        found = self._found
        found.checks = tuple(self._done.get(name) or self._waiting(name) for name in CHECKS)
        found.arm_q, found.tcp_pose, found.tcp_offset = map(self._six, ("actual_q", "actual_TCP_pose", "tcp_offset"))
        return found

    def _waiting(self, name: str) -> Check:
        """Return a check that could not be made, with the check that must pass first."""
        blockers = ("answer", "version", *WAITS_FOR.get(name, ()))
        first = next(blocker for blocker in blockers if blocker in self._done and not self._done[blocker].ok)
        return Check(name, False, f"needs {first}", checked=False)

    def run(self, upper: bool | None) -> None:
        """Make all checks that can be made."""
        self._found.upper_registers = upper is not False
        try:
            claims = self._ask_rtde()
        except RobotUnreachable as problem:
            # any failure here means that the robot does not answer as specified
            self._done.clear()
            self._bad("answer", f"none on port {RTDE_PORT}", str(problem))
            return
        self._ok("answer", f"RTDE on port {RTDE_PORT}")
        if not self._done["version"].ok:
            return
        self._check_registers(claims, self._seen.get(f"input_int_register_{self._offset}"))
        self._check_safety()
        self._check_power()
        self._check_program()
        self._check_tcp()
        self._state("payload", *payload_finding(self._seen, self._load))
        self._state("mounting", *mounting_finding(self._seen, self._nominal.up))
        self._check_speed()
        if self._done["power"].ok:
            self._check_standstill()
            self._check_kinematics()
            self._check_limits()
        self._check_model()
        self._check_remote()

    @property
    def _offset(self) -> int:
        return UPPER_OFFSET if self._found.upper_registers else 0

    def _ask_rtde(self) -> dict[str, str]:
        """Read the values for all checks, and the result of claiming the driver's registers; releases them at once."""
        with RtdeProbe(self._found.host, self._timeout_s) as rtde:
            self._found.version = rtde.version
            if not self._check_version(rtde.version):
                return {}
            claims = rtde.claim(register_names(self._offset, self._doubles))
            self._seen = rtde.read((*OUTPUTS, *PAYLOAD_OUTPUTS, GRAVITY_OUTPUT, f"input_int_register_{self._offset}"))
        if missing := [name for name in OUTPUTS if name not in self._seen]:
            self._bad("version", f"{self._version_text} lacks {', '.join(missing)}", actions.outputs(missing))
        return claims

    def _ok(self, name: str, found: str) -> None:
        self._done[name] = Check(name, True, found)

    def _bad(self, name: str, found: str, action: str) -> None:
        self._done[name] = Check(name, False, found, actions.as_on_x(action) if self._is_x() else action)

    def _state(self, name: str, ok: bool, found: str, action: str) -> None:
        if ok:
            self._ok(name, found)
        else:
            self._bad(name, found, action)

    def _number(self, name: str) -> float:
        return float(cast(float, self._seen[name]))

    def _six(self, name: str) -> Array | None:
        return np.array(self._seen[name], dtype=np.float64) if name in self._seen else None

    @property
    def _version_text(self) -> str:
        return "PolyScope " + ".".join(str(number) for number in (self._found.version or ())[:3])

    @property
    def _readable(self) -> bool:
        """The dashboard, or the Robot API of PolyScope X from 10.12 on, can be asked."""
        return asker(self._found.version or ()) is not None

    def _is_x(self) -> bool:
        return self._found.version is not None and self._found.version[0] >= POLYSCOPE_X

    def _check_version(self, version: tuple[int, ...]) -> bool:
        good = is_supported(version)
        self._state("version", good, self._version_text, actions.VERSION)
        return good

    def _check_safety(self) -> None:
        mode = int(self._number("safety_mode"))
        found = actions.SAFETY_MODES.get(mode, f"mode {mode}")
        if mode == REDUCED:
            found += " (the robot itself limits speed and force)"
        self._state("safety", mode in (NORMAL, REDUCED), found, actions.safety(mode))

    def _check_power(self) -> None:
        mode = int(self._number("robot_mode"))
        self._state("power", mode == RUNNING, actions.ROBOT_MODES.get(mode, f"mode {mode}"), actions.power(mode))

    def _check_program(self) -> None:
        state = int(self._number("runtime_state"))
        found = actions.RUNTIME_STATES.get(state, f"state {state}")
        name = ""
        if self._readable:
            try:
                told, _, name = self._ask("programState").partition(" ")
            except RobotUnreachable as problem:
                self._dashboard = False
                self._bad("program", f"{found}; {self._service} does not answer", str(problem))
                return
            if told in ("PLAYING", "PAUSED", "STOPPED"):
                found = told if state == STOPPED else found
            elif told != LOCAL:
                self._bad("program", f"{self._service} says {told} {name}".strip(), actions.DASHBOARD)
                return
        ready = found == "STOPPED"
        self._state("program", ready, "none runs" if ready else f"{found} {name}".strip(), actions.program(found, name))

    def _check_standstill(self) -> None:
        speed = float(np.abs(self._vector("actual_qd")).max())
        found = "at rest" if speed <= REST_RAD_S else f"a joint turns at {np.rad2deg(speed):.1f} deg/s"
        self._state("standstill", speed <= REST_RAD_S, found, actions.STANDSTILL)

    def _check_limits(self) -> None:
        q, arm = self._vector("actual_q"), self._found.arm or self._nominal
        margin = np.minimum(q - arm.position_lower, arm.position_upper - q)
        worst = int(np.argmin(margin))
        joint = arm.joint_names[worst].removesuffix("_joint").replace("_", " ")
        degrees = np.rad2deg(margin[worst])
        found = f"{joint} {abs(degrees):.0f} deg {'away' if degrees >= 0.0 else 'beyond'}; {self._whose_limits}"
        self._state("joint limits", bool(margin[worst] >= LIMIT_MARGIN_RAD), found, actions.limits(joint))

    def _check_tcp(self) -> None:
        offset = self._vector("tcp_offset")
        zero = bool(np.abs(offset).max() <= TCP_ZERO)
        found = "zero" if zero else f"{_triple(1e3 * offset[:3])} mm, {_triple(np.rad2deg(offset[3:]))} deg"
        self._state("TCP", zero, found, actions.TCP)

    def _check_speed(self) -> None:
        slider, scaling = self._number("target_speed_fraction"), self._number("speed_scaling")
        # the trajectory limiter's value while no program runs is not documented: it is shown here and checked during
        # motion
        found = f"{100 * slider:.0f} %" + (f" (scaling {100 * scaling:.0f} %)" if scaling < FULL_SPEED else "")
        self._state("speed slider", slider >= FULL_SPEED, found, actions.SLIDER)

    def _check_registers(self, claims: Mapping[str, str], command: Value | None) -> None:
        for answer, word, action in (
            (IN_USE, "in use", actions.REGISTERS),
            (NOT_FOUND, "unknown", actions.NO_REGISTERS),
        ):
            if names := [name for name, kind in claims.items() if kind == answer]:
                self._bad("registers", f"{ranges(names)} {word}", action)
                return
        # An old command in the command register does not fail the check: it cannot be cleared at the pendant, the
        # driver clears it, and the guard script ignores all commands until it has read zero there.
        stale = f"; command {command} is left over, the driver clears it" if command else ""
        self._ok("registers", f"{ranges(list(claims))} free{stale}")

    def _check_model(self) -> None:
        """Check that the controller's arm is the scenario's, as far as their names differ."""
        wanted = self._nominal.name
        if self._is_x():
            readable = "PolyScope X names none" if self._readable else "not readable on PolyScope X"
            self._ok("model", f"{readable}; the kinematics tell")
            return
        try:
            told = self._ask("get robot model")
        except RobotUnreachable as problem:
            self._bad("model", "the dashboard does not answer", str(problem))
            return
        self._state("model", *model_finding(told, wanted))

    def _check_kinematics(self) -> None:
        try:
            info, limits = read_kinematics(self._found.host, self._timeout_s)
        except RobotRefused as problem:
            self._bad("kinematics", "not readable on port 30001", str(problem))
            return
        self._found.kinematics = info
        try:
            arm = self._found.arm = limited_arm(calibrated_arm(self._nominal, info), limits)
        except InputError as problem:
            self._bad("kinematics", f"not a {self._nominal.name}'s", str(problem))
            return
        if limits is not None:
            self._whose_limits = "the pendant's may be nearer"  # its safety limits: what is reported may not hold them
        found = "factory calibration" if info.calibrated else "nominal, as URSim or an emulator has it"
        self._ok("kinematics", found)
        pose, offset = self._vector("actual_TCP_pose"), self._vector("tcp_offset")
        error_m, error_rad = cross_check(arm, self._vector("actual_q"), pose, offset)
        self._found.pose_error_m, self._found.pose_error_rad = error_m, error_rad
        agrees = error_m <= KINEMATICS_TOLERANCE_M and error_rad <= KINEMATICS_TOLERANCE_RAD
        found = f"{1e3 * error_m:.3f} mm, {np.rad2deg(error_rad):.4f} deg from the controller's"
        self._state("flange pose", agrees, found, actions.POSE)

    def _check_remote(self) -> None:
        if not self._readable:
            old = "not readable before PolyScope X 10.12"
            self._ok("operational mode", f"{old}; look at the pendant")
            # it has neither dashboard nor Robot API; in local control it ignores scripts, and the driver refuses a
            # guard script that does not start
            self._ok("remote control", f"{old}; checked when the guard script starts")
            return
        if not self._dashboard:
            return
        try:
            told, mode = self._ask("is in remote control"), self._ask("get operational mode")
        except RobotUnreachable as problem:
            for name in ("operational mode", "remote control"):
                self._bad(name, f"{self._service} does not answer", str(problem))
            return
        self._state("operational mode", *mode_finding(mode))
        if told not in ("true", "false", LOCAL):
            self._bad("remote control", f"{self._service} says {told}", actions.DASHBOARD)
            return
        self._state("remote control", told == "true", "on" if told == "true" else "local control", actions.LOCAL)

    @property
    def _service(self) -> str:
        return "the Robot API" if self._is_x() else "the dashboard"

    def _ask(self, command: str) -> str:
        """Return the dashboard's or Robot API's answer; LOCAL where it refuses because the robot is in local control.

        Raises:
            RobotUnreachable: it does not answer in time.
        """
        asks = asker(self._found.version or ())
        assert asks is not None
        answer = asks(self._found.host, command, self._timeout_s)
        return LOCAL if "remote control mode" in answer.lower() else answer

    def _vector(self, name: str) -> Array:
        return np.array(self._seen[name], dtype=np.float64)


def _triple(values: Array) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in values) + ")"
