"""The robot behind the independent controller: joints, program, safety, inputs and outputs, in frames of 2 ms.

Marks: [D] stated in Universal Robots' manuals, [M] a choice of this model, where the manuals are silent.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Generator, Sequence
from typing import Any

from tests.hardware.independent.grammar import ScriptError
from tests.hardware.independent.program import Halt, Pose, Program

STEP_S = 0.002
STOPPING, STOPPED, PLAYING, PAUSING, PAUSED, RESUMING = range(6)
NORMAL, REDUCED, PROTECTIVE, ROBOT_EMERGENCY = 1, 2, 3, 7
POWER_OFF, POWER_ON, IDLE, RUNNING = 3, 4, 5, 7
PROGRAM_STOP, SAFETY_STOP = 8.0, 25.0  # rad/s^2 [M]
UNLOCK_S = 5.0  # [D] dashboard: a protective stop cannot be unlocked earlier
RESUMES_S = 0.020  # [M]
STARTS_S = 0.050  # [M] from the end of a program to the start of the one that replaces it
REGISTERS = 48
HALF_PI = math.pi / 2.0
TURN = 2.0 * math.pi

# UR10e, nominal (Universal Robots, "DH parameters for calculations of kinematics and dynamics")
A = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
D = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
ALPHA = (HALF_PI, 0.0, 0.0, HALF_PI, -HALF_PI, 0.0)
FASTEST = tuple(math.radians(v) for v in (120.0, 120.0, 180.0, 180.0, 180.0, 180.0))
HOME = (0.0, -HALF_PI, HALF_PI, -HALF_PI, -HALF_PI, 0.0)


def flange_pose(q: Sequence[float], tcp: Sequence[float] = (0.0,) * 6) -> list[float]:
    """The pose of the TCP in the base: x, y, z (m) and a rotation vector (rad), from the chain of DH transforms."""
    r = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    p = [0.0, 0.0, 0.0]
    for i in range(6):
        c, s, ca, sa = math.cos(q[i]), math.sin(q[i]), math.cos(ALPHA[i]), math.sin(ALPHA[i])
        x, y, z = A[i] * c, A[i] * s, D[i]
        p = [p[k] + r[k][0] * x + r[k][1] * y + r[k][2] * z for k in range(3)]
        r = [
            [
                row[0] * c + row[1] * s,
                -row[0] * s * ca + row[1] * c * ca + row[2] * sa,
                row[0] * s * sa - row[1] * c * sa + row[2] * ca,
            ]
            for row in r
        ]
    if any(tcp):
        p = [p[k] + sum(r[k][j] * tcp[j] for j in range(3)) for k in range(3)]
        turn = _matrix(tcp[3:])
        r = [[sum(row[k] * turn[k][j] for k in range(3)) for j in range(3)] for row in r]
    return [*p, *_vector(r)]


def _matrix(v: Sequence[float]) -> list[list[float]]:
    """The rotation of a rotation vector (Rodrigues)."""
    angle = math.sqrt(sum(x * x for x in v))
    if angle == 0.0:
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    x, y, z = (c / angle for c in v)
    s, c, t = math.sin(angle), math.cos(angle), 1.0 - math.cos(angle)
    return [
        [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
        [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
        [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
    ]


def _vector(r: list[list[float]]) -> list[float]:
    """The rotation vector of a rotation, by its quaternion (Shepperd)."""
    diagonal = (r[0][0], r[1][1], r[2][2])
    trace = sum(diagonal)
    if trace >= max(diagonal):
        w = 1.0 + trace
        x, y, z = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    else:
        i = diagonal.index(max(diagonal))
        j, k = (i + 1) % 3, (i + 2) % 3
        parts = [0.0, 0.0, 0.0]
        parts[i] = 1.0 + r[i][i] - r[j][j] - r[k][k]
        parts[j], parts[k] = r[i][j] + r[j][i], r[i][k] + r[k][i]
        w, (x, y, z) = r[k][j] - r[j][k], parts
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return [0.0, 0.0, 0.0]
    factor = 2.0 * math.atan2(length, w) / length
    return [factor * x, factor * y, factor * z]


class Machine:
    """The state of the robot; `frame` advances it by one step."""

    def __init__(self, q: Sequence[float] = HOME) -> None:
        self.time = 100.0
        self.q, self.qd = list(q), [0.0] * 6
        self.pose = flange_pose(self.q)
        self.robot_mode, self.safety_mode, self.state = RUNNING, NORMAL, STOPPED
        self.remote = True
        self.slider, self.scaling = 1.0, 1.0
        self.tcp, self.payload, self.cog = [0.0] * 6, 0.0, [0.0] * 3
        self.ints_in, self.ints_out = [0] * REGISTERS, [0] * REGISTERS
        self.floats_in, self.floats_out = [0.0] * REGISTERS, [0.0] * REGISTERS
        self.digital_in, self.digital_out = 0, 0
        self.analog_out, self.analog_volts = [0.0, 0.0], [True, True]
        # choices of the model that a test may vary
        self.keeps_outputs_in_pause = True  # [M] whether a paused program counts as one that runs, for the outputs
        self.starts_s = STARTS_S
        self.target_speeds_late = 0  # [M] frames until get_target_joint_speeds shows a speedj
        self.noise_rad_s = 0.0  # of the joint speeds that are reported
        self.program: Program | None = None
        self.name = ""
        self.programs_started = 0
        self.travel = 0.0  # rad, of the joint that moved most since `mark`
        self.travelled = [0.0] * 6
        self.moved_at = 0.0  # newest time at which the arm moved
        self.log: list[tuple[float, str]] = []
        self._run: Generator[Any, None, None] | None = None
        self._doing: tuple[str, list[float], float, float] | None = None
        self._queued: Program | None = None
        self._braking = PROGRAM_STOP
        self._watchdogs: dict[str, list[Any]] = {}
        self._low_when_stopped: dict[int, int] = {}
        self._analog_low: dict[int, int] = {}
        self._protected_at = -math.inf
        self._past = deque([[0.0] * 6], maxlen=8)  # the target speeds of the last frames
        self._random = random.Random(1)
        self._resumed_at, self._starts_at = 0.0, 0.0

    def note(self, text: str) -> None:
        """Add a line to the log."""
        self.log.append((round(self.time, 3), text))
        del self.log[:-200]

    # the program

    def upload(self, text: str) -> None:
        """What a script port has received: a program, or one of the lines that the pendant's interface takes."""
        if text == "stop program":
            self.stop("by the script port")
            return
        if not self.remote:
            self.note("script ignored: local control")  # [M]
            return
        if self.robot_mode != RUNNING or self.safety_mode not in (NORMAL, REDUCED):
            self.note("script ignored: the arm is not running")
            return
        if not text.lstrip().startswith("def"):
            text = f"def line():\n{text}\nend\n"
        try:
            program = Program(text, self._builtins(), self._blocking())
        except ScriptError as error:
            self.note(f"compile error: {error}")
            return
        if self._run is not None:
            self.stop("replaced by another program")
            self._starts_at = self.time + self.starts_s
        self._queued = program

    def stop(self, why: str) -> None:
        """End the program; the arm slows down. All watchdogs are removed [D]."""
        if self._run is None:
            return
        self.note(f"program {self.name} stopped: {why}")
        self._run, self._doing, self.program = None, None, None
        self._watchdogs.clear()
        self.state, self._braking = STOPPING, PROGRAM_STOP
        self._outputs_low()

    def pause(self, why: str, braking: float = PROGRAM_STOP) -> None:
        """Pause the program; the arm slows down."""
        self._braking = braking
        if self._run is not None and self.state in (PLAYING, RESUMING):
            self.note(f"program paused: {why}")
            self.state = PAUSING
            if not self.keeps_outputs_in_pause:
                self._outputs_low()

    def play(self) -> bool:
        """Go on with a paused program, where the arm is ready."""
        ready = self.robot_mode == RUNNING and self.safety_mode in (NORMAL, REDUCED)
        if self.state != PAUSED or not ready or not self.remote:
            return False
        self.note("program resumed")
        self.state, self._resumed_at = RESUMING, self.time
        for watchdog in self._watchdogs.values():
            watchdog[2] = self.time
        return True

    # the safety system and the pendant

    def protective_stop(self) -> None:
        """A protective stop: it pauses the program."""
        self.safety_mode, self._protected_at = PROTECTIVE, self.time
        self.pause("protective stop", SAFETY_STOP)

    def emergency_stop(self) -> None:
        """An emergency stop: it pauses the program and takes the power."""
        self.safety_mode, self.robot_mode = ROBOT_EMERGENCY, POWER_OFF
        self.pause("emergency stop", SAFETY_STOP)

    def unlock(self, *, at_once: bool = False) -> bool:
        """Unlock a protective stop, which is possible after 5 s."""
        if self.safety_mode != PROTECTIVE or (self.time - self._protected_at < UNLOCK_S and not at_once):
            return False
        self.safety_mode = NORMAL
        return True

    def repair(self) -> None:
        """What an operator does after any stop: unlock, release, power on, release the brakes, slider to 100 %."""
        self.safety_mode, self.robot_mode, self.slider = NORMAL, RUNNING, 1.0

    def measured_speeds(self) -> list[float]:
        """The joint speeds as they are reported."""
        if not self.noise_rad_s:
            return self.qd
        return [v + self._random.gauss(0.0, self.noise_rad_s) for v in self.qd]

    def mark(self) -> None:
        """Count the travel from now on."""
        self.travelled, self.travel = [0.0] * 6, 0.0

    # a frame

    def frame(self) -> None:
        """One step of 2 ms: the program's slice, then the arm."""
        self.time += STEP_S
        if self.state == RESUMING and self.time - self._resumed_at >= RESUMES_S:
            self.state = PLAYING
        if self.state == PLAYING:
            self._watch()
        if self.state == PLAYING:
            self._slice()
        wanted, acceleration = [0.0] * 6, self._braking
        if self.state == PLAYING and self._doing is not None and self._doing[0] == "speedj":
            _, wanted, acceleration, _ = self._doing
        self._move(wanted, acceleration)
        self._past.append(self.qd)
        self._after(wanted)
        if self.state == PAUSING and not any(self.qd):
            self.state = PAUSED
        if self.state == STOPPING and not any(self.qd):
            self.state = STOPPED
        if self.state == STOPPED and self._queued is not None and self.time >= self._starts_at:
            self._start(self._queued)

    def _start(self, program: Program) -> None:
        self._queued = None
        self.program, self.name, self._run, self._doing = program, program.name, program.run(), None
        self.state = PLAYING
        self.programs_started += 1
        self.note(f"program {self.name} started")

    def _slice(self) -> None:
        if self._doing is not None or self._run is None or self.program is None:
            return
        self.program.pause_over()
        try:
            self._doing = next(self._run)
        except (StopIteration, Halt):
            self.stop("its end")
        except ScriptError as error:
            self.stop(f"runtime error: {error}")

    def _move(self, wanted: Sequence[float], acceleration: float) -> None:
        """Accelerate linearly in joint space, the leading axis with `acceleration` [D: speedj]; integrate."""
        share = self.slider * self.scaling
        change = [share * w - v for w, v in zip(wanted, self.qd, strict=True)]
        most = max(map(abs, change))
        if most > acceleration * STEP_S:
            change = [c * acceleration * STEP_S / most for c in change]
            self.qd = [v + c for v, c in zip(self.qd, change, strict=True)]
        else:
            self.qd = [share * w for w in wanted]
        if not any(self.qd):
            return
        self.moved_at = self.time
        self.q = [p + v * STEP_S for p, v in zip(self.q, self.qd, strict=True)]
        self.travelled = [t + abs(v) * STEP_S for t, v in zip(self.travelled, self.qd, strict=True)]
        self.travel = max(self.travelled)
        self.pose = flange_pose(self.q, self.tcp)
        if any(abs(p) > TURN for p in self.q):
            self.note("protective stop: joint position")
            self.protective_stop()
        elif any(abs(v) > 1.001 * limit for v, limit in zip(self.qd, FASTEST, strict=True)):
            self.note("protective stop: joint speed")
            self.protective_stop()

    def _after(self, wanted: Sequence[float]) -> None:
        """Whether what the program does has ended with this frame."""
        if self._doing is None or self.state != PLAYING:
            return
        what, qd, acceleration, left = self._doing
        if math.isnan(left):
            reached = all(abs(v - self.slider * w) < 1e-9 for v, w in zip(self.qd, wanted, strict=True))
            self._doing = None if reached else self._doing
        else:
            left -= STEP_S
            self._doing = (what, qd, acceleration, left) if left > 0.5 * STEP_S else None

    # inputs and outputs

    def fed(self, name: str) -> None:
        """An RTDE input has been written."""
        if name in self._watchdogs:
            self._watchdogs[name][2] = self.time

    def _watch(self) -> None:
        for name, (period, action, fed) in list(self._watchdogs.items()):
            if self.time - fed > period:
                self.note(f"watchdog of {name}: {action}")
                if action == "stop":
                    self.stop("watchdog")
                elif action == "pause":
                    self.pause("watchdog")

    def _outputs_low(self) -> None:
        """The outputs' actions of a program that does not run [D: set_runstate_...: 1 low, 2 high]."""
        for pin, state in self._low_when_stopped.items():
            self.set_digital(pin, state == 2)
        for port, state in self._analog_low.items():
            self.analog_out[port] = 1.0 if state == 2 else 0.0

    def set_digital(self, pin: int, on: bool) -> None:
        """Set a standard digital output."""
        if not 0 <= pin <= 7:
            raise ScriptError(f"there is no standard digital output {pin}")
        self.digital_out = self.digital_out | 1 << pin if on else self.digital_out & ~(1 << pin)

    def set_analog(self, port: int, share: float) -> None:
        """Set a standard analog output to a share of its range."""
        if port not in (0, 1) or not 0.0 <= share <= 1.0:
            raise ScriptError(f"there is no analog output {port} at {share}")
        self.analog_out[port] = float(share)

    def analog_value(self, port: int) -> float:
        """What an analog output shows, V or A."""
        share = self.analog_out[port]
        return 10.0 * share if self.analog_volts[port] else 0.004 + 0.016 * share

    def _speedj(self, qd: list[float], a: float = 1.4, t: float = math.nan) -> tuple[str, list[float], float, float]:
        if len(qd) != 6 or not all(map(math.isfinite, qd)) or not a > 0.0 or not math.isfinite(a):
            raise ScriptError(f"speedj({qd}, {a})")
        return "speedj", list(qd), a, t

    def _blocking(self) -> dict[str, Any]:
        return {
            "speedj": self._speedj,
            "stopj": lambda a: ("speedj", [0.0] * 6, a, math.nan),
            "sync": lambda: ("sync", [], 0.0, 0.0),
            "sleep": lambda t: ("sleep", [], 0.0, t),
        }

    def _builtins(self) -> dict[str, Any]:
        def write(registers: list[Any], kinds: tuple[type, ...]) -> Any:
            def put(i: int, value: Any) -> None:
                if not 0 <= i < REGISTERS or isinstance(value, bool) or not isinstance(value, kinds):
                    raise ScriptError(f"register {i} cannot be {value!r}")
                registers[i] = value

            return put

        def watchdog(name: str, frequency: float, action: str = "pause") -> None:
            if action not in ("ignore", "pause", "stop") or not frequency > 0.0:
                raise ScriptError(f"no such watchdog: {name}, {frequency}, {action}")
            self._watchdogs[name] = [1.0 / frequency, action, self.time]

        def domain(port: int, kind: int) -> None:
            if port not in (0, 1) or kind not in (0, 1):
                raise ScriptError(f"analog output {port} has no domain {kind}")
            self.analog_volts[port] = kind == 1

        def tcp(pose: Any) -> None:
            if not isinstance(pose, Pose) or len(pose) != 6:
                raise ScriptError("set_tcp takes a pose")
            self.tcp = [float(x) for x in pose]
            self.pose = flange_pose(self.q, self.tcp)

        def payload(mass: float, cog: list[float]) -> None:
            if not 0.0 <= mass <= 15.0 or len(cog) != 3:
                raise ScriptError(f"the payload cannot be {mass} kg at {cog}")
            self.payload, self.cog = float(mass), [float(x) for x in cog]

        def digital_action(pin: int, state: int) -> None:
            self._low_when_stopped.pop(pin, None)
            if state in (1, 2):
                self._low_when_stopped[pin] = state

        def analog_action(port: int, state: int) -> None:
            self._analog_low.pop(port, None)
            if state in (1, 2):
                self._analog_low[port] = state

        return {
            "read_input_integer_register": lambda i: self.ints_in[_index(i)],
            "read_input_float_register": lambda i: self.floats_in[_index(i)],
            "write_output_integer_register": write(self.ints_out, (int,)),
            "write_output_float_register": write(self.floats_out, (int, float)),
            "get_target_joint_speeds": lambda: list(self._past[max(-1 - self.target_speeds_late, -len(self._past))]),
            "get_actual_joint_speeds": lambda: list(self.qd),
            "get_actual_joint_positions": lambda: list(self.q),
            "get_target_joint_positions": lambda: list(self.q),
            "get_steptime": lambda: STEP_S,
            "set_tcp": tcp,
            "set_payload": payload,
            "set_standard_digital_out": self.set_digital,
            "set_standard_analog_out": self.set_analog,
            "set_analog_outputdomain": domain,
            "set_runstate_standard_digital_output_to_value": digital_action,
            "set_runstate_standard_analog_output_to_value": analog_action,
            "rtde_set_watchdog": watchdog,
            "textmsg": lambda *words: self.note("message: " + "".join(map(str, words))),
        }


def _index(i: Any) -> int:
    if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < REGISTERS:
        raise ScriptError(f"there is no register {i!r}")
    return i
