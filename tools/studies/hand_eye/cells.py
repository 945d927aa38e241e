"""Hand-eye calibrations of simulated cells: beside OpenCV's in imperfect cells, and every mounting live over several seeds."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.jobs.discovery import job_of
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.report.run import RunOptions
from weldcal.tools.studies.harness import Figures, Results, Row, Study
from weldcal.tools.worlds.imperfect_cells import KINDS, WEIGHTINGS, ratios

MARGIN = 0.02  # by which a method must be better to count as ahead


def _ahead(results: Results) -> Figures:
    """In how many of a hundred cells some OpenCV method is ahead in a column by more than MARGIN, and the 95th percentile of the ratio."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for name, cell in results.items():
        found.setdefault(name.rpartition(", cell ")[0], []).append(cell)
    runs = len(next(iter(found.values())))
    cells = {}
    found["all"] = list(results.values())
    for kind, each in found.items():
        for name in WEIGHTINGS:
            ratio = np.array([cell[name] for cell in each])
            deg, mm = (float(v) for v in np.percentile(ratio, 95, axis=0, method="lower"))
            ahead = 100.0 * float((ratio > 1.0 + MARGIN).any(axis=1).mean())
            cells[f"{kind}, {name}"] = {"opencv_ahead_percent": ahead, "p95_deg": deg, "p95_mm": mm}
    return {"runs": runs, "cells": cells}


def _ahead_rows(figures: Figures) -> Iterable[Row]:
    cells = figures["cells"]
    for kind in dict.fromkeys(key.rpartition(", ")[0] for key in cells):
        found = (cells[f"{kind}, {name}"] for name in WEIGHTINGS)
        yield kind, *(f"{c['opencv_ahead_percent']:.0f} % ({c['p95_deg']:.2f}, {c['p95_mm']:.2f})" for c in found)


CELLS = Study(
    name="hand-eye-cells",
    what="Cells in which some OpenCV method has the smaller held-out error, and the 95 % ratio of the errors (deg, mm).",
    case=ratios,
    figures=_ahead,
    header=("cells", *WEIGHTINGS),
    rows=_ahead_rows,
)


@command(
    "benchmark hand-eye-cells",
    short_help="Compare with OpenCV on cells with a wrong camera or arm.",
    hidden=True,
    options=FARM,
)
def hand_eye_cells(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of cells of each kind.", min=1)] = 40
) -> Outcome:
    """Compare held-out errors with OpenCV's best on simulated cells with a wrong camera matrix, a wrong robot, or both."""
    seeds = range(call.seed, call.seed + runs)
    return CELLS.outcome(call, {f"{kind}, cell {s}": {"kind": kind, "seed": s} for kind in KINDS for s in seeds})


def run_mounting(name: str, folder: str, seed: int) -> Mapping[str, object]:
    """One live calibration: what the table needs of it, mm and deg."""
    options = RunOptions(scenario=name, out=Path(folder), seed=seed, recording=False)
    report = run_mounting_live(load_scenario(name), options, lambda *_: None)
    if report.state != "done":
        return {"scenario": name, "seed": seed, "state": report.state, "reason": report.reason}
    return {
        "scenario": name,
        "seed": seed,
        "state": "done",
        "scans": len(report.status.seen),
        "refused": len(report.status.refused),
        "expected_mm": 1e3 * report.status.sigma_work_m,
        "work_mm": report.work_error_mm(),
        "aside_mm": [1e3 * kept.error_m for kept in report.status.held_out],
        "errors": list(report.truth_errors().values()),
        "seconds": report.seconds,
    }


def _mountings(results: Results) -> Figures:
    scenarios: dict[str, dict[str, Any]] = {}
    for case, run in results.items():
        name, _, seed = case.rpartition(", seed ")
        scenarios.setdefault(name, {})[seed] = run
    rows = [_mounting(name, runs) for name, runs in scenarios.items()]
    failures = [f"{row['scenario']} {text}" for row in rows for text in row["failed"]]
    seeds = sorted({int(seed) for runs in scenarios.values() for seed in runs})
    figures = {"state": "failed" if failures else "done", "seeds": seeds, "mountings": rows}
    return figures | ({"reason": failures[0]} if failures else {})


