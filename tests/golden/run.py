"""Run golden calls, each once, in a process of its own."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

from tests.golden.calls import CALLS, LIVE, filled, make_inputs, named
from tests.golden.compare import RESULTS, Figures, differences, figures, rounded

_LIVE_OPTIONS = ("--seed", "1")  # not 0, so that it is seen to arrive
_LONGEST_S = 900.0
_WITHOUT_OUT = ("robots", "doctor")


class Runs:
    """Results of calls in a folder; a call that another one needs is run first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make_inputs(folder / "made")
        self.figures = cache(self._figures)

    def differences(self, name: str) -> list[str]:
        """Run a call and return what differs from the kept figures."""
        return differences(name, held(name), rounded(self.figures(name)))

    def _figures(self, name: str) -> Figures:
        for other in named(CALLS[name]):
            self.figures(other)
        command = shlex.split(filled(name, self.folder, self.folder / "made"))
        out = (
            () if name in _WITHOUT_OUT or "{out}" in CALLS[name] else ("--out", str(self.folder / name), "--overwrite")
        )
        live = _LIVE_OPTIONS if name in LIVE else ()
        finished = subprocess.run(
            [sys.executable, "-P", "-m", "weldcal.tools", *command, *live, *out, "--json"],
            capture_output=True,
            text=True,
            check=False,
            timeout=_LONGEST_S,
            cwd=self.folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        lines = [line for line in finished.stdout.splitlines() if line.startswith("{")]
        if not lines:
            raise RuntimeError(
                f"{name} printed no JSON object and ended with {finished.returncode}:\n{finished.stderr}"
            )
        document = json.loads(lines[-1])
        return {"exit_code": finished.returncode, **figures(document)}


def held(name: str) -> Figures:
    """The kept figures of a call; empty where none are kept."""
    path = RESULTS / f"{name}.json"
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else {}


def keep(name: str, found: Figures) -> None:
    """Write the figures of a call as the ones to hold."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(rounded(found), indent=0) + "\n", encoding="utf-8")
