"""A person's click holds the job for good, and a person's slider sets the pace."""

from __future__ import annotations

import math
import struct

import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from weldcal.systems.motion.operator_panel import HOLD_BUTTON, PACE_SLIDER, OperatorPanel


class Panel:
    """The panel alone, with what it says at any time."""

    def __init__(self, pace: float = 0.0) -> None:
        self.meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
        self.system = OperatorPanel(self.meshcat, pace)
        self.simulator = Simulator(self.system)

    def after(self, duration: float) -> tuple[float, float]:
        """Hold and pace after some more time."""
        context = self.simulator.get_context()
        self.simulator.AdvanceTo(context.get_time() + duration)
        return tuple(float(self.system.GetOutputPort(name).Eval(context)[0]) for name in ("hold", "pace"))  # type: ignore[return-value]

    def click(self) -> None:
        """What the browser sends when the button is clicked."""
        self.send({"type": "button", "name": HOLD_BUTTON})

    def send(self, message: dict[str, str | float]) -> None:
        """What any page may send (msgpack: a map of strings, and numbers of eight bytes)."""
        packed = bytes([0x80 + len(message)])
        for item in (part for pair in message.items() for part in pair):
            if isinstance(item, str):
                word = item.encode()
                packed += (bytes([0xA0 + len(word)]) if len(word) < 32 else bytes([0xD9, len(word)])) + word
            else:
                packed += b"\xcb" + struct.pack(">d", item)
        self.meshcat._InjectWebsocketMessage(packed)


def test_nobody_holds_by_default() -> None:
    assert Panel().after(0.2) == (0.0, 0.0)


def test_a_click_holds_and_stays() -> None:
    panel = Panel()
    panel.after(0.1)
    panel.click()
    assert panel.after(0.1)[0] == 1.0
    panel.meshcat.DeleteButton(HOLD_BUTTON)  # even the count of clicks may go
    panel.meshcat.AddButton(HOLD_BUTTON)
    assert panel.after(0.2)[0] == 1.0


@pytest.mark.parametrize("pace", [0.0, 1.0])
def test_the_slider_begins_at_the_pace_that_was_asked_for_and_can_be_moved(pace: float) -> None:
    panel = Panel(pace)
    assert panel.after(0.1)[1] == pace
    panel.meshcat.SetSliderValue(PACE_SLIDER, 2.0)
    assert panel.after(0.1)[1] == 2.0


def test_a_page_may_send_any_number_and_the_pace_stays_one_that_exists() -> None:
    panel = Panel(1.0)
    panel.send({"type": "slider", "name": PACE_SLIDER, "value": 2.0})
    assert panel.after(0.1) == (0.0, 2.0), "the message is the browser's own"
    for value in (math.nan, math.inf, -math.inf, -1.0, 3.1, 1e300):
        panel.send({"type": "slider", "name": PACE_SLIDER, "value": value})
        assert panel.after(0.1) == (0.0, 2.0), value


def test_no_message_of_a_page_takes_a_hold_back() -> None:
    panel = Panel(1.0)
    panel.click()
    assert panel.after(0.1)[0] == 1.0
    for message in (
        {"type": "button", "name": HOLD_BUTTON},
        {"type": "button", "name": "Go on"},
        {"type": "delete_control", "name": HOLD_BUTTON},
        {"type": "slider", "name": HOLD_BUTTON, "value": 0.0},
    ):
        panel.send(message)  # type: ignore[arg-type]
        assert panel.after(0.1)[0] == 1.0
