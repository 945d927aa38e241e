"""Times the detection of the flange: weldcal, and the paper's loop."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.flange_frames import FlangeScan, facing, flange_frame
from weldcal.calibration.flange.fit import FlangeGuess, fit_flange
from weldcal.models.arrays import Array
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.report.render import fixed

FLANGE = "iso9409-1-50-4-m6"
_E_D, _E_R, _K_MAX = 0.0003, 0.001, 10_000  # paper, section 3.2.2
_REPEATS = 15
_SEGMENTED = 13_000  # points, as the recorded clouds have


Timing = dict[str, Any]
"""One row: what ran on what, median and least milliseconds of processor time, and the centre's error, mm (None: it
found nothing)."""


def run_flange_benchmark(seed: int = 0, progress: Progress = no_progress) -> list[Timing]:
    """Time every method on the same simulated PhoXi M scans; on one thread where its library allows that."""
    standard = get_flange(FLANGE)
    frames: dict[str, FlangeScan] = {}
    for name, width in (("0.5", 824), ("3.2", 2064)):
        progress("ray-casting the scans", 0.05 * len(frames))
        X_CR = facing(np.array([0.04, -0.03, 0.62]), np.radians(12.0), 0.7, 0.3)
        frames[name] = flange_frame(get_scanner("phoxi_m", width), standard, np.random.default_rng(seed), X_CR=X_CR)
    cloud, truth = _segmented(frames["3.2"], standard.outer_m)
    rows: list[Timing] = []

    def find(points: Array, guess: FlangeGuess | None = None) -> Callable[[], Array]:
        return lambda: fit_flange(points, standard, guess=guess).center_C

    ours: list[tuple[str, Callable[[], Array]]] = [(f"segmented cloud, {len(cloud)} points", find(cloud))]
    for name in ("0.5", "3.2"):
        points = frames[name].points_C
        ours.append((f"{name} Mpx frame", find(points)))
        last = fit_flange(points, standard)
        guess = FlangeGuess(last.center_C, 0.7 * standard.outer_m, last.normal_C)
        ours.append((f"{name} Mpx frame, tracked", find(points, guess)))
    for k, (name, job) in enumerate(ours):
        progress("ours", 0.1 + 0.08 * k)
        rows.append(_time(f"weldcal, {name}", job, _REPEATS, truth))
    return rows


def _time(name: str, job: Callable[[], Array | None], repeats: int, truth: Array) -> Timing:
    spans, center = [], None
    for k in range(repeats + (repeats > 1)):
        start = time.process_time()
        center = job()
        if k or repeats == 1:  # the first of many warms the caches
            spans.append(1e3 * (time.process_time() - start))
    error = None if center is None else float(1e3 * np.linalg.norm(center - truth))
    least = float(min(spans))
    return {"name": name, "median_ms": float(np.median(spans)), "least_ms": least, "error_mm": error}


def _segmented(frame: FlangeScan, outer_m: float) -> tuple[Array, Array]:
    """Return the flange's own points of a frame, thinned to a recorded cloud's number, and the true centre."""
    assert frame.X_CR is not None
    p = frame.points_C.reshape(-1, 3)
    p = p[np.isfinite(p).all(axis=1)]
    d = frame.X_CR.inverse() @ p.T
    near = (np.hypot(d[0], d[1]) < 0.53 * outer_m) & (np.abs(d[2]) < 0.0015)
    p = p[near]
    keep = np.sort(np.random.default_rng(0).choice(len(p), min(_SEGMENTED, len(p)), replace=False))
    return p[keep], np.asarray(frame.X_CR.translation())


@figure("flange-speed", "processor time to find the flange in a scan")
def speed(run: Run) -> None:
    """Time the detection of the flange in a scan."""
    rows = run_flange_benchmark(run.seed, run.progress)
    ours = rows[0]["median_ms"]
    lines = (
        (
            r["name"],
            *(f"{r[k]:.2f}" for k in ("median_ms", "least_ms")),
            f"{r['median_ms'] / ours:.1f}",
            fixed(r["error_mm"], 3),
        )
        for r in rows
    )
    run.table("", ("method and scan", "median ms", "least ms", "over the first", "centre off, mm"), lines)
