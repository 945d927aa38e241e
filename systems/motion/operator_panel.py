"""OperatorPanel: reads what a person asks for, at the terminal, on the dashboard or in Meshcat, into the Diagram."""

from pydrake.geometry import Meshcat
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.person import FASTEST, Person
from weldcal.systems.viewer.kept import keep

HOLD_BUTTON = "Hold the job"
PACE_SLIDER = "Pace (1 = real time, 0 = as fast as it goes)"
PERIOD_S = 0.008
_HOLD, _END, _PACE, _CLICKS, _ASKED = range(5)


class OperatorPanel(LeafSystem):
    """Reads the person's wishes and the controls of the viewer at 125 Hz.

    .. pydrake_system::

        name: OperatorPanel
        output_ports:
        - hold
        - end
        - pace

    `hold` (1) is 1.0 while a person holds the run. `end` (1) is 1.0 once a person has ended it, for good. `pace` (1) is the
    requested real-time rate, 0 to 3; other values are ignored. A click of the viewer's button holds the run. Any page of this computer's
    browsers can reach the viewer, so that nothing there may let it go on.
    """

    def __init__(self, person: Person, meshcat: Meshcat | None = None, period_s: float = PERIOD_S) -> None:
        super().__init__()
        self._person, self._meshcat = person, None if meshcat is None else keep(meshcat)
        pace = person.pace or 0.0
        if meshcat is not None:
            meshcat.AddButton(HOLD_BUTTON, "Escape")
            meshcat.AddSlider(PACE_SLIDER, 0.0, FASTEST, 0.1, pace)
        state = self.DeclareDiscreteState([0.0, 0.0, pace, 0.0, pace])
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareVectorOutputPort("hold", 1, self._hold, ticket)
        self.DeclareVectorOutputPort("end", 1, self._end, ticket)
        self.DeclareVectorOutputPort("pace", 1, self._pace, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._read)

    def _read(self, context: Context, discrete: DiscreteValues) -> None:
        old = context.get_discrete_state_vector().value()
        person, pace, clicks = self._person, old[_PACE], old[_CLICKS]
        asked = old[_ASKED] if person.pace is None else person.pace
        if self._meshcat is not None:
            if asked != old[_ASKED]:
                self._meshcat.SetSliderValue(PACE_SLIDER, asked)
            slider = self._meshcat.GetSliderValue(PACE_SLIDER)
            pace = slider if 0.0 <= slider <= FASTEST else pace
            if (now := float(self._meshcat.GetButtonClicks(HOLD_BUTTON))) > clicks:
                person.hold("the 3D view")
            clicks = now
        elif asked != old[_ASKED]:
            pace = asked
        discrete.set_value([float(person.holds), max(old[_END], float(person.ends)), pace, clicks, asked])

    def _hold(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_discrete_state_vector().value()[_HOLD])

    def _end(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_discrete_state_vector().value()[_END])

    def _pace(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_discrete_state_vector().value()[_PACE])
