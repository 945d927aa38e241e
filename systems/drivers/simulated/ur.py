"""Simulated UR arm: the controller's speedj on top of the MultibodyPlant's implicit joint servos."""

import dataclasses as dc
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, jacobian
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.arm_error import draw_true_arm
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import UrStatus

_LARGEST_MM = 1.0  # a larger error is a defect, not repeatability


READY = UrStatus()


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
        output_ports:
        - desired_state
        - position_measured
        - velocity_measured
        - X_BF
        - sample_time
        - status

    Inputs: velocity (6) rad/s, arm state (12) rad, rad/s. Outputs depend on the discrete state only: no feedthrough, one tick
    of latency. Speeds and accelerations above the arm's limits are clamped as by the controller. A reference that differs
    from the arm by more than the following error latches a fault and freezes the reference. With a repeatability above zero
    the measured joints differ from the true ones by a small offset. It is constant while the arm is at rest and is drawn
    anew, from ``seed`` and the number of the stop, when the arm starts to move.
    """

    def __init__(self, arm: ArmModel, config: SimulatedUr, q_start: np.ndarray, seed: int = 0) -> None:
        super().__init__()
        self._arm = arm
        self._config = config
        self._seed = seed
        rows = (arm.velocity_limit, arm.acceleration_limit, arm.position_lower, arm.position_upper)
        self._limits = np.array([*rows, np.full(6, config.following_error_rad)])
        offset = self._offset(q_start, 0)
        own = [*offset, 0.0] if config.repeatability_mm else []
        self._command = self.DeclareVectorInputPort("velocity_command", 6)
        self._arm_state = self.DeclareVectorInputPort("arm_state", 12)
        # q_ref, v_ref, q, v, sample time, fault; with a repeatability above zero: joint offset of this stop, its number
        state = self.DeclareDiscreteState(
            np.concatenate([q_start, np.zeros(6), q_start - offset, np.zeros(6), [0.0, 0.0], own])
        )
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("desired_state", 12, self._desired, ticket)
        self.DeclareVectorOutputPort("position_measured", 6, self._position, ticket)
        self.DeclareVectorOutputPort("velocity_measured", 6, self._velocity, ticket)
        self.DeclareAbstractOutputPort("X_BF", lambda: AbstractValue.Make(RigidTransform()), self._pose, ticket)
        self.DeclareVectorOutputPort("sample_time", 1, self._time, ticket)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(UrStatus()), self._status, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(config.control_period_s, 0.0, self._sample)

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        new = np.array(context.get_discrete_state_vector().value())
        measured = np.array(self._arm_state.Eval(context))
        command = np.array(self._command.Eval(context))
        starts = _follow(new, measured, command, self._limits, self._config.control_period_s)
        own = new[26:]
        if own.size:
            if starts:
                own[6] += 1.0
                own[:6] = self._offset(measured[:6], int(own[6]))
            measured[:6] -= own[:6]
        new[12:24], new[24] = measured, context.get_time()
        discrete.set_value(new)

    def _offset(self, q: np.ndarray, stop: int) -> np.ndarray:
        """Joint offsets (6,) rad that displace the flange by the repeatability (rms) at any arm pose."""
        if not self._config.repeatability_mm:
            return np.zeros(6)
        lever = float(np.linalg.norm(jacobian(self._arm, q)[3:]))
        sigma = 1e-3 * self._config.repeatability_mm / lever
        return np.asarray(sigma * np.random.default_rng([self._seed, stop]).standard_normal(6))

    def _desired(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[:12])

    def _position(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[12:18])

    def _velocity(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[18:24])

    def _pose(self, context: Context, output: Any) -> None:
        output.set_value(forward_kinematics(self._arm, context.get_discrete_state_vector().value()[12:18]))

    def _time(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[24:25])

    def _status(self, context: Context, output: Any) -> None:
        fault = bool(context.get_discrete_state_vector().value()[25])
        text = (
            "The simulated arm stopped: it did not follow its command, or the command was not finite."
            if fault
            else None
        )
        output.set_value(UrStatus(safety_mode="PROTECTIVE_STOP", fault=text) if fault else READY)


@compiled()
def _follow(state: Array, measured: Array, command: Array, limits: Array, dt: float) -> bool:
    """Advance reference (6,), its velocity (6,) and the fault at index 25 of the servo's state, in place; whether the arm starts
    to move.

    ``limits`` (5, 6): velocity, acceleration, lower and upper position, following error; rad and s.
    """
    moved, moves = False, False
    for k in range(6):
        moved = moved or state[6 + k] != 0.0
        if not np.isfinite(command[k]) or abs(state[k] - measured[k]) > limits[4, k]:
            state[25] = 1.0
    for k in range(6):
        wanted = 0.0 if state[25] else min(max(command[k], -limits[0, k]), limits[0, k])
        step = limits[1, k] * dt
        state[6 + k] += min(max(wanted - state[6 + k], -step), step)
        state[k] = min(max(state[k] + dt * state[6 + k], limits[2, k]), limits[3, k])
        moves = moves or state[6 + k] != 0.0
    return moves and not moved


def ApplyDriverConfig(config: SimulatedUr, build: StationBuild) -> None:
    """Add the servo and connect it to the simulated arm."""
    if not 0.0 <= config.repeatability_mm <= _LARGEST_MM:
        raise InputError(
            f"robot.repeatability_mm must be from 0 to {_LARGEST_MM:g}, and it is {config.repeatability_mm:g}."
        )
    world = build.require(SimulatedWorld)
    # no draw where it is not needed: the other devices' random numbers stay the same
    seed = int(build.rng.integers(2**32)) if config.repeatability_mm else 0
    servo = build.builder.AddSystem(SpeedJointServo(build.arm, config, build.q_start, seed))
    servo.set_name("arm_servo")
    build.builder.Connect(world.plant.get_state_output_port(world.arm), servo.GetInputPort("arm_state"))
    build.builder.Connect(servo.GetOutputPort("desired_state"), world.plant.get_desired_state_input_port(world.arm))
    build.inputs["arm.velocity_command"] = servo.GetInputPort("velocity_command")
    for name in ("position_measured", "velocity_measured", "X_BF", "sample_time", "status"):
        build.outputs[f"arm.{name}"] = servo.GetOutputPort(name)
