"""The demo's cell on a short seam, finished once a session for all tests that look at what it came to."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.demo import run_scenario
from weldcal.tools.outcomes.demo import DemoResult
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.studies.perfect_world import perfect

SHORTER = "welding: {seam_length_mm: 30.0}\ncalibration: {minimum_scans: 4}"
SHORT_JOB_SEED = 5


def short_job_scenario(preset: str) -> Scenario:
    """The S groove with another scanner, calibrated from as few scans as there may be, in a perfect world; its first 30 mm are
    welded."""
    scanner = f"scanner: !RenderedScanner {{preset: {preset}, width: 824, height: 616}}"
    return perfect(load_scenario("s_groove", f"{SHORTER}\n{scanner}"))


@pytest.fixture(scope="session")
def short_jobs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], DemoResult]:
    """The job on the simulated arm, by the scanner's preset."""

    @cache
    def finished(preset: str) -> DemoResult:
        folder = tmp_path_factory.mktemp(preset) / "run"
        return run_scenario(
            short_job_scenario(preset), RunOptions("a test's own", folder, SHORT_JOB_SEED, recording=False)
        )

    return finished
