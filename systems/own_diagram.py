"""Add a cell or a station to the builder of a user's own Diagram, as a Diagram inside it."""

from collections.abc import Mapping
from typing import Any

from pydrake.geometry import Meshcat
from pydrake.systems.framework import DiagramBuilder

from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.jobs.job import job_of
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.systems.wiring import Replacement


def AddStation(builder: DiagramBuilder, scenario: Scenario | str, seed: int = 0, *, name: str = "station") -> Station:
    """Add the arms, sensors and tool of a scenario to a builder, without a job; see make_station for the ports.

    Args:
        builder: of the user's own Diagram, which must connect the inputs of `.diagram`.
        scenario: a scenario, or the name or path of one.
        seed: seed of all random numbers.
        name: of the station in the Diagram.

    Returns:
        `.diagram`, the Diagram that was added; `.world`, with plant and scene graph where devices are simulated. The
        caller must close it.

    Raises:
        InputError: the scenario cannot be used. RobotRefused: the robot does not allow the job.
    """
    scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
    station = make_station(scenario, seed, set_up_world=job_of(scenario).set_up_world)
    station.diagram.set_name(name)
    builder.AddSystem(station.diagram)
    return station


def AddCell(
    builder: DiagramBuilder,
    scenario: Scenario | str,
    seed: int = 0,
    meshcat: Meshcat | None = None,
    *,
    replace: Mapping[str, Replacement] | None = None,
    name: str = "cell",
) -> Cell[Any]:
    """Add the cell of a scenario, with its job, to a builder; `run_cell(cell, diagram=...)` then runs the whole.

    Args:
        builder: of the user's own Diagram.
        scenario: a scenario, or the name or path of one.
        seed: seed of all random numbers.
        meshcat: viewer of the cell; None: no viewer.
        replace: makes systems that replace systems of the job, by name; each gets that system and the station.
        name: of the cell in the Diagram.

    Returns:
        `.diagram`, the Diagram that was added, with the output ports that Cell lists. The caller must close the
        `.station`.

    Raises:
        InputError, UnreachableScanner: the scenario cannot be run, or `replace` does not fit the job.
    """
    scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
    cell = build_cell(scenario, seed, meshcat, replace=replace)
    cell.diagram.set_name(name)
    builder.AddSystem(cell.diagram)
    return cell
