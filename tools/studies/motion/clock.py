"""Repeats calibrations in motion with known truth: error and coverage of the clock's offset, error and NEES of X_BC."""

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any

import numpy as np
from scipy.stats import binom, chi2

from weldcal.calibration.geometry.se3 import difference
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.expected import recorded_stream
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.studies.harness import Cases, Figures, Results, Row, Study, whole
from weldcal.tools.worlds.moves import DELAY_S, cube_moves, exact_errors, observed_frames

LEVEL, SIGMAS = 0.95, 1.959964
WORK_M = 0.75  # from the scanner to the middle of the cube
CLOCKS = ("arrival", "device")
_DRIFT, _EPOCH_S = 2e-5, 1.0e6  # of a device's clock

Estimator = Callable[..., MotionEstimate]


def one_run(
    clock: str, index: int, duration_s: float, seed: int, estimate: Estimator = estimate_in_motion
) -> Mapping[str, object]:
    """Calibrate one recording of a moveJ (even ``index``) or moveL, with device times or arrivals of 140 +- 15 ms.

    Returns:
        errors (7,) of X_BC's six and the clock's offset (rad, m, s), the same in sigmas, the NEES of X_BC over its six,
        the error of the offset against the mean delay of the recording's own frames (ms), the error of a point in the
        middle of the work (mm), the turn (deg). With device times also the errors in sigmas (7,) of a least-squares fit
        that knows the motion exactly: what the draws themselves are.
    """
    device, linear = clock == "device", index % 2 == 1
    rng = np.random.default_rng([seed, index, int(device)])
    moves, X_BC = cube_moves(rng, linear=linear)
    stream = recorded_stream(moves, duration_s + 1.0, rng, joints=not linear)
    frames, capture = observed_frames(
        moves, X_BC, duration_s + 1.0, rng, device=device, drift=_DRIFT * device, epoch_s=-_EPOCH_S * device
    )
    found = estimate(frames, ContinuousMotion(stream), held_out=False)
    stated = found.clock
    assert stated.offset_s is not None
    assert stated.sigma_s is not None
    if device:
        assert frames.device is not None
        true = own = float(np.interp(stated.reference_s, frames.device, capture - frames.device))
    else:
        true, own = DELAY_S, float(np.mean(frames.arrival - capture))
    # from the estimate to the truth, as the covariance is defined
    error = -difference(found.X_BC.GetAsMatrix4(), X_BC.GetAsMatrix4())
    errors = np.concatenate([error, [stated.offset_s - true]])
    p = np.array([0.0, 0.0, WORK_M])
    return {
        "clock": clock,
        "errors": errors,
        "scaled": errors / np.append(np.sqrt(np.diag(found.covariance)), stated.sigma_s),
        "nees": float(error @ np.linalg.solve(found.covariance, error)) / 6.0,
        "own_ms": 1e3 * (stated.offset_s - own),
        "work_mm": 1e3 * float(np.linalg.norm(np.asarray(found.X_BC @ p) - np.asarray(X_BC @ p))),
        "turn_deg": float(np.degrees(np.linalg.norm(error[:3]))),
        "exact": exact_errors(frames, capture, moves, X_BC) if device else None,
        "duration_s": duration_s,
    }


def cases(runs: int, duration_s: float, seed: int) -> Cases:
    """``runs`` recordings with each clock."""
    return {
        f"{clock} {k}": {"clock": clock, "index": k, "duration_s": duration_s, "seed": seed}
        for clock in CLOCKS
        for k in range(runs)
    }


def _figures(results: Results) -> Figures:
    return {clock: _summary([r for r in whole(results).values() if r["clock"] == clock]) for clock in CLOCKS}


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the runs with one clock."""
    of = {
        key: np.array([r[key] for r in runs]) for key in ("errors", "scaled", "nees", "own_ms", "work_mm", "turn_deg")
    }
    exact = None if runs[0]["exact"] is None else np.array([r["exact"] for r in runs])
    offset = 1e3 * of["errors"][:, 6]
    low, high = (binom.ppf(q, len(offset), LEVEL) / len(offset) for q in (0.005, 0.995))
    return {
        "runs": len(offset),
        "duration_s": runs[0]["duration_s"],
        "offset_coverage": float((np.abs(of["scaled"][:, 6]) < SIGMAS).mean()),
        "offset_coverage_chance": [float(low), float(high)],
        "offset_rms_ms": float(np.sqrt(np.mean(offset**2))),
        "offset_worst_ms": float(np.abs(offset).max()),
        "offset_own_mean_rms_ms": float(np.sqrt(np.mean(of["own_ms"] ** 2))),
        "offset_own_mean_worst_ms": float(np.abs(of["own_ms"]).max()),
        "nees": float(of["nees"].mean()),
        "nees_per_unknown": [float(v) for v in (of["scaled"] ** 2).mean(axis=0)],
        "nees_per_unknown_of_exact_fits": None if exact is None else [float(v) for v in (exact**2).mean(axis=0)],
        "offset_coverage_of_exact_fits": None if exact is None else float((np.abs(exact[:, 6]) < SIGMAS).mean()),
        "nees_per_unknown_chance": [float(chi2.ppf(q, len(offset)) / len(offset)) for q in (0.005, 0.995)],
        "work_p95_mm": float(np.percentile(of["work_mm"], 95)),
        "work_worst_mm": float(of["work_mm"].max()),
        "turn_worst_deg": float(of["turn_deg"].max()),
    }


def _rows(figures: Figures) -> Iterable[Row]:
    for key in figures[CLOCKS[0]]:
        yield key, *(_cell(figures[clock][key]) for clock in CLOCKS)


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(f"{v:.3g}" for v in value)
    return "" if value is None else f"{value:.4g}"


STUDY = Study(
    name="motion-clock",
    what=(
        "Calibrations in motion with known truth: coverage of the clock's offset, error and NEES of the scanner's pose."
    ),
    case=one_run,
    figures=_figures,
    header=("figure", *CLOCKS),
    rows=_rows,
)


@command(
    "benchmark motion-clock",
    short_help="Measure how well the clock's offset is found in motion.",
    options=FARM,
    hidden=True,
)
def benchmark_clock(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of calibrations with each clock.", min=2)] = 300,
    seconds: Annotated[float, option("--seconds", "S", "Length of each recording.", min=5.0)] = 20.0,
) -> Outcome:
    """Repeat calibrations in motion with known truth: coverage of the clock's offset, error and NEES of the scanner's
    pose."""
    return STUDY.outcome(call, cases(runs, seconds, call.seed))