def _mounting(name: str, runs: Mapping[str, Any]) -> dict[str, Any]:
    failed = [f"seed {s}: {run['reason']}" for s, run in runs.items() if run["state"] != "done"]
    good = [run for run in runs.values() if run["state"] == "done"]
    if not good:
        return {"scenario": name, "runs": 0, "failed": failed}
    work = np.array([run["work_mm"] or np.nan for run in good])
    aside = np.array([mm for run in good for mm in run["aside_mm"]])
    errors = [e for run in good for e in run["errors"]]
    return {
        "scenario": name,
        "runs": len(good),
        "failed": failed,
        "scans": float(np.mean([run["scans"] for run in good])),
        "refused": sum(run["refused"] for run in good),
        "expected_mm": float(np.median([run["expected_mm"] for run in good])),
        "work_median_mm": float(np.median(work)),
        "work_worst_mm": float(work.max()),
        "aside_median_mm": float(np.median(aside)),
        "aside_worst_mm": float(aside.max()),
        "worst_mm": max(e["mm"] for e in errors),
        "worst_deg": max(e["deg"] for e in errors),
        "nees_mean": float(np.mean([e["nees"] for e in errors])),
        "nees_worst": max(e["nees"] for e in errors),
        "bound": max(e["bound"] for e in errors),
        "seconds": float(np.mean([run["seconds"] for run in good])),
    }


def _mounting_rows(figures: Figures) -> Iterable[Row]:
    for r in figures["mountings"]:
        if r["runs"] == 0:
            yield r["scenario"], "0", *("-",) * 5
            continue
        yield (
            r["scenario"],
            f"{r['runs']:.0f}",
            f"{r['scans']:.1f}",
            f"{r['expected_mm']:.3f} / {r['work_median_mm']:.3f} / {r['work_worst_mm']:.3f}",
            f"{r['aside_median_mm']:.3f} / {r['aside_worst_mm']:.3f}",
            f"{r['worst_mm']:.3f}, {r['worst_deg']:.4f}",
            f"{r['nees_mean']:.1f} / {r['nees_worst']:.1f} ({r['bound']:.1f})",
        )


LIVE = Study(
    name="mountings",
    what="Every mounting calibrated live in simulation: errors against the truth, and in units of the covariance.",
    case=run_mounting,
    figures=_mountings,
    header=(
        "scenario",
        "runs",
        "scans",
        "point at best distance, mm: expected / true median / worst",
        "held out, mm: median / worst",
        "unknown off the truth: worst mm, deg",
        "squared error per covariance: mean / worst (99.7 % bound)",
    ),
    rows=_mounting_rows,
)


@command(
    "benchmark mountings", short_help="Calibrate every mounting live over several seeds.", hidden=True, options=FARM
)
def mountings(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of seeds of each.", min=1)] = 5,
    names: Annotated[list[str] | None, option("--scenario", "NAME", "Only this scenario; repeat for more.")] = None,
) -> Outcome:
    """Calibrate every mounting live over several seeds: errors against the truth, held-out errors, and errors in units of
    the covariance."""
    chosen = names or [n for n in scenario_names() if job_of(load_scenario(n)).key == "mounting"]
    for name in chosen:
        if job_of(load_scenario(name)).key != "mounting":
            raise InputError(f"Scenario '{name}' has no mounting part; choose one that has.")
    folder = LIVE.folder(call)
    cases = {
        f"{name}, seed {seed}": {
            "name": name,
            "folder": str(folder.absolute() / Path(name).stem / f"seed{seed}"),
            "seed": seed,
        }
        for name in chosen
        for seed in range(call.seed, call.seed + runs)
    }
    return LIVE.outcome(call, cases, folder)
