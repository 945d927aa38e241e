"""What a driver is given while the station is built: the builder, the world it is simulated in, and where to export ports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.tool import WeldingTool

if TYPE_CHECKING:
    from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture
    from weldcal.systems.drivers.simulated.tablet_world import TabletFittings
    from weldcal.systems.drivers.simulated.world import SimulatedWorld


class Closable(Protocol):
    """What a driver holds open outside the Diagram."""

    def close(self) -> None:
        """End it safely; a second call does nothing."""


@dataclass(frozen=True, eq=False)
class PreparedRobot:
    """The robot as it was found before the station is built, by the `PrepareRobot` beside a driver's config.

    `q_start` (6,) rad is where the arm stands. `pace` is how many seconds of the Diagram a second of the wall clock is worth
    to the robot; None: it does not care, the Diagram may run as fast as it goes.
    """

    arm: ArmModel
    q_start: np.ndarray
    handle: Closable | None = None
    pace: float | None = None

    def close(self) -> None:
        """End what the driver holds open."""
        if self.handle is not None:
            self.handle.close()


@dataclass
class StationBuild:
    """Collects what the drivers add; `make_station` exports it under fixed names. `q_start` (6,) rad: where the arm stands."""

    builder: DiagramBuilder
    arm: ArmModel
    tool: WeldingTool | None
    q_start: np.ndarray
    rng: np.random.Generator
    world: SimulatedWorld | None = None
    robot: PreparedRobot | None = None
    visit: TabletFittings | None = None  # camera, pen and tablet as they truly are, where there is a tablet
    profiler: ProfilerFixture | None = None
    inputs: dict[str, InputPort] = field(default_factory=dict)
    outputs: dict[str, OutputPort] = field(default_factory=dict)

    def simulated_world(self) -> SimulatedWorld:
        """The world that simulated drivers act in."""
        if self.world is None:
            raise RuntimeError("this driver is simulated and needs a simulated world in the station")
        return self.world
