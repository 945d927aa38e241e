"""Measure weldcal itself: `./tools/run figures NAME` prints what README and docs cite, and the papers' tables."""

from __future__ import annotations

from weldcal.systems.interrupts import answer_signals
from weldcal.tools.cli.app import build_app

PURPOSE = "Measure weldcal itself, and repeat the published studies."
GROUPS = {"benchmark": "Measure speed and accuracy.", "reproduce": "Repeat the published studies."}
app = build_app(("tests.figures",), PURPOSE, GROUPS)

if __name__ == "__main__":
    answer_signals()
    app(prog_name="./tools/run figures")
