"""The study for a person at a terminal: the target table, the turns, and the laws side by side."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.weld.command import Study
from weldcal.tools.studies.weld.files import compared_lines, table_lines

TURN_HEADER = ("seam", "chord mm", "turn deg", "back-up mm", "for a trailing torch", "what was done")
LAW_HEADER = (
    "weld", "law", "mean mm", "largest mm", "omega rad/s", "speed CV %", "torch mm/s", "outside ±25 % mm", "completed",
)  # fmt: skip


def print_study(study: Study) -> None:
    """Write the tables on stdout."""
    console = Console()
    if study.rows:
        table = Table(
            "what", "figure", "target", "mean", "worst", "", title="Reached against targets", title_justify="left"
        )
        for line in table_lines(study.rows):
            verdict = line[5]
            table.add_row(*line[:5], f"[{'green' if verdict == 'met' else 'bold red'}]{verdict}[/]")
        console.print(table)
        for line in table_lines(study.rows):
            if line[5] != "met":
                console.print(f"missed: {line[1]}, target {line[2]}: {line[6]}", highlight=False)
    if study.turns:
        table = Table(*TURN_HEADER, title="Turns, U-turns and cusps", title_justify="left")
        for t in study.turns:
            asked = "possible" if t.possible else "impossible"
            table.add_row(t.seam, fixed(t.chord_mm, 0), fixed(t.turn_deg, 0), fixed(t.back_up_mm, 1), asked, t.outcome)
        console.print(table)
    if study.compared:
        table = Table(*LAW_HEADER, title="The laws side by side", title_justify="left")
        for cells in compared_lines(study.compared):
            table.add_row(*cells)
        console.print(table)
    console.print(f"written to {study.folder}", highlight=False, soft_wrap=True)
