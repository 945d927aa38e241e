"""A broken weld is resumed only where it can be: not twice, not complete, not changed, and never without a yes."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.places import ROOT
from weldcal.models.files import write_apart
from weldcal.systems.jobs.weld.progress_keeper import RESTART, sha256_of
from weldcal.systems.recording.scenario_files import packed
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.welding.record.progress import Progress


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    files = packed(load_scenario("straight_groove"))
    for name, data in files.items():
        write_apart(tmp_path / RESTART / name, data)
    state(tmp_path).write(tmp_path)
    return tmp_path


def state(folder: Path, **changes: object) -> Progress:
    files = {path.name: path.read_bytes() for path in (folder / RESTART).iterdir()}
    begun = Progress(scenario="straight_groove", seed=1, robot=None, scenario_sha256=sha256_of(files))
    return replace(begun, **changes)  # type: ignore[arg-type]


def resumed(folder: Path, *more: str) -> str:
    there = sorted(path.name for path in folder.iterdir())
    done = CliRunner().invoke(app, ["weld", "--resume", str(folder), *more])
    assert done.exit_code in (1, 2), done.output
    assert sorted(path.name for path in folder.iterdir()) == there
    return " ".join(done.output.split())


def test_an_arc_needs_somebody_who_says_yes(broken: Path) -> None:
    assert "nobody could give it: run the command in a terminal" in resumed(broken, "--no-browser")
    assert "nobody could give it" in resumed(broken, "--json")


def test_what_cannot_go_on_is_refused(broken: Path) -> None:
    assert "omit it" in resumed(broken, "--dry-run")
    assert "give no other" in resumed(broken, "--scenario", "s_groove")
    state(broken, done=True).write(broken)
    assert "is complete" in resumed(broken)
    assert "omit --out" in resumed(broken, "--out", str(broken / "out"))
    state(broken).write(broken)
    (broken / RESTART / "scenario.yaml").write_text("extends: straight_groove\n")
    assert "is not that of the broken weld" in resumed(broken)
    assert "holds no broken weld" in resumed(broken / RESTART)


@pytest.mark.parametrize(
    ("welding", "refused"),
    [
        ("passes: [{vertical_mm: 3.0}]", "of several passes cannot go on"),
        ("stitch: {on_mm: 20, off_mm: 20}", "of stitches can go on only with"),
    ],
)
def test_what_no_single_crater_describes_is_not_resumed(tmp_path: Path, welding: str, refused: str) -> None:
    scenario = load_scenario("straight_groove", f"welding: {{{welding}}}")
    for name, data in packed(scenario).items():
        write_apart(tmp_path / RESTART / name, data)
    for done in (False, True):  # the root's end is not the weld's
        state(tmp_path, done=done).write(tmp_path)
        assert refused in resumed(tmp_path)


def test_a_weld_whose_process_was_killed_goes_on() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.restarted", "1", "4", "power"], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert "1 stops, 0 bad, 0 arcs without a question" in done.stdout
