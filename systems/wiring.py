"""A DiagramBuilder of a cell with the objects that its parts share, and methods to add and connect systems."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar, cast

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort, PortDataType, System
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from weldcal.models.errors import InputError
from weldcal.systems.operator import Operator
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station

AnySystem = TypeVar("AnySystem", bound=LeafSystem)
Replacement = Callable[[LeafSystem, Station], System]
"""Makes the system that replaces a job's system of that name, from that system and the station."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Wiring:
    """A cell under construction.

    `meshcat` is the viewer, or None; `seed` seeds all random numbers; `operator` may hold and end the run (None: a
    recording is played back).

    `read` and `driven` are the ports of the station that the cell reads, and the sources of those that it drives, by
    name. `replace`: what makes the systems that replace others, by name.
    """

    builder: DiagramBuilder
    station: Station
    scenario: Scenario
    seed: int = 0
    meshcat: Meshcat | None = None
    operator: Operator | None = None
    read: dict[str, OutputPort] = field(default_factory=dict)
    driven: dict[str, OutputPort] = field(default_factory=dict)
    replace: Mapping[str, Replacement] = field(default_factory=dict)

    def add(self, name: str, system: AnySystem) -> AnySystem:
        """Add a system, or its replacement, under its name.

        Raises:
            InputError: the replacement lacks an output port of the system.
        """
        if name in self.replace:
            replacement = self.replace[name](system, self.station)
            _check_outputs(name, system, replacement)
            system = cast(AnySystem, replacement)
        self.builder.AddNamedSystem(name, system)
        return system

    def connect(self, system: LeafSystem, **sources: OutputPort) -> None:
        """Connect each source to the system's input port of that name; a replacement need not have all of them."""
        for port, source in sources.items():
            if system.get_name() not in self.replace or system.HasInputPort(port):
                self.builder.Connect(source, system.GetInputPort(port))

    def out(self, name: str) -> OutputPort:
        """Return an output port of the station."""
        port = self.station.diagram.GetOutputPort(name)
        self.read[name] = port
        return port

    def feed(self, name: str, source: OutputPort) -> None:
        """Connect a source to an input port of the station."""
        self.builder.Connect(source, self.station.diagram.GetInputPort(name))
        self.driven[name] = source

    def constant(self, name: str, value: object) -> OutputPort:
        """Return an output port with a constant message."""
        return self.add(name, ConstantValueSource(AbstractValue.Make(value))).get_output_port()

    def zeros(self, name: str, size: int) -> OutputPort:
        """Return a vector port of zeros."""
        return self.add(name, ConstantVectorSource(np.zeros(size))).get_output_port()


def _kind(port: OutputPort) -> str:
    """What a port carries, in words: how many numbers, or which class."""
    if port.get_data_type() == PortDataType.kVectorValued:
        return f"{port.size()} numbers"
    return type(port.Allocate().get_value()).__name__


def _check_outputs(name: str, system: System, replacement: System) -> None:
    for port in (system.get_output_port(k) for k in range(system.num_output_ports())):
        own, kind = port.get_name(), _kind(port)
        if not replacement.HasOutputPort(own):
            raise InputError(f"What replaces '{name}' has no output port '{own}' ({kind}): declare it.")
        if (given := _kind(replacement.GetOutputPort(own))) != kind:
            raise InputError(f"Output port '{own}' of what replaces '{name}' carries {given}: declare it with {kind}.")
