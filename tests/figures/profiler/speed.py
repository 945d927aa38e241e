"""Times the calibration of a profiler by an edge without a guess, and by the paper's method."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.figures.harness import Figures, Row, Study
from tests.figures.profiler.seeds import profiler_seeds
from tests.figures.subject import one_of
from tests.worlds.edge_trials import EdgeTrial, fixed_edge_trials, made_edge_trials, rms
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.console import Progress
from weldcal.tools.report.render import fixed

SETS = 20
SAME_DEG, SAME_MM = 0.01, 0.01  # from the optimum that a start at the truth leads to: that one was found

Answer = tuple[Floats, Floats]


@command("benchmark profiler-speed", short_help="Time the profiler's calibration by an edge.", hidden=True)
def benchmark_speed(
    call: Call,
    data: Annotated[
        Path | None, option("--data", "FOLDER", "The fixed files. Without them, sets generated from the seed.")
    ] = None,
) -> Outcome:
    """Time the profiler's calibration by an edge and compare it with the published method."""
    folder = SPEED.folder(call)
    return SPEED.found(time_methods(call.seed, data, call.progress), folder)


@command("benchmark profiler", short_help="Measure the profiler's calibration: speed, or seeds.", options=FARM)
@one_of("speed", speed=benchmark_speed, seeds=profiler_seeds)
def benchmark_profiler(call: Call) -> None:
    """Time the profiler's calibration by an edge, or run every target of 'reproduce profiler' over many seeds."""


def time_methods(seed: int, data: Path | None, progress: Progress) -> dict[str, object]:
    """Time them in one run on the same sets.

    Raises:
        InputError: the fixed files are not in the folder named.
    """
    if data is not None and not data.is_dir():
        raise InputError(f"There is no folder '{data}': give the one with edge_features.npz.")

    def sets(name: str, count: int) -> list[EdgeTrial]:
        every = made_edge_trials(name, count, seed) if data is None else fixed_edge_trials(data, name)
        return list(every)[:count]

    rows: list[dict[str, Any]] = []
    for k, level in enumerate(("paper", "nominal")):
        free = sets(f"free_{level}", SETS)
        progress(f"40 free poses, {level} noise", 0.15 * k)
        best = [_from_truth(t) for t in free]
        rows.append(_row("joint, no guess", f"40 free, {level} noise", free, _joint, best))
    arcs = sets("tilt_paper", 10)
    progress("the paper's method", 0.8)
    rows.append(_row("joint, no guess", "25 x 10, paper noise", arcs, _joint, [_from_truth(t) for t in arcs]))
    rows.append(_row("paper, centred", "25 x 10, paper noise", arcs, _paper, None))
    return {"data": "fixed files" if data is not None else f"seed {seed}", "rows": rows}


def _lines(figures: Figures) -> Iterable[Row]:
    for r in figures["rows"]:
        times = (f"{1e3 * r[key]:.1f}" for key in ("median_s", "most_s", "processor_s", "most_processor_s"))
        found = "" if r["found"] is None else f"{r['found']} of {r['sets']}"
        yield r["method"], r["poses"], *times, found, fixed(r["rotation_deg"], 3), fixed(r["translation_mm"], 3)


SPEED = Study(
    name="profiler",
    what="Time of a profiler's calibration by an edge without a guess, and by the paper's method.",
    header=("method", "poses", "median ms", "most ms", "processor ms", "most ms", "optimum found", "off deg", "off mm"),
    rows=_lines,
    numbers=7,
)


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
