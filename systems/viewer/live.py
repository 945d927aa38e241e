"""LiveView: what the dashboard shows of a running cell.

A thin system writes it, other threads read it without a lock.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus

from weldcal.models.arrays import Array
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, PlannedSeam
from weldcal.systems.motion.spine import JobPorts
from weldcal.systems.viewer.cameras import Views
from weldcal.systems.wiring import Wiring
from weldcal.welding.servo.state import Phase

PERIOD_S = 0.1  # a choice: values shown are at most this old; half of it doubles the load of the control loop
ACTIVE = ("TRACK", "COAST", "FINISH", "HELD", "BACK")
"""Phases of the servo in which the torch has a place on the seam."""


class WeldRow(NamedTuple):
    """One row of the weld's plots.

    Time s, torch and tip along the seam m, the felt seam to the left of the planned one m, deflection m, torch speed
    m/s, whether the torch is on. NaN where there is no value.
    """

    time: float
    s_torch: float
    s_tip: float
    offset: float
    deflection: float
    speed: float
    torch_on: bool


class ScanRow(NamedTuple):
    """One row of the calibration's plot: scans so far, expected error at the work point m, held-out median m."""

    scans: int
    predicted: float
    held_out: float


@dataclass(frozen=True, eq=False)
class Moment:
    """The values of one moment.

    Diagram time s, the job's command, its shown messages by name, and the arm's least singular value (NaN where the job
    has none).
    """

    time: float = 0.0
    command: JobCommand = field(default_factory=JobCommand)
    shown: Mapping[str, Any] = field(default_factory=dict)
    sigma_min: float = math.nan


class LiveView:
    """The newest moment and the rows of the plots.

    One thread writes; readers take `moment` and slices of the lists, which only grow. `scan_times`: when the rows of
    `scans` came, s. `views`: the cameras of the 3D view, which readers may pick.
    """

    def __init__(self) -> None:
        self.moment = Moment()
        self.views = Views()
        self.weld: list[WeldRow] = []
        self.scans: list[ScanRow] = []
        self.scan_times: list[float] = []


class LiveWriter(LeafSystem):
    """Writes the values of its inputs to a LiveView at 10 Hz; holds no state of the simulation.

    .. pydrake_system::

        name: LiveWriter
        input_ports:
        - job
        - margin

    The job's `state` and each message that it shows have input ports of their own besides. `margin` (2) of the
    SingularityGuard may stay open. `p_TW` (3,) m is the torch in the tool's frame; None: the job has no torch.
    """

    def __init__(self, view: LiveView, shown: Mapping[str, AbstractValue], p_TW: Array | None) -> None:
        super().__init__()
        self._view, self._p_TW = view, p_TW
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._margin = self.DeclareVectorInputPort("margin", 2)
        self._shown = {name: self.DeclareAbstractInputPort(name, model) for name, model in shown.items()}
        self._torch: tuple[float, Array] | None = None
        self.DeclarePeriodicPublishEvent(PERIOD_S, 0.0, self._write)

    def _write(self, context: Context) -> EventStatus:
        shown = {name: port.Eval(context) for name, port in self._shown.items()}
        margin = float(self._margin.Eval(context)[0]) if self._margin.HasValue(context) else math.nan
        self._view.moment = Moment(context.get_time(), self._job.Eval(context), shown, margin)
        history = getattr(shown.get("calibration_status"), "history", ())
        for row in history[len(self._view.scans) :]:
            self._view.scan_times.append(context.get_time())
            self._view.scans.append(ScanRow(*row[:3]))
        report = shown.get("servo_report")
        if isinstance(report, ServoReport) and self._p_TW is not None:
            self._append(report, shown.get("planned_seam"), self._p_TW)
        return EventStatus.Succeeded()

    def _append(self, report: ServoReport, planned: PlannedSeam | None, p_TW: Array) -> None:
        if report.phase not in ACTIVE or report.command is None or report.X_BT is None:
            self._torch = None
            return
        p_BW, d, speed = np.asarray(report.X_BT @ p_TW), report.command.diagnostics, math.nan
        if self._torch is not None and report.time > self._torch[0]:
            speed = float(np.linalg.norm(p_BW - self._torch[1])) / (report.time - self._torch[0])
        self._torch = (report.time, p_BW)
        offset = math.nan
        if d.p_BTorch_target is not None and planned is not None and planned.seam is not None:
            plan = planned.seam.frame(planned.seam.nearest(d.p_BTorch_target, d.s_torch))
            offset = float((d.p_BTorch_target - plan.position) @ plan.normal)
        # past the seam's end the tip feels nothing
        past = report.state is not None and report.state.phase == Phase.FINISH
        deflection = math.nan if past else d.delta_n
        self._view.weld.append(
            WeldRow(
                time=report.time,
                s_torch=d.s_torch,
                s_tip=d.s_tip,
                offset=offset,
                deflection=deflection,
                speed=speed,
                torch_on=report.torch_on,
            )
        )


def add_live_view(wiring: Wiring, ports: JobPorts, view: LiveView) -> LiveWriter:
    """Add the writer of a job's view, and connect it."""
    tool = wiring.station.tool
    models = {name: port.Allocate() for name, port in ports.shown.items()}
    models["state"] = ports.state.Allocate()
    writer = wiring.add("live_writer", LiveWriter(view, models, None if tool is None else np.asarray(tool.p_TW)))
    wiring.connect(writer, job=ports.commands[0], state=ports.state, **ports.shown)
    if ports.margin is not None:
        wiring.connect(writer, margin=ports.margin)
    return writer
