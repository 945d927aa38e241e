"""The words for phases: one list, which knows every phase of every job."""

from __future__ import annotations

from typing import Any

import pytest

from weldcal.systems.jobs.motion.procedure import MotionProcedure
from weldcal.systems.jobs.mounting.procedure import MountingProcedure
from weldcal.systems.jobs.procedure import ENDS, Procedure
from weldcal.systems.jobs.profiler.procedure import ProfilerProcedure
from weldcal.systems.jobs.tablet.procedure import TabletProcedure
from weldcal.systems.jobs.tool_scan.job import ToolScanProcedure
from weldcal.systems.jobs.touch.procedure import TouchProcedure
from weldcal.systems.jobs.weld.sequencer import PHASES
from weldcal.systems.phase_words import OTHERS, STEPS, TEXT, phase_words


@pytest.mark.parametrize(
    "procedure",
    [TabletProcedure, MountingProcedure, MotionProcedure, ProfilerProcedure, TouchProcedure, ToolScanProcedure],
)
def test_every_phase_of_a_job_has_words(procedure: type[Procedure[Any, Any]]) -> None:
    assert len(procedure.steps) >= 3
    assert {*procedure.steps, *ENDS} <= set(TEXT) | set(OTHERS)
    assert {*procedure.moves, *procedure.driven} <= set(procedure.steps)


def test_the_weld_job_has_words_and_steps_for_every_phase() -> None:
    assert {*PHASES, "done", "held"} == set(TEXT)
    assert {phase for _, _, phases in STEPS for phase in phases} == set(PHASES)
    assert not set(TEXT) & set(OTHERS)


def test_a_phase_of_an_installed_job_is_told_as_it_is_written() -> None:
    assert phase_words("turn_the_part", "2 of 3") == "turn the part, 2 of 3"
    assert phase_words("weld", "12 of 300 mm") == f"{TEXT['weld']}, 12 of 300 mm"
