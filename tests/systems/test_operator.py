"""An operator at the terminal holds a run in any phase and lets it go on; a page of the viewer cannot."""

from __future__ import annotations

import io
import threading
import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.operator import Operator, operator_at
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Run, _tell, run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.run import JobRun

TOLD = """
scanner: !RenderedScanner {mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}
job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}
"""
HELD_S = 0.3


def made(operator: Operator) -> Cell[Any]:
    """A cell whose arm goes home from a little beside it, and then parks."""
    scenario = load_scenario("straight_groove", TOLD)
    scenario.job.weld = False
    return build_cell(
        scenario, robot=PreparedRobot(load_arm("ur10e"), np.deg2rad(scenario.home_deg) + 0.05), operator=operator
    )


def test_the_terminals_lines_hold_and_let_go_on() -> None:
    operator = Operator()
    for line, holds in (("x", False), ("h", True), ("\n", True), (" G ", False), ("go", False), ("H", True)):
        operator.says(line)
        assert operator.holds == holds


def test_a_question_is_answered_by_yes_and_refused_by_no() -> None:
    for line, answered, ends in (("yes\n", True, False), (" Y ", True, False), ("g", True, False), ("ja", False, False), ("No", False, True)):  # fmt: skip
        operator = Operator()
        operator.ask("Start?")
        operator.says(line)
        assert (operator.answered == "Start?", operator.ends) == (answered, ends)
    operator = Operator()
    operator.hold()
    for line in ("yes", "no"):
        operator.says(line)
    assert (operator.holds, operator.ends) == (True, False), "nothing was asked"


def test_the_completed_share_never_falls() -> None:
    shares, told = iter((0.65, 0.31, 0.71, 1.0, 0.98)), []
    job = SimpleNamespace(
        stage=lambda root, phases: ("", next(shares)), command=lambda root: SimpleNamespace(held=False)
    )
    run = Run(cell=cast(Any, SimpleNamespace(job=job)), simulator=cast(Any, None))
    for _ in range(5):
        _tell(run, cast(Any, None), lambda stage, share: told.append(share))
    assert told == [0.65, 0.65, 0.71, 0.98, 0.98]
    finished = JobRun(cast(Any, SimpleNamespace(held=False, share=0.99)), None, "simulated")
    assert finished.share(0.985) == 0.99


def test_a_terminal_is_listened_to_until_it_ends() -> None:
    with operator_at(io.StringIO("nothing\nh\n")) as operator:
        until = time.monotonic() + 5.0
        while not operator.holds and time.monotonic() < until:
            time.sleep(0.005)
        assert operator.holds


@pytest.mark.parametrize("phase", ["move_home", "park", "start"])
def test_a_job_that_was_held_goes_on_as_if_nothing_had_been(phase: str) -> None:
    ends = []
    for hold in (False, True):
        operator, told = Operator(), []

        def watch(
            stage: str, _: float, operator: Operator = operator, told: list[str] = told, hold: bool = hold
        ) -> None:
            told.append(stage)
            if hold and stage == phase_words(phase) and stage not in told[:-1]:
                operator.hold()
                threading.Timer(HELD_S, operator.go_on).start()

        run = run_cell(made(operator), watch)
        assert run.reason is None
        assert run.held_by_person == int(hold)
        assert any(stage.startswith("held by an operator") for stage in told) == hold
        ends.append((run.seconds, [name for name, _, _ in run.phases]))
    assert ends[0] == ends[1]


@pytest.mark.parametrize("held", [False, True])
def test_a_person_ends_the_job_also_while_it_is_held(held: bool) -> None:
    operator = Operator()
    if held:
        operator.hold()

    def watch(stage: str, _: float) -> None:
        if stage.startswith("held by an operator"):
            threading.Timer(HELD_S, operator.end).start()
        elif not held:
            operator.end()

    run = run_cell(made(operator), watch)
    assert run.held
    assert run.ended_by_operator
    assert (run.reason or "").startswith("The operator ended the job in phase")
    assert run.held_by_person == int(held)


def test_a_pace_that_does_not_exist_is_not_asked_for() -> None:
    operator = Operator()
    for pace in (float("nan"), -0.1, 3.1, float("inf")):
        operator.ask_pace(pace)
        assert operator.pace is None
    operator.ask_pace(3.0)
    assert operator.pace == 3.0
