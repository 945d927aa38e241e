"""What a driver is given while the station is built: the builder, the world it is simulated in, and where to export ports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.tool import WeldingTool

if TYPE_CHECKING:
    from weldcal.systems.drivers.simulated_world import SimulatedWorld


@dataclass
class StationBuild:
    """Collects what the drivers add; `make_station` exports it under fixed names."""

    builder: DiagramBuilder
    arm: ArmModel
    tool: WeldingTool | None
    q_home: np.ndarray
    rng: np.random.Generator
    world: SimulatedWorld | None = None
    inputs: dict[str, InputPort] = field(default_factory=dict)
    outputs: dict[str, OutputPort] = field(default_factory=dict)

    def simulated_world(self) -> SimulatedWorld:
        """The world that simulated drivers act in."""
        if self.world is None:
            raise RuntimeError("this driver is simulated and needs a simulated world in the station")
        return self.world
