"""The interface between drivers and the station builder.

The DiagramBuilder, the station's parts and the ports to export.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from pydrake.systems.framework import DiagramBuilder, InputPort, LeafSystem, OutputPort

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.tool import WeldingTool
from weldcal.systems.wall_clock import WallClock

ARM_PORTS = tuple(
    f"arm.{name}"
    for name in ("velocity_command", "position_measured", "velocity_measured", "X_BF", "sample_time", "status")
)
"""The ports that every robot's driver exports."""
Part = TypeVar("Part")
SystemOf = TypeVar("SystemOf", bound=LeafSystem)


class Closable(Protocol):
    """A resource that a driver holds open outside the Diagram."""

    def close(self) -> None:
        """Close it safely; a second call has no effect."""


@dataclass(frozen=True, eq=False)
class PreparedRobot:
    """The state of the robot before the station is built, as the driver's `PrepareRobot` returns it.

    `q_start` (6,) rad is the arm's present configuration. `clock` paces the Diagram by the wall clock; None: the
    Diagram may run as fast as possible. `waits`: the robot is emulated, and its time waits for this computer.
    `transport`: a sentence about the connection to its controller.
    """

    arm: ArmModel
    q_start: np.ndarray
    handle: Closable | None = None
    clock: WallClock | None = None
    waits: bool = False
    transport: str = ""

    @property
    def pace(self) -> float | None:
        """Seconds of the robot per second of the wall clock; None without a clock."""
        return None if self.clock is None else self.clock.pace

    def rest(self) -> None:
        """Keep the arm at rest while the Diagram is paused, with the handle's `rest` where it has one."""
        if (rest := getattr(self.handle, "rest", None)) is not None:
            rest()

    def close(self) -> None:
        """Close the resource that the driver holds open."""
        if self.handle is not None:
            self.handle.close()


@dataclass(kw_only=True)
class StationBuild:
    """Collects the ports that drivers add; `make_station` exports them under fixed names.

    `q_start` (6,) rad: the arm's present configuration.

    `parts` are further objects of the station, looked up by type: the simulated world, and the parts of a job's
    setup. `closables` are closed with the station.
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
    closables: list[Closable] = field(default_factory=list)

    @property
    def may_wait(self) -> bool:
        """Whether the Diagram may wait for a device.

        It may not while it keeps the pace of a robot that does not wait for it.

        Nor while it follows a robot that waits for it: a device of that robot's world may need the robot's time to go
        on.
        """
        clock = None if self.robot is None else self.robot.clock
        return clock is None or (self.robot is not None and self.robot.waits and not clock.follows)

    def add(self, name: str, system: SystemOf, *exported: str) -> SystemOf:
        """Add a system under its name, and export its ports as the station names them, such as `scanner.trigger`."""
        self.builder.AddNamedSystem(name, system)
        for port in exported:
            own = port.rpartition(".")[2]
            if system.HasInputPort(own):
                self.inputs[port] = system.GetInputPort(own)
            else:
                self.outputs[port] = system.GetOutputPort(own)
        return system

    def find(self, kind: type[Part]) -> Part | None:
        """Return the part of this type; None where the station has none."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def require(self, kind: type[Part]) -> Part:
        """Return the part of this type; raises RuntimeError where the station has none."""
        found = self.find(kind)
        if found is None:
            raise RuntimeError(f"this driver needs a {kind.__name__} in the station")
        return found
