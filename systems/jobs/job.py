"""Job: the base class of jobs, and those of weldcal and of installed packages by their keys."""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Generic, TypeVar

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, OutputPort

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.discovery import plugins
from weldcal.systems.drivers.simulated.world import WorldSetup
from weldcal.systems.messages import JobCommand
from weldcal.systems.motion.spine import MOVE_ACCELERATION, MOVE_SPEED, JobPorts, Spine
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

PlanOf = TypeVar("PlanOf")
Phases = Sequence[tuple[str, float, float]]
JOBS = {
    "": "weld",
    "motion": "motion",
    "mounting": "mounting",
    "profiler_job": "profiler",
    "tablet": "tablet",
    "tool_scan": "tool_scan",
    "touch": "touch",
}
"""The folders of weldcal's own jobs by the key of their part of a scenario; jobs/<folder>/job.py holds JOB."""


@dataclass(eq=False, kw_only=True)
class AddedJob(ABC):
    """Give the run loop, the reports and the tests access to a job's systems in a cell."""

    ports: JobPorts
    maximum_time_s: float  # the job holds itself after this time

    def command(self, root: Context) -> JobCommand:
        """Return the job's command to the first arm; `root` is a context of the whole Diagram."""
        found: JobCommand = self.value(self.ports.commands[0], root)
        return found

    def state(self, root: Context) -> Any:
        """Return the job's state; `root` is a context of the whole Diagram."""
        return self.value(self.ports.state, root)

    @staticmethod
    def value(port: OutputPort, root: Context) -> Any:
        """Return the value of an output port; `root` is a context of the whole Diagram."""
        return port.Eval(port.get_system().GetMyContextFromRoot(root))

    def view(self) -> tuple[Array, Array]:
        """Position and target of the viewer's camera, (3,) m in B each."""
        return np.array([1.30, -0.68, 0.78]), np.array([0.42, 0.0, 0.42])

    def can_stand(self, root: Context) -> bool:
        """Return whether the Diagram's time may stand still now.

        Where an operator holds a job that has motion of its own, it rests first.
        """
        return True

    @abstractmethod
    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """Return the present step as text, and the completed share of the run.

        `phases`: started phases as name, simulated s, wall s.
        """


class Job(ABC, Generic[PlanOf]):
    """Base class of a job. Its module defines an instance named JOB, by which discovery finds it."""

    key: str = ""  # key of its part of the scenario; empty: the default job
    config: type | None = None  # dataclass of that part
    move_speed = MOVE_SPEED  # rad/s of the fastest joint
    move_acceleration = MOVE_ACCELERATION  # rad/s^2

    def check(self, scenario: Scenario) -> None:
        """Check this job's part of a scenario, which has one; raises InputError."""

    def set_up_world(
        self, scenario: Scenario, rng: np.random.Generator, part: WeldPart | None, X_BP: RigidTransform | None
    ) -> WorldSetup:
        """Return the objects that the job adds to a simulated world, besides the true workpiece `part` at X_BP."""
        return WorldSetup()

    def position_error(self, scenario: Scenario, arm: ArmModel, seed: int) -> LeafSystem | None:
        """Return a system between the simulated arm and the readers of its joints (see add_spine), or None."""
        return None

    @abstractmethod
    def plan(self, scenario: Scenario, station: Station, seed: int) -> PlanOf:
        """Plan everything that can be planned before any motion; raises InputError, UnreachableScanner."""

    @abstractmethod
    def add(self, wiring: Wiring, spine: Spine, plan: PlanOf) -> AddedJob:
        """Add the job's systems and connect them to the spine and the station."""


@cache
def added_jobs() -> dict[str, Job[Any]]:
    """Return the jobs of installed packages by their keys."""
    found = [module.JOB for module in plugins() if hasattr(module, "JOB")]
    return {job.key: job for job in found if job.key}


def job_keys() -> tuple[str, ...]:
    """Return the keys of all jobs that a scenario may have, sorted; no module of a job is imported."""
    return tuple(sorted({*JOBS, *added_jobs()} - {""}))


def job_at(key: str) -> Job[Any]:
    """Return the job with a key of `job_keys`, or the one without a key for ""; imports its module."""
    added = added_jobs().get(key)
    return importlib.import_module(f"weldcal.systems.jobs.{JOBS[key]}.job").JOB if added is None else added


def job_of(scenario: Scenario) -> Job[Any]:
    """Return the job of a scenario: the one whose part the scenario contains, else the job without a key.

    Raises:
        InputError: the scenario has the parts of two jobs.
    """
    asked = [key for key in job_keys() if getattr(scenario, key, None) is not None]
    if len(asked) > 1:
        raise InputError(f"A scenario has one job: move {' or '.join(asked)} to another scenario.")
    return job_at(asked[0] if asked else "")
