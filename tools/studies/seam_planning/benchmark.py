"""Benchmark of seam planning from one scan, by drawing and from the cloud alone, for each scanner and hard case."""

import math
from pathlib import Path

from weldcal.models.scanners import SCANNERS
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.report.files import records_csv
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.seam_planning.trials import (
    COLUMNS,
    FIRST_HELD_OUT,
    METHODS,
    SHAPES,
    TROUBLE_COLUMNS,
    WIDEST_PX,
    Trial,
    run_trial,
    run_troubles,
    scan,
    summary_rows,
    trouble_rows,
)


def run_seam_planning_benchmark(
    out: Path,
    runs: int = 2,
    seed: int = 0,
    presets: list[str] | None = None,
    progress: Progress = no_progress,
    *,
    full: bool = False,
    troubles: bool = True,
) -> tuple[dict[str, object], dict[str, str]]:
    """Every preset, shape and method over `runs` held-out poses: trials.csv in `out`, and the rows of the table.

    full: images as wide as the scanner has them. troubles: occlusion, clutter and wrong workpieces as well (troubles.csv).
    """
    presets = list(SCANNERS) if presets is None else presets
    trials: list[Trial] = []
    total = len(presets) * len(SHAPES) * runs
    for preset in presets:
        for shape in SHAPES:
            for k in range(runs):
                number = FIRST_HELD_OUT + seed + k
                scene = scan(preset, shape, number, None if full else WIDEST_PX)
                trials += [run_trial(scene, preset, shape, number, method) for method in METHODS]
                progress("planning", len(trials) / (len(METHODS) * total))
                write_atomic(out / "trials.csv", records_csv(trials, COLUMNS))
    rows = summary_rows(trials)
    if troubles:
        cases = run_troubles(runs, FIRST_HELD_OUT + seed)
        write_atomic(out / "troubles.csv", records_csv(cases, TROUBLE_COLUMNS))
        rows |= trouble_rows(cases)
    done = [t for t in trials if not t.refused]
    summary: dict[str, object] = {
        "state": "done",
        "trials": len(trials),
        "planned": len(done),
        "worst_mm": max((t.worst_mm for t in done), default=math.nan),
        "most_seconds": max((t.seconds for t in trials), default=math.nan),
    }
    return summary, rows
