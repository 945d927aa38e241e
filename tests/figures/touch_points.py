"""How often touched points lie in the stated 95 % region, in light worlds whose truth is not the estimator's model."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tests.figures.harness import Figures, Results, Row, Study, done
from tests.worlds.touch import touch_world
from weldcal.calibration.touch.judge import judge_touches
from weldcal.systems.runner import no_progress
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.touch import run_touches, touching
from weldcal.tools.commands.weld import run_calibration_live
from weldcal.tools.report.render import statistics
from weldcal.tools.report.run import RunOptions


def judge_worlds(seeds: list[int]) -> Mapping[str, object]:
    """Touches of the worlds of these seeds: errors and limits (mm), by row."""
    rows = []
    for seed in seeds:
        world = touch_world(seed)
        found = judge_touches(world.result, world.touches)
        rows += [
            [
                seed,
                found.features[k],
                1e3 * abs(found.error_m[k]),
                1e3 * found.limit_m[k],
                bool(found.inside[k]),
                1e3 * abs(found.relative_m[k]),
                bool(found.relative_inside[k]),
                found.outside > found.most_outside,
            ]
            for k in range(len(found.ids))
        ]
    return {"seeds": seeds, "rows": rows}


def _world_figures(results: Results) -> Figures:
    rows: list[Any] = [row for r in done(results) for row in r["rows"]]
    _, kinds, error, limit, inside, relative, related, _ = zip(*rows, strict=True)
    inside_, related_ = np.array(inside), np.array(related)
    known = np.isfinite(np.array(relative, dtype=float))
    alarms = {r[0]: r[7] for r in rows}
    of_kind = {k: inside_[[kind == k for kind in kinds]] for k in sorted(set(kinds))}
    return {
        "worlds": len(alarms),
        "failed": sum(_EACH if "seeds" not in r else 0 for r in results.values()),
        "touches": len(rows),
        "inside_percent": 100.0 * float(inside_.mean()),
        "inside_percent_by_feature": {k: 100.0 * float(v.mean()) for k, v in of_kind.items()},
        "error_mm": statistics(error, "median", "p95"),
        "limit_mm": statistics(limit, "median"),
        "relative_mm": statistics(np.array(relative, dtype=float)[known], "median", "p95"),
        "relative_inside_percent": 100.0 * float(related_[known].mean()),
        "false_alarms_percent": 100.0 * float(np.mean(list(alarms.values()))),
    }


def _rows(f: Figures) -> Iterable[Row]:
    if not f.get("touches"):
        return
    yield "touches", str(f["touches"])
    yield "in the stated 95 % region", f"{f['inside_percent']:.1f} %"
    yield from ((f"  of each {k}", f"{v:.1f} %") for k, v in f.get("inside_percent_by_feature", {}).items())
    yield "error, median and 95 %", f"{f['error_mm']['median']:.3f} and {f['error_mm']['p95']:.3f} mm"
    yield "stated limit, median", f"{f['limit_mm']['median']:.3f} mm"
    if "relative_mm" in f:
        yield (
            "relative error, median and 95 %",
            f"{f['relative_mm']['median']:.3f} and {f['relative_mm']['p95']:.3f} mm",
        )
        yield "relative, in its 95 % region", f"{f['relative_inside_percent']:.1f} %"
        yield "false alarms", f"{f['false_alarms_percent']:.1f} % of {f['worlds']} worlds"


WORLDS = Study(
    name="touch",
    what="How often points that the robot touches lie in the 95 % region that their calibration states.",
    case=judge_worlds,
    figures=_world_figures,
    header=("of all touches", "found"),
    rows=_rows,
)
_EACH = 20  # worlds of one case


def touch_cell(scenario: str, seed: int, points: int, folder: str) -> Mapping[str, object]:
    """Calibrate a simulated cell, touch the part with its tip, and judge: as `verify --scenario`."""
    calibrated = run_calibration_live(
        RunOptions(scenario=scenario, out=Path(folder) / f"cell{seed}", seed=seed, browser=False, recording=False)
    )
    options = RunOptions(
        scenario=scenario, out=Path(folder) / f"touch{seed}", seed=seed, browser=False, recording=False
    )
    found = run_touches(touching(scenario, calibrated.folder, points), options, no_progress).summary()
    return {k: found.get(k) for k in ("state", "reason", "n_touches", "inside", "error_mm", "relative_mm", "touches")}


def _cell_figures(results: Results) -> Figures:
    good = [r for r in results.values() if r.get("state") == "done"]
    touches = [t for r in good for t in r["touches"]]
    figures: dict[str, object] = {"cells": len(good), "failed": len(results) - len(good), "touches": len(touches)}
    if touches:
        figures |= {
            "inside_percent": 100.0 * float(np.mean([t["inside"] for t in touches])),
            "error_mm": statistics((abs(t["error_mm"]) for t in touches), "median", "p95", "max"),
            "limit_mm": statistics((t["limit_mm"] for t in touches), "median"),
        }
    return figures


CELLS = Study(
    name="touch cells",
    what="The same in whole simulated cells: calibrate, then touch the part with the soft tip.",
    case=touch_cell,
    figures=_cell_figures,
    header=("of all touches", "found"),
    rows=_rows,
)


@command("benchmark touch", short_help="Count touched points within the stated 95 % region.", options=FARM)
def touch(
    call: Call,
    runs: Annotated[
        int, option("--runs", "N", "Number of light worlds of six touches, or of whole cells.", min=1)
    ] = 500,
    scenario: Annotated[
        str | None,
        option("--scenario", "NAME", "Whole simulated cells of this scenario: calibrate, then touch the part."),
    ] = None,
    points: Annotated[
        int, option("--points", "N", "With --scenario: places to touch in each cell.", min=3, max=60)
    ] = 8,
) -> Outcome:
    """Measure how often points touched by the robot lie in the 95 % region that their calibration states."""
    seeds = list(range(call.seed, call.seed + runs))
    if scenario is None:
        blocks = [seeds[k : k + _EACH] for k in range(0, runs, _EACH)]
        return WORLDS.outcome(call, {f"worlds {b[0]} to {b[-1]}": {"seeds": b} for b in blocks})
    folder = CELLS.folder(call)
    each = {"scenario": scenario, "points": points, "folder": str(folder.absolute())}
    return CELLS.outcome(call, {f"{scenario} {k}": {**each, "seed": k} for k in seeds}, folder)
