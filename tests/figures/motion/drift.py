"""Jumps, creeps and quiet hours of a monitored calibration, on a world of features."""

from dataclasses import dataclass, replace

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.moves import Change, WorldConfig, simulate
from weldcal.calibration.data.results import statistics
from weldcal.calibration.motion.drift.sequential import DriftConfig, DriftEvent, DriftTest
from weldcal.models.arrays import Array
from weldcal.tools.report.render import fixed

SHIFT_M, TURN_RAD = 2e-4, float(np.radians(0.03))
WITHIN_S = 2.0
CREEP_M_S, CREEP_MOST_M = 2e-5 / 60.0, 2e-4
_KNOCK_S, _AFTER_S = (25.0, 35.0), 10.0
_CREEP_START_S = 60.0


@dataclass(frozen=True, kw_only=True)
class DriftTrial:
    """One recording with one change: what, when found (s after it; NaN: not), and how well measured."""

    kind: str
    false_alarms: int
    found_after_s: float = float("nan")
    time_error_s: float = float("nan")
    translation_error_mm: float = float("nan")
    rotation_error_deg: float = float("nan")
    named: str = ""


@figure("drift", "how soon knocks of 0.2 mm or 0.03 degrees and creeps are found, and false alarms in quiet hours")
def drift(run: Run) -> None:
    """Measure the drift test on a world of features."""
    (knocks, creeps, hours), world = run.size((2, 1, 0.01), (200, 8, 10.0)), WorldConfig()
    trials = []
    for k in range(knocks):
        run.progress("knocks", k / knocks)
        trials.append(knock_trial(world, run.seed + k, turn=bool(k % 2)))
    found = np.array([t.found_after_s for t in trials])
    slow = [creep_trial(world, run.seed + 5000 + k) for k in range(creeps)]
    reached = 1e3 * CREEP_M_S * np.array([t.found_after_s for t in slow])
    quiet, largest = watched(world, 3600.0 * hours, run.seed + 9000)
    right = sum(t.named == {"shift": "translation", "turn": "rotation"}[t.kind] for t in trials)
    shifts = [t.translation_error_mm for t in trials if t.kind == "shift"]
    turns = [t.rotation_error_deg for t in trials if t.kind == "turn"]
    rows = (
        (f"knocks found within {WITHIN_S:g} s", f"{(found <= WITHIN_S).sum()} of {knocks}"),
        ("knocks named right", f"{right} of {knocks}"),
        ("found after, s: median, 95 %, worst", _spread(found)),
        ("time off, s", _spread(np.abs([t.time_error_s for t in trials]))),
        ("shift off, mm", _spread(np.array(shifts))),
        ("turn off, deg", _spread(np.array(turns))),
        ("creep when found, mm", _spread(reached)),
        (f"false alarms in {hours:g} quiet hours", str(len(quiet.events))),
        ("false alarms before a change", str(sum(t.false_alarms for t in (*trials, *slow)))),
        ("largest statistic in quiet hours, of its threshold", f"{largest / quiet.threshold:.2f}"),
    )
    run.table("", ("", "found"), rows)


def knock_trial(world: WorldConfig, seed: int, *, turn: bool) -> DriftTrial:
    """Return a recording of some 40 s with a jump of 0.2 mm, or 0.03 degrees, along or about a random axis."""
    rng = np.random.default_rng([seed, 3])
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    at = float(rng.uniform(*_KNOCK_S))
    shift, rotation = (np.zeros(3), TURN_RAD * axis) if turn else (SHIFT_M * axis, np.zeros(3))
    change = Change(at, tuple(shift.tolist()), tuple(rotation.tolist()))
    test, _ = watched(replace(world, changes=(change,)), at + _AFTER_S, seed)
    return _trial("turn" if turn else "shift", test.events, at, shift, rotation)


def creep_trial(world: WorldConfig, seed: int) -> DriftTrial:
    """Return a recording with a creep of 0.02 mm/min in a random direction."""
    rng = np.random.default_rng([seed, 4])
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    over = CREEP_MOST_M / CREEP_M_S
    shift = CREEP_MOST_M * axis
    change = Change(_CREEP_START_S, tuple(shift.tolist()), over_s=over)
    slow = replace(world, frame_s=8.0 * world.frame_s, changes=(change,))
    test, _ = watched(slow, _CREEP_START_S + over, seed)
    return _trial("creep", test.events, _CREEP_START_S, shift, np.zeros(3))


def watched(config: WorldConfig, duration_s: float, seed: int) -> tuple[DriftTest, float]:
    """Return the test after a recording, and its largest statistic."""
    w = simulate(config, duration_s, seed)
    test = DriftTest(w.X_BC, w.covariance, w.pivot, DriftConfig(), frame_rate_hz=1.0 / config.frame_s)
    largest = 0.0
    for k in range(len(w.rows)):
        test.update(w.rows.part(slice(k, k + 1)))
        largest = max(largest, test.statistic)
    test.finish()
    return test, largest


def _trial(kind: str, events: list[DriftEvent], at: float, shift: Array, rotation: Array) -> DriftTrial:
    missed = DriftTrial(kind=kind, false_alarms=sum(e.found_s < at for e in events))
    for e in (e for e in events if e.found_s >= at):
        return replace(
            missed,
            found_after_s=e.found_s - at,
            time_error_s=e.time_s - at,
            translation_error_mm=1e3 * float(np.linalg.norm(e.translation_m - shift)),
            rotation_error_deg=float(np.degrees(np.linalg.norm(e.rotation_rad - rotation))),
            named=e.model,
        )
    return missed


def _spread(values: Array) -> str:
    return ", ".join(fixed(v, 4) for v in statistics(values, "median", "p95", "max").values())
