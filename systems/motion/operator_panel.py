"""OperatorPanel: reads Meshcat's button that holds the job and its slider for the pace of the simulation."""

from pydrake.geometry import Meshcat
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

HOLD_BUTTON = "Hold the job"
PACE_SLIDER = "Pace (1 = real time, 0 = as fast as it goes)"
FASTEST = 3.0


class OperatorPanel(LeafSystem):
    """Reads the controls of the viewer at 20 Hz.

    .. pydrake_system::

        name: OperatorPanel
        output_ports:
        - hold
        - pace

    `hold` (1) is 1.0 from the first click on and is never reset. `pace` (1) is the requested real-time rate, 0 to 3; other
    values are ignored. Any page of this computer's browsers can reach the viewer, so that nothing here may start or resume motion.
    """

    def __init__(self, meshcat: Meshcat, pace: float = 0.0, period_s: float = 0.05) -> None:
        super().__init__()
        self._meshcat = meshcat
        meshcat.AddButton(HOLD_BUTTON, "Escape")
        meshcat.AddSlider(PACE_SLIDER, 0.0, FASTEST, 0.1, pace)
        state = self.DeclareDiscreteState([0.0, pace])
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("hold", 1, self._hold, ticket)
        self.DeclareVectorOutputPort("pace", 1, self._pace, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._read)

    def _read(self, context: Context, discrete: DiscreteValues) -> None:
        held = context.get_discrete_state_vector().value()[0]
        clicked = self._meshcat.GetButtonClicks(HOLD_BUTTON) > 0
        asked = self._meshcat.GetSliderValue(PACE_SLIDER)
        pace = asked if 0.0 <= asked <= FASTEST else context.get_discrete_state_vector().value()[1]
        discrete.set_value([max(held, float(clicked)), pace])

    def _hold(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_discrete_state_vector().value()[0])

    def _pace(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_discrete_state_vector().value()[1])
