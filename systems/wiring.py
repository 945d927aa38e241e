"""A DiagramBuilder of a cell with the objects that its parts share, and methods to add and connect systems."""

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from weldcal.systems.operator import Operator
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station

AnySystem = TypeVar("AnySystem", bound=LeafSystem)


@dataclass(frozen=True, eq=False, kw_only=True)
class Wiring:
    """A cell under construction.

    `meshcat` is the viewer, or None; `seed` seeds all random numbers; `operator` may hold and end the run (None: a
    recording is played back).

    `read` and `driven` are the ports of the station that the cell reads, and the sources of those that it drives, by
    name.
    """

    builder: DiagramBuilder
    station: Station
    scenario: Scenario
    seed: int = 0
    meshcat: Meshcat | None = None
    operator: Operator | None = None
    read: dict[str, OutputPort] = field(default_factory=dict)
    driven: dict[str, OutputPort] = field(default_factory=dict)

    def add(self, name: str, system: AnySystem) -> AnySystem:
        """Add a system under its name."""
        self.builder.AddNamedSystem(name, system)
        return system

    def connect(self, system: LeafSystem, **sources: OutputPort) -> None:
        """Connect each source to the system's input port of that name."""
        for port, source in sources.items():
            self.builder.Connect(source, system.GetInputPort(port))

    def out(self, name: str) -> OutputPort:
        """An output port of the station."""
        port = self.station.diagram.GetOutputPort(name)
        self.read[name] = port
        return port

    def feed(self, name: str, source: OutputPort) -> None:
        """Connect a source to an input port of the station."""
        self.builder.Connect(source, self.station.diagram.GetInputPort(name))
        self.driven[name] = source

    def constant(self, name: str, value: object) -> OutputPort:
        """An output port with a constant message."""
        return self.add(name, ConstantValueSource(AbstractValue.Make(value))).get_output_port()

    def zeros(self, name: str, size: int) -> OutputPort:
        """A vector port of zeros."""
        return self.add(name, ConstantVectorSource(np.zeros(size))).get_output_port()
