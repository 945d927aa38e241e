"""Measures what recording costs: the same run with and without it, in turn, by the computing time of this process."""

import time
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


def run_overhead(folder: Path, pairs: int, seed: int, progress: Progress) -> tuple[dict[str, object], str]:
    """Pairs of one run (the S groove, 30 mm of seam), one of each pair recorded: the JSON object, and a table in Markdown.

    Computing time (all threads of this process, s) of whole runs, reports included, is compared. Run it on an idle computer: on a busy one
    the same work takes up to half as long again. Who is first alternates. A first run, which compiles and loads, does not count.
    Each recording is removed. `percent_of_a_core`: what recording takes, spread over the run's own seconds.
    """
    progress("first run, not counted", 0.0)
    _seconds(folder / "first", seed, record=True)
    rows: list[dict[str, float]] = []
    for k in range(pairs):
        progress(f"pair {k + 1} of {pairs}", (k + 1) / (pairs + 1))
        row = {"pair": k + 1.0}
        for record in (k % 2 == 0, k % 2 == 1):
            name = "recorded" if record else "plain"
            cpu, wall, size, length = _seconds(folder / f"pair_{k + 1}_{name}", seed, record=record)
            row |= {f"{name}_cpu_s": cpu, f"{name}_wall_s": wall, "run_s": length} | (
                {"size_mb": size} if record else {}
            )
        rows.append(row)
    found = overhead(np.array([[row["plain_cpu_s"], row["recorded_cpu_s"]] for row in rows]))
    lines = [
        (f"{row['pair']:.0f}", *(f"{row[name]:.1f}" for name in ("plain_cpu_s", "recorded_cpu_s", "plain_wall_s", "recorded_wall_s")),
         f"{row['size_mb']:.0f}")
        for row in rows
    ]  # fmt: skip
    header = ("pair", "computing s", "recorded, s", "wall s", "recorded, s", "MB")
    text = markdown_table(header, lines)
    share = 100.0 * float(np.median([(row["recorded_cpu_s"] - row["plain_cpu_s"]) / row["run_s"] for row in rows]))
    text += "recording costs {percent:.1f} % of computing time (median; {low:.1f} to {high:.1f} at 95 %)".format(
        **found
    )
    text += f"; at the pace of a robot that is {share:.1f} % of one core\n"
    return {"state": "done", "overhead": found, "percent_of_a_core": share, "per_pair": rows}, text


def overhead(seconds: np.ndarray) -> dict[str, float]:
    """By how many percent the second column (n,2) is longer than the first: the median of the pairs, and its interval of at least 95 %.

    A host that works for others too makes single runs longer by a third: the median and its interval (order statistics) bear that.
    """
    percent = 100.0 * (seconds[:, 1] / seconds[:, 0] - 1.0)
    interval: Any = stats.quantile_test(percent, p=0.5).confidence_interval(0.95)
    return {"percent": float(np.median(percent)), "low": float(interval.low), "high": float(interval.high)}


def _seconds(folder: Path, seed: int, *, record: bool) -> tuple[float, float, float, float]:
    """Computing and wall time (s) of one run, the size of its recording (MB, 0 without one), and the run's own length (s)."""
    scenario = load_scenario("s_groove", f"{SHORT}\n{FEW}")
    cpu, wall = time.process_time(), time.perf_counter()
    result = run_scenario(scenario, RunOptions("s_groove", folder, seed, recording=False, record=record))
    used = time.process_time() - cpu, time.perf_counter() - wall
    path = folder / RECORDING
    size = path.stat().st_size / 1e6 if record else 0.0
    path.unlink(missing_ok=True)
    return *used, size, result.run.seconds
