"""The state of the emulated controller: power, safety, arm, registers and clock, without programs."""

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.arm import ElasticContact, EmulatedArm, ForceSensor
from weldcal.tools.emulators.ur.controller.motions import STEP_S
from weldcal.tools.emulators.ur.controller.registers import (
    MOVING,
    POWERLESS,
    ErrorCode,
    Event,
    Payload,
    Registers,
    RobotMode,
    RuntimeState,
    SafetyChanged,
    SafetyMode,
    Terminals,
    Watchdog,
)
from weldcal.tools.emulators.ur.versions import Version

START_TIMESTAMP_S = 100.0  # a controller has been on for a while; some clients wait for more than 40 s
UNLOCK_AFTER_S = 5.0
# "A protective stop was triggered", and the level of such a report
PROTECTIVE_STOP_CODE, WARNING = 209, 2
POWER_STEP_S = 0.5  # [M] how long power on and brake release take


class ControllerState:
    """What scripts read and change. Times count in frames of 2 ms."""

    def __init__(self, model: ArmModel, q: NDArray[np.float64], version: Version) -> None:
        self.version = version
        self.arm = EmulatedArm(model, q)
        self.arm.touch = self.touch
        self.inputs, self.outputs, self.terminals = Registers(), Registers(), Terminals()
        self.surroundings, self.sensor = ElasticContact(), ForceSensor()
        self.force_gain_scaling = 1.0
        self.gravity = [0.0, 0.0, 9.82]
        self.random = np.random.default_rng(0)  # of the script's random(): the same row after every start
        self.tcp_offset = [0.0] * 6
        self.payload = Payload(1.4, [0.03, 0.0, 0.05], [0.0] * 6)  # [M] of the installation: the welding tool's
        self.operational_mode = "NONE"
        self.tool_contact_steps = 0
        self.frame = 0
        self.timestamp = START_TIMESTAMP_S
        self.clock_rate = 1.0
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.runtime_state = RuntimeState.STOPPED
        self.remote = True
        self.refuse_upload = False
        self.start_delay_s = 0.0
        self.watchdogs: dict[str, Watchdog] = {}
        self.log: deque[str] = deque(maxlen=200)
        self.events: deque[Event] = deque(maxlen=200)
        self.popup_open = False
        self.protective_since = -(10**9)
        self._later: list[tuple[int, Callable[[], object]]] = []

    @property
    def time_s(self) -> float:
        """Seconds since start, by the count of frames."""
        return self.frame * STEP_S

    @property
    def speed_scaling(self) -> float:
        """Share of the commanded speed that the trajectory limiter lets through; the slider is not in it."""
        return self.terminals.limiter

    @property
    def motion_scaling(self) -> float:
        """Share of the commanded speed that the arm gets: the slider's times the limiter's."""
        return self.terminals.speed_slider * self.terminals.limiter

    @property
    def ready(self) -> bool:
        """The arm has power and no safety stop is active."""
        return self.robot_mode == RobotMode.RUNNING and self.safety_mode in MOVING

    def note(self, text: str) -> None:
        """Writes to the log."""
        self.log.append(f"{self.time_s:.3f} {text}")

    def tell(self, event: Event) -> None:
        """Lets the clients of the primary port know."""
        self.events.append(event)

    def later(self, seconds: float, action: Callable[[], object]) -> None:
        """Does something after some time."""
        self._later.append((self.frame + round(seconds / STEP_S), action))

    def pause_program(self) -> None:
        """Pause the program and brake the arm on its path; `resume_program` continues from there."""
        if self.runtime_state in (RuntimeState.PLAYING, RuntimeState.RESUMING):
            self.runtime_state = RuntimeState.PAUSING

    def protective_stop(self, reason: str, code: int = PROTECTIVE_STOP_CODE) -> None:
        """The arm brakes and the program pauses until it is unlocked; `code` is the number of the report."""
        if self.safety_mode in MOVING:
            self.tell(ErrorCode(code, 0, WARNING, reason))
            self.set_safety_mode(SafetyMode.PROTECTIVE_STOP)
            self.note(f"protective stop: {reason}")

    def set_safety_mode(self, mode: SafetyMode) -> None:
        """What the safety system would do; modes that stop also pause the program."""
        if mode != self.safety_mode:
            self.tell(SafetyChanged(int(mode)))
        self.safety_mode = mode
        if mode == SafetyMode.PROTECTIVE_STOP:
            self.protective_since = self.frame
        if mode not in MOVING:
            self.pause_program()
        if mode in POWERLESS:
            self.robot_mode = RobotMode.POWER_OFF
        self.note(f"safety mode {mode.name}")

    def unlock_protective_stop(self, *, at_once: bool = False) -> bool:
        """Only a protective stop that is at least 5 s old unlocks, unless it is asked for on the primary port."""
        if self.safety_mode != SafetyMode.PROTECTIVE_STOP:
            return True
        if not at_once and (self.frame - self.protective_since) * STEP_S < UNLOCK_AFTER_S:
            return False
        self.set_safety_mode(SafetyMode.NORMAL)
        return True

    def power_on(self) -> None:
        """POWER_OFF -> POWER_ON -> IDLE."""
        if self.robot_mode == RobotMode.POWER_OFF and self.safety_mode not in POWERLESS:
            self.robot_mode = RobotMode.POWER_ON
            self.later(POWER_STEP_S, lambda: self._advance(RobotMode.POWER_ON, RobotMode.IDLE))

    def release_brakes(self) -> None:
        """IDLE -> RUNNING."""
        if self.robot_mode == RobotMode.IDLE:
            self.later(POWER_STEP_S, lambda: self._advance(RobotMode.IDLE, RobotMode.RUNNING))
        elif self.robot_mode == RobotMode.POWER_OFF:
            self.power_on()
            self.later(POWER_STEP_S + STEP_S, self.release_brakes)

    def _advance(self, before: RobotMode, after: RobotMode) -> None:
        if self.robot_mode == before:
            self.robot_mode = after

    def written(self, names: tuple[str, ...]) -> None:
        """Inputs arrived: those with a watchdog have been fed."""
        for name in names:
            if name in self.watchdogs:
                self.watchdogs[name].fed_at = self.frame

    def set_tcp(self, pose: list[float]) -> None:
        """The tool centre point in the flange frame."""
        self.tcp_offset = [float(value) for value in pose]
        self.arm.set_tcp(self.tcp_offset)

    def touch(self) -> Array:
        """Return the wrench on the tool centre point in base axes, from the surroundings or from a client's sensor."""
        if self.sensor.external:
            X = self.arm.flange(self.arm.q)[:3, :3]
            return np.concatenate([X @ self.sensor.written[:3], X @ self.sensor.written[3:]])
        if self.surroundings.empty:
            return np.zeros(6)
        return self.surroundings.wrench(np.array(self.arm.tool_pose()[:3]))

    def tcp_force(self) -> list[float]:
        """What the script and RTDE read: the wrench in base axes less the sensor's offset."""
        if not self.sensor.external and self.surroundings.empty and not self.sensor.offset.any():
            return [0.0] * 6
        return list((self.touch() - self.sensor.offset).tolist())

    def flange_wrench(self) -> list[float]:
        """What the sensor feels, in the flange's axes, without its offset."""
        if self.sensor.external:
            return self.sensor.written
        if self.surroundings.empty:
            return [0.0] * 6
        R, felt = self.arm.flange(self.arm.q)[:3, :3], self.touch()
        return [*(felt[:3] @ R).tolist(), *(felt[3:] @ R).tolist()]
