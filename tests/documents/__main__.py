"""`./tools/run docs --check [PAGE...]`: executes the blocks of the pages in order and reports what share of them
ran."""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.documents.blocks import DOCUMENTS
from tests.documents.execution import FAILED, LEFT_OUT, SHORT, WRITTEN, Check, Executed, execute_page


def arguments() -> argparse.Namespace:
    """What was typed."""
    parser = argparse.ArgumentParser(prog="./tools/run docs --check", description=__doc__)
    parser.add_argument("--check", action="store_true", help="What this is for.")
    parser.add_argument("--full", action="store_true", help="Also the hours of the long forms: nothing is shortened.")
    parser.add_argument("--only", default="", metavar="REGEX", help="Only the command lines that it matches.")
    parser.add_argument("--but", default="", metavar="REGEX", help="Not the command lines that it matches.")
    parser.add_argument("--list", action="store_true", help="Run no command line: only YAML, TOML and Python.")
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="Names such as arms or first_hour; default: all.")
    return parser.parse_args()


def report(done: Executed) -> None:
    """One line of the report, at once."""
    sys.stdout.write(f"{done.how:16} {done.seconds:7.1f} s  {done.page}:{done.line}  {done.text}\n")
    if done.said:
        sys.stdout.write(f"{'':16} {done.said}\n")
    sys.stdout.flush()


def main() -> int:
    """Executes the pages; the exit code is 1 if a block failed."""
    asked = arguments()
    pages = [page for page in DOCUMENTS if not asked.pages or any(name in str(page) for name in asked.pages)]

    def skip(name: str) -> bool:
        wanted = re.search(asked.only, name) and not (asked.but and re.search(asked.but, name))
        return asked.list or not wanted

    results: list[Executed] = []
    check = Check(asked.full, skip)
    with tempfile.TemporaryDirectory(prefix="weldcal-docs-") as scratch:
        for number, page in enumerate(pages):
            folder = Path(scratch) / f"{number:02d}-{page.stem}"
            folder.mkdir()
            for done in execute_page(page, folder, check):
                report(done)
                results.append(done)
    counts = Counter(done.how for done in results)
    ran = counts[WRITTEN] + counts[SHORT]
    parts = ", ".join(f"{count} {how}" for how, count in counts.most_common())
    sys.stdout.write(f"\n{ran} of {len(results) - counts[LEFT_OUT]} blocks and command lines were executed: {parts}\n")
    return 1 if counts[FAILED] else 0


if __name__ == "__main__":
    sys.exit(main())
