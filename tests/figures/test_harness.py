"""A study is one description: its table, verdicts and files, and one command of a subject with old names beside it."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.figures.__main__ import app
from tests.figures.harness import MISSED, Study, Target
from weldcal.models.errors import InputError
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.render import statistics


def half(n: int) -> Mapping[str, object]:
    """A case: half of an even number."""
    if n % 2:
        raise InputError("Give an even number.")
    return {"half": n // 2, "of": {"n": n}}


STUDY = Study(
    name="halves",
    what="Halves of even numbers.",
    case=half,
    figures=lambda results: {"largest": max(r["half"] for r in results.values() if "half" in r)},
    header=("figure", "value"),
    rows=lambda f: [("largest", str(f["largest"]))],
    targets=lambda f: [Target("largest", "", f["largest"], 2.0)],
    group="reproduce",
)


def test_a_study_writes_its_table_its_cases_and_its_verdict(tmp_path: Path) -> None:
    cases = {f"case {n}": {"n": n} for n in (2, 3, 6)}
    found = STUDY.run(Farm(tmp_path, workers=0), cases)
    assert found.figures == {"state": "done", "largest": 3}
    assert "| largest | 3 |" in (tmp_path / "table.md").read_text()
    assert "MISSED" in found.markdown()
    assert found.outcome().problem == MISSED
    rows = list(csv.DictReader((tmp_path / "runs.csv").open()))
    assert [row["of.n"] for row in rows] == ["2", "", "6"]
    assert rows[1]["reason"] == "Give an even number."
    assert json.loads((tmp_path / "table.json").read_text())["study"] == "halves"


def test_a_study_without_any_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="even number"):
        STUDY.run(Farm(tmp_path, workers=0), {"case": {"n": 1}})


def test_statistics_leave_out_what_is_not_finite() -> None:
    assert statistics([1.0, float("nan"), 3.0], "mean", "max") == {"mean": 2.0, "max": 3.0}
    assert statistics([], "median")["median"] != statistics([], "median")["median"]


def test_the_page_shows_each_study_with_its_command(tmp_path: Path) -> None:
    STUDY.run(Farm(tmp_path / "one", workers=0), {"case": {"n": 2}})
    document = json.loads((tmp_path / "one/table.json").read_text())
    document |= {"command": "./tools/run figures reproduce halves"}
    (tmp_path / "one/table.json").write_text(json.dumps(document))
    run = CliRunner().invoke(app, ["benchmark", "page", str(tmp_path / "one"), "--out", str(tmp_path / "page")])
    assert run.exit_code == 0, run.output
    page = (tmp_path / "page/BENCHMARK.md").read_text()
    assert "## reproduce halves" in page
    assert "Command: `./tools/run figures reproduce halves`" in page
    assert "| largest | 1 |" in page
    assert "met" in page


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--what", "dance"], "is not one of speed, frames"),
        (["--what", "honesty", "--width", "400"], "takes no --width"),
        (["--what", "live", "--scans", "9"], "at most 8"),
        (["--what", "few"], "needs DATASET"),
    ],
)
def test_a_subject_refuses_what_its_study_does_not_take(words: list[str], said: str) -> None:
    run = CliRunner().invoke(app, ["benchmark", "flange", *words])
    assert run.exit_code == 2
    assert said in " ".join(run.output.replace("│", " ").split())


@pytest.mark.parametrize("old", ["flange-frames", "flange-arm", "hand-eye-cells", "mountings"])
def test_an_old_name_runs_and_is_not_listed(old: str) -> None:
    assert CliRunner().invoke(app, ["benchmark", old, "--help"]).exit_code == 0
    assert f"  {old} " not in CliRunner().invoke(app, ["benchmark", "--help"]).output
