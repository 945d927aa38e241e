"""Each tutorial runs in a fresh process and reaches the figures of its text; its code passes pyright's strict rules."""

from __future__ import annotations

import ast
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.math import RollPitchYaw, RotationMatrix

from tests.documents.blocks import blocks_of
from tests.places import ROOT

FOLDER = ROOT / "docs" / "tutorials"
PAGES = sorted(page.stem for page in FOLDER.glob("*.md") if page.stem != "index")
BEFORE = {"read_a_result": "calibrate_your_scans"}  # it continues in the folder of another one
LONGEST_CELL_S = 60.0  # of processor time
# Like a notebook, whose main module has no file either. The time of a cell includes that of commands that it runs.
RUNNER = """
import json, os, sys
sys.path.insert(0, "")
names = {"__name__": "__main__"}
for cell in json.load(sys.stdin):
    before = sum(os.times()[:4])
    exec(compile(cell, "cell", "exec"), names)
    print(f"[cell: {sum(os.times()[:4]) - before:.1f} s]", flush=True)
"""
Executed = Callable[[str], tuple[Path, str]]


def cells(name: str) -> list[str]:
    """List the code cells of a tutorial."""
    return [block.text for block in blocks_of(FOLDER / f"{name}.md") if block.language == "{code-cell}"]


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> Executed:
    """Execute a tutorial once, in a folder with the files beside it; return the folder and what the cells print."""

    @cache
    def execute(name: str) -> tuple[Path, str]:
        folder = execute(BEFORE[name])[0] if name in BEFORE else tmp_path_factory.mktemp(name)
        for file in (*FOLDER.glob("*.py"), *FOLDER.glob("*.step")):
            shutil.copy(file, folder)
        finished = subprocess.run(
            [sys.executable, "-P", "-c", RUNNER],
            input=json.dumps(cells(name)),
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
            timeout=900,  # a busy computer
        )
        assert finished.returncode == 0, finished.stderr[-2000:]
        return folder, finished.stdout

    return execute


def numbers(text: str) -> list[float]:
    """Read all numbers of a text."""
    return [float(word) for word in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text)]


@pytest.mark.parametrize("name", PAGES)
def test_each_cell_takes_less_than_a_minute(name: str, executed: Executed) -> None:
    seconds = [float(found) for found in re.findall(r"\[cell: (.*) s\]", executed(name)[1])]
    assert len(seconds) == len(cells(name)) > 1
    assert max(seconds) < LONGEST_CELL_S


@pytest.mark.parametrize("name", PAGES)
def test_the_pictures_of_a_page_are_those_that_its_cells_draw(name: str, executed: Executed) -> None:
    text = (FOLDER / f"{name}.md").read_text()
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text):
        drawn = {path.suffix for path in executed(name)[0].rglob("*") if path.stem == Path(picture).stem}
        assert (FOLDER / picture).is_file()
        assert Path(picture).suffix in drawn


def test_the_calibration_of_scans_finds_the_scanner_and_its_scale(executed: Executed) -> None:
    folder, printed = executed("calibrate_your_scans")
    found = yaml.safe_load((folder / "my_calibration" / "calibration.yaml").read_text())
    # three times what the page states as the most of a sigma, and of the camera's height of 0.65 m in angle
    assert found["X_BC"]["xyz"] == pytest.approx([0.66, 0.02, 0.94], abs=1.5e-4)
    turned = RotationMatrix(RollPitchYaw(3.12, 0.03, 0.4)).InvertAndCompose(
        RotationMatrix(np.array(found["X_BC"]["matrix"])[:3, :3])
    )
    assert turned.ToAngleAxis().angle() < 1.5e-4 / 0.65
    sigma_mm = 1e3 * np.sqrt(np.diag(found["covariance"]["matrix"])[3:])
    assert sigma_mm.max() < 0.05
    (line,) = re.findall(r"^\[( *\d.*\d)\]$", printed, re.MULTILINE)
    assert numbers(line) == pytest.approx(sigma_mm, abs=1e-3)
    assert found["scanner_correction"]["scale"] == pytest.approx(1 / 1.003, abs=2e-4)
    assert found["held_out_mm"]["median"] < 0.02
    assert printed.count(" used\n") == 8
    assert "The scanner is corrected" in printed


