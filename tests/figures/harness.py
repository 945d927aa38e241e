"""Run every study alike: cases on workers, figures, targets with verdicts, tables, and the files of its result.

A study is one frozen description in its own module, and the command that runs it:

    STUDY = Study(
        name="doctor",
        what="Causes that the doctor names first in simulated sets of scans.",
        case=named_first,
        figures=count_causes,
        header=("injected", "named first", "instead"),
        rows=cause_rows,
    )

    @command("benchmark doctor", short_help="Count ...", options=FARM)
    def doctor(call: Call, runs: ...) -> Outcome:
        return STUDY.outcome(call, cases(runs, call.seed))

Each case is {name: keyword arguments}, such as {"moved, set 0": {"cause": "moved", "seed": 0}}.
"""

import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.console import Console
from rich.table import Table as RichTable

from weldcal.calibration.data.results import software_version
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome
from weldcal.tools.console import plain
from weldcal.tools.farm.pools import FAILED
from weldcal.tools.farm.run import Farm, Result
from weldcal.tools.report.render import csv_text, fixed, write_atomic, write_json

_STYLES = {"met": "[green]met[/]", "MISSED": "[bold red]MISSED[/]"}


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, with a newline at its end."""
    lines = [header, *rows]
    text = [f"| {' | '.join(line)} |\n" for line in lines]
    return "".join([text[0], f"|{'---|' * len(header)}\n", *text[1:]])


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], *, text: Sequence[int] = (0,)
) -> None:
    """Write a table on stdout; columns in `text` are text, the others are numbers, aligned right."""
    table = RichTable(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    for k, name in enumerate(header):
        table.add_column(name, justify="left" if k in text else "right")
    for row in rows:
        table.add_row(*(_STYLES.get(cell, cell) for cell in row))
    console = Console()
    console.print(table)
    console.print()


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
    """Return the word for a target that is met or missed."""
    return "met" if met else "MISSED"


def all_met(targets: Iterable[Target]) -> bool:
    """Return whether every target that decides is met."""
    return all(t.met for t in targets if t.decides)


def print_targets(title: str, targets: Iterable[Target], digits: int = 3) -> None:
    """Write the targets as a table on stdout."""
    rows = [(t.what, t.wanted, fixed(t.value, digits), t.verdict) for t in targets]
    print_table(title, ("figure", "target", "reached", ""), rows, text=(0, 1, 3))


Cases = Mapping[str, Mapping[str, Any]]
"""Keyword arguments of the case function, by the case's name."""
Results = Mapping[str, Result]
"""What the case function returned, by the case's name, in JSON's own types."""
Figures = Mapping[str, Any]
"""The figures of a study: its JSON object."""
Row = Sequence[str]
Table = tuple[str, Row, Sequence[Row]]
"""Title, names of the columns and lines of a table."""
TABLE, RUNS, SUMMARY = "table.json", "runs.csv", "summary.json"
MISSED = "Some targets were missed; see the table."


