"""The tool-scan job: the arm moves its tool before the fixed scanner, which takes one scan from each side."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.jobs.tool_scan.planner import ToolScanConfig, ToolView, check_tool_scan, plan_tool_views
from weldcal.systems.messages import JobCommand, Scan
from weldcal.systems.motion.spine import MOVE_TIMEOUT_S, Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

DWELL_S = 0.3  # at rest before a scan
SCAN_TIMEOUT_S = 30.0  # a choice: a scan takes seconds; twice as much only delays the report of a scanner that hangs


@dataclass(frozen=True, eq=False, kw_only=True)
class ToolScanState(ProcedureState):
    """State of the procedure; `taken`: joints (6,) rad at each scan."""

    taken: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ToolScanInputs(Inputs):
    """Inputs of the procedure at one tick."""

    scan: Scan


class ToolScanProcedure(Procedure[ToolScanState, ToolScanInputs]):
    """Runs the procedure; a robot fault, the operator or a scanner that does not answer holds it with a reason.

    .. pydrake_system::

        name: ToolScanProcedure
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - position_measured
        - scan
        output_ports:
        - job
        - state
        - trigger

    `job` drives the FlangeMover between goals. `trigger` (1) goes to the station's scanner. `hold` (1) is the
    operator's stop request.
    """

    inputs = ToolScanInputs
    moves = ("to_home", "move", "go_home")

    def __init__(
        self,
        views: tuple[ToolView, ...],
        q_home: Array,
        *,
        move_timeout_s: float = MOVE_TIMEOUT_S,
        maximum_time_s: float = np.inf,
        period_s: float = 0.008,
    ) -> None:
        silent = f"No scan arrived within {SCAN_TIMEOUT_S:.0f} s of its trigger: check the scanner."
        super().__init__(
            ToolScanState(),
            move_timeout_s=move_timeout_s,
            maximum_time_s=maximum_time_s,
            timeouts={"scan": (SCAN_TIMEOUT_S, silent)},
            dwell_s=DWELL_S,
            period_s=period_s,
        )
        self._views, self._q_home = views, q_home
        self.read(scan=Scan())

    def command(self, s: ToolScanState, arm: int = 0) -> JobCommand:
        """See Procedure."""
        return replace(super().command(s), scan_purpose="tool", scan_label=f"pose{s.trigger:02d}")

    def _start(self, s: ToolScanState, now: ToolScanInputs) -> ToolScanState:
        return self.go(s, now, "to_home", self._q_home)

    def _next(self, s: ToolScanState, now: ToolScanInputs) -> ToolScanState:
        if len(s.taken) < len(self._views):
            return self.go(s, now, "move", self._views[len(s.taken)].q)
        return self.go(s, now, "go_home", self._q_home)

    def _arrived(self, s: ToolScanState, now: ToolScanInputs) -> ToolScanState:
        return self.request(s, now, "scan")

    def _scanned(self, s: ToolScanState, now: ToolScanInputs) -> ToolScanState:
        if now.scan.sequence != s.trigger:
            return s
        return self._next(replace(s, taken=(*s.taken, now.q)), now)

    steps: ClassVar = {"start": _start, "to_home": _next, "move": _arrived, "scan": _scanned, "go_home": Procedure.end}


@dataclass(eq=False, kw_only=True)
class AddedToolScan(AddedJob):
    """The systems of the job."""

    arm: ArmModel
    views: tuple[ToolView, ...]
    procedure: ToolScanProcedure

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob."""
        state: ToolScanState = self.state(root)
        done, n = len(state.taken), len(self.views)
        at = f"{min(done + 1, n)} of {n}" if state.phase in ("move", "scan") else ""
        return phase_words(state.phase, at), 0.05 + 0.85 * done / n

    def poses(self, root: Context) -> dict[str, tuple[RigidTransform, Array]]:
        """Return X_BF and the joints (6,) rad of each scan so far, by the scan's label."""
        taken = self.state(root).taken
        return {f"pose{k + 1:02d}": (forward_kinematics(self.arm, q), q) for k, q in enumerate(taken)}


class ToolScanJob(Job[tuple[ToolView, ...]]):
    """The job of a scenario with a `tool_scan` part."""

    key = "tool_scan"
    config = ToolScanConfig

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        check_tool_scan(scenario)

    def plan(self, scenario: Scenario, station: Station, seed: int) -> tuple[ToolView, ...]:
        """See Job."""
        return plan_tool_views(scenario, station, seed)

    def add(self, wiring: Wiring, spine: Spine, plan: tuple[ToolView, ...]) -> AddedToolScan:
        """See Job."""
        station, scenario = wiring.station, wiring.scenario
        slower = 1.0 / scenario.job.speed_factor
        maximum_time_s = scenario.job.maximum_time_s * slower
        procedure = wiring.add(
            "tool_scan_procedure",
            ToolScanProcedure(
                plan,
                np.deg2rad(scenario.home_deg),
                move_timeout_s=MOVE_TIMEOUT_S * slower,
                maximum_time_s=maximum_time_s,
            ),
        )
        spine.serve(procedure, scan=wiring.out("scanner.scan"))
        wiring.feed("scanner.trigger", procedure.GetOutputPort("trigger"))
        for port in ("finger_camera.streaming", "scanner.streaming"):
            if station.diagram.HasInputPort(port):
                wiring.feed(port, wiring.zeros(f"no_{port}", 1))
        return AddedToolScan(
            arm=station.arm,
            views=plan,
            procedure=procedure,
            ports=procedure.ports(shown={"scan": wiring.out("scanner.scan")}),
            maximum_time_s=maximum_time_s,
        )


JOB = ToolScanJob()
"""Found by systems/jobs/job.py."""
