"""Files and tables of the studies: JSON, CSV, Markdown, and tables for a terminal."""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from weldcal.tools.console import plain
from weldcal.tools.report.render import write_atomic

_STYLES = {"met": "[green]met[/]", "MISSED": "[bold red]MISSED[/]"}


def write_json(path: Path, content: object) -> None:
    """Write the content, in JSON's own types (what is not finite becomes null), with its folder."""
    write_atomic(path, json.dumps(plain(content), allow_nan=False, indent=1) + "\n")


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """A header line and one line per row."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def records_csv(records: Sequence[object], columns: Sequence[str] = ()) -> str:
    """Objects of one kind, one line each: these attributes, or all that they hold."""
    columns = columns or list(vars(records[0]))
    return csv_text(columns, ([getattr(record, name) for name in columns] for record in records))


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, with a newline at its end."""
    lines = [header, *rows]
    text = [f"| {' | '.join(line)} |\n" for line in lines]
    return "".join([text[0], f"|{'---|' * len(header)}\n", *text[1:]])


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], *, text: Sequence[int] = (0,)
) -> None:
    """Write a table on stdout; columns in `text` are text, the others are numbers and stand at the right."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    for k, name in enumerate(header):
        table.add_column(name, justify="left" if k in text else "right")
    for row in rows:
        table.add_row(*(_STYLES.get(cell, cell) for cell in row))
    console = Console()
    console.print(table)
    console.print()


def print_note(text: str) -> None:
    """Write a sentence on stdout as it is."""
    Console().print(text, highlight=False, soft_wrap=True)