@dataclass(frozen=True, kw_only=True)
class Study:
    """The description of a study.

    Attributes:
        name: the words of its command after "benchmark" or "reproduce", such as "touch".
        what: one sentence for the page of all studies.
        case: a module's function; keyword arguments to a mapping of JSON values. None: the results are computed
            elsewhere.
        figures: from the results of the cases, failed ones included, to the JSON object; without cases see `found`.
        header: names of the table's columns.
        rows: the table's lines, from the figures.
        targets: the bounds that the figures are judged against, from the figures.
        plots: file name to a function of the results that draws an SVG.
        numbers: how many columns from the right are numbers.
        others: further tables from the figures: title, names of the columns, lines.
        group: of its command, "benchmark" or "reproduce". A missed target ends "reproduce" with exit code 1.
    """

    name: str
    what: str
    header: Row
    rows: Callable[[Figures], Iterable[Row]]
    figures: Callable[[Results], Figures] = lambda results: results["all"]
    case: Callable[..., Mapping[str, object]] | None = None
    targets: Callable[[Figures], Sequence[Target]] = lambda figures: ()
    plots: Mapping[str, Callable[[Results], bytes]] = field(default_factory=dict)
    numbers: int = 0
    others: Callable[[Figures], Iterable[Table]] = lambda figures: ()
    group: str = "benchmark"

    def outcome(self, call: Call, cases: Cases, folder: Path | None = None) -> Outcome:
        """Run it for a command, on workers where the command takes --workers, else in this process.

        Raises:
            InputError: the folder holds another study, or no case could be done. WorkerLost: a process has ended.
        """
        farm = Farm.of(folder or self.folder(call), call.given, call.progress)
        return self.run(farm if "workers" in call.given else replace(farm, workers=0), cases).outcome()

    def folder(self, call: Call) -> Path:
        """Where a command writes the result, once a call."""
        return call.folder(self.group, self.name.replace(" ", "-"))

    def here(self, cases: Cases) -> "Measured":
        """Compute the cases in this process, write nothing, and pass on every error."""
        assert self.case is not None
        return self.measured({name: Result(_plain(self.case(**given))) for name, given in cases.items()})

    def run(self, farm: Farm, cases: Cases) -> "Measured":
        """Compute the cases that the folder does not hold yet, and write the files of the result.

        Raises:
            InputError: the folder holds another study, or no case could be done. WorkerLost: a process has ended.
        """
        assert self.case is not None
        found = farm.run(self.case, cases)
        if found and not done(found):
            raise InputError(str(next(iter(found.values()))["reason"]))
        return self.measured(found, farm.folder, cases)

    def found(self, figures: Figures, folder: Path) -> Outcome:
        """The outcome of a study that computes its figures without cases; the files of its result are written."""
        return self.measured({"all": dict(figures)}, folder).outcome()

    def measured(self, results: Results, folder: Path | None = None, cases: Cases | None = None) -> "Measured":
        """Return the figures, the table and the verdicts of results; with a folder their files are written there."""
        figures = self.figures(results)
        found = Measured(
            study=self,
            figures={"state": "done", **figures},
            tables=(
                (self.name, self.header, tuple(tuple(row) for row in self.rows(figures))),
                *((title, header, tuple(rows)) for title, header, rows in self.others(figures)),
            ),
            targets=tuple(self.targets(figures)),
            folder=folder,
            command=command_line(),
        )
        if folder is not None:
            found.write(folder)
            if cases:
                write_atomic(folder / RUNS, runs_csv(cases, results))
            for name, draw in self.plots.items():
                write_atomic(folder / name, draw(results))
        return found


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What a study found.

    Attributes:
        study: its description.
        figures: the JSON object.
        tables: its table, and further ones.
        targets: figures that were held against a bound.
        folder: where its files are; None: nowhere.
        command: the command line that measured it.
    """

    study: Study
    figures: Figures
    tables: tuple[Table, ...]
    targets: tuple[Target, ...]
    folder: Path | None = None
    command: str = ""

    @property
    def met(self) -> bool:
        """Whether all targets that decide are met."""
        return all_met(self.targets)

    @property
    def target_rows(self) -> list[Row]:
        """One line a target: figure, bound, value, verdict."""
        return [(t.what, t.wanted, f"{t.value:.4g}", t.verdict) for t in self.targets]

    def outcome(self) -> Outcome:
        """Return the JSON object and the table, with exit code 1 where a reproduced target is missed."""
        problem = None if self.figures["state"] != "done" else MISSED if self._fails else ""
        return Outcome(self.figures, text=self.show, problem=problem)

    @property
    def _fails(self) -> bool:
        return self.study.group == "reproduce" and not self.met

    def markdown(self) -> str:
        """Return the tables, and below them the targets where the study has some."""
        return "\n".join(
            (f"**{title}**\n\n" if k else "") + markdown_table(header, rows)
            for k, (title, header, rows) in enumerate(self._shown)
        )

    @property
    def _shown(self) -> list[Table]:
        targets: Table = ("Targets", ("figure", "target", "reached", ""), self.target_rows)
        return [table for table in (*self.tables, targets) if table[2]]

    def show(self) -> None:
        """Write the tables on stdout."""
        for k, (title, header, rows) in enumerate(self._shown):
            numbers = self.study.numbers if k == 0 else 0
            print_table(title, header, rows, text=range(len(header) - numbers))
        if self.folder is not None:
            Console().print(f"written to {self.folder}", highlight=False, soft_wrap=True)

    def write(self, folder: Path) -> None:
        """Write summary.json, table.md and table.json; the latter is what the page of all studies is made from."""
        write_json(folder / SUMMARY, self.figures)
        write_atomic(folder / "table.md", self.markdown())
        write_json(
            folder / TABLE,
            {
                "study": self.study.name,
                "what": self.study.what,
                "command": self.command,
                "tables": [{"title": title, "header": header, "rows": rows} for title, header, rows in self._shown],
                "met": self.met,
                "software": software_version(),
                "measured_on": date.today().isoformat(),
            },
        )


def command_line() -> str:
    """Return the arguments of this program as a user types them, without the output folder."""
    words = sys.argv[1:]
    if "--out" in words:
        k = words.index("--out")
        words = words[:k] + words[k + 2 :]
    return shlex.join(["./tools/run", "figures", *(word for word in words if word != "--json")])


def done(results: Results) -> list[Result]:
    """Return the results of the cases that were not refused."""
    return [r for r in results.values() if r.get("state") != FAILED]


def whole(results: Results) -> Results:
    """Return the results of a study that needs every case.

    Raises:
        InputError: a case was refused.
    """
    for name, found in results.items():
        if found.get("state") == FAILED:
            raise InputError(f"{name}: {found['reason']}")
    return results


def runs_csv(cases: Cases, results: Results) -> str:
    """One line a case: its name, arguments and results; members of an object are named "a.b", lists stay JSON text."""
    lines = [{"case": name} | _flat(cases.get(name, {})) | _flat(found) for name, found in results.items()]
    columns = list(dict.fromkeys(key for line in lines for key in line))
    return csv_text(columns, ([line.get(key, "") for key in columns] for line in lines))


def _plain(found: Mapping[str, object]) -> Mapping[str, Any]:
    """As another process would return it: in JSON's own types."""
    value = plain(found)
    assert isinstance(value, dict)
    return value


def _flat(value: Mapping[str, Any], before: str = "") -> dict[str, object]:
    out: dict[str, object] = {}
    for key, item in value.items():
        item = plain(item)
        out |= _flat(item, f"{before}{key}.") if isinstance(item, Mapping) else {f"{before}{key}": item}
    return out
