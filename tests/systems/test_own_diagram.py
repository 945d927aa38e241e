"""Stations and cells in a user's own Diagram, and jobs with systems of the user's own."""

from __future__ import annotations

import re
from contextlib import closing
from typing import get_args, get_type_hints

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder
from pydrake.systems.framework import LeafSystem as DrakeSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

import weldcal.systems
import weldcal.welding
from tests.places import ROOT
from tests.systems.cells import EXACT_PLATE, Q_HOME, SMALL_IDEAL_SCANNER, scenario, weld_only_cell
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.jobs.weld.welding_velocity_servo import TELEMETRY, ServoReport
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand
from weldcal.systems.own_diagram import AddCell, AddStation
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import Station
from weldcal.welding.servo.state import Phase, WeldingCommand

SPEED = 0.1  # rad/s


class LiftingServo(LeafSystem):
    """A servo of a user: lifts the tip for a moment, then ends the weld. It reads the job's command only."""

    def __init__(self) -> None:
        super().__init__()
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._since = self.DeclareDiscreteState([-1.0])
        self.DeclareVectorOutputPort("V_BT", 6, self._velocity)
        self.DeclareAbstractOutputPort("servo_report", lambda: AbstractValue.Make(ServoReport()), self._report)
        self.DeclareVectorOutputPort("telemetry", len(TELEMETRY), lambda context, output: None)
        self.DeclareVectorOutputPort("torch_on", 1, lambda context, output: None)
        self.DeclarePeriodicDiscreteUpdateEvent(0.008, 0.0, self._update)

    def _update(self, context: Context, discrete: object) -> None:
        if self._job.Eval(context).mode == "weld" and self._age(context) is None:
            discrete.set_value(self._since, [context.get_time()])

    def _age(self, context: Context) -> float | None:
        since = context.get_discrete_state(self._since).value()[0]
        return None if since < 0.0 else context.get_time() - since

    def _velocity(self, context: Context, output: BasicVector) -> None:
        age = self._age(context)
        output.SetFromVector([0.0] * 5 + [0.0 if age is None or age > 0.5 else 0.02])

    def _report(self, context: Context, output: AbstractValue) -> None:
        age = self._age(context)
        over = age is not None and age > 0.7
        output.set_value(ServoReport(phase=Phase.FAULT, reason="The tip is lifted.") if over else ServoReport())


def test_a_station_moves_in_a_diagram_of_ones_own() -> None:
    builder = DiagramBuilder()
    station = AddStation(builder, scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE), seed=1)
    with closing(station):
        velocity = builder.AddSystem(ConstantVectorSource([SPEED, 0.0, 0.0, 0.0, 0.0, 0.0]))
        builder.Connect(velocity.get_output_port(), station.diagram.GetInputPort("arm.velocity_command"))
        off = builder.AddSystem(ConstantVectorSource([0.0]))
        for name in ("scanner.trigger", "finger_camera.streaming"):
            builder.Connect(off.get_output_port(), station.diagram.GetInputPort(name))
        log = LogVectorOutput(station.diagram.GetOutputPort("arm.position_measured"), builder, 0.1)
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(1.0)
        assert station.world is not None
        plant, root = station.world.plant, simulator.get_context()
        turned = plant.GetPositions(plant.GetMyContextFromRoot(root))[0] - Q_HOME[0]
        # a servo reaches its speed after some hundredths of a second
        assert turned == pytest.approx(SPEED * 1.0, rel=0.1)
        assert log.FindLog(root).data()[0, -1] - Q_HOME[0] == pytest.approx(turned, rel=0.05)


