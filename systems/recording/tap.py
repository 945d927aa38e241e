"""Taps a cell under construction: its station's ports and its job's results go to a recorder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from pydrake.systems.framework import OutputPort, PortDataType
from pydrake.systems.primitives import Multiplexer

from weldcal.systems.recording.answers import Note
from weldcal.systems.recording.port_recorder import PortRecorder, PortSink
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

NOT_RECORDED = ("cheat.", "query_object")  # a simulation's truth and its drawing enter no algorithm
QUICK = ".status"  # of an arm: read at each tick


@dataclass(frozen=True)
class PortLayout:
    """The sizes of the vector ports in a row of values, by name and in order: what entered the cell, what left it.

    The ports that left and that are inputs of the station are `drives`, with their sizes.
    """

    entered: dict[str, int]
    left: dict[str, int]
    drives: dict[str, int]


class CellSink(PortSink, Protocol):
    """A PortSink that notes answers, too."""

    def answered(self, number: int, looks: int) -> None:
        """Take how often a question was looked at before its answer was there."""


OpenSink = Callable[[Station, PortLayout], CellSink]
"""Opens a sink for a station."""


def add_recorder(wiring: Wiring, results: Mapping[str, OutputPort], open_sink: OpenSink) -> Note:
    """Add a recorder of everything that enters and leaves the cell; returns where to note answers."""
    entered = {name: port for name, port in wiring.read.items() if not name.startswith(NOT_RECORDED)}
    left = {**wiring.driven, **results}
    rows = _vectors(entered), _vectors(left)
    sizes = [{name: port.size() for name, port in side.items()} for side in rows]
    drives = {name: port.size() for name, port in wiring.driven.items()}
    sink = open_sink(wiring.station, PortLayout(sizes[0], sizes[1], drives))
    messages = _messages(entered), _messages(left)
    totals = (sum(sizes[0].values()), sum(sizes[1].values()))
    quick = tuple(name for name in messages[0] if name.endswith(QUICK))
    models = [{name: port.Allocate() for name, port in side.items()} for side in messages]
    recorder = wiring.add("port_recorder", PortRecorder(totals, models[0], models[1], sink, quick))
    row = list(rows[0].values())
    if row:
        row = [_in_a_row(wiring, "recorded_entered", row)]
        wiring.builder.Connect(row[0], recorder.GetInputPort("entered"))
    if row or rows[1]:
        both = _in_a_row(wiring, "recorded_both", [*row, *rows[1].values()])
        wiring.builder.Connect(both, recorder.GetInputPort("both"))
    for side, ports in zip(("in", "out"), messages, strict=True):
        for name, port in ports.items():
            wiring.builder.Connect(port, recorder.GetInputPort(f"{side}.{name}"))
    return sink.answered


def _vectors(ports: Mapping[str, OutputPort]) -> dict[str, OutputPort]:
    return {name: p for name, p in ports.items() if p.get_data_type() == PortDataType.kVectorValued}


def _messages(ports: Mapping[str, OutputPort]) -> dict[str, OutputPort]:
    return {name: p for name, p in ports.items() if p.get_data_type() != PortDataType.kVectorValued}


def _in_a_row(wiring: Wiring, name: str, ports: Sequence[OutputPort]) -> OutputPort:
    row = wiring.add(name, Multiplexer([port.size() for port in ports]))
    for k, port in enumerate(ports):
        wiring.builder.Connect(port, row.get_input_port(k))
    return row.get_output_port()
