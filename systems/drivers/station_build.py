"""What a driver is given while the station is built: the builder, what else the station holds, and where to export ports."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.tool import WeldingTool

Part = TypeVar("Part")


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
    """Collects what the drivers add; `make_station` exports it under fixed names. `q_start` (6,) rad: where the arm stands.

    `parts` are what else the station holds, found by their type: the simulated world, and what a job puts into it.
    """

    builder: DiagramBuilder
    arm: ArmModel
    tool: WeldingTool | None
    q_start: np.ndarray
    rng: np.random.Generator
    robot: PreparedRobot | None = None
    parts: Sequence[object] = ()
    inputs: dict[str, InputPort] = field(default_factory=dict)
    outputs: dict[str, OutputPort] = field(default_factory=dict)

    def find(self, kind: type[Part]) -> Part | None:
        """The part of this type; None where the station has none."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def require(self, kind: type[Part]) -> Part:
        """The part of this type; raises RuntimeError where the station has none."""
        found = self.find(kind)
        if found is None:
            raise RuntimeError(f"this driver needs a {kind.__name__} in the station")
        return found
