"""Write one page of all measured figures from result folders of studies."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from tests.figures.harness import TABLE, markdown_table
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command
from weldcal.tools.report.render import write_atomic

PAGE = "BENCHMARK.md"
HEAD = """# Measured figures

`./tools/run figures benchmark page` wrote this page from the results of the studies. Each section has its command.
The sizes (`--runs`, `--quick` and similar) are in that command. A larger size gives narrower figures. Times are of the
machine that ran it.

"""


@command("benchmark page", short_help="Write one page of the figures of all studies.")
def page(
    call: Call,
    results: Annotated[
        list[Path], typer.Argument(metavar="RESULTS", help="Result folders of studies, or folders of such folders.")
    ],
) -> Outcome:
    """Write BENCHMARK.md from the results of `benchmark` and `reproduce`: figures, targets, command, version and
    date."""
    found = sorted((path for folder in results for path in folder.rglob(TABLE)), key=lambda path: path.parent.name)
    studies = [study for study in map(_read, found) if study is not None]
    if not studies:
        raise InputError(f"'{results[0]}' holds no result of a study. Run one with --out, then give its folder.")
    folder = call.folder("benchmark", "page")
    studies.sort(key=lambda study: (_group(study), study["study"]))
    write_atomic(folder / PAGE, HEAD + "\n".join(map(_section, studies)))
    return Outcome({"state": "done", "studies": [study["study"] for study in studies], "page": str(folder / PAGE)})


def _read(path: Path) -> dict[str, Any] | None:
    """Return a study's table.json; None for a file that is another command's."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return content if isinstance(content, dict) and {"study", "tables", "command"} <= set(content) else None


def _group(study: dict[str, Any]) -> str:
    """Whether the study is of `benchmark` or of `reproduce`."""
    return str(next(word for word in study["command"].split()[1:] if word != "figures"))


def _section(study: dict[str, Any]) -> str:
    lines = [
        f"## {_group(study)} {study['study']}\n",
        f"{study['what']}\n",
        f"Command: `{study['command']}`\n",
        f"Measured on {study['measured_on']} with {study['software']}.\n",
    ]
    for k, table in enumerate(study["tables"]):
        lines += [f"**{table['title']}**\n"] if k else []
        lines.append(markdown_table(table["header"], table["rows"]))
    return "\n".join(lines)
