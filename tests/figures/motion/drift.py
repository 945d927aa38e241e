"""Jumps, creeps and quiet hours of a monitored calibration, on a world of features."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.stats import ncx2

from tests.figures.harness import Run, figure
from tests.worlds.moves import Change, FeatureWorld, WorldConfig, simulate
from weldcal.calibration.motion.drift.hypotheses import STEP, DriftFilter
from weldcal.calibration.motion.drift.residuals import CLOCK
from weldcal.calibration.motion.drift.sequential import DriftConfig, DriftEvent, DriftTest
from weldcal.models.arrays import Array
from weldcal.tools.report.render import fixed, statistics

SHIFT_M, TURN_RAD = 2e-4, float(np.radians(0.03))
WITHIN_S = 2.0
CREEP_M_S, CREEP_MOST_M = 2e-5 / 60.0, 2e-4
_KNOCK_S, _AFTER_S = (25.0, 35.0), 10.0
_CREEP_START_S = 60.0


@dataclass(frozen=True, kw_only=True)
class DriftTrial:
    """One recording with one change: what, when found (s after it; NaN: not), and how well measured.

    ``along_view`` is the cosine between the change's axis and the line of sight. ``shown`` is what the frames of
    the first WITHIN_S say of it to a test that knows the noise and all other errors exactly, in units of the test's
    threshold. ``told`` what they say to one that knows of these errors what the monitor knows, and is told when the
    change was, in the same units.
    """

    kind: str
    seed: int
    along_view: float
    false_alarms: int
    shown: float
    told: float
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
    alarmed, largest, threshold = quiet_hours(world, hours, run.seed + 9000)
    right = sum(t.named == {"shift": "translation", "turn": "rotation"}[t.kind] for t in trials)
    shifts = [t.translation_error_mm for t in trials if t.kind == "shift"]
    turns = [t.rotation_error_deg for t in trials if t.kind == "turn"]
    rows = (
        (f"knocks found within {WITHIN_S:g} s", f"{(found <= WITHIN_S).sum()} of {knocks}"),
        ("late by noise alone, expected", f"{expected_late(trials):.2f}"),
        ("knocks named right", f"{right} of {knocks}"),
        ("found after, s: median, 95 %, worst", _spread(found)),
        ("time off, s", _spread(np.abs([t.time_error_s for t in trials]))),
        ("shift off, mm", _spread(np.array(shifts))),
        ("turn off, deg", _spread(np.array(turns))),
        ("creep when found, mm", _spread(reached)),
        (f"false alarms in {hours:g} quiet hours", str(len(alarmed))),
        ("false alarms before a change", str(sum(t.false_alarms for t in (*trials, *slow)))),
        ("largest statistic in quiet hours, of its threshold", f"{largest / threshold:.2f}"),
    )
    run.table("", ("", "found"), rows)
    by_angle = (
        (f"{r['from_deg']:g} to {r['to_deg']:g}", f"{r['turns']}", f"{r['found_percent']:.0f}", f"{r['shown']:.3g}")
        for r in found_by_angle(trials)
    )
    header = ("turns about an axis so far from the view, deg", "turns", "found within 2 s, %", "shown, thresholds")
    run.table("", header, by_angle)


def knock_trial(world: WorldConfig, seed: int, *, turn: bool) -> DriftTrial:
    """Return a recording of some 40 s with a jump of 0.2 mm, or 0.03 degrees, along or about a random axis."""
    rng = np.random.default_rng([seed, 3])
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    at = float(rng.uniform(*_KNOCK_S))
    shift, rotation = (np.zeros(3), TURN_RAD * axis) if turn else (SHIFT_M * axis, np.zeros(3))
    change = Change(at, tuple(shift.tolist()), tuple(rotation.tolist()))
    events, view, *said = _watched(replace(world, changes=(change,)), at + _AFTER_S, seed, (at, shift, rotation))
    return _trial("turn" if turn else "shift", seed, events, at, shift, rotation, float(abs(axis @ view)), *said)


def creep_trial(world: WorldConfig, seed: int) -> DriftTrial:
    """Return a recording with a creep of 0.02 mm/min in a random direction."""
    rng = np.random.default_rng([seed, 4])
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    over = CREEP_MOST_M / CREEP_M_S
    shift = CREEP_MOST_M * axis
    change = Change(_CREEP_START_S, tuple(shift.tolist()), over_s=over)
    slow = replace(world, frame_s=8.0 * world.frame_s, changes=(change,))
    events, view, _, _ = _watched(slow, _CREEP_START_S + over, seed, (0.0, shift, np.zeros(3)))
    said = (float("nan"), float("nan"))
    return _trial("creep", seed, events, _CREEP_START_S, shift, np.zeros(3), float(abs(axis @ view)), *said)


def quiet_hours(world: WorldConfig, hours: float, seed: int) -> tuple[list[DriftEvent], float, float]:
    """False alarms, the largest statistic and the threshold over hours in which nothing happens."""
    w = simulate(world, 3600.0 * hours, seed)
    test = DriftTest(w.X_BC, w.covariance, w.pivot, DriftConfig(), frame_rate_hz=1.0 / world.frame_s)
    largest = 0.0
    for k in range(len(w.rows)):
        test.update(w.rows.part(slice(k, k + 1)))
        largest = max(largest, test.statistic)
    test.finish()
    return test.events, largest, test.threshold


def _watched(
    config: WorldConfig, duration_s: float, seed: int, change: tuple[float, Array, Array]
) -> tuple[list[DriftEvent], Array, float, float]:
    """Return events of a recording, the line of sight in the base, and what its frames show of a change.

    The change is (time s, shift m, rotation rad); shown to a test that knows everything else, and to one that knows
    what the monitor does.
    """
    w = simulate(config, duration_s, seed)
    test = DriftTest(w.X_BC, w.covariance, w.pivot, DriftConfig(), frame_rate_hz=1.0 / config.frame_s)
    before: DriftFilter | None = None
    for k in range(len(w.rows)):
        if before is None and w.rows.times[k] >= change[0]:
            before = test.filter.copy()
        test.update(w.rows.part(slice(k, k + 1)))
    test.finish()
    told = float("nan") if before is None else _told(w, test, before, change)
    return test.events, np.asarray(w.X_BC.rotation().matrix()[:, 2]), _shown(w, test, change), told


def expected_late(knocks: Sequence[DriftTrial]) -> float:
    """Count changes that noise alone hides for WITHIN_S from a test of three unknowns that knows their times."""
    threshold = DriftTest(RigidTransform(), np.eye(6), np.ones(3)).threshold_alone
    return float(sum(ncx2.cdf(threshold, 3, t.told * threshold) for t in knocks if np.isfinite(t.told)))


def _moved(w: FeatureWorld, change: tuple[float, Array, Array]) -> Array:
    """Return a change [rotation; translation] (6,) about the pivot."""
    _, shift, rotation = change
    return np.concatenate([rotation, shift + np.cross(rotation, w.pivot - np.asarray(w.X_BC.translation()))])


def _within(w: FeatureWorld, at: float) -> NDArray[np.intp]:
    """Return the frames of WITHIN_S after a time."""
    return np.flatnonzero((w.rows.times >= at) & (w.rows.times <= at + WITHIN_S))


def _without_clock(information: Array) -> Array:
    """Information (6, 6) of a move, where the clock may be other as well."""
    N, c = information, CLOCK
    return np.asarray(N[:c, :c] - np.outer(N[:c, c], N[c, :c]) / N[c, c])


def _shown(w: FeatureWorld, test: DriftTest, change: tuple[float, Array, Array]) -> float:
    """Compute the expected statistic of a pure shift or turn by the frames of WITHIN_S, over its threshold.

    Noise and all other errors are known exactly, and the clock alone is not.
    """
    chosen = _within(w, change[0])
    if not len(chosen) or test.noise is None:
        return float("nan")
    H = w.rows.derivatives[chosen][:, :, : CLOCK + 1]
    motion = w.rows.derivatives[chosen][:, :, CLOCK]
    noise = test.noise
    R = np.array([noise.covariance(S, u) for S, u in zip(w.rows.covariances[chosen], motion, strict=True)])
    N = np.einsum("nia,nij,njb->ab", H, np.linalg.inv(R), H)
    move = _moved(w, change)
    return float(move @ _without_clock(N) @ move) / test.threshold_alone


def _told(w: FeatureWorld, test: DriftTest, before: DriftFilter, change: tuple[float, Array, Array]) -> float:
    """Compute it with all other errors known as by the monitor's filter ``before`` the change, and its time."""
    chosen = _within(w, change[0])
    if not len(chosen) or test.noise is None:
        return float("nan")
    before.spawn(change[0], (STEP,))
    (slot,) = np.flatnonzero(before.used)
    for k in chosen:
        before.update(w.rows, int(k), test.noise, spawn=False)
    move, c = _moved(w, change), test.config
    floor = np.repeat([c.floor_rad**2, c.floor_m**2], 3)
    known = float(move @ _without_clock(before.information[slot]) @ move)
    if known <= 0.0:
        return 0.0
    return 1.0 / (1.0 / known + 1.0 / float(move @ (move / floor))) / test.threshold_alone


