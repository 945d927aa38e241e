"""The live view in Meshcat, seen by a browser and used by an operator's click."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from tests.browser import Browser, colours
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.motion.spine import HOLD_BUTTON
from weldcal.systems.scenario.loading import load_scenario


@pytest.fixture(scope="module")
def live() -> Iterator[tuple[Meshcat, Cell, Simulator]]:
    """A cell that has just begun to move, shown on this machine only."""
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    cell = build_cell(load_scenario("s_groove"), seed=0, meshcat=meshcat)
    simulator = Simulator(cell.diagram)
    simulator.AdvanceTo(0.4)
    return meshcat, cell, simulator


def test_the_live_view_shows_the_cell(live: tuple[Meshcat, Cell, Simulator], browser: Browser, tmp_path: Path) -> None:
    meshcat, _, _ = live
    browser.open(meshcat.web_url(), wait_for="document.querySelector('canvas')")
    pixels = browser.screenshot(tmp_path / "live.png", until=lambda picture: colours(picture) > 40)
    assert colours(pixels) > 40, "arm, table, workpiece and scanner are drawn"
    assert HOLD_BUTTON in browser.text()


def test_a_click_asks_for_a_hold(live: tuple[Meshcat, Cell, Simulator], browser: Browser) -> None:
    meshcat, cell, simulator = live
    browser.open(meshcat.web_url(), wait_for=f"document.body.innerText.includes('{HOLD_BUTTON}')")
    browser.run(
        "[...document.querySelectorAll('span,div,button')]"
        f".filter(e => e.children.length === 0 && e.innerText === '{HOLD_BUTTON}')[0].click()"
    )
    for _ in range(100):  # the click travels over a socket: give it simulated time until it has arrived
        simulator.AdvanceTo(simulator.get_context().get_time() + 0.02)
        if cell.operator.holds:
            break
    assert cell.operator.holds
    assert cell.operator.held_by == "the 3D view"
