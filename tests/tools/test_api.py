"""The examples of docs/python.md run, and an example of a dataset is one that they can use."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

import weldcal
from tests.places import ROOT
from weldcal.models.errors import InputError
from weldcal.tools.commands import new
from weldcal.tools.commands.new import write_example

BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs/python.md").read_text(encoding="utf-8"), flags=re.DOTALL)
CELL = "extends: calibrate_only\njob: {maximum_time_s: 3.0}\nscanner: {width: 412, height: 308}\n"  # held after 3 s


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    fewer = f"{new.SMALL}\ncalibration: {{minimum_scans: 4, maximum_scans: 5, required_error_mm: 5.0}}"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(new, "SMALL", fewer)
        return write_example(tmp_path_factory.mktemp("example") / "my_scans", 1)


@pytest.fixture
def place(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with everything that the examples name."""
    (tmp_path / "my_scans").symlink_to(example)
    (tmp_path / "other_scans").symlink_to(example)
    (tmp_path / "my_cell.yaml").write_text(CELL)
    rng = np.random.default_rng(0)
    X, Y = (RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, 3)), rng.uniform(-0.5, 0.5, 3)) for _ in "XY")
    robot = [RigidTransform(RollPitchYaw(rng.uniform(-0.6, 0.6, 3)), rng.uniform(-0.5, 0.5, 3)) for _ in range(12)]
    camera = [(F @ X).InvertAndCompose(Y).GetAsMatrix4() for F in robot]
    np.savez(tmp_path / "pairs.npz", A=[F.GetAsMatrix4() for F in robot], B=camera, X=X.GetAsMatrix4())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_example_runs_and_has_at_most_eight_lines(place: Path) -> None:
    known: dict[str, object] = {}
    for block in BLOCKS:
        assert len(block.splitlines()) <= 8, block
        exec(compile(block, "docs/python.md", "exec"), known)
    X = weldcal.hand_eye(*(np.load("pairs.npz")[k] for k in "AB")).poses["X"]
    assert X.GetAsMatrix4() == pytest.approx(np.load("pairs.npz")["X"], abs=1e-6)
    assert (place / "my_result" / "calibration.yaml").exists()
    assert (place / "my_run" / "recording.html").exists()
    assert known["summary"]["state"] == "held"  # type: ignore[index]


def test_nothing_is_kept_where_no_folder_is_given(place: Path) -> None:
    before = sorted(place.iterdir())
    found = weldcal.calibrate("my_scans", correct_scanner=False)
    assert found.estimate.inliers.sum() >= 4
    assert sorted(place.iterdir()) == before


def test_importing_weldcal_loads_nothing_else_and_shows_its_functions() -> None:
    script = "import sys, weldcal; assert 'pydrake' not in sys.modules; print(*[n for n in dir(weldcal) if n in weldcal.__all__])"
    finished = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.split() == sorted(weldcal.__all__)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        weldcal.calibrat  # noqa: B018


@pytest.mark.parametrize("shape", [(4, 4), (3, 3, 4), (2, 4, 4)])
def test_poses_of_another_shape_are_refused_in_a_sentence(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"robot and camera must both be \(n, 4, 4\) matrices"):
        weldcal.hand_eye(np.zeros(shape), np.zeros((3, 4, 4)))


def test_an_example_is_not_written_over_something(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty: choose another folder"):
        write_example(tmp_path, 0)
