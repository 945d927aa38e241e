"""ProcessSwitch: computes the process output; every cause that stops the arm first turns the torch off, latched."""

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, UrStatus


class ProcessSwitch(LeafSystem):
    """Passes on the servo's torch request while robot, guard and operator allow it.

    .. pydrake_system::

        name: ProcessSwitch
        input_ports:
        - torch_wanted
        - job
        - robot_status
        - margin
        - hold
        output_ports:
        - process_on
        - arm_stopped

    `torch_wanted` (1) of the servo; `margin` (2) of the SingularityGuard, whose second number is 1 while it stops the arm;
    `hold` (1) of the operator. `process_on` (1) follows all inputs without delay. The arm's command passes through the
    arbiter and the slew limiter, so the torch is off no later than the first tick in which the arm is commanded to stop.
    A burning torch that the robot's status or the guard turned off stays off for the rest of that weld; after a person's hold
    the servo asks for it anew, when it is let go and has gone back. `arm_stopped` (1): the guard turned it off; the JobSequencer
    then holds the job.
    """

    def __init__(self, period_s: float = 0.002) -> None:
        super().__init__()
        self._wanted = self.DeclareVectorInputPort("torch_wanted", 1)
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._margin = self.DeclareVectorInputPort("margin", 2)
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._off = self.DeclareDiscreteState(1)  # turned off for this weld
        self._stopped_by_guard = self.DeclareDiscreteState(1)
        ticket = {self.all_input_ports_ticket(), self.discrete_state_ticket(self._off)}
        self.DeclareVectorOutputPort("process_on", 1, self._process, ticket)
        self.DeclareStateOutputPort("arm_stopped", self._stopped_by_guard)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._latch)

    def _stopped(self, context: Context) -> bool:
        return bool(self._margin.Eval(context)[1] > 0.5)

    def _free(self, context: Context) -> bool:
        """Whether robot and guard both allow the process."""
        return bool(self._status.Eval(context).ready and not self._stopped(context))

    def _latch(self, context: Context, discrete: DiscreteValues) -> None:
        if self._job.Eval(context).mode != "weld":
            discrete.set_value(self._off, [0.0])
            discrete.set_value(self._stopped_by_guard, [0.0])
        elif self._wanted.Eval(context)[0] > 0.5 and not self._free(context):
            discrete.set_value(self._off, [1.0])
            if self._stopped(context):
                discrete.set_value(self._stopped_by_guard, [1.0])

    def _process(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        off = context.get_discrete_state(self._off).value()[0] > 0.5
        consent = job.process_on and not job.held and self._wanted.Eval(context)[0] > 0.5
        held = self._hold.Eval(context)[0] > 0.5
        output.SetAtIndex(0, float(consent and not off and not held and self._free(context)))
