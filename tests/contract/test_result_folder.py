"""A result folder belongs to one command at a time, and an earlier result is written over only where that is asked
for."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.calibration.hand_eye.poses import eye_in_hand
from weldcal.models.errors import InputError
from weldcal.models.files import UNFINISHED
from weldcal.tools.cli.app import app
from weldcal.tools.cli.result_folder import RUNNING, claimed


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    F, G, _, _ = eye_in_hand(10, np.random.default_rng(0), 1e-3, 3e-4)
    path = tmp_path_factory.mktemp("pairs") / "pairs.npz"
    np.savez(path, robot=F, camera=G)
    return path


def call(pairs: Path, out: Path, *more: str) -> tuple[int, str]:
    words = ["hand-eye", "ax-yb", str(pairs), "--mounting", "eye_in_hand", "--out", str(out), *more]
    done = CliRunner().invoke(app, words)
    return done.exit_code, " ".join(done.output.split())


def test_an_earlier_result_is_not_written_over(pairs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call(pairs, out)[0] == 0
    assert not (out / RUNNING).exists()
    before = (out / "report.html").read_bytes()
    code, said = call(pairs, out)
    assert code == 1
    assert "already holds a result (report.html). Give another folder with --out, or add --overwrite" in said
    assert (out / "report.html").read_bytes() == before
    assert call(pairs, out, "--overwrite")[0] == 0
    assert call(pairs, tmp_path / "another")[0] == 0


def test_files_that_are_no_result_are_no_reason_to_refuse(pairs: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert call(pairs, tmp_path)[0] == 0
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_killed_run_is_run_again(pairs: Path, tmp_path: Path) -> None:
    (tmp_path / UNFINISHED).write_text("")
    (tmp_path / "report.html").write_text("a part")
    (tmp_path / RUNNING).write_text(f"{ended_process()}\n")
    assert call(pairs, tmp_path)[0] == 0
    assert not (tmp_path / UNFINISHED).exists()


def test_a_second_command_at_once_is_refused(pairs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = (
        "import sys; from pathlib import Path; from weldcal.tools.cli.result_folder import claimed\n"
        f"with claimed(Path({str(out)!r})): print(1, flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-P", "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "1\n"
        for more in ((), ("--overwrite",)):
            code, said = call(pairs, out, *more)
            assert code == 1
            assert f"Another weldcal (process {other.pid}) writes into" in said
    finally:
        other.communicate("")
    assert not out.exists(), "nothing is left of a command that wrote nothing"
    assert call(pairs, out)[0] == 0


def test_a_study_goes_on_and_another_command_does_not(tmp_path: Path) -> None:
    (tmp_path / "tasks.jsonl").write_text("")
    (tmp_path / "report.html").write_text("")
    with claimed(tmp_path, resumes=True):
        assert int((tmp_path / RUNNING).read_text()) == os.getpid()
    with pytest.raises(InputError, match="already holds a result"), claimed(tmp_path):
        pass


def ended_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid
