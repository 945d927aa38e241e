"""Whatever stops the arm turns the torch off first: in the same look at the Diagram, and for the rest of that weld."""

from __future__ import annotations

import dataclasses as dc
from collections.abc import Callable

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from tests.systems.cells import Q_HOME, place_servo, weld_only_cell
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.weld.sequencer import JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import JobCommand, UrStatus
from weldcal.systems.motion.spine import ProcessSwitch
from weldcal.welding.servo.state import Diagnostics, Phase, WeldingCommand

WELD = JobCommand(phase="weld", mode="weld", process_on=True)
WELDING = JobState(phase="weld", process_on=True)
ON_THE_WAY = np.array([0.0, 0.0, 0.0, 0.0, 0.008, 0.0])


class Welding:
    """The whole cell's Diagram in the middle of a weld: the arc burns, the arm is on its way."""

    def __init__(self, cell: Cell) -> None:
        self.diagram = cell.diagram
        self.root = cell.diagram.CreateDefaultContext()
        self.job(WELDING)
        self.report(Phase.TRACK, torch_on=True)
        self.arm(Q_HOME)

    def context(self, name: str) -> Context:
        return self.diagram.GetSubsystemByName(name).GetMyMutableContextFromRoot(self.root)

    def job(self, state: JobState) -> None:
        self.context("job_sequencer").SetAbstractState(0, state)

    def report(self, phase: Phase, *, torch_on: bool) -> None:
        command = WeldingCommand(ON_THE_WAY, torch_on, phase, None, Diagnostics())
        report = ServoReport(
            phase=str(phase),
            torch_on=torch_on,
            reason=None,
            command=command,
            state=None,
            time=0.0,
            X_BT=RigidTransform(),
        )
        self.context("welding_servo").SetAbstractState(0, report)

    def arm(self, q: np.ndarray, fault: float = 0.0) -> None:
        station = self.diagram.GetSubsystemByName("station")
        servo = station.GetSubsystemByName("arm_servo").GetMyMutableContextFromRoot(self.root)
        place_servo(servo, q, fault=fault)

    def person_holds(self) -> None:
        self.context("operator_panel").SetDiscreteState(0, [1.0])

    @property
    def process_on(self) -> bool:
        return bool(self.diagram.GetOutputPort("process_on").Eval(self.root)[0])

    @property
    def arm_moves(self) -> bool:
        arbiter = self.diagram.GetSubsystemByName("command_arbiter")
        wanted = arbiter.GetOutputPort("velocity_wanted").Eval(arbiter.GetMyContextFromRoot(self.root))
        return bool(np.abs(wanted).max() > 0.0)


def stretched() -> np.ndarray:
    q = Q_HOME.copy()
    q[2] = 0.0
    return q


# What stops a weld, and whether the arm is still told to move in that same moment.
CAUSES: dict[str, tuple[Callable[[Welding], None], bool]] = {
    "a fault of the servo": (lambda w: w.report(Phase.FAULT, torch_on=False), True),
    "a held job": (lambda w: w.job(dc.replace(WELDING, phase="held")), False),
    "a job that only takes back its consent": (lambda w: w.job(dc.replace(WELDING, process_on=False)), True),
    "an operator": (lambda w: w.person_holds(), True),
    "a protective stop of the robot": (lambda w: w.arm(Q_HOME, fault=1.0), False),
    "the guard of the arm's singularities": (lambda w: w.arm(stretched()), False),
}


def test_the_arc_burns_and_the_arm_moves_while_nothing_speaks_against_it() -> None:
    weld = Welding(weld_only_cell())
    assert weld.process_on
    assert weld.arm_moves


@pytest.mark.parametrize("cause", CAUSES)
def test_in_the_moment_that_would_stop_the_arm_the_torch_is_off(cause: str) -> None:
    weld = Welding(weld_only_cell())
    stop, still_moving = CAUSES[cause]
    stop(weld)
    assert not weld.process_on
    assert weld.arm_moves == still_moving


class Alone:
    """The switch by itself."""

    def __init__(self) -> None:
        self.system = ProcessSwitch()
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.feed(torch_wanted=[1.0], job=WELD, robot_status=UrStatus(), margin=[0.5, 0.0], hold=[0.0])

    def feed(self, **values: object) -> None:
        for name, value in values.items():
            fixed = np.array(value) if isinstance(value, list) else AbstractValue.Make(value)
            self.system.GetInputPort(name).FixValue(self.context, fixed)

    def after(self, seconds: float) -> tuple[bool, bool]:
        """(process on, arm stopped by the guard)."""
        self.simulator.AdvanceTo(self.context.get_time() + seconds)
        ports = (self.system.GetOutputPort(name).Eval(self.context)[0] for name in ("process_on", "arm_stopped"))
        on, stopped = (bool(v) for v in ports)
        return on, stopped


STOPS = {"margin": ([0.02, 1.0], [0.5, 0.0]), "robot_status": (UrStatus(safety_mode="PROTECTIVE_STOP"), UrStatus())}


@pytest.mark.parametrize("name", STOPS)
def test_a_torch_once_turned_off_does_not_come_back_by_itself(name: str) -> None:
    switch, (bad, good) = Alone(), STOPS[name]
    assert switch.after(0.01) == (True, False)
    switch.feed(**{name: bad})
    assert switch.after(0.01) == (False, name == "margin")
    switch.feed(**{name: good})
    assert switch.after(0.01) == (False, name == "margin")
    switch.feed(job=JobCommand(mode="move"))
    switch.after(0.01)
    switch.feed(job=WELD)
    assert switch.after(0.01) == (True, False), "another weld begins afresh"


def test_a_person_who_holds_turns_the_torch_off_until_the_servo_asks_for_it_after_that() -> None:
    switch = Alone()
    assert switch.after(0.01) == (True, False)
    switch.feed(hold=[1.0])
    assert switch.after(0.0) == (False, False), "in the same look"
    assert switch.after(0.01) == (False, False)
    switch.feed(torch_wanted=[0.0])
    assert switch.after(0.01) == (False, False)
    switch.feed(hold=[0.0])
    assert switch.after(0.01) == (False, False), "the servo is on its way back"
    switch.feed(torch_wanted=[1.0])
    assert switch.after(0.01) == (True, False)


def test_a_guard_that_slows_the_arm_before_the_arc_is_no_stop() -> None:
    switch = Alone()
    switch.feed(torch_wanted=[0.0], margin=[0.02, 1.0])
    assert switch.after(0.01) == (False, False)
    switch.feed(torch_wanted=[1.0], margin=[0.5, 0.0])
    assert switch.after(0.01) == (True, False)
