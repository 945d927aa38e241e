"""What a kind of job is: its part of the scenario, what it asks of it, and how it adds its systems to a cell."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.workpieces import Workpiece
from weldcal.systems.drivers.simulated.furnishing import Furnishing
from weldcal.systems.messages import JobCommand
from weldcal.systems.motion.spine import MOVE_ACCELERATION, MOVE_SPEED, JobPorts, Spine
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

PlanOf = TypeVar("PlanOf")
Phases = Sequence[tuple[str, float, float]]


class AddedJob(ABC):
    """A job's systems in a cell, for whoever runs, measures or tests it."""

    ports: JobPorts
    maximum_time_s: float  # after which the job holds itself

    def command(self, root: Context) -> JobCommand:
        """What the job asks of the first arm, in a context of the whole Diagram."""
        port = self.ports.commands[0]
        found: JobCommand = port.Eval(port.get_system().GetMyContextFromRoot(root))
        return found

    def state(self, root: Context) -> Any:
        """The job's own state in a context of the whole Diagram."""
        return self.ports.state.Eval(self.ports.state.get_system().GetMyContextFromRoot(root))

    def view(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where a viewer stands and looks, (3,) m in B each."""
        return np.array([1.30, -0.68, 0.78]), np.array([0.42, 0.0, 0.42])

    @abstractmethod
    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """What is being done, for a person, and the share of the run that lies behind; `phases` begun: name, simulated s, wall s."""


class Job(ABC, Generic[PlanOf]):
    """A kind of job. Its module holds an instance called JOB; that is how it is found."""

    key: str = ""  # of its part of the scenario; empty: the job of a scenario with no other job's part
    config: type | None = None  # dataclass of that part
    move_speed = MOVE_SPEED  # rad/s of the fastest joint
    move_acceleration = MOVE_ACCELERATION  # rad/s^2

    @abstractmethod
    def check(self, scenario: Scenario) -> None:
        """Refuse, for any scenario, what belongs to this job and does not fit; raises InputError."""

    def furnish(
        self, scenario: Scenario, rng: np.random.Generator, part: Workpiece | None, X_BP: RigidTransform | None
    ) -> Furnishing:
        """What the job puts into a simulated world beside the real workpiece `part` at X_BP."""
        return Furnishing()

    def position_error(self, scenario: Scenario, arm: ArmModel, seed: int) -> LeafSystem | None:
        """A system between the simulated arm and all that reads its joints (see add_spine), or None."""
        return None

    @abstractmethod
    def plan(self, scenario: Scenario, station: Station, seed: int) -> PlanOf:
        """Everything that can be decided before anything moves; raises InputError, UnreachableScanner."""

    @abstractmethod
    def add(self, wiring: Wiring, spine: Spine, plan: PlanOf) -> AddedJob:
        """Add the job's own systems and connect them to the spine and the station."""
