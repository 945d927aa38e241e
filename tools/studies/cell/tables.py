"""The weld in the cell for a person at a terminal: every run, and the targets."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.cell.study import AT_LEAST, TARGETS, CellStudy

FIGURES = (
    ("seam points, sd mm", "point_sd_mm", 4), ("seam points, offset mm", "point_offset_mm", 4),
    ("their height, sd mm", "height_sd_mm", 3), ("their height, offset mm", "height_offset_mm", 3),
    ("torch, mean mm", "torch_mean_mm", 3), ("torch, largest mm", "torch_max_mm", 3),
    ("in space, largest mm", "space_max_mm", 3), ("torch speed CV %", "cv_percent", 2),
    ("real-time factor of the weld", "real_time_factor", 2), ("CPU s per simulated s", "cpu_per_second", 2),
)  # fmt: skip
NAMES = {
    "point_sd_mm": "seam points, sd", "torch_mean_mm": "torch, mean", "torch_max_mm": "torch, largest",
    "real_time_factor": "real-time factor of the weld",
}  # fmt: skip


def print_cell_study(study: CellStudy) -> None:
    """Write the tables on stdout."""
    console = Console()
    table = Table("", *(f"{run.scenario.removesuffix('_groove')}\nseed {run.seed}" for run in study.runs))
    for title, name, digits in FIGURES:
        table.add_row(title, *(fixed(getattr(run, name), digits) for run in study.runs))
    console.print(table)
    for run in study.runs:
        if not run.completed:
            console.print(f"{run.scenario}, seed {run.seed}, was not completed: {run.reason}", highlight=False)
    targets = Table("figure", "target", "reached", "", title=f"Law: {study.options.law}", title_justify="left")
    units = {name: (over, unit) for name, over, _, unit in TARGETS}
    for name, value, limit, ok in study.reached:
        over, unit = units[name]
        sign = "≥" if name in AT_LEAST else "≤"
        verdict = "[green]met[/]" if ok else "[bold red]MISSED[/]"
        targets.add_row(NAMES[name], f"{over} {sign} {limit:g} {unit}".rstrip(), fixed(value, 3), verdict)
    console.print(targets)
    console.print(f"written to {study.options.folder}", highlight=False, soft_wrap=True)
