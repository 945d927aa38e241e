"""Repeats calibrations in motion with known truth: error and coverage of the clock's offset, error and NEES of X_BC."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

from weldcal.calibration.geometry.se3 import difference
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.planning.moves import recorded_stream
from weldcal.models.arrays import Array
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.motion.exact import exact_errors
from weldcal.tools.studies.motion.moves import DELAY_S, cube_moves, observed_frames
from weldcal.tools.studies.output import markdown_table

LEVEL, SIGMAS = 0.95, 1.959964
WORK_M = 0.75  # from the scanner to the middle of the cube
_DRIFT, _EPOCH_S = 2e-5, 1.0e6  # of a device's clock

Estimator = Callable[..., MotionEstimate]


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockRuns:
    """Runs of one kind (``device`` times or arrivals), each of ``duration_s``: errors (N, 7) of X_BC's six and the offset (rad, m, s)
    and the same in sigmas ``scaled`` (N, 7); ``nees`` (N,) of X_BC over its six; ``own_ms`` (N,) error of the offset against the mean
    delay of the recording's own frames; ``work_mm`` (N,) error of a point in the middle of the work; ``turn_deg`` (N,). ``exact`` (N, 7) are the errors in
    sigmas of a least-squares fit that knows the motion exactly, of device times: what the draws themselves are. NaN for arrivals."""

    device: bool
    duration_s: float
    errors: Array
    scaled: Array
    nees: Array
    own_ms: Array
    work_mm: Array
    turn_deg: Array
    exact: Array

    @property
    def coverage(self) -> float:
        """Share of the runs whose stated 95 % interval holds the offset."""
        return float((np.abs(self.scaled[:, 6]) < SIGMAS).mean())

    def summary(self) -> dict[str, Any]:
        """Figures of these runs as plain values."""
        offset = 1e3 * self.errors[:, 6]
        low, high = (binom.ppf(q, len(offset), LEVEL) / len(offset) for q in (0.005, 0.995))
        return {
            "runs": len(offset),
            "duration_s": self.duration_s,
            "offset_coverage": self.coverage,
            "offset_coverage_chance": [float(low), float(high)],
            "offset_rms_ms": float(np.sqrt(np.mean(offset**2))),
            "offset_worst_ms": float(np.abs(offset).max()),
            "offset_own_mean_rms_ms": float(np.sqrt(np.mean(self.own_ms**2))),
            "offset_own_mean_worst_ms": float(np.abs(self.own_ms).max()),
            "nees": float(self.nees.mean()),
            "nees_per_unknown": [float(v) for v in (self.scaled**2).mean(axis=0)],
            "nees_per_unknown_of_exact_fits": [float(v) for v in (self.exact**2).mean(axis=0)] if self.device else None,
            "offset_coverage_of_exact_fits": float((np.abs(self.exact[:, 6]) < SIGMAS).mean()) if self.device else None,
            "nees_per_unknown_chance": [float(chi2.ppf(q, len(offset)) / len(offset)) for q in (0.005, 0.995)],
            "work_p95_mm": float(np.percentile(self.work_mm, 95)),
            "work_worst_mm": float(self.work_mm.max()),
            "turn_worst_deg": float(self.turn_deg.max()),
        }


def run_clock_study(
    runs: int,
    folder: Path | None = None,
    *,
    seed: int = 0,
    duration_s: float = 20.0,
    progress: Progress = no_progress,
    estimate: Estimator = estimate_in_motion,
) -> dict[str, ClockRuns]:
    """Runs with arrivals of 140 +- 15 ms and with device times; every other one moveL, else moveJ. With ``folder`` a table is written."""
    found = {}
    for name, device in (("arrival", False), ("device", True)):
        rows = []
        for k in range(runs):
            progress(name, (k + runs * device) / (2 * runs))
            rows.append(_one(device, duration_s, np.random.default_rng([seed, k, int(device)]), k % 2 == 1, estimate))
        columns = (np.array([row[i] for row in rows]) for i in range(7))
        names = ("errors", "scaled", "nees", "own_ms", "work_mm", "turn_deg", "exact")
        found[name] = ClockRuns(device=device, duration_s=duration_s, **dict(zip(names, columns, strict=True)))
    if folder is not None:
        write_atomic(folder / "motion_clock.md", clock_table(found))
    return found


def _one(
    device: bool, duration_s: float, rng: np.random.Generator, linear: bool, estimate: Estimator
) -> tuple[Array, Array, float, float, float, float, Array]:
    """One run: errors (7,), in sigmas (7,), NEES, error against the recording's own mean delay (ms), at the work (mm), turn (deg), and
    the errors in sigmas (7,) of the exact fit."""
    moves, X_BC = cube_moves(rng, linear=linear)
    stream = recorded_stream(moves, duration_s + 1.0, rng, joints=not linear)
    frames, capture = observed_frames(
        moves, X_BC, duration_s + 1.0, rng, device=device, drift=_DRIFT * device, epoch_s=-_EPOCH_S * device
    )
    found = estimate(frames, ContinuousMotion(stream), held_out=False)
    clock = found.clock
    assert clock.offset_s is not None
    assert clock.sigma_s is not None
    if device:
        assert frames.device is not None
        true = float(np.interp(clock.reference_s, frames.device, capture - frames.device))
        own = true
    else:
        true, own = DELAY_S, float(np.mean(frames.arrival - capture))
    # from the estimate to the truth, as the covariance is defined
    error = -difference(found.X_BC.GetAsMatrix4(), X_BC.GetAsMatrix4())
    offset = clock.offset_s - true
    errors = np.concatenate([error, [offset]])
    scaled = errors / np.append(np.sqrt(np.diag(found.covariance)), clock.sigma_s)
    nees = float(error @ np.linalg.solve(found.covariance, error)) / 6.0
    p = np.array([0.0, 0.0, WORK_M])
    work = float(np.linalg.norm(np.asarray(found.X_BC @ p) - np.asarray(X_BC @ p)))
    turn = float(np.degrees(np.linalg.norm(error[:3])))
    exact = exact_errors(frames, capture, moves, X_BC) if device else np.full(7, np.nan)
    return errors, scaled, nees, 1e3 * (clock.offset_s - own), 1e3 * work, turn, exact


def clock_table(found: dict[str, ClockRuns]) -> str:
    """The figures of both kinds in Markdown."""
    rows = []
    summaries = {name: runs.summary() for name, runs in found.items()}
    for key in next(iter(summaries.values())):
        cells = []
        for summary in summaries.values():
            value = summary[key]
            cells.append(
                " ".join(f"{v:.3g}" for v in value)
                if isinstance(value, list)
                else ""
                if value is None
                else f"{value:.4g}"
            )
        rows.append((key, *cells))
    return markdown_table(("figure", *summaries), rows)
