"""A person at the terminal holds a run in any phase and lets it go on; a page of the viewer cannot."""

from __future__ import annotations

import io
import threading
import time
from typing import Any

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.person import Person, person_at
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario

TOLD = """
scanner: !RenderedScanner {mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}
job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}
"""
HELD_S = 0.3


def made(person: Person) -> Cell[Any]:
    """A cell whose arm goes home from a little beside it, and then parks."""
    scenario = load_scenario("straight_groove", TOLD)
    scenario.job.weld = False
    return build_cell(
        scenario, robot=PreparedRobot(load_arm("ur10e"), np.deg2rad(scenario.home_deg) + 0.05), person=person
    )


def test_the_terminals_lines_hold_and_let_go_on() -> None:
    person = Person()
    for line, holds in (("x", False), ("h", True), ("\n", True), (" G ", False), ("go", False), ("H", True)):
        person.says(line)
        assert person.holds == holds


def test_a_terminal_is_listened_to_until_it_ends() -> None:
    with person_at(io.StringIO("nothing\nh\n")) as person:
        until = time.monotonic() + 5.0
        while not person.holds and time.monotonic() < until:
            time.sleep(0.005)
        assert person.holds


@pytest.mark.parametrize("phase", ["move_home", "park", "start"])
def test_a_job_that_was_held_goes_on_as_if_nothing_had_been(phase: str) -> None:
    ends = []
    for hold in (False, True):
        person, told = Person(), []

        def watch(stage: str, _: float, person: Person = person, told: list[str] = told, hold: bool = hold) -> None:
            told.append(stage)
            if hold and stage == phase_words(phase) and stage not in told[:-1]:
                person.hold()
                threading.Timer(HELD_S, person.go_on).start()

        run = run_cell(made(person), watch)
        assert run.reason is None
        assert run.held_by_person == int(hold)
        assert any(stage.startswith("held by a person") for stage in told) == hold
        ends.append((run.seconds, [name for name, _, _ in run.phases]))
    assert ends[0] == ends[1]


@pytest.mark.parametrize("held", [False, True])
def test_a_person_ends_the_job_also_while_it_is_held(held: bool) -> None:
    person = Person()
    if held:
        person.hold()

    def watch(stage: str, _: float) -> None:
        if stage.startswith("held by a person"):
            threading.Timer(HELD_S, person.end).start()
        elif not held:
            person.end()

    run = run_cell(made(person), watch)
    assert run.held
    assert run.ended_by_operator
    assert (run.reason or "").startswith("The operator ended the job in phase")
    assert run.held_by_person == int(held)


def test_a_pace_that_does_not_exist_is_not_asked_for() -> None:
    person = Person()
    for pace in (float("nan"), -0.1, 3.1, float("inf")):
        person.ask_pace(pace)
        assert person.pace is None
    person.ask_pace(3.0)
    assert person.pace == 3.0
