"""Keeps each Meshcat until the thread that made it frees it: Drake aborts the process where another thread does."""

import atexit
import ctypes
import gc
import sys
import threading

from pydrake.geometry import Meshcat

_KEPT: dict[int, tuple[Meshcat, int]] = {}
_HERE_ONLY = 2  # references: that of _KEPT, and that of the function that counts them


def keep(meshcat: Meshcat) -> Meshcat:
    """The Meshcat, which from now on is not freed with the system that draws in it, as garbage is: in any thread."""
    _KEPT.setdefault(id(meshcat), (meshcat, threading.get_ident()))
    return meshcat


def free_unused() -> None:
    """Free what earlier cells of this thread have left, with each Meshcat that nobody uses any more."""
    gc.collect()
    here = threading.get_ident()
    for key in list(_KEPT):
        if _KEPT[key][1] == here and sys.getrefcount(_KEPT[key][0]) <= _HERE_ONLY:
            del _KEPT[key]


@atexit.register
def _never_free_of_other_threads() -> None:
    """The end of the program is in the main thread: what other threads made is left to the operating system."""
    for meshcat, maker in _KEPT.values():
        if maker != threading.main_thread().ident:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(meshcat))
