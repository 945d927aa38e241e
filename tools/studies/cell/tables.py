"""Tables of the cell study for the terminal: every run, and the targets."""

from __future__ import annotations

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.cell.study import AT_LEAST, TARGETS, WALL_CLOCK, CellStudy
from weldcal.tools.studies.output import print_note, print_table
from weldcal.tools.studies.targets import Target, print_targets

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
    header = ("", *(f"{run.scenario.removesuffix('_groove')}\nseed {run.seed}" for run in study.runs))
    print_table(
        "", header, [(title, *(fixed(getattr(run, name), k) for run in study.runs)) for title, name, k in FIGURES]
    )
    for run in study.runs:
        if not run.completed:
            print_note(f"{run.scenario}, seed {run.seed}, was not completed: {run.reason}")
    reached = {name: value for name, value, _, _ in study.reached}
    targets = [
        Target(
            NAMES[name],
            unit,
            reached[name],
            limit,
            "≥" if name in AT_LEAST else "≤",
            over=over,
            decides=name not in WALL_CLOCK,
        )
        for name, over, limit, unit in TARGETS
        if name in reached
    ]
    print_targets(f"Law: {study.options.law}", targets)
    print_note(f"written to {study.options.folder}")
