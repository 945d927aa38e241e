"""weldcal view: finds the pages of a finished run and opens them in the web browser."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from weldcal.models.errors import InputError
from weldcal.models.result_files import require_whole
from weldcal.tools import console
from weldcal.tools.cli.options import LOOK, Call, Outcome, command, switch

PAGES = ("report.html", "recording.html")


@command("view", common=LOOK, short_help="Show the report and the 3D recording of a finished run.")
def view(
    call: Call,
    result: Annotated[Path, typer.Argument(help="A result folder, or one recording.html or report.html.")],
    browser: Annotated[
        bool, switch("--browser/--no-browser", "Open the pages, or only print their paths.", show_default="browser")
    ] = True,
) -> Outcome:
    """Show a finished run again: its 3D recording and its report."""
    pages = find_pages(result)
    opened = browser and open_pages(pages)
    if browser and not opened:
        console.emit_warning("No web browser could be opened. Open these files on a machine that has one.")
    return Outcome({"state": "done", "pages": pages, "opened": opened}, text="\n".join(map(str, pages)))


def find_pages(result: Path) -> list[Path]:
    """The absolute paths of the pages in a result folder (report first), or the one page that was given.

    Raises:
        InputError: if there is no such folder or file, or it holds no page.
    """
    if not result.exists():
        raise InputError(f"There is no {result}. Give the result folder of a weldcal command.")
    require_whole(result)
    candidates = [result] if result.is_file() else [result / name for name in PAGES]
    pages = [page.resolve() for page in candidates if page.is_file() and page.suffix == ".html"]
    if not pages:
        raise InputError(
            f"{result} holds neither report.html nor recording.html. Give the result folder of a finished run."
        )
    return pages


def open_pages(pages: list[Path]) -> bool:
    """Opens each page in the web browser; false where there is none."""
    opened = [webbrowser.open(page.as_uri()) for page in pages]
    return all(opened)
