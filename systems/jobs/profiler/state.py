"""State and data of the profiler job's procedure."""

from dataclasses import dataclass

import numpy as np

from weldcal.models.arrays import Array
from weldcal.systems.background import Answer
from weldcal.systems.jobs.profiler.estimates import EdgeFound, SeamFound, SphereFound, Taken
from weldcal.systems.jobs.profiler.plan import Goal
from weldcal.systems.jobs.profiler.planning_context import PlanningContext
from weldcal.systems.messages import Message


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerState(Message):
    """State and data of the procedure; `step` is the present one: edge, sphere, touch, pass, torch."""

    phase: str = "start"  # start, compute, move, dwell, await, descend, lift, run, done, held
    since: float = 0.0
    goal_id: int = 0
    step: str = ""
    steps_left: tuple[str, ...] = ()
    goals: tuple[Goal, ...] = ()  # the first is the present goal
    sequence: int = 0  # number of the newest requested profile
    seen: int = 0  # number of the newest received profile
    before: int = 0  # number of profiles at the start of the pass
    felt: int = 0  # number of touches at the start of the descent
    taken: tuple[Taken, ...] = ()
    touches: tuple[Array, ...] = ()
    edge: EdgeFound | None = None
    sphere: SphereFound | None = None
    seam: SeamFound | None = None
    edge_scans: tuple[Taken, ...] = ()
    sphere_scans: tuple[Taken, ...] = ()
    seam_scans: tuple[Taken, ...] = ()
    torch_from_s: float = np.inf
    torch_until_s: float = np.inf
    reason: str = ""
    planning: PlanningContext | None = None
    asked: Answer["ProfilerState"] | None = None  # in the phase compute: the state with the next step
