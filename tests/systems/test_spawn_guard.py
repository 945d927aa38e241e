"""A script that starts a robot's job outside `if __name__ == "__main__":` ends with a sentence and runs once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

OPEN = """
from pathlib import Path

with Path("runs.txt").open("a") as runs:
    runs.write("a run\\n")
from weldcal.systems.background import OwnProcess
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station

{job}
"""
STATION = 'make_station(load_scenario("calibrate_only", "robot: !UrRtde {host: 127.30.0.99}"), 1)'
PROCESS = (
    "import os\n{indent}background = OwnProcess()\n{indent}print(background.ask(os.getppid).value == os.getpid())\n"
)
PROCESS += "{indent}background.close()"
GUARD = 'if __name__ == "__main__":'
SENTENCE = f"put what the script runs below {GUARD}"


def executed(folder: Path, text: str) -> tuple[int, str, str, int]:
    """Exit code and output of a script, and how often it has run."""
    (folder / "script.py").write_text(text)
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=240, check=False)
    return done.returncode, done.stdout, done.stderr, len((folder / "runs.txt").read_text().splitlines())


def test_a_job_without_a_guard_ends_with_a_sentence(tmp_path: Path) -> None:
    code, _, said, runs = executed(tmp_path, OPEN.format(job=STATION))
    assert code == 1
    assert SENTENCE in said.splitlines()[-1]
    assert "BrokenProcessPool" not in said
    assert runs == 1


def test_a_job_above_its_guard_does_not_begin_again(tmp_path: Path) -> None:
    code, said, errors, _ = executed(tmp_path, OPEN.format(job=PROCESS.format(indent="") + f"\n{GUARD}\n    pass"))
    assert code == 1
    assert SENTENCE in errors
    assert "outside if __name__" in errors.splitlines()[-1]
    assert said == ""


def test_a_script_with_its_guard_computes_beside_the_robot(tmp_path: Path) -> None:
    job = f"def main():\n    {PROCESS.format(indent='    ')}\n\n\n{GUARD}\n    main()"
    assert executed(tmp_path, OPEN.format(job=job))[:2] == (0, "True\n")


@pytest.mark.parametrize("page", ["python.md", "tutorials/a_robot.md"])
def test_the_pages_name_the_guard(page: str) -> None:
    assert GUARD in (ROOT / "docs" / page).read_text(encoding="utf-8")
