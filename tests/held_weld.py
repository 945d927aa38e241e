"""A short weld that an operator holds in its middle for a moment, on any robot, and what came of it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from weldcal.systems.cell import build_cell
from weldcal.systems.operator import Operator
from weldcal.systems.recording.tap import OpenSink
from weldcal.systems.runner import Run, run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.viewer.live import LiveView
from weldcal.tools.report.weld import weld_outcome

HELD_AT_M, HELD_S = 0.012, 0.4
STILL_RAD_S = 1e-3
NEAR_M = 8e-3  # to both sides of the place where the arc went out

SHORT_WELD = """
scanner: !RenderedScanner {width: 412, height: 308, mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}
job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}
welding: {seam_length_mm: 24.0, speed_mm_s: 16.0}
"""


def short_weld() -> Scenario:
    """The first 24 mm of a straight groove, with a known scanner, twice as fast as usual."""
    return load_scenario("straight_groove", SHORT_WELD)


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldWeld:
    """The run, ms of the robot's time from the hold (the torch goes off) to the still arm, and the torch near the join:
    mean and largest distance from the true seam, the longest stretch that was left out, and how much was welded twice,
    m."""

    run: Run[Any]
    still_ms: float
    mean_m: float
    largest_m: float
    left_out_m: float
    welded_twice_m: float
    live: LiveView


def held_weld(scenario: Scenario, open_sink: OpenSink | None = None) -> HeldWeld:
    """Weld, hold once the torch has come to HELD_AT_M, and go on."""
    operator, live = Operator(), LiveView()
    cell = build_cell(scenario, 0, operator=operator, live=live, open_sink=open_sink)

    def beside() -> None:
        while not (live.weld and live.weld[-1].torch_on and live.weld[-1].s_torch > HELD_AT_M):
            time.sleep(0.002)
        operator.hold("a test")
        while not operator.stands:
            time.sleep(0.002)
        time.sleep(HELD_S)
        operator.go_on()

    threading.Thread(target=beside, daemon=True).start()
    run = run_cell(cell)
    log = cell.logs["position"].FindLog(run.root)
    times, on = log.sample_times(), cell.logs["torch_on"].FindLog(run.root).data()[0] > 0.5
    speed = np.linalg.norm(np.diff(log.data(), axis=1), axis=0) / np.diff(times)
    assert on.any(), f"the torch has not burned: {run.reason}"
    assert run.held_by_person, f"nobody has held it: {run.reason}"
    off = int(np.flatnonzero(on[:-1] & ~on[1:])[0])
    still = off + int(np.flatnonzero(speed[off:] < STILL_RAD_S)[0])
    outcome = weld_outcome(cell, run.root)
    assert outcome is not None
    assert outcome.error is not None
    error = outcome.error
    out_at = float(error.s[int(np.argmax(np.diff(error.s) < -1e-3))])
    near = np.abs(error.s - out_at) < NEAR_M
    aside = np.hypot(error.lateral, error.height)[near]
    twice = -float(np.diff(error.s).min())
    left_out = float(np.diff(np.sort(error.s[near])).max())
    still_ms = 1e3 * float(times[still] - times[off])
    return HeldWeld(
        run=run,
        still_ms=still_ms,
        mean_m=float(aside.mean()),
        largest_m=float(aside.max()),
        left_out_m=left_out,
        welded_twice_m=twice,
        live=live,
    )
