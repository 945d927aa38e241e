"""The study of seam planning in its short form: the table of one scanner and one shape."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.figures.parts import planning


def test_the_table_of_the_benchmark_counts_refusals_and_states_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "SHAPES", ("s",))
    summary, rows = planning.run_seam_planning_benchmark(tmp_path, 1, 50, ["azure_kinect"], troubles=False)
    assert summary["trials"] == 2
    assert set(rows) == {"azure_kinect cad", "azure_kinect cloud"}
    with (tmp_path / "trials.csv").open() as table_file:
        trials = list(csv.DictReader(table_file))
    assert len(trials) == 2
    for trial in trials:
        # Noise of 1 mm and points 1.8 mm apart: refused in a sentence, or a line with a sigma that covers its error.
        assert trial["refused"] or float(trial["rms_mm"]) < 3.0 * float(trial["sigma_mm"]) < 2.0
