"""External Control node of a program on the pendant: fetches its URScript from a client on play.

This is the only way in on PolyScope X before 10.10, where ur_rtde neither opens the script port nor uploads. As the
URCap does, it connects to the client's script sender, asks `request_program`, and takes what comes until 0.1 s of silence.
"""

from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.wire.net import Connection, Server

CLIENT_PORT = 50002
SILENCE_S = 0.1
GIVE_UP_S = 5.0


class ExternalControl(Server):
    """One request under way at a time."""

    kind = "external_control"

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._connection: Connection | None = None
        self._last = 0.0

    def opened(self, connection: Connection, now: float) -> None:
        if self._connection is not None:
            self._connection.close(reset=False)
        self._connection, self._last = connection, now
        connection.send(b"request_program\n", now)

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        connection.inbox += data
        self._last = now

    def gone(self, connection: Connection) -> None:
        if connection is self._connection:
            self._finish(connection)

    def frame(self, now: float) -> None:
        connection = self._connection
        if connection is not None and now - self._last > (SILENCE_S if connection.inbox else GIVE_UP_S):
            self._finish(connection)
            connection.close(reset=False)

    def _finish(self, connection: Connection) -> None:
        self._connection = None
        text = connection.inbox.decode("ascii", "replace")
        if not text.strip():
            self._controller.note("external control: the client sent no script")
            return
        self._controller.start(f"def external_control():\n{text}\nend\n")
