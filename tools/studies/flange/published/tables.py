"""The flange study for a person at a terminal: Table 1, the costs, the held-out errors, what a registration sees."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from weldcal.tools.studies.flange.published.command import Study
from weldcal.tools.studies.flange.published.rows import (
    COST_HEADER,
    HELD_HEADER,
    SIGHT_HEADER,
    TABLE1_HEADER,
    cost_rows,
    held_out_rows,
    kinect_rows,
    pairs_rows,
    sight_rows,
    table1_rows,
)

KINECT_HEADER = ("calibration", "median mm", "mean mm", "95 % mm")


def print_study(study: Study) -> None:
    """Write the tables on stdout."""
    console = Console()

    def show(title: str, header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
        if not rows:
            return
        table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
        for k, name in enumerate(header):
            table.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
        for row in rows:
            table.add_row(*row)
        console.print(table)
        console.print()

    show("What the cost chooses (simulated, 1 mm of noise)", COST_HEADER, cost_rows(study))
    if study.pairs or study.clouds:
        show("Table 1: all pairs, no iteration", TABLE1_HEADER, table1_rows(study))
    show("Centre pairs: errors on pairs outside the fit", HELD_HEADER, pairs_rows(study))
    for c in study.clouds:
        show(f"{c.title}: fitted on {c.n_fit} scans, judged on the others", HELD_HEADER, held_out_rows(c))
        show(f"{c.title}: share of a known error that a registration reports", SIGHT_HEADER, sight_rows(c))
    show("Azure Kinect: errors at the wrist ring", KINECT_HEADER, kinect_rows(study))
    for note in study.notes:
        console.print(note, highlight=False)
    console.print(f"written to {study.folder}", highlight=False, soft_wrap=True)
