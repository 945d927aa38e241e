"""Simulated UR arm: its true kinematics, and the controller's speedj on top of the plant's implicit joint servos."""

import dataclasses as dc
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel, jacobian, link_frames
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled
from weldcal.systems.drivers.config import DriverConfig, check_range
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import ARM_PORTS, StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import UrStatus

_LARGEST_MM = 1.0  # a larger error is a defect, not repeatability


READY = UrStatus()
_LENGTH_M = 0.5  # a link's length error is this times its angle error: machined parts of half a metre
_LARGEST_LINK_MM = 5.0  # more is another arm


@dc.dataclass
class SimulatedUr(DriverConfig):
    """`!SimulatedUr`: the controller's speedj for the simulated arm."""

    FOR: ClassVar[tuple[str, ...]] = ("robot", "robot_2")
    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ("robot",)
    SIMULATED: ClassVar[bool] = True

    control_period_s: float = 0.002  # 500 Hz, like the real controller
    following_error_rad: float = 0.05  # a larger following error stops the arm
    # rms distance of the true flange position from the reported one, drawn for each stop; 0: the report is exact
    repeatability_mm: float = 0.0
    # rms distance of the true flange position from that of the controller's model; drawn once; 0: the model is exact
    kinematic_error_mm: float = 0.0

    def true_arm(self, arm: ArmModel, q_start: np.ndarray, rng: np.random.Generator) -> ArmModel:
        """See DriverConfig."""
        return draw_true_arm(arm, self.kinematic_error_mm, q_start, rng)


class SpeedJointServo(LeafSystem):
    """Integrates the newest joint velocity to the reference of the joint servos and samples the arm, at 500 Hz.

    .. pydrake_system::

        name: SpeedJointServo
        input_ports:
        - velocity_command
        - arm_state
        - arm_acceleration
        output_ports:
        - desired_state
        - position_measured
        - velocity_measured
        - X_BF
        - sample_time
        - status

    Inputs: velocity (6) rad/s, arm state (12) rad, rad/s, its acceleration (6) rad/s^2. What is measured is the arm at
    the end of the plant's step at this tick, so that a sample is not a tick old: the state after one semi-implicit step
    of ``plant_period_s``. An open `arm_acceleration` says that `arm_state` has made that step already. Outputs depend
    on the discrete state only: no feedthrough, one tick of latency. Speeds and accelerations above the arm's limits are
    clamped as by the controller. A reference that differs from the arm by more than the following error latches a fault
    and freezes the reference. With a repeatability above zero the measured joints differ from the true ones by a small
    offset. It is constant while the arm is at rest and is drawn anew, from ``seed`` and the number of the stop, when
    the arm starts to move.
    """

    def __init__(
        self, arm: ArmModel, config: SimulatedUr, q_start: np.ndarray, seed: int = 0, plant_period_s: float = 0.002
    ) -> None:
        super().__init__()
        self._arm = arm
        self._config = config
        self._seed = seed
        self._plant_period_s = plant_period_s
        rows = (arm.velocity_limit, arm.acceleration_limit, arm.position_lower, arm.position_upper)
        self._limits = np.array([*rows, np.full(6, config.following_error_rad)])
        offset = self._offset(q_start, 0)
        self._command = self.DeclareVectorInputPort("velocity_command", 6)
        self._arm_state = self.DeclareVectorInputPort("arm_state", 12)
        self._acceleration = self.DeclareVectorInputPort("arm_acceleration", 6)
        # one group for each port, which Drake then fills without Python
        self._reference = self.DeclareDiscreteState(np.concatenate([q_start, np.zeros(6)]))
        self._position = self.DeclareDiscreteState(q_start - offset)
        self._velocity = self.DeclareDiscreteState(np.zeros(6))
        self._sampled = self.DeclareDiscreteState(1)
        self._fault = self.DeclareDiscreteState(1)
        self._stop = self.DeclareDiscreteState(np.append(offset, 0.0))  # joint offset of this stop, its number
        self.DeclareStateOutputPort("desired_state", self._reference)
        self.DeclareStateOutputPort("position_measured", self._position)
        self.DeclareStateOutputPort("velocity_measured", self._velocity)
        position, fault = ({self.discrete_state_ticket(group)} for group in (self._position, self._fault))
        self.DeclareAbstractOutputPort("X_BF", lambda: AbstractValue.Make(RigidTransform()), self._pose, position)
        self.DeclareStateOutputPort("sample_time", self._sampled)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(UrStatus()), self._status, fault)
        self.DeclarePeriodicDiscreteUpdateEvent(config.control_period_s, 0.0, self._sample)

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        now = context.get_time()
        measured = np.array(self._arm_state.Eval(context))
        if self._acceleration.HasValue(context) and self._plant_steps_at(now):
            step = self._plant_period_s
            measured[6:] += step * self._acceleration.Eval(context)
            measured[:6] += step * measured[6:]
        command = np.array(self._command.Eval(context))
        reference, fault = np.array(discrete.value(self._reference)), np.array(discrete.value(self._fault))
        starts = _follow(reference, fault, measured, command, self._limits, self._config.control_period_s)
        discrete.set_value(self._reference, reference)
        discrete.set_value(self._fault, fault)
        if self._config.repeatability_mm:
            stop = np.array(discrete.value(self._stop))
            if starts:
                stop[6] += 1.0
                stop[:6] = self._offset(measured[:6], int(stop[6]))
                discrete.set_value(self._stop, stop)
            measured[:6] -= stop[:6]
        discrete.set_value(self._position, measured[:6])
        discrete.set_value(self._velocity, measured[6:])
        discrete.set_value(self._sampled, [now])

    def _plant_steps_at(self, time: float) -> bool:
        """Return whether the plant makes a step at this tick."""
        steps = time / self._plant_period_s
        return abs(steps - round(steps)) < 1e-6

    def _offset(self, q: np.ndarray, stop: int) -> np.ndarray:
        """Joint offsets (6,) rad that displace the flange by the repeatability (rms) at any arm pose."""
        if not self._config.repeatability_mm:
            return np.zeros(6)
        lever = float(np.linalg.norm(jacobian(self._arm, q)[3:]))
        sigma = 1e-3 * self._config.repeatability_mm / lever
        return np.asarray(sigma * np.random.default_rng([self._seed, stop]).standard_normal(6))

    def _pose(self, context: Context, output: Any) -> None:
        output.set_value(tick_flange_pose(self._arm, context.get_discrete_state(self._position).value()))

    def _status(self, context: Context, output: Any) -> None:
        fault = bool(context.get_discrete_state(self._fault).value()[0])
        text = (
            "The simulated arm stopped: it did not follow its command, or the command was not finite."
            if fault
            else None
        )
        output.set_value(UrStatus(safety_mode="PROTECTIVE_STOP", fault=text) if fault else READY)


