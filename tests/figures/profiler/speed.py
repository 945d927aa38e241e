"""Times the calibration of a profiler by an edge without a guess, and by the paper's method."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.figures.harness import Run, figure
from tests.worlds.edge_trials import EdgeTrial, fixed_edge_trials, made_edge_trials, rms
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import Floats
from weldcal.tools.console import Progress
from weldcal.tools.report.render import fixed

SETS = 20
SAME_DEG, SAME_MM = 0.01, 0.01  # from the optimum that a start at the truth leads to: that one was found

Answer = tuple[Floats, Floats]


@figure("profiler-speed", "time of a profiler's calibration by an edge without a guess, and by the paper's method")
def profiler_speed(run: Run) -> None:
    """Time both methods on the same sets."""
    rows = []
    for r in time_methods(run.seed, run.data, run.size(4, SETS), run.progress):
        times = (f"{1e3 * r[key]:.1f}" for key in ("median_s", "most_s", "processor_s", "most_processor_s"))
        found = "" if r["found"] is None else f"{r['found']} of {r['sets']}"
        off = (fixed(r["rotation_deg"], 3), fixed(r["translation_mm"], 3))
        rows.append((r["method"], r["poses"], *times, found, *off))
    times_of = ("median ms", "most ms", "processor ms", "most ms")
    run.table("", ("method", "poses", *times_of, "optimum found", "off deg", "off mm"), rows)


def time_methods(seed: int, data: Path | None, count: int, progress: Progress) -> list[dict[str, Any]]:
    """Time them in one run on ``count`` sets, of the folder or made from the seed."""

    def sets(name: str, count: int) -> list[EdgeTrial]:
        every = made_edge_trials(name, count, seed) if data is None else fixed_edge_trials(data, name)
        return list(every)[:count]

    rows: list[dict[str, Any]] = []
    for k, level in enumerate(("paper", "nominal")):
        free = sets(f"free_{level}", count)
        progress(f"40 free poses, {level} noise", 0.15 * k)
        best = [_from_truth(t) for t in free]
        rows.append(_row("joint, no guess", f"40 free, {level} noise", free, _joint, best))
    arcs = sets("tilt_paper", (count + 1) // 2)
    progress("the paper's method", 0.8)
    rows.append(_row("joint, no guess", "25 x 10, paper noise", arcs, _joint, [_from_truth(t) for t in arcs]))
    rows.append(_row("paper, centred", "25 x 10, paper noise", arcs, _paper, None))
    return rows


def _row(
    method: str,
    poses: str,
    trials: Sequence[EdgeTrial],
    solve: Callable[[EdgeTrial], Answer],
    best: list[Answer] | None,
) -> dict[str, Any]:
    """Time a method on sets: wall and processor s (median, largest), how often it found the optimum, rms error."""
    seconds, worked, errors, found = [], [], [], 0
    for k, trial in enumerate(trials):
        start, begun = time.perf_counter(), time.process_time()
        answer = solve(trial)
        seconds.append(time.perf_counter() - start)
        worked.append(time.process_time() - begun)
        errors.append(trial.error(*answer))
        if best is not None:
            deg, mm = _apart(answer, best[k])
            found += bool(deg < SAME_DEG and mm < SAME_MM)
    rotation_deg, translation_mm = rms(errors)
    return {
        "method": method,
        "poses": poses,
        "sets": len(trials),
        "median_s": float(np.median(seconds)),
        "most_s": max(seconds),
        "processor_s": float(np.median(worked)),
        "most_processor_s": max(worked),
        "found": None if best is None else found,
        "rotation_deg": rotation_deg,
        "translation_mm": translation_mm,
    }


def _apart(a: Answer, b: Answer) -> tuple[float, float]:
    turn = np.degrees(Rotation.from_matrix(a[0].T @ b[0]).magnitude())
    return float(turn), 1e3 * float(np.linalg.norm(a[1] - b[1]))


def _joint(t: EdgeTrial, start: EdgeState | None = None) -> Answer:
    e = t.joint(start)
    return e.rotation, e.translation


def _from_truth(t: EdgeTrial) -> Answer:
    return _joint(t, t.truth)


def _paper(t: EdgeTrial) -> Answer:
    e = t.paper()
    return e.rotation, e.translation
