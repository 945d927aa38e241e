"""Builds the cell Diagram of a scenario: the station, the spine shared by all jobs, and the scenario's job."""

import dataclasses as dc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder, PortDataType
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.second_arm import FIRST, SECOND
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.jobs.job import AddedJob, Job, job_of
from weldcal.systems.motion.clear_moves import check_way_home
from weldcal.systems.motion.spine import add_spine
from weldcal.systems.operator import Operator
from weldcal.systems.recording.answers import NotedBackground
from weldcal.systems.recording.player import Playback
from weldcal.systems.recording.tap import OpenSink, add_recorder
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.systems.viewer.cameras import Views, add_cameras
from weldcal.systems.viewer.live import LiveView, add_live_view
from weldcal.systems.wiring import Replacement, Wiring

LOG_PERIOD_S = 0.008  # a row per servo tick

JobOf = TypeVar("JobOf", bound=AddedJob, covariant=True)


@dataclass(frozen=True, eq=False)
class Cell(Generic[JobOf]):
    """The Diagram and its named parts; `operator` may hold and end its run.

    The caller that builds a cell must close its station.

    `diagram` exports the station's output ports under their names, those of the job that JobPorts lists under theirs,
    and `job` (JobCommand), `state` and `process_on` (1). What each vector holds: docs/reference/python_functions.md.
    `logs`: the sinks of the logged values by name; in the Diagram the sink of NAME is called `log_NAME`.
    """

    diagram: Diagram
    station: Station
    scenario: Scenario
    job: JobOf
    logs: dict[str, VectorLogSink]
    operator: Operator = dc.field(default_factory=Operator)

    @property
    def ports(self) -> dict[str, str]:
        """The diagram's output ports by name: the class of the values, or how many numbers a vector has.

        What the numbers mean: docs/reference/python_functions.md, "Ports of a cell".
        """
        found = {}
        for k in range(self.diagram.num_output_ports()):
            port = self.diagram.get_output_port(k)
            vector = port.get_data_type() == PortDataType.kVectorValued
            value = None if vector else port.Allocate().get_value()
            found[port.get_name()] = f"vector of {port.size()}" if vector else type(value).__name__
        return found

    @property
    def plant(self) -> MultibodyPlant | None:
        """The simulated plant, finalized; None where no device of the station is simulated."""
        return None if self.station.world is None else self.station.world.plant

    @property
    def scene_graph(self) -> SceneGraph | None:
        """The simulated plant's SceneGraph; None where no device of the station is simulated."""
        return None if self.station.world is None else self.station.world.scene_graph


def build_cell(
    scenario: Scenario,
    seed: int = 0,
    meshcat: Meshcat | None = None,
    robot: PreparedRobot | None = None,
    played: Playback | None = None,
    open_sink: OpenSink | None = None,
    operator: Operator | None = None,
    live: LiveView | None = None,
    replace: Mapping[str, Replacement] | None = None,
) -> Cell[Any]:
    """Build the cell of a scenario. The caller must close its station.

    The same systems run with simulated plants and with hardware; only the drivers inside `make_station` differ.

    Args:
        scenario: describes the cell; its parts determine the job.
        seed: seed of all random numbers.
        meshcat: viewer of the cell, with the operator's controls; None: no viewer.
        robot, played: see make_station.
        open_sink: opens the sink that takes what enters and leaves the cell; None: nothing is recorded.
        operator: who may hold and end the run; None: a new one, the cell's `operator`.
        live: takes what the dashboard shows; None: no dashboard.
        replace: makes systems that replace systems of the job, by name; each gets that system and the station.

    Raises:
        InputError, UnreachableScanner: the scenario cannot be run, or the job has no system of a name in `replace`;
            nothing has been written or moved.
    """
    job = job_of(scenario)
    station = make_station(scenario, seed, robot, job.set_up_world, played)
    noted = NotedBackground(station.background)
    if open_sink is not None:
        station = dc.replace(station, background=noted)
    try:
        check_way_home(scenario, station)
        operator = operator or Operator()
        wiring = Wiring(
            builder=DiagramBuilder(),
            station=station,
            scenario=scenario,
            seed=seed,
            meshcat=meshcat,
            operator=operator if played is None else None,
            replace=replace or {},
        )
        cell = _build(job, job.plan(scenario, station, seed), wiring, noted, open_sink, live)
        return dc.replace(cell, operator=operator)
    except BaseException:
        station.close()
        raise


def _build(
    job: Job[Any], plan: Any, wiring: Wiring, noted: NotedBackground, open_sink: OpenSink | None, live: LiveView | None
) -> Cell[Any]:
    builder, station, scenario = wiring.builder, wiring.station, wiring.scenario
    builder.AddSystem(station.diagram)
    arms = [(FIRST, station.arm)] + ([] if station.second is None else [(SECOND, station.second)])
    error = job.position_error(scenario, station.arm, wiring.seed)
    # what limits and stops the arm cannot be replaced
    spine = add_spine(dc.replace(wiring, replace={}), arms, job.move_speed, job.move_acceleration, error)
    shared = {system.get_name() for system in builder.GetSystems()}
    added = job.add(wiring, spine, plan)
    names = {system.get_name() for system in builder.GetSystems()} - shared
    if unknown := sorted(set(wiring.replace) - names):
        raise InputError(f"This job has no system '{unknown[0]}' to replace. It has {', '.join(sorted(names))}.")
    spine.connect(added.ports)
    if open_sink is not None:
        noted.note = add_recorder(wiring, added.ports.results, open_sink)
    if live is not None:
        add_live_view(wiring, added.ports, live)
    if wiring.meshcat is not None:
        add_cameras(wiring, added.ports, added.view(), Views() if live is None else live.views)
        period_s = 1.0 / scenario.visualization.recording_fps
        params = MeshcatVisualizerParams(role=Role.kIllustration, prefix="cell", publish_period=period_s)
        visualizer = builder.AddNamedSystem("meshcat_visualizer", MeshcatVisualizer(wiring.meshcat, params))
        builder.Connect(wiring.out("query_object"), visualizer.query_object_input_port())
    logs = {name: LogVectorOutput(port, builder, LOG_PERIOD_S) for name, port in added.ports.logged.items()}
    for name, sink in logs.items():
        sink.set_name(f"log_{name}")
    ports = {
        port.get_name(): port
        for port in map(station.diagram.get_output_port, range(station.diagram.num_output_ports()))
    }
    own = added.ports
    ports |= {**own.logged, **own.shown, **own.results, "job": own.commands[0], "state": own.state}
    for name, port in ports.items():
        builder.ExportOutput(port, name)
    diagram = builder.Build()
    diagram.set_name("cell")
    return Cell(diagram, station, scenario, added, logs)
