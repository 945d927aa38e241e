"""Benchmark of the mountings: every mounting scenario live over several seeds, as the table of docs/hand_eye.md."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.jobs.discovery import job_of
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions
from weldcal.tools.studies.output import markdown_table

HEADER = (
    "scenario", "runs", "scans", "point at best distance, mm: expected / true median / worst",
    "held out, mm: median / worst", "unknown off the truth: worst mm, deg",
    "squared error per covariance: mean / worst (99.7 % bound)",
)  # fmt: skip


def run_mounting(name: str, folder: str, seed: int) -> Mapping[str, object]:
    """One live calibration: what the table needs of it, mm and deg."""
    options = RunOptions(scenario=name, out=Path(folder), seed=seed, recording=False)
    report = run_mounting_live(load_scenario(name), options, lambda *_: None)
    if report.state != "done":
        return {"state": report.state, "reason": report.reason}
    return {
        "state": "done",
        "scans": len(report.status.seen),
        "refused": len(report.status.refused),
        "expected_mm": 1e3 * report.status.sigma_work_m,
        "work_mm": report.work_error_mm(),
        "aside_mm": [1e3 * kept.error_m for kept in report.status.held_out],
        "errors": list(report.truth_errors().values()),
        "seconds": report.seconds,
    }


def run_mountings(farm: Farm, seeds: Sequence[int], names: tuple[str, ...]) -> tuple[dict[str, object], str]:
    """Run the mounting scenarios (all that ship, or those named) with every seed; the summary, and the table in Markdown.

    Raises:
        InputError: a scenario that is not a mounting job.
    """
    folder = farm.folder.absolute()
    chosen = names or tuple(n for n in scenario_names() if job_of(load_scenario(n)).key == "mounting")
    for name in chosen:
        if job_of(load_scenario(name)).key != "mounting":
            raise InputError(f"Scenario '{name}' has no mounting part; choose one that has.")
    tasks = {
        f"{name}, seed {seed}": {"name": name, "folder": str(folder / Path(name).stem / f"seed{seed}"), "seed": seed}
        for name in chosen
        for seed in seeds
    }
    found = farm.run(run_mounting, tasks)
    rows, failed_by = [], dict[str, list[str]]()
    for name in chosen:
        runs = {seed: found[f"{name}, seed {seed}"] for seed in seeds}
        failed = failed_by[name] = [f"seed {s}: {run['reason']}" for s, run in runs.items() if run["state"] != "done"]
        rows.append(_row(name, [run for run in runs.values() if run["state"] == "done"], failed))
    summary: dict[str, object] = {
        "state": "done" if all(not row["failed"] for row in rows) else "failed",
        "seeds": list(seeds),
        "mountings": rows,
    }
    failures = [f"{name} {text}" for name, texts in failed_by.items() for text in texts]
    if failures:
        summary["reason"] = failures[0]
    table = markdown_table(HEADER, map(_line, rows))
    write_json(folder / "mountings.json", summary)
    write_atomic(folder / "mountings.md", table)
    return summary, table


def _row(name: str, runs: list[Result], failed: list[str]) -> dict[str, object]:
    if not runs:
        return {"scenario": name, "runs": 0, "failed": failed}
    work = np.array([run["work_mm"] or np.nan for run in runs])
    aside = np.array([mm for run in runs for mm in run["aside_mm"]])
    errors = [e for run in runs for e in run["errors"]]
    return {
        "scenario": name,
        "runs": len(runs),
        "failed": failed,
        "scans": float(np.mean([run["scans"] for run in runs])),
        "refused": sum(run["refused"] for run in runs),
        "expected_mm": float(np.median([run["expected_mm"] for run in runs])),
        "work_median_mm": float(np.median(work)),
        "work_worst_mm": float(work.max()),
        "aside_median_mm": float(np.median(aside)),
        "aside_worst_mm": float(aside.max()),
        "worst_mm": max(e["mm"] for e in errors),
        "worst_deg": max(e["deg"] for e in errors),
        "nees_mean": float(np.mean([e["nees"] for e in errors])),
        "nees_worst": max(e["nees"] for e in errors),
        "bound": max(e["bound"] for e in errors),
        "seconds": float(np.mean([run["seconds"] for run in runs])),
    }


def _line(row: dict[str, object]) -> tuple[str, ...]:
    if row["runs"] == 0:
        return (str(row["scenario"]), "0", *("-",) * 5)
    r = {k: v for k, v in row.items() if isinstance(v, int | float)}
    return (
        str(row["scenario"]),
        f"{r['runs']:.0f}",
        f"{r['scans']:.1f}",
        f"{r['expected_mm']:.3f} / {r['work_median_mm']:.3f} / {r['work_worst_mm']:.3f}",
        f"{r['aside_median_mm']:.3f} / {r['aside_worst_mm']:.3f}",
        f"{r['worst_mm']:.3f}, {r['worst_deg']:.4f}",
        f"{r['nees_mean']:.1f} / {r['nees_worst']:.1f} ({r['bound']:.1f})",
    )
