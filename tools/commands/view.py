"""`weldcal view`: finds the pages of a finished run and opens them in the web browser."""

import webbrowser
from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.models.result_files import require_whole

PAGES = ("report.html", "recording.html")


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
