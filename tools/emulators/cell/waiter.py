"""Hands data to a device's process of the world, one at a time: the world waits for it, and not for one that has
stopped."""

import contextlib
from multiprocessing.connection import Connection

LIMIT_S = 2.0  # of the host; a cell that follows the world takes a longer silence for a broken link


class Waiter:
    """The world's end of the pipe of a device that says something when it has shown what it was sent."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._unshown = self._gone = False

    def send(self, datum: object) -> None:
        """Send once the last datum is shown; a device that does not answer misses this one, and is not waited for until
        it does."""
        with contextlib.suppress(OSError, EOFError):
            if self._unshown and self._pipe.poll(0.0 if self._gone else LIMIT_S):
                self._pipe.recv()
                self._unshown = self._gone = False
            if self._unshown:
                self._gone = True
                return
            self._pipe.send(datum)
            self._unshown = True
