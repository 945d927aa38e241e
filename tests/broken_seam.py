"""Breaks welds of the servo's own world off at random places, goes on with each, and judges the join by its truth.

python -m tests.broken_seam [TIMES] [SEED] [BUDGET]     prints one line for each stop, and the largest errors

The progress goes through its file. Between the runs the plan, the noise of the tag and the roughness of the groove are
drawn anew. `tests.restarted` does the same with a whole cell.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from tests.worlds.weld import plant
from tests.worlds.weld.budgets import BUDGETS, NOMINAL, Budget, planned_seam
from tests.worlds.weld.plant import StudyRun, simulate
from tests.worlds.weld.seams import TrueSeam, arcs, corner, s_curve
from weldcal.systems.jobs.weld.progress_keeper import EVERY_M, felt_points
from weldcal.systems.jobs.weld.seam_planning import RUN_UP_S
from weldcal.welding.numerics import Array
from weldcal.welding.record.process import path_error
from weldcal.welding.record.progress import Progress, Stretch, load_progress
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.faults import fault
from weldcal.welding.servo.felt_before import start_state
from weldcal.welding.servo.interruption import Interruption, interruptible_step
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import ServoSample, WeldingCommand, WeldingState
from weldcal.welding.servo.step import welding_step

UP = np.array((0.0, 0.0, 1.0))
SEAMS = {"straight": arcs((0.12, 0.0), spacing=2e-3), "s": s_curve(), "corner": corner(0.020, 60.0, -1.0, 0.06)}
KINDS = ("stop", "kill", "pause")
"""Pause: an operator holds the weld and lets it go on. Stop: what stands in the file is the newest. Kill: it is up to
EVERY_M older, as after a loss of power."""
OVERLAP_M, PAUSE_OVERLAP_M, NEAR_M = 8e-3, 5e-3, 8e-3
CONFIG = ServoConfig()
FIRST_M, END_M = 1e-3, 12e-3


class Broken:
    """The servo until the torch has come to a place; the progress as its keeper writes it."""

    def __init__(self, at_m: float, kind: str) -> None:
        self.at_m, self.kind, self.written, self.newest = (
            at_m,
            kind,
            -math.inf,
            Progress(scenario="", seed=0, robot=None, scenario_sha256=""),
        )

    def __call__(
        self, state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig
    ) -> tuple[WeldingState, WeldingCommand]:
        if state.torch_on and state.s_torch >= self.at_m:
            state = fault(state, "broken off")
        state, command = welding_step(state, sample, plan, config)
        if state.torch_on and (self.kind == "stop" or state.s_torch > self.written + EVERY_M):
            self.written = state.s_torch
            crater = np.asarray(sample.X_BT @ config.p_TW)
            stretch = Stretch(seam=0, piece=0, run=0, from_m=0.0, to_m=state.s_torch, done=False, time="")
            begin = crater if self.newest.p_BBegin is None else self.newest.p_BBegin
            found = replace(self.newest.with_stretch(stretch), p_BCrater=crater, p_BBegin=begin)
            self.newest = replace(found, felt=felt_points(state))
        return state, command


class GoesOn:
    """The servo that begins with the points that were felt before; `moved_m` (3,): of the part since then."""

    def __init__(self, felt: Array | None) -> None:
        self.felt = felt

    def __call__(
        self, state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig
    ) -> tuple[WeldingState, WeldingCommand]:
        return welding_step(start_state(self.felt) if state.time is None else state, sample, plan, config)


class Paused:
    """The servo with an operator who holds it for half a second at a place."""

    def __init__(self, at_m: float) -> None:
        self.at_m, self.since, self.held = at_m, -math.inf, Interruption()

    def __call__(
        self, state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig
    ) -> tuple[WeldingState, WeldingCommand]:
        if state.torch_on and state.s_torch >= self.at_m:
            self.at_m, self.since = math.inf, sample.time
        holds = sample.time - self.since < 0.5
        state, self.held, command = interruptible_step(state, self.held, sample, plan, config, holds)
        return state, command


@dataclass(frozen=True)
class Join:
    """Errors of a join, mm: across the true seam within 8 mm of the crater, and of the place where the arc came on."""

    across_mm: float
    along_mm: float
    reason: str | None


def welded(seam: TrueSeam, budget: Budget, seed: int, servo: object, plan: SeamCurve, arc_m: float | None) -> StudyRun:
    """One run of the world with this servo."""
    config = CONFIG if arc_m is None else replace(CONFIG, touch=replace(CONFIG.touch, arc_m=arc_m))
    with patch.object(plant, "welding_step", servo):
        return simulate(seam, budget, config, seed, plan=plan)


def broken_off(name: str, at_m: float, kind: str, seed: int, budget: Budget, moved_m: float = 0.0) -> Join:
    """Break a weld off and go on with it; `moved_m`: the part has moved to its left in between."""
    seam, rng = TrueSeam(name, SEAMS[name], UP), np.random.default_rng((seed, 7))
    plans = [planned_seam(seam, budget, rng) for _ in range(2)]
    if kind == "pause":
        run = welded(seam, budget, seed, Paused(at_m), plans[0], None)
        error = path_error(run.points("torch")[run.column("torch_on") > 0.5], run.torch_line)
        k = int(np.argmin(np.diff(error.s)))
        place = (float(error.s[0]), float(error.s[k]))
        return joined(place, error.s[k + 1 :], error.distance_m[k + 1 :], PAUSE_OVERLAP_M, run.state.reason)
    first = Broken(at_m, kind)
    run = welded(seam, budget, seed, first, plans[0], None)
    error = path_error(run.points("torch")[run.column("torch_on") > 0.5], run.torch_line)
    place = (float(error.s[0]), float(error.s[-1]))
    with tempfile.TemporaryDirectory() as folder:
        first.newest.write(Path(folder))
        restart = load_progress(Path(folder)).restart(OVERLAP_M)
    cut = restart.cut(plans[1], CONFIG.tool.torch_offset_m, RUN_UP_S * CONFIG.weld_speed_m_s, CONFIG.gap.end_window_m)
    shift = np.array((0.0, moved_m, 0.0))
    felt = None if restart.felt is None else restart.felt - np.append(shift, 0.0)
    again = welded(seam, budget, seed, GoesOn(felt), cut.line, cut.down_m)
    on = again.column("torch_on") > 0.5
    if not on.any():
        return Join(math.inf, math.inf, again.reason or again.state.reason)
    error = path_error(again.points("torch")[on], again.torch_line)
    return joined(place, error.s, error.distance_m, OVERLAP_M, again.state.reason)


def joined(arc: tuple[float, float], s: Array, distance: Array, overlap_m: float, reason: str | None) -> Join:
    """The join of the run that went on: where its torch was along the seam (n,) m, and how far from it (n,) m.

    `arc`: where the first one began and where it went out, m; before its beginning nothing is to be welded.
    """
    begin, crater = arc
    near = np.abs(s - crater) < NEAR_M
    return Join(1e3 * float(distance[near].max()), 1e3 * (float(s[0]) - max(crater - overlap_m, begin)), reason)


def main(times: int, seed: int, budget: Budget) -> int:
    """Break welds off at random; returns the number of those that did not go on as they should."""
    rng, found, bad = np.random.default_rng(seed), [], 0
    for k in range(times):
        name, kind = list(SEAMS)[k % len(SEAMS)], KINDS[k // len(SEAMS) % len(KINDS)]
        length = SeamCurve.from_points(SEAMS[name]).length
        at_m = float(rng.uniform(FIRST_M, length - END_M))
        join = broken_off(name, at_m, kind, int(rng.integers(10000)), budget)
        good = join.reason is None and join.across_mm <= 0.3 and abs(join.along_mm) <= 1.0
        bad += not good
        found.append(join)
        print(f"{k} {name} {kind} at {1e3 * at_m:.1f} mm: {join}{'' if good else '   BAD'}", flush=True)
    across, along = (np.abs([getattr(j, n) for j in found]) for n in ("across_mm", "along_mm"))
    print(f"{times} stops in the {budget.name} world, {bad} bad")
    print(f"across: median {np.median(across):.3f}, at most {across.max():.3f} mm")
    print(f"along: median {np.median(along):.3f}, at most {along.max():.3f} mm")
    return bad


if __name__ == "__main__":
    given = [*sys.argv[1:], *("100", "0", NOMINAL.name)[len(sys.argv) - 1 :]]
    raise SystemExit(min(main(int(given[0]), int(given[1]), BUDGETS[given[2]]), 1))
