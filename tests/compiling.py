"""One process of the suite compiles a loop and the others wait for its code: after a fresh clone each would compile all
of them."""

from __future__ import annotations

import fcntl
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import wraps
from hashlib import sha1
from pathlib import Path
from typing import Any

from numba.core.dispatcher import Dispatcher

from tests.places import ROOT

_LOCKS = Path(tempfile.gettempdir()) / f"weldcal-tests-compile-{sha1(str(ROOT).encode()).hexdigest()[:12]}"
_thread = threading.RLock()
_held: set[str] = set()


@contextmanager
def _alone(loop: str) -> Iterator[None]:
    """Held by one thread of one process for this loop; that thread may enter again.

    A loop that calls another takes that one's lock, too: calls do not go in circles, so no two processes wait for each
    other.
    """
    with _thread:
        if loop in _held:
            yield
            return
        _LOCKS.mkdir(exist_ok=True)
        with (_LOCKS / loop).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            _held.add(loop)
            try:
                yield
            finally:
                _held.discard(loop)


def compile_one_by_one() -> None:
    """From here on, Numba looks for a loop's code on disk and compiles it where there is none, without another process
    between."""
    found = Dispatcher.compile

    @wraps(found)
    def compile(self: Dispatcher, signature: Any) -> Any:
        with _alone(f"{self.py_func.__module__}.{self.py_func.__qualname__}"):
            return found(self, signature)

    Dispatcher.compile = compile
