"""Figures of a weld in the whole simulated cell: felt seam points and torch against the truth, and speed."""

from dataclasses import dataclass

import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.weld import FeltSeam, felt_seam


@dataclass(frozen=True, kw_only=True)
class CellRun:
    """One weld.

    Lengths in mm: seam points sideways and in height against where the tool's numbers say a seated tip is felt (sd
    about a smooth line through themselves, and mean); torch against the true line, sideways and in space; its speed's
    coefficient of variation in %. `cpu_per_second`: processor seconds (all threads) per simulated second of the weld.
    """

    scenario: str
    law: str
    seed: int
    completed: bool
    reason: str
    point_sd_mm: float = np.nan
    point_spread_mm: float = np.nan
    point_offset_mm: float = np.nan
    height_sd_mm: float = np.nan
    height_offset_mm: float = np.nan
    torch_mean_mm: float = np.nan
    torch_max_mm: float = np.nan
    space_max_mm: float = np.nan
    cv_percent: float = np.nan
    welded_mm: float = np.nan
    real_time_factor: float = np.nan
    cpu_per_second: float = np.nan


def figures(result: DemoResult, name: str, law: str, seed: int, cpu_per_second: float) -> CellRun:
    """The figures of a finished run, in mm."""
    run, weld = result.run, result.weld
    felt: FeltSeam | None = felt_seam(run.cell, run.root)
    if weld is None or weld.error is None or weld.speed is None or felt is None:
        return CellRun(scenario=name, law=law, seed=seed, completed=False, reason=run.reason or "nothing was welded")
    return CellRun(
        scenario=name,
        law=law,
        seed=seed,
        completed=not run.held,
        reason=run.reason or "",
        point_sd_mm=1e3 * scatter(felt.lateral),
        point_spread_mm=1e3 * float(felt.lateral.std()),
        point_offset_mm=1e3 * float(felt.lateral.mean()),
        height_sd_mm=1e3 * scatter(felt.height),
        height_offset_mm=1e3 * float(felt.height.mean()),
        torch_mean_mm=1e3 * weld.error.mean_m,
        torch_max_mm=1e3 * weld.error.max_m,
        space_max_mm=1e3 * float(np.hypot(weld.error.lateral, weld.error.height).max()),
        cv_percent=1e2 * weld.speed.cv,
        welded_mm=1e3 * weld.speed.welded_m,
        real_time_factor=run.real_time_factor("weld"),
        cpu_per_second=cpu_per_second,
    )


def scatter(values: Array, window: int = 31) -> float:
    """Standard deviation of a series about a smooth line through itself: quadratics over `window` neighbours."""
    from scipy.signal import savgol_coeffs, savgol_filter

    if len(values) <= window:
        return float(np.std(values))
    gap = values - savgol_filter(values, window, 2)
    # A point pulls its own line towards itself by its weight in it.
    own = savgol_coeffs(window, 2)[window // 2]
    return float(np.sqrt(np.mean(gap**2) / (1.0 - own)))
