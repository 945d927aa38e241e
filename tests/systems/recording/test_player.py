"""A played station: its outputs are what was recorded, and follow from no input."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.systems.recording.player import PortPlayer, Track
from weldcal.systems.recording.port_recorder import STAGES


@pytest.fixture
def player() -> PortPlayer:
    tracks = {"q": Track([0, 10 * STAGES], [np.zeros(2), np.ones(2)]), "status": Track([0], ["at rest"])}
    return PortPlayer(tracks, {"velocity_command": 6, "process_on": 1})


def test_no_output_follows_from_an_input(player: PortPlayer) -> None:
    # A real cell's process switch reads the status and drives the process: with a feedthrough it would be a loop.
    assert not player.HasAnyDirectFeedthrough()


def test_each_value_holds_from_its_tick_on(player: PortPlayer) -> None:
    context = player.CreateDefaultContext()
    seen = []
    for time in (0.0, 0.018, 0.022):
        context.SetTime(time)
        seen.append(float(player.GetOutputPort("q").Eval(context)[0]))
    assert seen == [0.0, 0.0, 1.0]
    assert player.GetOutputPort("status").Eval(context) == "at rest"
