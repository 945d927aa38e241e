"""One process of the suite compiles a loop and the others wait for its code: after a fresh clone each would compile all of them."""

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

_LOCK = Path(tempfile.gettempdir()) / f"weldcal-tests-compile-{sha1(str(ROOT).encode()).hexdigest()[:12]}.lock"
_thread = threading.RLock()
_depth = 0


@contextmanager
def _alone() -> Iterator[None]:
    """Held by one thread of one process; that thread may enter again, for a loop that calls another."""
    global _depth
    with _thread:
        if _depth:
            yield
            return
        with _LOCK.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            _depth += 1
            try:
                yield
            finally:
                _depth -= 1


def compile_one_by_one() -> None:
    """From here on, Numba looks for a loop's code on disk and compiles it where there is none, without another process between."""
    found = Dispatcher.compile

    @wraps(found)
    def compile(self: Dispatcher, signature: Any) -> Any:
        with _alone():
            return found(self, signature)

    Dispatcher.compile = compile
