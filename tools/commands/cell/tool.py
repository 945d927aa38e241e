"""weldcal tool check: reads a tool file, says what was understood and draws it."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.models.tools.loading import check_sight, load_tool
from weldcal.tools.cli.options import Call, Outcome, command
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.tool import ToolCheck, tool_picture, tool_report


@command("tool check", short_help="Check a tool file and draw the tool.")
def tool_check(
    call: Call,
    file: Annotated[Path, typer.Argument(help="A tool file; models/tools/welding.yaml is one.")],
) -> Outcome:
    """Read a tool file, say what was understood of it, and draw it: tool.png and tool.html."""
    folder = call.folder("tool", file.stem)
    loaded = load_tool(file)
    check = ToolCheck(loaded, check_sight(loaded), folder)
    picture = tool_picture(loaded)
    write_atomic(folder / "tool.png", picture)
    write_atomic(folder / "tool.html", tool_report(check, picture))
    return Outcome(check.summary(), values={}, rows=check.rows())
