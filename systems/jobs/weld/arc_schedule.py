"""Output the set values of the power source at this moment of the weld."""

import math

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import PlannedSeam
from weldcal.welding.record.schedule import WeldSchedule
from weldcal.welding.servo.arc import Stand

SET_VALUES = ("job", "wire_feed_m_min", "voltage_V", "current_A")
"""The numbers of the port `set_values`; NaN: not set."""


class ArcSchedule(LeafSystem):
    """The schedule at the torch's place and time.

    .. pydrake_system::

        name: ArcSchedule
        input_ports:
        - servo_report
        - planned_seam
        - process_on
        - arc_established
        output_ports:
        - set_values
        - gap

    `set_values` (4) as in SET_VALUES; `gap` (1) m, measured at the torch's place; NaN where no schedule follows it.
    `process_on` (1) asks for the torch. `arc_established` (1; unconnected: with the torch) starts the hot start. Before
    it the values are those of the hot start.
    """

    def __init__(self, schedule: WeldSchedule, period_s: float = 0.008) -> None:
        super().__init__()
        self._schedule = schedule
        self._report = self.DeclareAbstractInputPort("servo_report", AbstractValue.Make(ServoReport()))
        self._planned = self.DeclareAbstractInputPort("planned_seam", AbstractValue.Make(PlannedSeam()))
        self._process = self.DeclareVectorInputPort("process_on", 1)
        self._arc = self.DeclareVectorInputPort("arc_established", 1)
        self._values = self.DeclareDiscreteState(np.full(len(SET_VALUES), np.nan))
        self._gap = self.DeclareDiscreteState([np.nan])
        self._since = self.DeclareDiscreteState([np.nan, np.nan])  # of the arc, and of the torch at the end, s
        self.DeclareStateOutputPort("set_values", self._values)
        self.DeclareStateOutputPort("gap", self._gap)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        now, state = context.get_time(), self._report.Eval(context).state
        lit, end = discrete.value(self._since)
        if self._process.Eval(context)[0] < 0.5:
            lit = end = math.nan
        else:
            arc = not self._arc.HasValue(context) or self._arc.Eval(context)[0] > 0.5
            lit = now if math.isnan(lit) and arc else lit
            at_end = state is not None and state.stand == Stand.CRATER
            end = now if math.isnan(end) and at_end else end
        along = self._planned.Eval(context).gap
        gap = math.nan if along is None else along.at(0.0 if state is None else state.s_torch)
        since = [-1.0 if math.isnan(t) else now - t for t in (lit, end)]
        job = self._schedule.job
        values = [math.nan if job is None else float(job), *self._schedule.values(gap, *since)]
        discrete.set_value(self._values, values)
        discrete.set_value(self._gap, [gap])
        discrete.set_value(self._since, [lit, end])
