"""A UR10e in simulation: what a controller's speedj does, over the MultibodyPlant's implicit joint servos."""

import dataclasses as dc
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import UrStatus


@dc.dataclass
class SimulatedUr:
    """`!SimulatedUr`: the controller's speedj over the arm of the simulated world."""

    control_period_s: float = 0.002  # 500 Hz, as the real controller
    following_error_rad: float = 0.05  # beyond this the controller stops the arm


class SpeedJointServo(LeafSystem):
    """Integrates the newest joint velocity into the reference of the joint servos and samples the arm, at 500 Hz.

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

    Velocity (6) rad/s in, arm state (12) rad, rad/s in. Outputs depend on the discrete state only: no feedthrough, one tick
    of latency. Speeds and accelerations beyond the arm's are clamped as the controller clamps them; a reference that leaves
    the arm by more than the following error latches a fault and the reference freezes.
    """

    def __init__(self, arm: ArmModel, config: SimulatedUr, q_start: np.ndarray) -> None:
        super().__init__()
        self._arm = arm
        self._config = config
        self._command = self.DeclareVectorInputPort("velocity_command", 6)
        self._arm_state = self.DeclareVectorInputPort("arm_state", 12)
        # q_ref, v_ref, q, v, sample time, fault
        state = self.DeclareDiscreteState(np.concatenate([q_start, np.zeros(6), q_start, np.zeros(6), [0.0, 0.0]]))
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("desired_state", 12, self._desired, ticket)
        self.DeclareVectorOutputPort("position_measured", 6, self._position, ticket)
        self.DeclareVectorOutputPort("velocity_measured", 6, self._velocity, ticket)
        self.DeclareAbstractOutputPort("X_BF", lambda: AbstractValue.Make(RigidTransform()), self._pose, ticket)
        self.DeclareVectorOutputPort("sample_time", 1, self._time, ticket)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(UrStatus()), self._status, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(config.control_period_s, 0.0, self._sample)

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        dt = self._config.control_period_s
        old = context.get_discrete_state_vector().value()
        measured = self._arm_state.Eval(context)
        command = self._command.Eval(context)
        fault = old[25]
        if (
            not np.all(np.isfinite(command))
            or np.max(np.abs(old[:6] - measured[:6])) > self._config.following_error_rad
        ):
            fault = 1.0
        wanted = np.zeros(6) if fault else np.clip(command, -self._arm.velocity_limit, self._arm.velocity_limit)
        step = self._arm.acceleration_limit * dt
        v_ref = old[6:12] + np.clip(wanted - old[6:12], -step, step)
        q_ref = np.clip(old[:6] + dt * v_ref, self._arm.position_lower, self._arm.position_upper)
        discrete.set_value(np.concatenate([q_ref, v_ref, measured, [context.get_time(), fault]]))

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
        output.set_value(UrStatus(safety_mode="PROTECTIVE_STOP" if fault else "NORMAL", fault=text))


def ApplyDriverConfig(config: SimulatedUr, build: StationBuild) -> None:
    """Add the servo and wire it to the arm of the simulated world."""
    world = build.simulated_world()
    servo = build.builder.AddSystem(SpeedJointServo(build.arm, config, build.q_start))
    servo.set_name("ur10e_servo")
    build.builder.Connect(world.plant.get_state_output_port(world.arm), servo.GetInputPort("arm_state"))
    build.builder.Connect(servo.GetOutputPort("desired_state"), world.plant.get_desired_state_input_port(world.arm))
    build.inputs["ur10e.velocity_command"] = servo.GetInputPort("velocity_command")
    for name in ("position_measured", "velocity_measured", "X_BF", "sample_time", "status"):
        build.outputs[f"ur10e.{name}"] = servo.GetOutputPort(name)
