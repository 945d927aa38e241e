"""Targets of a study: a figure, its bound and the verdict, judged and shown in one way by all studies."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.output import print_table

Bound = Literal["≤", "≥", "<", "±"]


class Target(NamedTuple):
    """A bound and, once measured, the figure that is held against it.

    Attributes:
        what: the figure's name; unit: of value and limit.
        value: what was reached; NaN (not measured) misses every bound.
        bound: how value compares with limit; with "±" it may differ from limit by tolerance.
        over: the statistic over the runs, such as "worst" or "mean"; empty for a single figure.
        decides: whether a miss fails the study. Wall-clock times are shown and do not decide.
    """

    what: str
    unit: str
    value: float
    limit: float
    bound: Bound = "≤"
    tolerance: float = 0.0
    over: str = ""
    decides: bool = True

    @property
    def met(self) -> bool:
        """Whether the figure is within its bound."""
        match self.bound:
            case "≤":
                return bool(self.value <= self.limit)
            case "<":
                return bool(self.value < self.limit)
            case "≥":
                return bool(self.value >= self.limit)
            case "±":
                return bool(abs(self.value - self.limit) <= self.tolerance)

    @property
    def verdict(self) -> str:
        """The word for the tables."""
        return verdict(self.met)

    @property
    def wanted(self) -> str:
        """The bound with its unit, such as "worst ≤ 0.3 mm"."""
        limit = f"{self.limit:g} ± {self.tolerance:g}" if self.bound == "±" else f"{self.bound} {self.limit:g}"
        return " ".join(part for part in (self.over, limit, self.unit) if part)


def verdict(met: bool) -> str:
    """The word for a target that is met or missed."""
    return "met" if met else "MISSED"


def all_met(targets: Iterable[Target]) -> bool:
    """Whether every target that decides is met."""
    return all(t.met for t in targets if t.decides)


def print_targets(title: str, targets: Iterable[Target], digits: int = 3) -> None:
    """Write the targets as a table on stdout."""
    rows = [(t.what, t.wanted, fixed(t.value, digits), t.verdict) for t in targets]
    print_table(title, ("figure", "target", "reached", ""), rows, text=(0, 1, 3))
