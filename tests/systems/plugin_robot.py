"""A robot driver that simulates nothing but joint angles: it stands in for an arm whose world weldcal cannot see
into."""

from __future__ import annotations

import dataclasses as dc
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import UrStatus


@dc.dataclass
class KinematicArm(DriverConfig):
    """`!KinematicArm {}`: the joints follow their velocity command exactly."""

    FOR: ClassVar[tuple[str, ...]] = ("robot",)


class JointIntegrator(LeafSystem):
    """Joint angles (6) rad from joint velocities (6) rad/s at 500 Hz; no world, no contact, no camera."""

    def __init__(self, arm: ArmModel, q_start: np.ndarray, period_s: float = 0.002) -> None:
        super().__init__()
        self._arm, self._period_s = arm, period_s
        self._command = self.DeclareVectorInputPort("velocity_command", 6)
        state = self.DeclareDiscreteState(np.concatenate([q_start, np.zeros(7)]))
        ticket = {self.discrete_state_ticket(state)}
        for name, part in (("position_measured", slice(6)), ("velocity_measured", slice(6, 12)), ("sample_time", [12])):
            size = 1 if name == "sample_time" else 6
            self.DeclareVectorOutputPort(name, size, lambda c, o, part=part: self._show(c, o, part), ticket)
        self.DeclareAbstractOutputPort("X_BF", lambda: AbstractValue.Make(RigidTransform()), self._pose, ticket)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(UrStatus()), self._status, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._step)

    def _step(self, context: Context, discrete: DiscreteValues) -> None:
        q, v = context.get_discrete_state_vector().value()[:6], self._command.Eval(context)
        discrete.set_value(np.concatenate([q + self._period_s * v, v, [context.get_time()]]))

    def _show(self, context: Context, output: BasicVector, part: Any) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[part])

    def _pose(self, context: Context, output: Any) -> None:
        output.set_value(forward_kinematics(self._arm, context.get_discrete_state_vector().value()[:6]))

    def _status(self, context: Context, output: Any) -> None:
        output.set_value(UrStatus())


def ApplyDriverConfig(config: KinematicArm, build: StationBuild) -> None:
    """Add the integrator and show the ports of an arm."""
    arm = build.builder.AddSystem(JointIntegrator(build.arm, build.q_start))
    arm.set_name("kinematic_arm")
    build.inputs["arm.velocity_command"] = arm.GetInputPort("velocity_command")
    for name in ("position_measured", "velocity_measured", "X_BF", "sample_time", "status"):
        build.outputs[f"arm.{name}"] = arm.GetOutputPort(name)
