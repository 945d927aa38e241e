"""Measures what recording costs: the same run with and without it, both in turns of a second, by the computing time of their processes."""

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.demo import run_scenario
from weldcal.tools.commands.record import RECORDING
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.studies.output import markdown_table
from weldcal.tools.studies.replay.study import FEW, SHORT

LONGEST_TURN_S = 120.0
ALL_TURNS = 2000  # more than a run takes
_TURNS: list[Semaphore] = []  # of a measuring process: one for each side


def run_overhead(folder: Path, pairs: int, seed: int, progress: Progress) -> tuple[dict[str, object], str]:
    """Pairs of one run (the S groove, 30 mm of seam), one of each pair recorded: the JSON object, and a table in Markdown.

    Computing time (all threads of a process, s) of whole runs, reports included, is compared. The two runs of a pair take turns of
    one simulated second: a host that works for others too changes its speed by a third within minutes, and so changes it for both.
    A first pair, which compiles and loads, does not count. Each recording is removed. `percent_of_a_core`: what recording takes,
    spread over the run's own seconds.
    """
    rows: list[dict[str, float]] = []
    with _two_processes() as (pool, turns):
        for k in range(pairs + 1):
            progress(f"pair {k} of {pairs}" if k else "first pair, not counted", k / (pairs + 1))
            plain, recorded = _pair(pool, turns, folder / f"pair_{k}", seed)
            if k:
                rows.append(
                    {"pair": float(k), "plain_cpu_s": plain[0], "recorded_cpu_s": recorded[0], "size_mb": recorded[1], "run_s": plain[2]}
                )  # fmt: skip
    found = overhead(np.array([[row["plain_cpu_s"], row["recorded_cpu_s"]] for row in rows]))
    lines = [
        (f"{row['pair']:.0f}", f"{row['plain_cpu_s']:.2f}", f"{row['recorded_cpu_s']:.2f}", f"{row['size_mb']:.0f}")
        for row in rows
    ]
    text = markdown_table(("pair", "computing s", "recorded, s", "MB"), lines)
    share = 100.0 * float(np.median([(row["recorded_cpu_s"] - row["plain_cpu_s"]) / row["run_s"] for row in rows]))
    text += "recording costs {percent:.1f} % of computing time (median; {low:.1f} to {high:.1f} at 95 %)".format(
        **found
    )
    text += f"; at the pace of a robot that is {share:.1f} % of one core\n"
    return {"state": "done", "overhead": found, "percent_of_a_core": share, "per_pair": rows}, text


def overhead(seconds: np.ndarray) -> dict[str, float]:
    """By how many percent the second column (n,2) is longer than the first: the median of the pairs, and its interval of at least 95 %.

    A disturbance of the host makes single runs longer: the median and its interval (order statistics) bear that.
    """
    percent = 100.0 * (seconds[:, 1] / seconds[:, 0] - 1.0)
    interval: Any = stats.quantile_test(percent, p=0.5).confidence_interval(0.95)
    return {"percent": float(np.median(percent)), "low": float(interval.low), "high": float(interval.high)}


@contextmanager
def _two_processes() -> Iterator[tuple[ProcessPoolExecutor, list[Semaphore]]]:
    context = get_context("spawn")
    turns = [context.Semaphore(0), context.Semaphore(0)]
    with ProcessPoolExecutor(2, mp_context=context, initializer=_begin, initargs=tuple(turns)) as pool:
        yield pool, turns


def _begin(*turns: Semaphore) -> None:
    _TURNS.extend(turns)


def _pair(
    pool: ProcessPoolExecutor, turns: list[Semaphore], folder: Path, seed: int
) -> list[tuple[float, float, float]]:
    """One run without and one with a recording, in turns."""
    for turn in turns:
        while turn.acquire(block=False):
            pass
    sides = [pool.submit(_in_turns, side, folder / str(side), seed) for side in (0, 1)]
    turns[0].release()
    return [side.result() for side in sides]


def _in_turns(side: int, folder: Path, seed: int) -> tuple[float, float, float]:
    """One run that works only in its turns; side 1 is recorded: computing time s, size of the recording MB, the run's own length s."""
    mine, others = _TURNS[side], _TURNS[1 - side]

    def hand_over(*_: object) -> None:
        others.release()
        mine.acquire(timeout=LONGEST_TURN_S)

    mine.acquire(timeout=LONGEST_TURN_S)
    try:
        return seconds(folder, seed, record=side == 1, progress=hand_over)
    finally:
        for _ in range(ALL_TURNS):
            others.release()


def seconds(folder: Path, seed: int, *, record: bool, progress: Progress) -> tuple[float, float, float]:
    """Computing time s of one run, the size of its recording (MB, 0 without one), and the run's own length s."""
    scenario = load_scenario("s_groove", f"{SHORT}\n{FEW}")
    before = time.process_time()
    result = run_scenario(
        scenario, RunOptions(scenario="s_groove", out=folder, seed=seed, recording=False, record=record), progress
    )
    used, path = time.process_time() - before, folder / RECORDING
    size = path.stat().st_size / 1e6 if record else 0.0
    path.unlink(missing_ok=True)
    return used, size, result.run.seconds
