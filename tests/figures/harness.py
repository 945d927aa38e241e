"""A figure is a function that prints its rows and draws the pictures that the documents show; `figure` gives it a name."""

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from weldcal.models.errors import WeldcalError
from weldcal.tools.report.render import write_atomic

Row = Sequence[str]
Size = TypeVar("Size")


class Missed(WeldcalError):
    """A figure is not what it must be."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """How a figure is computed.

    Attributes:
        full: as the documents cite it; False: the quick form, which decides nothing.
        seed: of everything random.
        data: folder of measured data; None: without.
        out: where pictures and tables of single runs go.
        text: what was printed, one item a table or line.
    """

    full: bool = False
    seed: int = 0
    data: Path | None = None
    out: Path = Path("weldcal-out/figures")
    text: list[str] = field(default_factory=list)

    def size(self, quick: Size, full: Size) -> Size:
        """Return what belongs to the form of this run."""
        return full if self.full else quick

    def seeds(self, quick: int, full: int) -> range:
        """Return so many seeds, from its own on."""
        return range(self.seed, self.seed + self.size(quick, full))

    def table(self, title: str, header: Row, rows: Iterable[Row]) -> None:
        """Print a table in Markdown; one without rows is left out."""
        lines = [f"| {' | '.join(row)} |\n" for row in rows]
        if lines:
            head = f"| {' | '.join(header)} |\n|{'---|' * len(header)}\n"
            self.say((f"**{title}**\n\n" if title else "") + head + "".join(lines))

    def say(self, text: str) -> None:
        """Print a line or a table."""
        self.text.append(text)
        print(text, flush=True)

    def write(self, name: str, content: str | bytes) -> None:
        """Write a picture or a table into the folder of the run."""
        write_atomic(self.out / name, content)

    def progress(self, stage: str, share: float) -> None:
        """Show on a terminal what is computed."""
        if sys.stderr.isatty():
            print(f"\r{100.0 * share:3.0f} % {stage:60.60}\r", end="", file=sys.stderr, flush=True)


Body = Callable[[Run], None]
FIGURES: dict[str, tuple[str, Body]] = {}
"""What each figure shows, and its function, by name."""


def figure(name: str, what: str) -> Callable[[Body], Body]:
    """Give a function the name by which `./tools/run figures NAME` runs it."""

    def named(body: Body) -> Body:
        assert name not in FIGURES, name
        FIGURES[name] = (what, body)
        return body

    return named