@compiled()
def _follow(reference: Array, fault: Array, measured: Array, command: Array, limits: Array, dt: float) -> bool:
    """Advance the servo's reference (12,), position and velocity, and its fault (1,), in place.

    Whether the arm starts to move.

    ``limits`` (5, 6): velocity, acceleration, lower and upper position, following error; rad and s.
    """
    moved, moves = False, False
    for k in range(6):
        moved = moved or reference[6 + k] != 0.0
        if not np.isfinite(command[k]) or abs(reference[k] - measured[k]) > limits[4, k]:
            fault[0] = 1.0
    for k in range(6):
        wanted = 0.0 if fault[0] else min(max(command[k], -limits[0, k]), limits[0, k])
        step = limits[1, k] * dt
        reference[6 + k] += min(max(wanted - reference[6 + k], -step), step)
        reference[k] = min(max(reference[k] + dt * reference[6 + k], limits[2, k]), limits[3, k])
        moves = moves or reference[6 + k] != 0.0
    return moves and not moved


def ApplyDriverConfig(config: SimulatedUr, build: StationBuild) -> None:
    """Add the servo and connect it to the simulated arm."""
    check_range("robot.repeatability_mm", config.repeatability_mm, 0.0, _LARGEST_MM)
    world = build.require(SimulatedWorld)
    # no draw where it is not needed: the other devices' random numbers stay the same
    seed = int(build.rng.integers(2**32)) if config.repeatability_mm else 0
    servo = SpeedJointServo(build.arm, config, build.q_start, seed, world.plant.time_step())
    build.add("arm_servo", servo, *ARM_PORTS)
    build.builder.Connect(world.plant.get_state_output_port(world.arm), servo.GetInputPort("arm_state"))
    if not world.plant.has_sampled_output_ports():
        acceleration = world.plant.get_generalized_acceleration_output_port(world.arm)
        build.builder.Connect(acceleration, servo.GetInputPort("arm_acceleration"))
    build.builder.Connect(servo.GetOutputPort("desired_state"), world.plant.get_desired_state_input_port(world.arm))


def draw_true_arm(arm: ArmModel, error_mm: float, q: Array, rng: np.random.Generator) -> ArmModel:
    """Return the arm with random errors in each link transform: three angles and three lengths, normal and independent.

    ``error_mm`` is the rms distance of the true flange from the reported one at ``q`` (6,) rad, over all draws. About a
    quarter of it remains between poses after the best rigid fit; the rest looks like a shift of the robot's base.
    Zero returns the arm as it is and draws nothing.

    Raises:
        InputError: the error is negative or larger than 5 mm.
    """
    check_range("robot.kinematic_error_mm", error_mm, 0.0, _LARGEST_LINK_MM)
    if error_mm == 0.0:
        return arm
    frames = link_frames(arm, q)
    flange = frames[-1].translation()
    levers = [float(np.sum((flange - X.translation()) ** 2)) for X in frames[:-1]]
    # two of the three angles move the flange by the lever
    gain = float(np.sqrt(sum(2.0 * square + 3.0 * _LENGTH_M**2 for square in levers)))
    sigma = 1e-3 * error_mm / gain
    stack = arm.stack.copy()
    for k in range(len(stack)):
        error = np.eye(4)
        error[:3, :3] = exp_rotation(sigma * rng.standard_normal(3))
        error[:3, 3] = _LENGTH_M * sigma * rng.standard_normal(3)
        stack[k] = error @ stack[k]
    return replace(arm, stack=stack)