def found_by_angle(trials: Sequence[DriftTrial]) -> list[dict[str, float]]:
    """Group turns by the angle of their axis to the line of sight.

    How many there were, the share found within WITHIN_S, and the median of what the frames show.
    """
    turns = [t for t in trials if t.kind == "turn"]
    angles = np.degrees(np.arccos(np.clip([t.along_view for t in turns], 0.0, 1.0)))
    rows = []
    for low, high in pairwise((0.0, 10.0, 20.0, 30.0, 45.0, 90.0)):
        part = [t for t, a in zip(turns, angles, strict=True) if low <= a < high or a == high == 90.0]
        if part:
            found = np.array([t.found_after_s for t in part])
            shown, hits = float(np.median([t.shown for t in part])), 100.0 * float(np.mean(found <= WITHIN_S))
            rows.append({"from_deg": low, "to_deg": high, "turns": len(part), "found_percent": hits, "shown": shown})
    return rows


def _trial(
    kind: str,
    seed: int,
    events: list[DriftEvent],
    at: float,
    shift: Array,
    rotation: Array,
    view: float,
    shown: float,
    told: float,
) -> DriftTrial:
    early = sum(e.found_s < at for e in events)
    missed = DriftTrial(kind=kind, seed=seed, along_view=view, false_alarms=early, shown=shown, told=told)
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
