"""The words for phases: one list, which knows every phase of every job."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.places import ROOT
from weldcal.systems.jobs.weld.sequencer import PHASES
from weldcal.systems.phase_words import OTHERS, STEPS, TEXT, phase_words


def phases_of(file: Path) -> set[str]:
    """The phases that a job's procedure enters: words that are compared with, or given as, a `phase`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.keyword) and node.arg == "phase":
            found |= {w.value for w in ast.walk(node.value) if isinstance(w, ast.Constant) and isinstance(w.value, str)}
        if isinstance(node, ast.Compare) and isinstance(node.left, ast.Attribute) and node.left.attr == "phase":
            found |= {
                w.value
                for side in node.comparators
                for w in ast.walk(side)
                if isinstance(w, ast.Constant) and isinstance(w.value, str)
            }
    return found


@pytest.mark.parametrize("job", ["tablet", "mounting", "motion", "profiler"])
def test_every_phase_of_a_job_has_words(job: str) -> None:
    phases = phases_of(ROOT / "systems" / "jobs" / job / "procedure.py")
    assert len(phases) >= 3
    assert phases <= set(TEXT) | set(OTHERS)


def test_the_weld_job_has_words_and_steps_for_every_phase() -> None:
    assert {*PHASES, "done", "held"} == set(TEXT)
    assert {phase for _, _, phases in STEPS for phase in phases} == set(PHASES)
    assert not set(TEXT) & set(OTHERS)


def test_a_phase_of_an_installed_job_is_told_as_it_is_written() -> None:
    assert phase_words("turn_the_part", "2 of 3") == "turn the part, 2 of 3"
    assert phase_words("weld", "12 of 300 mm") == f"{TEXT['weld']}, 12 of 300 mm"
