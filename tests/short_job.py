"""The README's demo on a short seam, finished once for all tests that look at what it came to."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions

SEED = 5  # its planned poses lie near each other
# The first 30 mm of the S groove, calibrated from as few scans as there may be; the scanner has noise and no other
# error, and the arm is exact: as in `tests.worlds.scaled_arms`.
SHORT_JOB = """
robot: !SimulatedUr {repeatability_mm: 0.0, kinematic_error_mm: 0.0}
scanner: !RenderedScanner
  {preset: phoxi_m, width: 824, height: 616, scale_error: 0.0, warp_mm: 0.0, gradient_error_per_m: [0.0, 0.0]}
calibration: {minimum_scans: 4, maximum_scans: 10, correct_scanner: false, required_error_mm: 0.10}
welding: {seam_length_mm: 30.0}
"""


def short_job_scenario() -> Scenario:
    """What the short job is run in."""
    return load_scenario("s_groove", SHORT_JOB)


@dataclass(frozen=True)
class ShortJob:
    """What the command left: its exit code, its output, its JSON object, and what it had in its hands."""

    returncode: int
    output: str
    summary: dict[str, Any]
    result: DemoResult


class ShortJobs:
    """The simulated short job, run by the first process of the suite that asks for it."""

    def __init__(self, shared: Path) -> None:
        self._shared = shared
        self.job = cache(self._job)

    def summary(self) -> dict[str, Any]:
        """Its JSON object, whichever process ran it: a seed gives the same figures in each."""
        with self._locked():
            if not self._written.exists():
                self._run()
        return dict(json.loads(self._written.read_text()))

    def folder(self) -> Path:
        """Its result folder, whichever process ran it."""
        self.summary()
        return self._folder

    def _job(self) -> ShortJob:
        with self._locked():
            return self._run()

    @property
    def _written(self) -> Path:
        return self._shared / "short_job.json"

    @property
    def _folder(self) -> Path:
        return self._shared / "short_job"

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with (self._shared / "short_job.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _run(self) -> ShortJob:
        kept: list[DemoResult] = []

        def short(_: Scenario, options: RunOptions, progress: Progress) -> DemoResult:
            kept.append(run_scenario(short_job_scenario(), options, progress))
            return kept[0]

        words = ["demo", "--no-browser", "--seed", str(SEED), "--out", str(self._folder), "--overwrite", "--json"]
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr("weldcal.tools.commands.weld.run_scenario", short)
            finished = CliRunner().invoke(app, words)
        lines = finished.stdout.splitlines()
        summary = json.loads(lines[-1]) if lines else {}
        (job,) = kept
        self._written.write_text(json.dumps(summary))
        return ShortJob(finished.exit_code, finished.output, summary, job)


@pytest.fixture(scope="session")
def short_jobs(tmp_path_factory: pytest.TempPathFactory) -> ShortJobs:
    """The short job, shared by the processes of the suite."""
    base = tmp_path_factory.getbasetemp()
    return ShortJobs(base.parent if "PYTEST_XDIST_WORKER" in os.environ else base)


@pytest.fixture(scope="session")
def finished_demo(short_jobs: ShortJobs) -> ShortJob:
    """The short job, finished in this process."""
    return short_jobs.job()
