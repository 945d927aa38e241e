"""`weldcal plan-passes`: its lines are pasted into a scenario, and the beads fill the joint's polygon."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app


def proposed(*words: str) -> tuple[int, str]:
    found = CliRunner().invoke(app, ["plan-passes", *words])
    return found.exit_code, found.output


def shoelace(corners: np.ndarray) -> float:
    x, y = corners.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def filled(scenario: str, lines: str, corners_mm: np.ndarray, feed_m_min: float, wire_mm: float) -> None:
    """Check the pasted passes: their metal against the polygon's area, and that their torches are inside of it."""
    loaded = load_scenario(scenario, lines)
    check_scenario(loaded)
    passes = loaded.welding.passes
    assert passes
    speeds = [loaded.welding.speed_mm_s, *(p.speed_mm_s or math.nan for p in passes)]
    metal = sum(math.pi * (0.5 * wire_mm) ** 2 * feed_m_min / 0.06 / speed for speed in speeds)
    assert metal == pytest.approx(shoelace(corners_mm), rel=0.1)
    slope = corners_mm[2, 0] / corners_mm[2, 1]
    for p in passes:
        assert abs(p.lateral_mm) < p.vertical_mm * slope
        assert 0.0 < p.vertical_mm < corners_mm[2, 1]
    assert sorted(p.vertical_mm for p in passes) == [p.vertical_mm for p in passes]


@pytest.mark.parametrize("feed", [2.0, 4.0, 7.0])
def test_the_passes_of_a_groove_fill_its_section(feed: float) -> None:
    code, lines = proposed("s_groove", "--wire-feed-m-min", f"{feed}")
    assert code == 0, lines
    half = 8.0 * math.tan(math.radians(22.5))  # of the package's plates: 45 deg, 8 mm deep
    filled("s_groove", lines, np.array([(0.0, 0.0), (-half, 8.0), (half, 8.0)]), feed, 1.2)


@pytest.mark.parametrize("throat", [6.0, 9.0])
def test_the_passes_of_a_fillet_fill_its_throat(tmp_path: Path, throat: float) -> None:
    cell = str(write_cell(PARTS["straight_web"](), tmp_path, PartTrial()))
    code, lines = proposed(cell, "--wire-feed-m-min", "6", "--depth-mm", f"{throat}", "--wire-mm", "1.0")
    assert code == 0, lines
    filled(cell, lines, np.array([(0.0, 0.0), (-throat, throat), (throat, throat)]), 6.0, 1.0)


def test_what_cannot_be_proposed_is_refused(tmp_path: Path) -> None:
    cell = str(write_cell(PARTS["straight_web"](), tmp_path, PartTrial()))
    for words, said in (
        (("s_groove",), "wire feed is not known"),
        ((cell, "--wire-feed-m-min", "6"), "by --depth-mm"),
        ((cell, "--depth-mm", "6", "--wire-feed-m-min", "6", "--seam", "2"), "has 1 seams"),
        (("s_groove", "--depth-mm", "9", "--wire-feed-m-min", "6"), "at most 8.0"),
    ):
        code, output = proposed(*words)
        assert code == 1
        assert said in " ".join(output.split())


def test_a_joint_that_the_root_fills_needs_no_pass() -> None:
    code, lines = proposed("s_groove", "--wire-feed-m-min", "12")
    assert code == 0
    assert load_scenario("s_groove", lines).welding.passes == []
