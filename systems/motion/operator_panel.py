"""OperatorPanel: reads what a person asks for, at the terminal, on the dashboard or in Meshcat, into the Diagram."""

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.person import FASTEST, Person
from weldcal.systems.viewer.kept import keep

HOLD_BUTTON = "Hold the job"
PACE_SLIDER = "Pace (1 = real time, 0 = as fast as it goes)"
PERIOD_S = 0.008


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
        self._hold, self._end = self.DeclareDiscreteState(1), self.DeclareDiscreteState(1)
        self._pace = self.DeclareDiscreteState([pace])
        self._seen = self.DeclareDiscreteState([0.0, pace])  # clicks, and the pace that was asked for
        self.DeclareStateOutputPort("hold", self._hold)
        self.DeclareStateOutputPort("end", self._end)
        self.DeclareStateOutputPort("pace", self._pace)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._read)

    def _read(self, context: Context, discrete: DiscreteValues) -> None:
        clicks, before = discrete.value(self._seen)
        pace = float(discrete.value(self._pace)[0])
        person = self._person
        asked = before if person.pace is None else person.pace
        if self._meshcat is not None:
            if asked != before:
                self._meshcat.SetSliderValue(PACE_SLIDER, asked)
            slider = self._meshcat.GetSliderValue(PACE_SLIDER)
            pace = slider if 0.0 <= slider <= FASTEST else pace
            if (now := float(self._meshcat.GetButtonClicks(HOLD_BUTTON))) > clicks:
                person.hold("the 3D view")
            clicks = now
        elif asked != before:
            pace = asked
        discrete.set_value(self._hold, [float(person.holds)])
        discrete.set_value(self._pace, [pace])
        discrete.set_value(self._seen, [clicks, asked])
        if person.ends:  # for good
            discrete.set_value(self._end, [1.0])
