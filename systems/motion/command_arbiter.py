"""CommandArbiter: selects the velocity of the mover, of the servo, or zero."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, UrStatus


class CommandArbiter(LeafSystem):
    """Outputs the velocity of the source that the job's mode selects, and zero while the job or the robot holds.

    .. pydrake_system::

        name: CommandArbiter
        input_ports:
        - job
        - robot_status
        - mover_velocity
        - servo_velocity
        output_ports:
        - velocity_wanted
    """

    def __init__(self) -> None:
        super().__init__()
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._mover = self.DeclareVectorInputPort("mover_velocity", 6)
        self._servo = self.DeclareVectorInputPort("servo_velocity", 6)
        self.DeclareVectorOutputPort("velocity_wanted", 6, self._choose, {self.all_input_ports_ticket()})

    def _choose(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        if not self._status.Eval(context).ready or job.mode not in ("move", "weld"):
            output.SetFromVector(np.zeros(6))
        else:
            output.SetFromVector((self._mover if job.mode == "move" else self._servo).Eval(context))
