"""A report page as data: cards, sections of tables, pictures and lists, and facts; one template shows every page."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from weldcal.calibration.data.results import software_version
from weldcal.tools.report.first_screen import FirstScreen
from weldcal.tools.report.render import fixed, render


@dataclass(frozen=True)
class Quantity:
    """A number of a page as a card: a text stays as it is, a number gets its digits."""

    label: str
    value: float | str | None
    unit: str = ""
    note: str = ""
    tone: str = "plain"
    digits: int = 3

    @property
    def shown(self) -> str:
        """The value as the page shows it."""
        return self.value if isinstance(self.value, str) else fixed(self.value, self.digits)


@dataclass(frozen=True)
class TableRows:
    """A table; the columns of `text` are words, the others numbers. `folded` is the title of a closed one."""

    rows: Sequence[Sequence[object]]
    header: tuple[str, ...] = ()
    text: tuple[int, ...] = (0,)
    folded: str = ""
    caption: str = ""


@dataclass(frozen=True)
class Shot:
    """A picture (PNG, JPEG or SVG) with its caption and alternative text; it is absent without its bytes."""

    picture: bytes | None
    caption: str
    alt: str


@dataclass(frozen=True)
class Bullets:
    """Sentences as a list, each after the word of `before`; closed under the title of `folded`."""

    bullets: Sequence[str]
    before: str = ""
    folded: str = ""


@dataclass(frozen=True)
class FactList:
    """Names with their values; closed under the title of `folded`."""

    facts: Sequence[tuple[str, object]]
    folded: str = ""


Section = tuple[str, Sequence[str | TableRows | Shot | Bullets | FactList]]
"""A heading (empty: none) with what stands below it; a heading above nothing is not shown."""


def page_html(
    title: str,
    subtitle: str,
    sections: Iterable[Section],
    *,
    first: FirstScreen | None = None,
    cards: Iterable[Quantity | None] = (),
    facts: Iterable[tuple[str, object]] = (),
    **context: object,
) -> str:
    """Return a page as one self-contained HTML text.

    Args:
        title: also the heading.
        subtitle: what was measured, in a line.
        sections: headings with their parts; a part that is None or empty is not shown.
        first: the first screen; None: `verdict` in the context, as tone, headline and sentence.
        cards: key numbers; None is left out.
        facts: provenance, after the version of the software.
        context: `robot_timing` of a run, `recording`: a 3D recording lies beside the page.
    """
    shown = [(heading, [part for part in parts if _filled(part)]) for heading, parts in sections]
    return render(
        "page.html.j2",
        title=title,
        subtitle=subtitle,
        sections=shown,
        first=first,
        cards=[card for card in cards if card],
        facts_shown=[("software", software_version()), *facts],
        **context,
    )


def _filled(part: object) -> bool:
    """Whether a part shows something."""
    return bool(next(iter(vars(part).values())) if hasattr(part, "__dataclass_fields__") else part)
