"""Reads a tool file, says what was understood and draws it."""

from pathlib import Path

from weldcal.models.tools.loading import check_sight, load_tool
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.tool import ToolCheck, tool_picture, tool_report


def check_tool(file: Path, folder: Path) -> ToolCheck:
    """Check a tool file; writes tool.png and tool.html into ``folder``.

    Raises:
        InputError: the file describes no tool that can be; nothing has been written.
    """
    loaded = load_tool(file)
    check = ToolCheck(loaded, check_sight(loaded), folder)
    picture = tool_picture(loaded)
    write_atomic(folder / "tool.png", picture)
    write_atomic(folder / "tool.html", tool_report(check, picture))
    return check
