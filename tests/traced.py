"""Which functions of the package run: `python -m tests.traced calibrate|tick` prints them as JSON, one file a key.

`calibrate` is the command on six scans. `tick` is the servo in a simulated weld, and the driver of a cell on an emulated
controller with the worker beside it, each for TICKS calls. (A traced weld by wire would be too late on a busy computer.)
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
import threading
from collections import Counter
from contextlib import redirect_stdout
from functools import cache
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from tests.places import ROOT

TICKS = 100
LAWS, DRIVER = "welding/servo/track.py", "systems/drivers/ur/rtde.py"
SCANS = 6


@cache
def _real(path: str) -> str:
    """A file's path without links: an editable install imports the package through one."""
    return os.path.realpath(path)


class Calls:
    """The calls of functions of the package, by file below the project's root and name."""

    def __init__(self) -> None:
        self.found: Counter[tuple[str, str]] = Counter()
        self._root = f"{ROOT}/"
        self._folders = tuple(f"{ROOT}/{name}/" for name in ("models", "calibration", "welding", "systems", "tools"))

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        path = _real(frame.f_code.co_filename)
        if event == "call" and frame.f_code.co_flags & CO_OPTIMIZED and path.startswith(self._folders):
            self.found[path.removeprefix(self._root), frame.f_code.co_qualname] += 1

    def start(self) -> None:
        """Count the calls of this thread, and of those that begin later."""
        threading.setprofile(self)
        sys.setprofile(self)

    def document(self) -> dict[str, dict[str, int]]:
        """How often each function was called, by file."""
        sys.setprofile(None)
        threading.setprofile(None)
        found: dict[str, dict[str, int]] = {}
        for (path, name), n in sorted(self.found.items()):
            found.setdefault(path, {})[name] = n
        return found


def calibrate() -> dict[str, dict[str, int]]:
    """The calls of `weldcal calibrate FOLDER`."""
    from tests.documents.scans import write_scans
    from weldcal.tools.cli.app import app

    calls = Calls()
    with tempfile.TemporaryDirectory() as scratch:
        data = write_scans(Path(scratch) / "data", SCANS, 3)
        calls.start()
        with redirect_stdout(sys.stderr):
            app(["calibrate", str(data), "--out", f"{scratch}/out"], standalone_mode=False)
        return calls.document()


def tick() -> dict[str, dict[str, int]]:
    """The calls of a simulated weld after its servo has begun, and those of a wired cell and its worker."""
    from tests.held_weld import short_weld
    from weldcal.systems.drivers.ur import link
    from weldcal.systems.drivers.ur.rtde import UrRtde
    from weldcal.systems.phase_words import phase_words
    from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

    scenario, start = short_weld(), link.started
    found = _run(scenario, phase_words("weld"), LAWS)
    with tempfile.TemporaryDirectory() as scratch:
        worker = Path(scratch) / "worker.json"
        link.started = lambda command, **options: start(  # type: ignore[assignment]
            [command[0], "-m", "tests.traced", command[2], command[3], str(worker)], **options
        )
        with emulator_process(q=np.deg2rad(scenario.home_deg).tolist(), lockstep=LOCKSTEP_S) as controller:
            scenario.robot = UrRtde(host=controller.host, lockstep=True)
            found = _run(scenario, "", DRIVER) | found
        return json.loads(worker.read_text()) | found


def _run(scenario: Any, stage: str, path: str) -> dict[str, dict[str, int]]:
    """The calls of a cell's process from a stage on (any, if it is empty), until a file has been called TICKS times."""
    from weldcal.systems.cell import build_cell
    from weldcal.systems.operator import Operator
    from weldcal.systems.runner import run_cell

    operator, calls, done = Operator(), Calls(), threading.Event()

    def watch(at: str, _: float) -> None:
        if stage in at and sys.getprofile() is None:
            calls.start()

    def end() -> None:
        while sum(n for (file, _), n in list(calls.found.items()) if file == path) < TICKS and not done.wait(0.02):
            pass
        operator.end("enough was traced")

    threading.Thread(target=end, daemon=True).start()
    run_cell(build_cell(scenario, 0, operator=operator), watch)
    done.set()
    return calls.document()


def _worker(module: str, descriptor: str, out: str) -> None:
    """The worker of the link, which ends by os._exit."""
    calls, leave = Calls(), os._exit

    def write(code: int) -> None:
        Path(out).write_text(json.dumps(calls.document()))
        leave(code)

    os._exit = write  # type: ignore[assignment]
    sys.argv = [module, descriptor]
    calls.start()
    runpy.run_module(module, run_name="__main__")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        _worker(*sys.argv[1:])
    sys.stdout.write(json.dumps({"calibrate": calibrate, "tick": tick}[sys.argv[1]]()))
