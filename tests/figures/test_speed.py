"""The figure of speed: its inputs run, ratios are of pairs, and a commit that is not there is named."""

import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.figures import speed
from tests.figures.__main__ import app
from tests.places import ROOT


def test_the_ratio_is_that_of_the_pairs() -> None:
    assert speed.row("demo", {"a": [10.0, 20.0, 30.0], "now": [5.0, 30.0, 15.0]}) == (
        "| demo | 20.00 | 15.00 | 0.50 | 0.50 to 1.50 |"
    )


def test_pairs_alternate_and_the_first_runs_do_not_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    order: list[str] = []

    def measured(root: Path, words: list[str], folder: Path) -> float:
        order.append(root.name)
        return float(len(order))

    monkeypatch.setattr(speed, "processor_s", measured)
    times = speed.compared([Path("old"), Path("new")], ["demo"], 2, tmp_path)
    assert order == ["old", "new", "old", "new", "new", "old"]
    assert times == [[3.0, 6.0], [4.0, 5.0]]


def test_a_command_is_measured_with_its_processes(tmp_path: Path) -> None:
    (words,) = speed.write_inputs(tmp_path, ["calibrate"]).values()
    assert 0.5 < speed.processor_s(ROOT, words, tmp_path) < 120.0
    assert not (tmp_path / "out").exists()


def test_an_unknown_commit_is_a_sentence() -> None:
    if subprocess.run(["git", "-C", str(ROOT), "rev-parse"], capture_output=True).returncode:
        pytest.skip("no git checkout")
    refused = CliRunner().invoke(app, ["speed", "--against", "no_such_commit", "--only", "calibrate"])
    assert refused.exit_code == 1
    assert "There is no commit 'no_such_commit'" in refused.stderr
