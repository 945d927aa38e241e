"""The panel brings an operator's wishes and the viewer's controls into the Diagram; the viewer can hold and set the pace,
no more."""

from __future__ import annotations

import math
import struct

import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from weldcal.systems.motion.spine import HOLD_BUTTON, PACE_SLIDER, OperatorPanel
from weldcal.systems.operator import Operator


class Panel:
    """The panel alone, with what it says at any time."""

    def __init__(self, pace: float | None = None, *, viewer: bool = True) -> None:
        self.operator = Operator()
        if pace is not None:
            self.operator.ask_pace(pace)
        self.meshcat = Meshcat(MeshcatParams(host="localhost", port=0)) if viewer else None
        self.system = OperatorPanel(self.operator, self.meshcat)
        self.simulator = Simulator(self.system)

    def after(self, duration: float) -> tuple[float, float, float]:
        """Hold, end and pace after some more time."""
        context = self.simulator.get_context()
        self.simulator.AdvanceTo(context.get_time() + duration)
        hold, end, pace = (float(self.system.GetOutputPort(n).Eval(context)[0]) for n in ("hold", "end", "pace"))
        return hold, end, pace

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
    assert Panel().after(0.2) == (0.0, 0.0, 0.0)


def test_a_persons_wishes_are_in_the_diagram_within_ten_milliseconds_without_a_viewer() -> None:
    panel = Panel(viewer=False)
    panel.after(0.1)
    panel.operator.hold()
    assert panel.after(0.01) == (1.0, 0.0, 0.0)
    panel.operator.go_on()
    panel.operator.ask_pace(1.5)
    assert panel.after(0.01) == (0.0, 0.0, 1.5)
    panel.operator.end()
    assert panel.after(0.01) == (0.0, 1.0, 1.5)


def test_a_click_of_the_viewer_holds_until_a_person_lets_it_go_on_and_another_click_holds_again() -> None:
    panel = Panel()
    panel.after(0.1)
    for _ in range(2):
        panel.click()
        assert panel.after(0.1)[:2] == (1.0, 0.0)
        assert panel.operator.held_by == "the 3D view"
        panel.operator.go_on()
        assert panel.after(0.1)[:2] == (0.0, 0.0)


@pytest.mark.parametrize("pace", [0.0, 1.0])
def test_the_slider_begins_at_the_pace_that_was_asked_for_and_can_be_moved(pace: float) -> None:
    panel = Panel(pace)
    assert panel.after(0.1)[2] == pace
    panel.meshcat.SetSliderValue(PACE_SLIDER, 2.0)
    assert panel.after(0.1)[2] == 2.0


def test_a_pace_asked_for_elsewhere_moves_the_slider() -> None:
    panel = Panel(1.0)
    panel.after(0.1)
    panel.operator.ask_pace(2.5)
    assert panel.after(0.1)[2] == 2.5
    assert panel.meshcat.GetSliderValue(PACE_SLIDER) == 2.5


def test_a_page_may_send_any_number_and_the_pace_stays_one_that_exists() -> None:
    panel = Panel(1.0)
    panel.send({"type": "slider", "name": PACE_SLIDER, "value": 2.0})
    assert panel.after(0.1) == (0.0, 0.0, 2.0), "the message is the browser's own"
    for value in (math.nan, math.inf, -math.inf, -1.0, 3.1, 1e300):
        panel.send({"type": "slider", "name": PACE_SLIDER, "value": value})
        assert panel.after(0.1) == (0.0, 0.0, 2.0), value


def test_no_message_of_a_page_takes_a_hold_back_or_ends_the_run() -> None:
    panel = Panel(1.0)
    panel.click()
    assert panel.after(0.1)[0] == 1.0
    for message in (
        {"type": "button", "name": HOLD_BUTTON},
        {"type": "button", "name": "Go on"},
        {"type": "button", "name": "End"},
        {"type": "delete_control", "name": HOLD_BUTTON},
        {"type": "slider", "name": HOLD_BUTTON, "value": 0.0},
    ):
        panel.send(message)  # type: ignore[arg-type]
        assert panel.after(0.1)[:2] == (1.0, 0.0)
