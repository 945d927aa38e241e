"""URScript functions that speak to people and clients: textmsg, popup; and protective_stop."""

from typing import Any

from weldcal.tools.emulators.ur.controller.events import Popup, Text
from weldcal.tools.emulators.ur.script.compiler import Slices
from weldcal.tools.emulators.ur.script.forces import Forces
from weldcal.tools.emulators.ur.script.texts import text_of


class Messages(Forces):
    """What they say goes to the log and to the clients of the primary port."""

    def textmsg(self, s1: Any, s2: Any = "") -> None:
        text = text_of(s1) + text_of(s2)
        self._controller.note(f"script: {text}")
        self._controller.tell(Text(text))

    def popup(
        self, s: Any, title: str = "Popup", warning: bool = False, error: bool = False, blocking: bool = False
    ) -> Slices:
        """One that blocks waits until a person closes it: the dashboard's `close popup`."""
        c = self._controller
        c.note(f"popup: {title}: {text_of(s)}")
        c.tell(Popup(text_of(s), text_of(title), warning, error, blocking))
        c.popup_open = blocking
        while blocking and c.popup_open:
            yield

    def protective_stop(self) -> None:
        """The program stands still from its next frame on; one that has nothing left to do ends."""
        self._controller.protective_stop("a protective stop was triggered", code=209)
