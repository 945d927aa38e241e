"""How often touched points lie in the stated 95 % region, in light worlds whose truth is not the estimator's model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.touch.judge import judge_touches
from weldcal.systems.runner import no_progress
from weldcal.tools.commands.demo import run_calibration_live
from weldcal.tools.commands.touch_live import run_touches, touching
from weldcal.tools.farm.run import Farm
from weldcal.tools.farm.work import FAILED
from weldcal.tools.report.files import write_json
from weldcal.tools.report.run import RunOptions
from weldcal.tools.worlds.touch import touch_world


def judge_worlds(seeds: list[int]) -> Mapping[str, object]:
    """Touches of the worlds of these seeds: errors and limits (mm), by row."""
    rows = []
    for seed in seeds:
        world = touch_world(seed)
        found = judge_touches(world.result, world.touches)
        rows += [
            [seed, found.features[k], 1e3 * abs(found.error_m[k]), 1e3 * found.limit_m[k], bool(found.inside[k]),
             1e3 * abs(found.relative_m[k]), bool(found.relative_inside[k]), found.outside > found.most_outside]
            for k in range(len(found.ids))
        ]  # fmt: skip
    return {"rows": rows}


_EACH = 20  # worlds of one task


def run_touch_study(farm: Farm, runs: int, seed: int = 0) -> dict[str, object]:
    """``runs`` worlds from ``seed`` on: shares of touches inside, all and by feature, and figures of their errors; touch.json in the folder."""
    seeds = list(range(seed, seed + runs))
    blocks = [seeds[k : k + _EACH] for k in range(0, runs, _EACH)]
    results = farm.run(judge_worlds, {f"worlds {b[0]} to {b[-1]}": {"seeds": b} for b in blocks})
    rows: list[Any] = [row for r in results.values() if r.get("state") != FAILED for row in r["rows"]]
    summary = _summary(rows, runs)
    write_json(Path(farm.folder) / "touch.json", summary)
    return summary


def touch_cell(scenario: str, seed: int, points: int, folder: str) -> Mapping[str, object]:
    """Calibrate a whole simulated cell, let its soft tip touch the part, and judge: the JSON object of `verify --scenario`."""
    calibrated = run_calibration_live(
        RunOptions(scenario=scenario, out=Path(folder) / f"cell{seed}", seed=seed, browser=False, recording=False)
    )
    options = RunOptions(
        scenario=scenario, out=Path(folder) / f"touch{seed}", seed=seed, browser=False, recording=False
    )
    found = run_touches(touching(scenario, calibrated.folder, points), options, no_progress).summary()
    return {k: found.get(k) for k in ("state", "reason", "n_touches", "inside", "error_mm", "relative_mm", "touches")}


def run_touch_cells(farm: Farm, scenario: str, runs: int, points: int, seed: int = 0) -> dict[str, object]:
    """``runs`` whole cells from ``seed`` on, ``points`` touches each; cells.json in the folder."""
    folder = str(Path(farm.folder).absolute())
    tasks = {
        f"{scenario} {k}": {"scenario": scenario, "seed": k, "points": points, "folder": folder}
        for k in range(seed, seed + runs)
    }
    done = [r for r in farm.run(touch_cell, tasks).values() if r.get("state") == "done"]
    touches = [t for r in done for t in r["touches"]]
    error = np.array([abs(t["error_mm"]) for t in touches])
    summary: dict[str, object] = {
        "state": "done",
        "cells": len(done),
        "failed": runs - len(done),
        "touches": len(touches),
    }
    if touches:
        summary |= {
            "inside_percent": 100.0 * float(np.mean([t["inside"] for t in touches])),
            "error_mm": {
                "median": float(np.median(error)),
                "p95": float(np.percentile(error, 95)),
                "max": float(error.max()),
            },
            "limit_mm": {"median": float(np.median([t["limit_mm"] for t in touches]))},
        }
    write_json(Path(farm.folder) / "cells.json", summary)
    return summary


def _summary(rows: list[Any], runs: int) -> dict[str, object]:
    inside, related = np.array([r[4] for r in rows]), np.array([r[6] for r in rows])
    error, relative = np.array([r[2] for r in rows], dtype=float), np.array([r[5] for r in rows], dtype=float)
    kinds = [str(r[1]) for r in rows]
    known = np.isfinite(relative)
    by = {k: 100.0 * float(inside[[kind == k for kind in kinds]].mean()) for k in sorted(set(kinds))}
    worlds = {r[0]: r[7] for r in rows}
    return {
        "state": "done",
        "worlds": len(worlds),
        "failed": runs - len(worlds),
        "touches": len(rows),
        "inside_percent": 100.0 * float(inside.mean()),
        "inside_percent_by_feature": by,
        "error_mm": {"median": float(np.median(error)), "p95": float(np.percentile(error, 95))},
        "limit_mm": {"median": float(np.median([r[3] for r in rows]))},
        "relative_mm": {"median": float(np.median(relative[known])), "p95": float(np.percentile(relative[known], 95))},
        "relative_inside_percent": 100.0 * float(related[known].mean()),
        "false_alarms_percent": 100.0 * float(np.mean(list(worlds.values()))),
    }
