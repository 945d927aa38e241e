"""A cell's memory is freed after its run: no callback and no attribute keeps a system, its Diagram, plants and
renderers alive."""

from __future__ import annotations

import gc
import threading
import weakref
from functools import partial
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus
from pydrake.systems.framework import LeafSystem as DrakeLeafSystem
from pydrake.systems.primitives import LogVectorOutput

from weldcal.systems.cell import build_cell
from weldcal.systems.leaf_system import DECLARATIONS, LeafSystem, without_owner
from weldcal.systems.motion.spine import OperatorPanel
from weldcal.systems.operator import Operator
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.viewer.kept import free_unused


class Every(LeafSystem):
    """Declares every callback, and keeps a port and attributes of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.kept, self.called = self.DeclareVectorInputPort("in", 1), set[str]()
        self.DeclareDiscreteState([0.0])
        self.DeclareAbstractState(AbstractValue.Make(self.called))
        self.DeclareVectorOutputPort("vector", 1, partial(self._output, name="vector"))
        self.DeclareAbstractOutputPort(
            "value", lambda: AbstractValue.Make(""), partial(self._output, name="value"), {self.time_ticket()}
        )
        for name in DECLARATIONS:
            if name.endswith("Event"):
                numbers = (0.1, 0.0) if "Periodic" in name else ()
                answer = EventStatus.Succeeded() if "Publish" in name else None
                getattr(self, name)(*numbers, partial(self._event, name, answer))

    def _output(self, _: Any, output: Any, name: str) -> None:
        self.called.add(name)

    def _event(self, name: str, answer: EventStatus | None, *_: object) -> EventStatus | None:
        self.called.add(name)
        return answer


def simulated() -> Every:
    """A system whose Diagram within a Diagram has run."""
    inside, outside = DiagramBuilder(), DiagramBuilder()
    system = inside.AddSystem(Every())
    inside.ExportOutput(system.GetOutputPort("vector"), "vector")
    diagram = outside.AddSystem(inside.Build())
    LogVectorOutput(diagram.GetOutputPort("vector"), outside, 0.1)
    simulator = Simulator(outside.Build())
    simulator.Initialize()
    simulator.AdvanceTo(0.3)
    context = system.GetMyContextFromRoot(simulator.get_context())
    system.GetOutputPort("value").Eval(context)
    system.ForcedPublish(context)
    after = system.CreateDefaultContext()
    system.CalcForcedDiscreteVariableUpdate(context, after.get_mutable_discrete_state())
    system.CalcForcedUnrestrictedUpdate(context, after.get_mutable_state())
    return system


def test_every_callback_is_called_and_none_keeps_its_system() -> None:
    system = simulated()
    assert system.called == {"vector", "value", *(name for name in DECLARATIONS if name.endswith("Event"))}
    alive = weakref.ref(system)
    del system
    gc.collect()
    assert alive() is None


def test_every_declaration_of_drake_with_a_callback_is_known() -> None:
    taking = {
        name
        for name in dir(DrakeLeafSystem)
        if name.startswith("Declare")
        and any(word in (getattr(DrakeLeafSystem, name).__doc__ or "") for word in ("Callable", "function<"))
    }
    assert taking - {"DeclareCacheEntry"} == set(DECLARATIONS)


def test_what_is_not_a_method_stays_as_it_is() -> None:
    assert without_owner(len) is len
    assert without_owner(3.0) == 3.0
    assert partial(without_owner, 1)() == 1


def test_a_cell_that_has_run_is_freed() -> None:
    told = load_scenario("calibrate_only", "job: {maximum_time_s: 0.05}\nscanner: {width: 412, height: 308}\n")
    run = run_cell(build_cell(told))
    systems = [weakref.ref(system) for system in run.cell.diagram.GetSystems() if isinstance(system, LeafSystem)]
    alive = [weakref.ref(run), weakref.ref(run.cell.diagram), *systems]
    assert len(systems) > 5
    del run
    gc.collect()
    assert [found for one in alive if (found := one()) is not None] == []


def test_a_viewer_outlives_its_cell_until_its_own_thread_frees_it() -> None:
    """Drake ends the process where another thread frees a Meshcat."""
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    panel = OperatorPanel(Operator(), meshcat)
    drawn, panels = weakref.ref(meshcat), weakref.ref(panel)
    free_unused()
    assert panels() is panel
    del meshcat, panel
    for work in (gc.collect, free_unused):
        elsewhere = threading.Thread(target=work)
        elsewhere.start()
        elsewhere.join()
    assert panels() is None
    assert drawn() is not None
    free_unused()
    assert drawn() is None