def test_the_result_moves_points_to_where_the_robot_has_the_flange(executed: Executed) -> None:
    folder, printed = executed("read_a_result")
    (shift_mm,) = numbers(re.findall(r"correction, mm: (.*)", printed)[0])
    rows = {row["id"]: row for row in csv.DictReader((folder / "my_scans" / "poses.csv").open())}
    flange = np.array([float(rows["pose1"][axis]) for axis in "xyz"])
    distance = np.linalg.norm(flange - [0.66, 0.02, 0.94])
    assert shift_mm == pytest.approx(1e3 * 0.003 * distance, rel=0.1)
    centre = numbers(re.findall(r"centre in the base: (.*)", printed)[0])
    assert np.linalg.norm(centre - flange) < 1e-3  # the dowel hole moves the mean of the face by 0.4 mm
    (sigma_mm,) = numbers(re.findall(r"sigma of the point, mm: (.*)", printed)[0])
    assert 0.0 < sigma_mm < 0.05
    assert "my_calibration/report.html" in printed


def test_the_job_finds_the_scanner_where_its_driver_put_it(executed: Executed) -> None:
    _, printed = executed("your_own_driver")
    assert "done None" in printed
    assert "5 scans" in printed
    assert numbers(re.findall(r"p=\[(.*)\]", printed)[0]) == pytest.approx([0.66, 0.01, 0.95], abs=1e-4)


def test_the_arm_goes_where_the_users_systems_send_it(executed: Executed) -> None:
    _, printed = executed("your_own_diagram")
    off, reached = (numbers(line) for line in re.findall(r"^\[([^c].*)\]$", printed, re.MULTILINE))
    assert len(off) == 6
    assert max(map(abs, off)) < 0.1
    assert reached == pytest.approx([170, -75, 115, -45, 95, 10], abs=0.1)


def test_the_filter_smooths_what_the_servo_gets(executed: Executed) -> None:
    _, printed = executed("a_filter")
    assert "done None" in printed
    raw, filtered = (numbers(re.findall(rf"{name} (.*) um", printed)[0])[0] for name in ("raw", "filtered"))
    assert 0.0 < filtered < 0.5 * raw


def test_the_part_has_the_seam_that_the_text_names(executed: Executed) -> None:
    folder, printed = executed("your_own_part")
    rows = {row["id"]: row for row in csv.DictReader((folder / "my_part" / "edges.csv").open())}
    assert rows["18"]["kind"] == "concave"
    # a bracket of 160 mm: the seam is as long as it is wide
    assert float(rows["18"]["length_mm"]) == pytest.approx(160.0)
    assert "160.0 x 100.0" in printed
    assert "160.0 mm, can be welded in one go" in printed


def test_the_robot_is_refused_then_ready_then_moved(executed: Executed) -> None:
    _, printed = executed("a_robot")
    assert "refused: The payload is not that of the scenario my_robot: set 0.00 kg" in printed
    ready = re.findall(r"^ready (\[.*\])$", printed, re.MULTILINE)
    assert len(ready) == 2
    assert "payload" in ast.literal_eval(ready[0])
    assert "The operator ended the job" in printed
    start = np.array([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])  # of an emulated controller
    assert np.abs(np.array(ast.literal_eval(ready[1])) - start).max() > 20.0


def test_a_robot_runs_as_a_script_below_its_guard(tmp_path: Path) -> None:
    body = textwrap.indent("\n".join(cells("a_robot")), "    ")
    (tmp_path / "robot.py").write_text(f'if __name__ == "__main__":\n{body}\n')
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    said = tmp_path / "said.txt"
    with said.open("w") as out:  # a file, because the emulator of a script that fails would hold a pipe open
        command = [sys.executable, "robot.py"]
        script = subprocess.Popen(
            command, cwd=tmp_path, env=environment, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = script.wait(900)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(script.pid, signal.SIGKILL)
    printed = said.read_text()
    assert code == 0, printed[-2000:]
    assert printed.count("The operator ended the job") == 1
    assert len(re.findall(r"^ready \[", printed, re.MULTILINE)) == 2


def test_the_code_passes_the_strict_rules_of_pyright(tmp_path: Path) -> None:
    for file in FOLDER.glob("*.py"):
        shutil.copy(file, tmp_path)
    for name in PAGES:
        (tmp_path / f"{name}.py").write_text("\n".join(cells(name)))
    (tmp_path / "wrong.py").write_text("import weldcal\n\nprint(weldcal.nothing)\n")
    (tmp_path / "pyrightconfig.json").write_text(
        json.dumps({"typeCheckingMode": "strict", "extraPaths": [str(ROOT.parent)]})
    )
    command = [sys.executable, "-P", "-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable, "."]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=400)
    found = [note for note in json.loads(finished.stdout)["generalDiagnostics"] if note["severity"] == "error"]
    wrong = [note for note in found if note["file"].endswith("wrong.py")]
    assert any(note.get("rule") == "reportAttributeAccessIssue" for note in wrong)
    others = [note for note in found if note not in wrong]
    places = [(Path(note["file"]).name, note["range"]["start"]["line"] + 1, note["message"]) for note in others]
    assert places == []
