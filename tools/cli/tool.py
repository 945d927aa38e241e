"""weldcal tool: a tool of one's own."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, Outcome, command


@command("tool check", short_help="Check a tool file and draw the tool.")
def tool_check(
    call: Call,
    file: Annotated[Path, typer.Argument(help="A tool file; models/tools/welding.yaml is one.")],
) -> Outcome:
    """Read a tool file, say what was understood of it, and draw it: tool.png and tool.html."""
    from weldcal.tools.commands.tool_check import check_tool

    check = check_tool(file, call.folder("tool", file.stem))
    return Outcome(check.summary(), values={}, rows=check.rows())
