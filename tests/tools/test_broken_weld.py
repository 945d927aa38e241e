"""A broken weld is resumed only where it can be: not twice, not complete, not changed, and never without a yes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.places import ROOT
from tests.restarted import disagreements
from tests.welding.record.test_welded_seam import log
from weldcal.models.errors import InputError
from weldcal.models.files import write_apart
from weldcal.systems.jobs.weld.progress_keeper import RESTART, sha256_of
from weldcal.systems.recording.scenario_files import packed
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.tools.cli.result_folder import RUNNING
from weldcal.tools.commands.weld import killed_weld
from weldcal.tools.report.weld_record import part_record
from weldcal.welding.record.order import WeldOrder
from weldcal.welding.record.progress import Progress, Stretch
from weldcal.welding.record.weld_log import weld_log_texts


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


def harness(*arguments: str) -> str:
    """What the harness prints."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.restarted", *arguments], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    return done.stdout


def test_a_weld_whose_process_was_killed_goes_on() -> None:
    assert "1 stops, 0 bad, 0 arcs without a question" in harness("1", "4", "power")


@pytest.mark.parametrize(("kind", "times"), [("sigint", 1), ("kill", 1), ("power", 1), ("pause", 2)])
def test_the_record_states_each_piece_and_what_ended_it(kind: str, times: int) -> None:
    """The union of its pieces is where the true arc burned, and JSON, CSV and pages agree; the second weld has two passes."""
    assert f"{times} interruptions, {times} records right" in harness("record", str(times), "0", kind)


def test_a_folder_says_how_far_a_killed_weld_came(broken: Path) -> None:
    stretch = Stretch(seam=0, piece=0, run=0, from_m=0.0, to_m=0.045, done=False, time="2026-11-27T10:00:00+00:00")
    state(broken, stretches=(stretch,), p_BCrater=np.zeros(3)).write(broken)
    assert "At 45 mm of seam 1 this run was cut off: power was lost" in killed_weld(broken), (
        "the computer started later"
    )
    record = json.loads((broken / "record.json").read_text())
    assert [(p["from_mm"], p["to_mm"], p["run"]) for p in record["pieces"]] == [(0.0, 45.0, 1)]
    assert "the arc broke off at 45 mm in run 1" in (broken / "record.html").read_text()
    shown = CliRunner().invoke(app, ["view", str(broken), "--no-browser"])
    assert (shown.exit_code, shown.stdout.strip()) == (0, str(broken / "record.html"))
    assert f"Go on with weldcal weld --resume {broken}" in " ".join(shown.stderr.split())
    later = replace(stretch, time=datetime.now(UTC).isoformat())
    state(broken, stretches=(later,), p_BCrater=np.zeros(3)).write(broken)
    assert "At 45 mm of seam 1 this run was killed. Go on with" in killed_weld(broken)
    (broken / RUNNING).write_text(f"{os.getppid()}\n")
    with pytest.raises(InputError, match="still runs"):
        killed_weld(broken)


def test_a_second_pass_that_was_killed_has_a_page(broken: Path) -> None:
    first = Stretch(seam=0, piece=0, run=0, from_m=0.0, to_m=0.141, done=True, time="2026-11-27T10:00:00+00:00")
    second = replace(first, weld_pass=1, to_m=0.030, done=False)
    state(broken, stretches=(first, second), p_BCrater=np.zeros(3)).write(broken)
    assert "At 30 mm of seam 1, pass 2, this run was cut off" in killed_weld(broken)
    assert "the arc broke off at 30 mm in run 1" in (broken / "record.html").read_text()


def test_a_joined_record_is_the_same_in_all_its_files(broken: Path) -> None:
    """A run that was stopped at 41 mm, one that was killed at 60 mm, and the one that went on at 52 mm."""
    runs = [log([0.010] * n, s_seam_m=(1e-3 * (a + np.arange(float(n)))).tolist()) for a, n in ((0.0, 42), (52.0, 90))]
    for number, ended, run in ((1, "The operator stopped the run with Ctrl-C.", runs[0]), (3, "done", runs[1])):
        run.settings["plans"], run.settings["arcs"] = [(0, 0)], [{"run": number, "ended": ended}]
        run.settings["ended"] = ended
    for path, text in zip((broken / "weld-1.csv", broken / "weld-1.json"), weld_log_texts(runs[0]), strict=True):
        path.write_text(text)
    second = Stretch(seam=0, piece=0, run=1, from_m=0.033, to_m=0.060, done=False, time="2026-11-27T10:00:00+00:00")
    progress = state(broken, ends=("stopped", "killed", "done"), stretches=(second,))
    record = part_record(WeldOrder(part="4711", operator="jd"), runs[1], progress, broken)
    record.write(broken)
    assert disagreements(broken, None) == []
    document = json.loads((broken / "record.json").read_text())
    assert [(p["run"], p["from_mm"], p["to_mm"], round(p["overlap_mm"], 6)) for p in document["pieces"]] == [
        (1, 0.0, 41.0, 0.0), (2, 33.0, 60.0, 8.0), (3, 52.0, 141.0, 8.0)
    ]  # fmt: skip
    assert document["welded_mm"] == pytest.approx(141.0)
    assert document["outside_limits"] == ["Seam 1: 33 to 60 mm were welded in run 2, whose log is lost."]
    assert ["Ctrl-C" in document["broke_off"][0], "killed" in document["broke_off"][1]] == [True, True]
    page = (broken / "record.html").read_text()
    (broken / "record.html").write_text(page.replace("60.0", "61.0"))
    assert disagreements(broken, None) == [f"record.html has no row {['33.0', '60.0']}"], "it finds another figure"


def test_before_its_first_arc_a_killed_weld_has_no_record(broken: Path) -> None:
    shown = CliRunner().invoke(app, ["view", str(broken), "--no-browser"])
    assert shown.exit_code == 1
    assert "Before its first arc this run was killed. Go on with" in " ".join(shown.stderr.split())
