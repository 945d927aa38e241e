"""Benchmarks that became one command with --what keep their old names, hidden."""

from __future__ import annotations

import pytest

from weldcal.tools.cli.discovery import find_commands

OLD = (
    *("seeds", "arms", "replay", "recording", "part-welds", "part-registration", "seam-planning"),
    *("robot-faults", "robot-jobs", "wired-faults", "soak"),
)


@pytest.mark.parametrize("name", OLD)
def test_an_old_name_is_a_hidden_command(name: str) -> None:
    assert find_commands()[f"benchmark {name}"].hidden


@pytest.mark.parametrize("subject", ["cell", "parts", "robot"])
def test_a_subject_is_listed(subject: str) -> None:
    assert not find_commands()[f"benchmark {subject}"].hidden
