"""The README's headline, run with the scanner's and the arm's errors of the shipped scenario: its bounds hold."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions

SEED = 0


@pytest.fixture(scope="module")
def bounds(repository: Path) -> tuple[float, float]:
    """The largest distances (mm) that the README's first row names: of a scanned point, and of the torch in space."""
    (row,) = re.findall(r"^\| the simulated demo, .*$", (repository / "README.md").read_text(), re.MULTILINE)
    point, torch = re.search(r"at most ([\d.]+) mm from where the arm", row), re.search(r"([\d.]+) mm at most \|", row)
    assert point is not None
    assert torch is not None
    return float(point[1]), float(torch[1])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    """The demo on 30 mm of its seam, nothing else changed: scale, gradient and warp of the scanner, errors of the arm's
    links."""
    scenario = load_scenario("s_groove", "welding: {seam_length_mm: 30.0}")
    out = tmp_path_factory.mktemp("headline") / "demo"
    return run_scenario(scenario, RunOptions(scenario="s_groove", out=out, seed=SEED, recording=False))


def test_a_scanned_point_is_where_the_arm_reports_it(run: DemoResult, bounds: tuple[float, float]) -> None:
    found = run.summary()
    assert found["state"] == "done", found.get("reason")
    assert 0.0 < found["X_BC_error_at_work_mm"] <= bounds[0]  # type: ignore[operator]
    # the errors are those of the headline: without its correction the scanner shifts the point by more than a
    # millimetre
    assert run.status.estimate is not None
    assert run.status.estimate.scanner is not None
    assert abs(run.status.estimate.scanner.scale - 1.0) > 1e-3


def test_the_torch_stays_on_the_seam_in_space(run: DemoResult, bounds: tuple[float, float]) -> None:
    found = run.summary()
    assert 0.0 < found["torch_mean_mm"] < found["torch_max_mm"] <= bounds[1]  # type: ignore[operator]
