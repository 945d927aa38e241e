"""RobotError: adds a random position error of the flange, drawn for each pose, to the simulated arm's joints."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand


class RobotError(LeafSystem):
    """Adds joint offsets so that the reported flange position differs from the true one, drawn for each goal.

    .. pydrake_system::

        name: RobotError
        input_ports:
        - position_measured
        - job
        output_ports:
        - position

    Both positions (6) rad. The error of the flange's position is `sigma_m` per axis, the orientation has none. It is constant
    for one goal, including the touch after a move and a whole pass.
    """

    def __init__(self, arm: ArmModel, sigma_m: float, seed: int) -> None:
        super().__init__()
        self._arm, self._sigma_m, self._seed = arm, sigma_m, seed
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self.DeclareVectorOutputPort("position", 6, self._add)

    def _add(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        q = np.array(self._position.Eval(context))
        shift = self._sigma_m * np.random.default_rng([self._seed, job.goal_id]).standard_normal(3)
        output.SetFromVector(q + np.linalg.solve(jacobian(self._arm, q), np.concatenate([np.zeros(3), shift])))
