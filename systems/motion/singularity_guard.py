"""SingularityGuard: maps the commanded twist of the tip to joint velocity, slowed and stopped near the arm's
singularities."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context

from weldcal.models.arms.compiled_kinematics import tick_jacobian
from weldcal.models.arms.kinematics import ArmModel
from weldcal.systems.leaf_system import LeafSystem
from weldcal.welding.servo.guards import GUARD, SPEED_SHARE, ArmGuardConfig, guarded_joint_velocity


class SingularityGuard(LeafSystem):
    """Maps a spatial velocity of the tip frame to joint velocities within the arm's speed limits, and stops it before a
    singularity.

    .. pydrake_system::

        name: SingularityGuard
        input_ports:
        - V_BT
        - position_measured
        output_ports:
        - guarded
        - velocity
        - margin

    `V_BT` (6) [omega rad/s; v m/s] in B; `guarded` (8) is both of the following; `velocity` (6) rad/s; `margin` (2):
    least singular value of the length-scaled Jacobian, and 1.0 while the arm is stopped. The seam's own singularity
    (n_d . n_t -> 0) is guarded inside the servo.
    """

    def __init__(
        self,
        arm: ArmModel,
        X_FT: RigidTransform,
        config: ArmGuardConfig | None = None,
        speed_share: float = SPEED_SHARE,
    ) -> None:
        super().__init__()
        self._arm, self._p_FT = arm, np.array(X_FT.translation())
        self._config, self._limit = config or GUARD, speed_share * arm.velocity_limit
        # the first call loads machine code, which no tick has time for
        guarded_joint_velocity(np.eye(6), np.zeros(6), self._limit, self._config)
        self._V = self.DeclareVectorInputPort("V_BT", 6)
        self._q = self.DeclareVectorInputPort("position_measured", 6)
        ticket = {self._V.ticket(), self._q.ticket()}
        self._both = self.DeclareVectorOutputPort("guarded", 8, self._calculate, ticket)
        self.DeclareVectorOutputPort("velocity", 6, self._velocity, ticket)
        self.DeclareVectorOutputPort("margin", 2, self._margin, ticket)

    def _calculate(self, context: Context, output: BasicVector) -> None:
        J = tick_jacobian(self._arm, self._q.Eval(context), self._p_FT)
        guarded = guarded_joint_velocity(J, self._V.Eval(context), self._limit, self._config)
        output.SetFromVector(np.concatenate([guarded.q_dot, [guarded.sigma_min, float(guarded.stopped)]]))

    def _velocity(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._both.Eval(context)[:6])

    def _margin(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._both.Eval(context)[6:])
