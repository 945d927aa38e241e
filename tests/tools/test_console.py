"""The printed rows of a result, and a question in a terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time

import pytest

from weldcal.tools import console


@pytest.mark.parametrize(
    ("value", "text"),
    [(-48213456.7, "-48,213,457"), (1234.5, "1,234"), (999.4, "999"), (0.01234, "0.0123"), (1e15, "1e+15"), (float("inf"), "inf")],
)  # fmt: skip
def test_a_large_number_has_no_exponent(value: float, text: str) -> None:
    assert console.rows({"clock_offset_ms": value}) == {"clock_offset_ms": text}


ASKS = """
import types
from weldcal.systems import runner
from weldcal.systems.operator import operator_at
from weldcal.tools import console
from weldcal.welding.seam.restart import CutSeam

with operator_at() as operator, console.progress_bar("weld") as progress:
    job = types.SimpleNamespace(stage=lambda root, phases: ("a question", 0.34))
    robot = types.SimpleNamespace(rest=lambda: None)
    cell = types.SimpleNamespace(operator=operator, job=job, station=types.SimpleNamespace(robot=robot))
    simulator = types.SimpleNamespace(ResetStatistics=lambda: None)
    run = types.SimpleNamespace(
        cell=cell, root=None, phases=[], share=0.34, held_by_person=0, clock=None, simulator=simulator
    )
    operator.ask(CutSeam(None, 0.05, 0.0337, 0.0417).question(0))
    runner._stand(run, progress)
print("REFUSED" if operator.ends else "STARTS")
"""


@pytest.mark.parametrize(
    ("answer", "then"), [("yes", "STARTS"), ("y", "STARTS"), (" G ", "STARTS"), ("no", "REFUSED"), ("N", "REFUSED")]
)
def test_the_restart_question_is_whole_at_80_columns(answer: str, then: str) -> None:
    main, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR")} | {"TERM": "xterm"}
    asked = subprocess.Popen(
        [sys.executable, "-c", ASKS], stdin=terminal, stdout=terminal, stderr=terminal, env=environment
    )
    os.close(terminal)
    shown = ""
    try:
        while "no arc is lit" not in shown:
            shown += read(main)
        os.write(main, b"what?\n")
        time.sleep(0.3)
        assert asked.poll() is None, "another word is no answer"
        os.write(main, f"{answer}\n".encode())
        while "STARTS" not in shown and "REFUSED" not in shown:
            shown += read(main)
    finally:
        asked.kill()
        asked.wait()
        os.close(main)
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line).strip() for line in re.split(r"[\r\n]+", shown)]
    lines = [line for line in lines if line and not line.startswith("weld")]  # that is the bar, with what was typed
    assert max(map(len, lines)) <= 80
    text = " ".join(lines)
    assert "The arc will start 8 mm before the crater at 42 mm of seam 1. Start?" in text
    assert "Type yes (or y, g) and Enter to start. Type no and Enter, or Ctrl-C, to refuse: no arc is lit." in text
    assert then in text


def read(main: int) -> str:
    """What a terminal was sent; fails after a while without anything."""
    assert select.select([main], [], [], 60.0)[0], "nothing more is said"
    return os.read(main, 65536).decode(errors="replace")
