"""Benchmark of the mountings: every mounting scenario live over several seeds, as the table of docs/hand_eye.md."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.jobs.discovery import job_of
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.console import Progress
from weldcal.tools.outcomes.mounting import MountingReport
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.output import markdown_table

HEADER = (
    "scenario", "runs", "scans", "point at best distance, mm: expected / true median / worst",
    "held out, mm: median / worst", "unknown off the truth: worst mm, deg",
    "squared error per covariance: mean / worst (99.7 % bound)",
)  # fmt: skip


def run_mountings(
    folder: Path, seeds: Sequence[int], names: tuple[str, ...], progress: Progress
) -> tuple[dict[str, object], str]:
    """Run the mounting scenarios (all that ship, or those named) with every seed; the summary, and the table in Markdown.

    Raises:
        InputError: a scenario that is not a mounting job.
    """
    chosen = names or tuple(n for n in scenario_names() if job_of(load_scenario(n)).key == "mounting")
    rows, failed_by = [], dict[str, list[str]]()
    for k, name in enumerate(chosen):
        if job_of(load_scenario(name)).key != "mounting":
            raise InputError(f"Scenario '{name}' has no mounting part; choose one that has.")
        reports: list[MountingReport] = []
        failed = failed_by[name] = []
        for i, seed in enumerate(seeds):
            progress(f"{name}, seed {seed}", (k + i / len(seeds)) / len(chosen))
            options = RunOptions(scenario=name, out=folder / name / f"seed{seed}", seed=seed, recording=False)
            try:
                report = run_mounting_live(load_scenario(name), options, lambda *_: None)
            except WeldcalError as error:
                failed.append(f"seed {seed}: {error}")
                continue
            if report.state == "done":
                reports.append(report)
            else:
                failed.append(f"seed {seed}: {report.reason}")
        rows.append(_row(name, reports, failed))
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


def _row(name: str, reports: list[MountingReport], failed: list[str]) -> dict[str, object]:
    if not reports:
        return {"scenario": name, "runs": 0, "failed": failed}
    work = np.array([r.work_error_mm() or np.nan for r in reports])
    held_out = np.array([1e3 * k.error_m for r in reports for k in r.status.held_out])
    errors = [e for r in reports for e in r.truth_errors().values()]
    return {
        "scenario": name,
        "runs": len(reports),
        "failed": failed,
        "scans": float(np.mean([len(r.status.seen) for r in reports])),
        "refused": sum(len(r.status.refused) for r in reports),
        "expected_mm": float(np.median([1e3 * r.status.sigma_work_m for r in reports])),
        "work_median_mm": float(np.median(work)),
        "work_worst_mm": float(work.max()),
        "aside_median_mm": float(np.median(held_out)),
        "aside_worst_mm": float(held_out.max()),
        "worst_mm": max(e.mm for e in errors),
        "worst_deg": max(e.deg for e in errors),
        "nees_mean": float(np.mean([e.nees for e in errors])),
        "nees_worst": max(e.nees for e in errors),
        "bound": max(e.bound for e in errors),
        "seconds": float(np.mean([r.seconds for r in reports])),
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
