"""The next command of verify runs as printed for every kind of result, and what it says of the pose is true."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.calibration.hand_eye.stated_forms import truth, write
from tests.documents.scans import X_BC, write_scans
from tests.tools.test_verify_pairs import moved, pairs
from weldcal.tools.cli.app import app
from weldcal.tools.recorded import calibrate_dataset

TRUTH = np.asarray(X_BC.GetAsMatrix4())
FLANGE = "iso9409-1-50-4-m6"


def asked(line: str) -> tuple[int, dict[str, Any]]:
    """Run a line of weldcal with --json: its exit code and its object."""
    words = shlex.split(line)
    assert words[0] == "weldcal"
    done = CliRunner().invoke(app, [*words[1:], "--json"])
    return done.exit_code, json.loads(done.stdout.splitlines()[-1])


def follow(line: str) -> list[tuple[str, dict[str, Any]]]:
    """Run a line and each next command that it prints, until none is printed or one is no verify."""
    done = []
    while True:
        code, found = asked(line)
        assert code == (found.get("verdict") == "do not use"), (line, found)
        done.append((line, found))
        following = found.get("first_screen", {}).get("command")
        if following is None or shlex.split(line)[1] != "verify" or len(done) > 3:
            return done
        line = following


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_pose_without_a_flange_leads_to_a_calibration(place: Path) -> None:
    header = write_scans(place / "new scans", 6, 1) / "dataset.yaml"
    header.write_text(header.read_text().replace(f"flange: {FLANGE}", "flange: ''"))
    write("matrix txt", moved(TRUTH, 2.0, 3), place)
    (name,) = [path.name for path in place.iterdir() if path.is_file()]
    steps = follow(f"weldcal verify {name} 'new scans' --flange {FLANGE}")
    assert [shlex.split(line)[1] for line, _ in steps] == ["verify", "verify", "calibrate"]
    first, judged, solved = (found for _, found in steps)
    assert first["verdict"] == "use with care"
    assert not [text for text in first["first_screen"]["could_be_wrong"] if "RESULT is" in text]
    assert any("RESULT is" in text for text in first["first_screen"]["good_to_know"])
    assert judged["verdict"] == "do not use"
    assert judged["off_mm"] == pytest.approx(2.0, abs=0.1)
    wanted = 1e3 * (moved(TRUTH, 2.0, 3) - TRUTH)[:3, 3]
    assert np.abs(np.array(judged["off_xyz_mm"]) - wanted).max() < 5.0 * max(judged["off_sigma_mm"])
    assert np.array(judged["X"]) == pytest.approx(moved(TRUTH, 2.0, 3), abs=1e-6)
    for found in (judged["new"]["X"], solved["X_BC"]):
        assert 1e3 * np.linalg.norm(np.array(found)[:3, 3] - TRUTH[:3, 3]) < 0.3


def test_a_result_folder_leads_to_the_doctor_of_its_scans(place: Path) -> None:
    calibrate_dataset(write_scans(place / "scans", 8, 0), place / "result")
    assert asked(f"weldcal verify result {write_scans(place / 'good', 6, 1).name}")[1]["verdict"] == "use it"
    steps = follow(f"weldcal verify result {write_scans(place / 'stretched', 6, 2, scale=1.02).name}")
    assert [shlex.split(line)[1] for line, _ in steps] == ["verify", "doctor"]


def test_pairs_lead_to_a_new_solution_in_their_unit(place: Path) -> None:
    X = truth(1)
    A, B, _ = pairs(16, 1, X)
    A[:, :3, 3] *= 1e3
    B[:, :3, 3] *= 1e3
    np.savez(place / "my pairs.npz", A=A, B=B)
    write("matrix txt", moved(X, 3.0, 1), place)
    (name,) = [path.name for path in place.iterdir() if path.suffix != ".npz"]
    steps = follow(f"weldcal verify {name} 'my pairs.npz' --mounting eye_in_hand --unit mm")
    assert [shlex.split(line)[1] for line, _ in steps] == ["verify", "hand-eye"]
    assert "--unit mm" in steps[1][0]
    assert 1e3 * np.linalg.norm(np.array(steps[1][1]["X"])[:3, 3] - X[:3, 3]) < 1.0


@pytest.mark.parametrize("kind", ["scans", "pairs"])
def test_both_poses_are_labelled(place: Path, kind: str) -> None:
    if kind == "scans":
        write("matrix txt", moved(TRUTH, 2.0, 3), place)
        data, symbol, more = write_scans(place / "data", 5, 1).name, "X_BC", ["--limit-mm", "0.5"]
    else:
        X = truth(1)
        A, B, _ = pairs(16, 1, X)
        np.savez(place / "pairs.npz", A=A, B=B, mode="eye_in_hand")
        write("matrix txt", moved(X, 2.0, 3), place)
        data, symbol, more = "pairs.npz", "X_FC", []
    (name,) = [path.name for path in place.iterdir() if path.is_file() and path.suffix != ".npz"]
    wide = {"COLUMNS": "200"}  # on 80 columns the offset would be the thirteenth line, which only -v shows
    said = " ".join(CliRunner().invoke(app, ["verify", name, data, *more, "--out", "v"], env=wide).stdout.split())
    poses = {
        label: re.findall(rf"{symbol}, {label} (\S+), (\S+), (\S+) mm", said) for label in ("judged", "new solution")
    }
    assert all(len(found) == 1 for found in poses.values()), said
    assert poses["judged"] != poses["new solution"]
    page = (place / "v" / "report.html").read_text()
    assert f"{symbol}, judged:" in page
    assert f"{symbol}, new solution:" in page
    if kind == "scans":
        assert re.search(r"off by \(\S+, \S+, \S+\) mm \+- 0\.\d+ mm \(one sigma\)", said), said
