"""Visit the planned poses with one arm or two, scan at each, hold out some scans, and return home."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import Context

from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.calibration.recorded_carried import CarriedCalibration
from weldcal.models.arrays import Array
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.messages import JobCommand, Message, UrStatus
from weldcal.systems.motion.clear_moves import stands_at

Route = tuple[tuple[int, Array], ...]
"""Moves one after the other: number of the arm, and its joints (6,) rad."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingState(ProcedureState):
    """State of the procedure."""

    moving: int = 0  # number of the arm that moves
    route: Route = ()  # the moves after the present one
    visit: int = -1  # index of the planned pose
    purpose: str = ""  # of the newest scan: calibrate, or verify at a held-out pose
    label: str = ""  # of the pose at the end of the route; empty: home
    scanned: str = ""  # label of the newest scan


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingStatus(CarriedCalibration, Message):
    """The calibration after its newest scan, and whether its error is as small as required."""

    sequence: int = 0
    done: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingInputs(Inputs):
    """Inputs of the procedure at one tick."""

    settled_goal_2: float
    robot_status_2: UrStatus
    status: MountingStatus


class MountingProcedure(Procedure[MountingState, MountingInputs]):
    """Runs the procedure; a robot fault, or a goal that is not reached, holds it with a reason.

    .. pydrake_system::

        name: MountingProcedure
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - position_measured
        - settled_goal_2
        - robot_status_2
        - status
        output_ports:
        - job
        - job_2
        - state
        - trigger

    One arm moves at a time: towards a pose the second arm first, towards home the first arm first, so that the move
    home is the reversed move from home. An arm that is not at home moves there first. `hold` (1) is the operator's stop
    request. The first `scans` poses of the plan are for the calibration (fewer where the required error is reached
    earlier), the next `held_out` poses for its verification. The ports of the second arm stay open where there is one
    arm.
    """

    inputs = MountingInputs
    moves = ("move",)
    commands = ("job", "job_2")

    def __init__(
        self,
        plan: Sequence[MountingPose],
        scans: int,
        held_out: int,
        home: tuple[Array, Array | None],
        *,
        timeout_s: float = 60.0,
        maximum_time_s: float = np.inf,
        period_s: float = 0.008,
    ) -> None:
        super().__init__(MountingState(), move_timeout_s=timeout_s, maximum_time_s=maximum_time_s, period_s=period_s)
        self._plan, self._scans, self._held_out, self.home = tuple(plan), scans, held_out, home
        self._homeward: Route = tuple((arm, q) for arm, q in enumerate(home) if q is not None)
        second = () if home[1] is not None else ("settled_goal_2", "robot_status_2")
        self.read(*second, settled_goal_2=0.0, robot_status_2=UrStatus(), status=MountingStatus())

    def look(self, context: Context, s: MountingState) -> MountingInputs:
        """See Procedure: the arm that moves, and the arm that is not ready."""
        now = super().look(context, s)
        robot = now.robot if not now.robot.ready else now.robot_status_2
        return replace(now, robot=robot, settled_goal=int(now.settled_goal_2) if s.moving else now.settled_goal)

    def where(self, s: MountingState) -> str:
        """See Procedure."""
        return f"{s.phase} {s.label}".rstrip()

    def command(self, s: MountingState, arm: int = 0) -> JobCommand:
        """See Procedure."""
        command = replace(super().command(s), scan_label=s.scanned)
        return command if s.moving == arm else replace(command, mode="hold", q_goal=None)

    def _start(self, s: MountingState, now: MountingInputs) -> MountingState:
        if not stands_at(now.q, self.home[0]):
            return self._follow(s, now, self._homeward, "")
        return self._visit(s, now, 0)

    def _arrived(self, s: MountingState, now: MountingInputs) -> MountingState:
        if s.route:
            return self._follow(s, now, s.route, s.label)
        if s.label:
            return self.request(s, now, "scan", scanned=s.label)
        if s.visit + 1 < self._scans + self._held_out:
            return self._visit(s, now, s.visit + 1)
        return self.enter(s, now, "done")

    def _scanned(self, s: MountingState, now: MountingInputs) -> MountingState:
        if now.status.sequence != s.trigger:
            return s
        if s.purpose == "calibrate" and (now.status.done or s.visit + 1 >= self._scans):
            # the held-out poses are approached from home, wherever the calibration ended
            return self._follow(replace(s, visit=self._scans - 1), now, self._homeward, "")
        if s.visit + 1 >= self._scans + self._held_out:
            return self._follow(s, now, self._homeward, "")
        return self._visit(s, now, s.visit + 1)

    def _visit(self, s: MountingState, now: MountingInputs, k: int) -> MountingState:
        pose, aside = self._plan[k], k >= self._scans
        label = f"aside{k - self._scans + 1:02d}" if aside else f"pose{k + 1:02d}"
        route: Route = ((0, pose.q),)
        if pose.q_2 is not None:
            route = ((1, pose.q_2), *route)
        if pose.via_home:
            route = (*self._homeward, *route)
        return self._follow(replace(s, visit=k, purpose="verify" if aside else "calibrate"), now, route, label)

    def _follow(self, s: MountingState, now: MountingInputs, route: Route, label: str) -> MountingState:
        """Start a route."""
        (arm, q), rest = route[0], route[1:]
        return self.go(s, now, "move", q, moving=arm, route=rest, label=label)

    steps: ClassVar = {"start": _start, "move": _arrived, "scan": _scanned}
