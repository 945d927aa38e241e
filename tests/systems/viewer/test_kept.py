"""A program in which another thread has shown something in Meshcat ends as any other."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import threading
from pydrake.geometry import Meshcat
from weldcal.systems.viewer.kept import keep
shown = threading.Thread(target=lambda: keep(Meshcat()))
shown.start()
shown.join()
"""


def test_a_viewer_of_another_thread_does_not_abort_the_end_of_the_program() -> None:
    finished = subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM], capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode == 0, finished.stderr
