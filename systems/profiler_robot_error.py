"""RobotError: the flange is never quite where the controller says; by how much differs from pose to pose."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.systems.messages import JobCommand


class RobotError(LeafSystem):
    """Adds to the joints what makes the flange, as the controller has it, differ from where it is: anew for each goal.

    .. pydrake_system::

        name: RobotError
        input_ports:
        - position_measured
        - job
        output_ports:
        - position

    Both positions (6) rad. The error of the flange's place is `sigma_m` per axis, its orientation is right; it stays the same
    as long as the goal does, for the touch after a move as for the whole of a pass.
    """

    def __init__(self, arm: ArmModel, sigma_m: float, seed: int) -> None:
        super().__init__()
        self._arm, self._sigma_m, self._seed = arm, sigma_m, seed
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self.DeclareVectorOutputPort("position", 6, self._add)
        self._known: dict[int, np.ndarray] = {}

    def _add(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        output.SetFromVector(self._position.Eval(context) + self._error(job))

    def _error(self, job: JobCommand) -> np.ndarray:
        """Of this goal; remembered, which changes no answer: it follows from the seed and the goal alone."""
        if job.q_goal is None:
            return np.zeros(6)
        if job.goal_id not in self._known:
            shift = self._sigma_m * np.random.default_rng([self._seed, job.goal_id]).standard_normal(3)
            twist = np.concatenate([np.zeros(3), shift])
            self._known[job.goal_id] = np.linalg.solve(jacobian(self._arm, job.q_goal), twist)
        return self._known[job.goal_id]