def test_a_job_in_a_users_diagram_calls_the_users_servo() -> None:
    builder, given = DiagramBuilder(), []

    def mine(shipped: DrakeSystem, station: Station) -> LiftingServo:
        given.append((shipped.HasInputPort("planned_seam"), station.tool is not None))
        return LiftingServo()

    short = scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE)
    cell = AddCell(builder, short, replace={"welding_servo": mine}, name="weld_cell")
    heights = LogVectorOutput(cell.diagram.GetOutputPort("tip_and_deflection"), builder, 0.1)
    diagram = builder.Build()
    run = run_cell(cell, diagram=diagram)
    assert given == [(True, True)]
    assert run.reason is not None
    assert "The tip is lifted." in run.reason
    assert diagram.GetSubsystemByName("weld_cell").GetSubsystemByName("log_telemetry") is cell.logs["telemetry"]
    log = heights.FindLog(run.root)
    began = next(at for name, at, _ in run.phases if name == "weld")
    z = np.interp([began, began + 0.6], log.sample_times(), log.data()[2])
    assert z[1] - z[0] == pytest.approx(0.02 * 0.5, rel=0.2)


def ports_on_the_page() -> dict[str, str]:
    """What the table of docs/reference/python_functions.md says of each port of a weld."""
    page = (ROOT / "docs" / "reference" / "python_functions.md").read_text()
    table = page.partition("## Ports of a cell")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.*?`) \| (.*?)(?::.*)? \|$", table, re.MULTILINE)
    return {name: kind for names, kind in rows for name in re.findall(r"`([\w.]+)`", names)}


def test_the_page_says_what_each_port_of_a_weld_holds() -> None:
    assert ports_on_the_page() == weld_only_cell().ports


@pytest.mark.parametrize("name", ["", "motion", "tablet", "profiler_edge", "eye_in_hand"])
def test_the_type_of_every_port_is_a_public_name(name: str) -> None:
    cell = build_cell(load_scenario(name)) if name else weld_only_cell()
    try:
        kinds = {kind for kind in cell.ports.values() if not kind.startswith("vector of ")}
    finally:
        if name:
            cell.station.close()
    assert len(kinds) > 5
    assert kinds - {"QueryObject", "RigidTransform", "Truth"} - set(weldcal.systems.__all__) == set()


@pytest.mark.parametrize("message", [Deformation, ServoReport, WeldingCommand])
def test_the_parts_of_a_message_of_the_weld_are_public_names(message: type) -> None:
    kinds = [kind for hint in get_type_hints(message).values() for kind in (hint, *get_args(hint))]
    own = {kind.__name__ for kind in kinds if getattr(kind, "__module__", "").startswith("weldcal.")}
    assert own
    assert own - {*weldcal.systems.__all__, *weldcal.welding.__all__} == set()


def test_planners_and_estimators_are_replaced_by_name() -> None:
    names, made = ("seam_planner", "deformation_estimator", "job_sequencer"), {}

    def kept(shipped: DrakeSystem, station: Station) -> DrakeSystem:
        made[shipped.__class__.__name__] = shipped
        return shipped

    cell = AddCell(DiagramBuilder(), scenario(), replace=dict.fromkeys(names, kept))
    with closing(cell.station):
        assert list(made) == ["JobSequencer", "SeamPlanner", "ArucoDeformationEstimator"]
        assert {cell.diagram.GetSubsystemByName(name) for name in names} == set(made.values())


class Silent(DrakeSystem):
    """A system without ports."""


class Short(DrakeSystem):
    """A servo with a velocity of three numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort("V_BT", 3, lambda context, output: None)


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("weldig_servo", Silent, "no system 'weldig_servo' to replace. It has .*seam_planner, .*welding_servo"),
        ("slew_limiter", Silent, "no system 'slew_limiter' to replace"),
        ("welding_servo", Silent, r"'welding_servo' has no output port 'V_BT' \(6 numbers\): declare it"),
        (
            "welding_servo",
            Short,
            "'V_BT' of what replaces 'welding_servo' carries 3 numbers: declare it with 6 numbers",
        ),
    ],
)
def test_a_replacement_that_does_not_fit_is_refused(name: str, kind: type[DrakeSystem], message: str) -> None:
    with pytest.raises(InputError, match=message):
        AddCell(DiagramBuilder(), scenario(), replace={name: lambda shipped, station: kind()})
