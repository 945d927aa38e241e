"""Puts the frames of a recording on the robot's clock where the scanner's pose is known, also if it moved meanwhile."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import DEVICE, ScannerClock
from weldcal.calibration.motion.clock_fit import DRIFT, OFFSET, ClockFit, fit_clock
from weldcal.calibration.motion.observed import FrameClock, ObservedFrames, choose_clock
from weldcal.calibration.motion.start import EARLIEST_S, LATEST_S
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

_STEP_S, _FINE_S = 0.01, 0.001
_MOST_FRAMES = 150
_FEWEST = 12
_SHOWN = 4.0  # times its own least: a spread of residuals that rises so much over the delays shows the clock
_LEAST_SHOWN_M = 2e-3  # a choice: the scatter of arm and scanner at 0.15 mm, ten times over
_WORST_S = 0.01  # a less certain offset is not used


@dataclass(frozen=True, eq=False, kw_only=True)
class Synchronised:
    """Nominal capture times (N,) s on the robot's clock, NaN where a frame has none, and how they were found.

    ``clock`` of the frames, its delay (s, capture = base - delay + drift (base - reference)) with a standard deviation,
    both None where neither the motion nor the calibration tells it, the drift, and the jitter (s) of single frames.
    ``source`` is "recording" or "calibration".
    """

    clock: FrameClock
    times: Array
    delay_s: float | None
    sigma_s: float | None
    drift: float
    jitter_s: float
    source: str


def synchronise(
    frames: ObservedFrames,
    motion: ContinuousMotion,
    X_BC: RigidTransform,
    *,
    X_FR: RigidTransform | None = None,
    known: ScannerClock | None = None,
) -> Synchronised:
    """Find the clock's delay in a recording itself, with the scanner near ``X_BC``.

    ``known`` is a calibration's clock, used where the recording does not show it.

    First a search: for each delay the residuals e_k = X_BC p_C,k - p_BR(t_k), without their median, which takes out a
    scanner that stands a little elsewhere; the delay with the least median of |e|. A scanner that moves by some
    millimetres in the middle does not change which delay is the best, since what the motion makes of a wrong one
    changes its sign with the motion. Then the joint fit of ``fit_clock``, whose pose is left free and given up.
    """
    clock = choose_clock(frames)
    coarse = _search(frames, clock, motion, X_BC, X_FR)
    if coarse is not None and len(frames) >= _FEWEST:
        free = (0, 1, 2, 3, 4, 5, OFFSET, *((DRIFT,) if clock.kind == DEVICE else ()))
        fit = fit_clock(frames, clock, motion, X_BC, clock.sign * -coarse, X_FR=X_FR, free=free)
        sigma = _sigma(fit)
        if sigma is not None and sigma < _WORST_S:
            delay = -clock.sign * fit.offset
            return Synchronised(
                clock=clock,
                times=clock.nominal(fit.offset, fit.drift),
                delay_s=delay,
                sigma_s=sigma,
                drift=fit.drift,
                jitter_s=float(np.sqrt(fit.variances.jitter)),
                source="recording",
            )
    if known is not None and known.offset_s is not None and known.kind == clock.kind:
        device = frames.device if clock.kind == DEVICE else None
        times = [
            known.capture(float(a), None if device is None else float(device[k])) for k, a in enumerate(frames.arrival)
        ]
        base = np.array([np.nan if t is None else t for t in times])
        delay = float(np.nanmedian(clock.base - base))
        return Synchronised(
            clock=clock,
            times=base,
            delay_s=delay,
            sigma_s=known.sigma_s,
            drift=0.0,
            jitter_s=known.jitter_s or 0.0,
            source="calibration",
        )
    return Synchronised(
        clock=clock,
        times=clock.base if coarse is None else clock.base - coarse,
        delay_s=coarse,
        sigma_s=None,
        drift=0.0,
        jitter_s=0.0,
        source="recording",
    )


def _search(
    frames: ObservedFrames,
    clock: FrameClock,
    motion: ContinuousMotion,
    X_BC: RigidTransform,
    X_FR: RigidTransform | None,
) -> float | None:
    """Return the delay (s) with the least spread of the residuals; None where the spread hardly depends on it."""
    usable = np.flatnonzero(np.isfinite(clock.base))
    if len(usable) < 3:
        return None
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _MOST_FRAMES)).astype(int))]
    seen = frames.p_C[chosen] @ X_BC.rotation().matrix().T + X_BC.translation()
    base = clock.base[chosen]
    delays = np.arange(EARLIEST_S, LATEST_S + 0.5 * _STEP_S, _STEP_S)
    spread = _spreads(seen, base, delays, motion, X_FR)
    if not np.isfinite(spread).any():
        return None
    best = float(delays[np.nanargmin(spread)])
    if np.nanmax(spread) < max(_SHOWN * np.nanmin(spread), _LEAST_SHOWN_M):
        return None
    fine = best + np.arange(-_STEP_S, _STEP_S + 0.5 * _FINE_S, _FINE_S)
    narrow = _spreads(seen, base, fine, motion, X_FR)
    return float(fine[np.nanargmin(narrow)]) if np.isfinite(narrow).any() else best


def _spreads(seen: Array, base: Array, delays: Array, motion: ContinuousMotion, X_FR: RigidTransform | None) -> Array:
    """Median distances (D,) m of the residuals from their median.

    NaN where fewer than half of the frames lie in the stream.
    """
    X = motion.poses((base - delays[:, None]).ravel())
    if X_FR is not None:
        X = X @ X_FR.GetAsMatrix4()
    e = seen - X[:, :3, 3].reshape(len(delays), len(base), 3)
    enough = np.isfinite(e[:, :, 0]).mean(axis=1) >= 0.5
    out = np.full(len(delays), np.nan)
    part = e[enough]
    out[enough] = np.nanmedian(np.linalg.norm(part - np.nanmedian(part, axis=1, keepdims=True), axis=2), axis=1)
    return out


def _sigma(fit: ClockFit) -> float | None:
    """Standard deviation (s) of the offset; None where the motion leaves it open."""
    k = fit.free.index(OFFSET)
    N = fit.information
    d = np.sqrt(np.maximum(np.diag(N), 1e-30))
    scaled = N / np.outer(d, d)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled).min() < 1e-9:
        return None
    return float(np.sqrt(np.linalg.inv(scaled)[k, k]) / d[k])
