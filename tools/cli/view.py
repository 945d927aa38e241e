"""weldcal view: the report and the 3D recording of a finished run."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console
from weldcal.tools.cli.options import LOOK, Call, Outcome, command, switch


@command("view", common=LOOK, short_help="Show the report and the 3D recording of a finished run.")
def view(
    call: Call,
    result: Annotated[Path, typer.Argument(help="A result folder, or one recording.html or report.html.")],
    browser: Annotated[
        bool, switch("--browser/--no-browser", "Open the pages, or only print their paths.", show_default="browser")
    ] = True,
) -> Outcome:
    """Show a finished run again: its 3D recording and its report."""
    from weldcal.tools.commands.view import find_pages, open_pages

    pages = find_pages(result)
    opened = browser and open_pages(pages)
    if browser and not opened:
        console.emit_warning("No web browser could be opened. Open these files on a machine that has one.")
    return Outcome({"state": "done", "pages": pages, "opened": opened}, text="\n".join(map(str, pages)))
