"""A command imports little more than it runs: the lines that `calibrate` and `demo` load keep a bound.

`python -m tests.loaded COMMAND ...` prints them for any call, with the lines that are entered.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.places import ROOT
from weldcal.tools.procedure import RUNNERS, runner_of

# Loaded before the arm moves; a figure that shrinks by much gets a lower bound.
STARTS = {
    "calibrate": ("import weldcal.tools.commands.calibrate", 18_400),
    "demo": (
        "from weldcal.tools.procedure import kind_of, runner_of\n"
        "from weldcal.systems.scenario.loading import load_scenario\n"
        "runner_of(kind_of(load_scenario('s_groove')))",
        48_500,
    ),
}
COUNTED = "\nfrom tests.loaded import loaded\nprint(sum(loaded().values()))"


@pytest.mark.parametrize("command", STARTS)
def test_a_command_loads_no_more_than_its_bound(command: str) -> None:
    begun, bound = STARTS[command]
    finished = subprocess.run(
        [sys.executable, "-c", begun + COUNTED], cwd=ROOT, capture_output=True, text=True, check=True
    )
    lines = int(finished.stdout.split()[-1])
    assert bound - 2_000 < lines <= bound, f"{command} loads {lines} lines: python -m tests.loaded {command} lists them"


def test_a_job_that_does_not_run_is_not_imported() -> None:
    begun, _ = STARTS["demo"]
    code = begun + "\nimport sys\nprint(*sorted(name for name in sys.modules if name.startswith('weldcal.systems')))"
    finished = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "weldcal.systems.jobs.weld.job" in finished.stdout.split()
    for other in ("jobs.motion.job", "jobs.profiler.job", "jobs.tablet.job", "drivers.ur.rtde", "drivers.power.modbus"):
        assert f"weldcal.systems.{other}" not in finished.stdout.split(), other


def test_every_job_finds_what_runs_it() -> None:
    assert all(callable(runner_of(key)) for key in (*RUNNERS, "a job without a command"))
