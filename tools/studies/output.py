"""Tables of the studies: in Markdown, and for a terminal."""

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

_STYLES = {"met": "[green]met[/]", "MISSED": "[bold red]MISSED[/]"}


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, with a newline at its end."""
    lines = [header, *rows]
    text = [f"| {' | '.join(line)} |\n" for line in lines]
    return "".join([text[0], f"|{'---|' * len(header)}\n", *text[1:]])


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], *, text: Sequence[int] = (0,)
) -> None:
    """Write a table on stdout; columns in `text` are text, the others are numbers, aligned right."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    for k, name in enumerate(header):
        table.add_column(name, justify="left" if k in text else "right")
    for row in rows:
        table.add_row(*(_STYLES.get(cell, cell) for cell in row))
    console = Console()
    console.print(table)
    console.print()
