"""A fleet of cells: what moved, drifts or cannot be calibrated is named, and what is fine is left alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.worlds import doctor
from tests.worlds.doctor import write_cell
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.fleet import find_cells, judge_cell
from weldcal.tools.report.fleet import FINE, LOOK, VISIT, Checked, sparkline


def calibrated(mm: float = 0.2, **given: Any) -> dict[str, Any]:
    pose = np.eye(4).tolist()
    work = {"p_B_mm": [600.0, 0.0, 300.0], "error_95_mm": 0.3}
    return {
        "state": "done",
        "held_out_mm": {"median": mm},
        "n_used": 20,
        "refused": [],
        "X_BC": pose,
        "work_point": work,
    } | given


def history(*errors_mm: float, refuted: int = 0, newest: dict[str, Any] | None = None) -> tuple[Checked, ...]:
    """Datasets with these errors of the first calibration; the last ``refuted`` verifications say that it must not be
    used."""
    n = len(errors_mm)
    return tuple(
        Checked(
            f"2026-{k + 1:02d}",
            newest if newest is not None and k == n - 1 else calibrated(),
            (
                None
                if k == 0
                else {
                    "state": "done",
                    "verdict": "do not use" if k >= n - refuted else "use it",
                    "reason": "why",
                    "position_error_mm": {"median": mm},
                }
            ),
            None,
            None,
        )
        for k, mm in enumerate(errors_mm)
    )


def test_a_moved_cell_and_one_without_enough_scans_need_a_visit_and_a_good_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "SCANS", 8)
    for name, fault in (("good", "none"), ("hall/moved", "moved"), ("broken", "broken")):
        write_cell(tmp_path / "cells" / name, fault, 2, np.random.default_rng(5))
    call = ["fleet", str(tmp_path / "cells"), "--out", str(tmp_path / "out"), "--workers", "1", "--json"]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 1, done.output
    assert "do not use, for the first calibration of hall/moved." in done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert (found["cells"], found["datasets"], found["fine"]) == (3, 6, 1)
    assert set(found["visit"]) == {"hall/moved", "broken"}
    cells = {cell["cell"]: cell for cell in found["per_cell"]}
    assert cells["hall/moved"]["since"] == "2026-02"
    assert cells["hall/moved"]["shift_mm"] > 1.0 > 0.3 > cells["good"]["shift_mm"]
    assert "2026-02" in cells["broken"]["reason"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.index("hall/moved") < page.index(">good<")
    assert (tmp_path / "out" / "calibrations" / "good" / "2026-01" / "report.html").is_file()
    assert 'href="calibrations/good/2026-02/report.html"' in page
    assert json.loads((tmp_path / "out" / "fleet.json").read_text()) == found
    assert json.loads(CliRunner().invoke(app, call).stdout.splitlines()[-1]) == found  # nothing is left to do


@pytest.mark.parametrize(
    ("datasets", "state", "since"),
    [
        (history(0.2, 0.2, 0.2), FINE, None),
        (history(0.2, 0.9, 0.9, refuted=2), VISIT, "2026-02"),
        (history(0.2, 0.9, 0.2), FINE, None),
        (history(0.20, 0.21, 0.23, 0.25, 0.26, 0.28, 0.3), LOOK, None),
        (history(0.20, 0.21, 0.23, 0.22, 0.26, 0.25, 0.2), FINE, None),
        (history(0.2, 0.2, newest={"state": "failed", "reason": "too few"}), VISIT, None),
        (history(0.2, 0.2, newest=calibrated(0.7)), LOOK, None),
        (history(0.2, 0.2, newest=calibrated(refused=[{}] * 6)), LOOK, None),
    ],
)
def test_a_cell_is_judged_by_its_newest_dataset_and_its_history(
    datasets: tuple[Checked, ...], state: str, since: str | None
) -> None:
    cell = judge_cell("cell", datasets, 0.2)
    assert (cell.state, cell.since) == (state, since)
    assert bool(cell.reason and cell.next) == (state != FINE)


def test_a_first_calibration_that_could_not_be_verified_is_no_fine_cell() -> None:
    *before, newest = history(0.2, 0.2, 0.2)
    lost = replace(newest, verification={"state": "failed", "reason": "There is no calibration at 'x'."})
    cell = judge_cell("cell", (*before, lost), 0.2)
    assert cell.state == LOOK
    assert "could not be verified on '2026-03'. There is no calibration at 'x'." in cell.reason


def test_datasets_of_one_folder_are_a_cell_and_a_dataset_at_the_top_is_one_by_itself(tmp_path: Path) -> None:
    for name in ("b/2", "b/1", "a", "hall/c/1", "b/1/inside"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / name / "dataset.yaml").touch()
    assert {cell: list(datasets) for cell, datasets in find_cells(tmp_path).items()} == {
        "a": ["a"], "b": ["1", "2"], "hall/c": ["1"],
    }  # fmt: skip


def test_a_folder_without_datasets_and_one_dataset_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"No folder below .* has a dataset\.yaml"):
        find_cells(tmp_path)
    (tmp_path / "dataset.yaml").touch()
    with pytest.raises(InputError, match="weldcal calibrate"):
        find_cells(tmp_path)


def test_a_missing_error_is_a_gap_in_the_line() -> None:
    drawn = sparkline([0.2, None, 0.4, 0.3])
    assert drawn.count("M") == 2
    assert "from 0.20 to 0.30 mm, at most 0.40 mm" in drawn
    assert sparkline([0.2]) == ""
