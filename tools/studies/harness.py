"""Runs every study in one way: cases on workers, figures, targets, a table, and the files of its result.

A study is one frozen description in its own module, and the command that runs it:

    STUDY = Study(
        name="doctor",
        what="Causes that the doctor names first in simulated sets of scans.",
        case=named_first,
        figures=count_causes,
        header=("injected", "named first", "instead"),
        rows=cause_rows,
    )
    found = STUDY.run(call.farm(folder), {"moved, set 0": {"cause": "moved", "seed": 0}, ...})
    return found.outcome()
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import software_version
from weldcal.models.arrays import Array
from weldcal.tools.console import plain
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.farm.work import FAILED
from weldcal.tools.report.files import csv_text, write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.output import markdown_table, print_note, print_table
from weldcal.tools.studies.targets import Target, all_met

Cases = Mapping[str, Mapping[str, Any]]
"""Keyword arguments of the case function, by the case's name."""
Results = Mapping[str, Result]
"""What the case function returned, by the case's name, in JSON's own types."""
Figures = Mapping[str, Any]
"""The figures of a study: its JSON object."""
Row = Sequence[str]
TABLE, RUNS, SUMMARY = "table.json", "runs.csv", "summary.json"
MISSED = "Some targets were missed; see the table."


@dataclass(frozen=True, kw_only=True)
class Study:
    """The description of a study.

    Attributes:
        name: the words of its command after "benchmark" or "reproduce", such as "touch".
        what: one sentence for the page of all studies.
        case: a module's function; keyword arguments to a mapping of JSON values. None: the results are computed elsewhere.
        figures: from the results of the cases, failed ones included, to the JSON object.
        header: names of the table's columns.
        rows: the table's lines, from the figures.
        targets: the bounds that the figures are judged against, from the figures.
        plots: file name to a function of the results that draws an SVG.
        numbers: how many columns from the right are numbers; None: all but the first.
    """

    name: str
    what: str
    figures: Callable[[Results], Figures]
    header: Row
    rows: Callable[[Figures], Iterable[Row]]
    case: Callable[..., Mapping[str, object]] | None = None
    targets: Callable[[Figures], Sequence[Target]] = lambda figures: ()
    plots: Mapping[str, Callable[[Results], bytes]] = field(default_factory=dict)
    numbers: int | None = 0

    def run(self, farm: Farm, cases: Cases) -> "Measured":
        """Compute the cases that the folder does not hold yet, and write the files of the result.

        Raises:
            InputError: the folder holds another study. WorkerLost: a process has ended.
        """
        assert self.case is not None
        return self.measured(farm.run(self.case, cases), farm.folder, cases)

    def measured(self, results: Results, folder: Path | None = None, cases: Cases | None = None) -> "Measured":
        """The figures, the table and the verdicts of results; with a folder their files are written there."""
        figures = self.figures(results)
        found = Measured(
            study=self,
            figures={"state": "done", **figures},
            rows=tuple(tuple(row) for row in self.rows(figures)),
            targets=tuple(self.targets(figures)),
            folder=folder,
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
        rows: lines of its table.
        targets: figures that were held against a bound.
        folder: where its files are; None: nowhere.
    """

    study: Study
    figures: Figures
    rows: tuple[Row, ...]
    targets: tuple[Target, ...]
    folder: Path | None = None

    @property
    def met(self) -> bool:
        """Whether all targets that decide are met."""
        return all_met(self.targets)

    @property
    def target_rows(self) -> list[Row]:
        """One line a target: figure, bound, value, verdict."""
        return [(t.what, t.wanted, f"{t.value:.4g}", t.verdict) for t in self.targets]

    @property
    def problem(self) -> str:
        """A sentence for exit code 1, empty where all targets are met."""
        return "" if self.met else MISSED

    def markdown(self) -> str:
        """The table, and below it the targets where the study has some."""
        tables = [markdown_table(self.study.header, self.rows)] if self.rows else []
        if self.targets:
            tables.append(markdown_table(("figure", "target", "reached", ""), self.target_rows))
        return "\n".join(tables)

    def show(self) -> None:
        """Write the tables on stdout."""
        width = len(self.study.header)
        numbers = width - 1 if self.study.numbers is None else self.study.numbers
        print_table(self.study.name, self.study.header, self.rows, text=range(width - numbers))
        if self.targets:
            print_table("Targets", ("figure", "target", "reached", ""), self.target_rows, text=(0, 1, 3))
        if self.folder is not None:
            print_note(f"written to {self.folder}")

    def write(self, folder: Path) -> None:
        """Write summary.json, table.md and table.json; the latter is what the page of all studies is made from."""
        write_json(folder / SUMMARY, self.figures)
        write_atomic(folder / "table.md", self.markdown())
        write_json(
            folder / TABLE,
            {
                "study": self.study.name,
                "what": self.study.what,
                "header": self.study.header,
                "rows": self.rows,
                "targets": self.target_rows,
                "software": software_version(),
                "measured_on": date.today().isoformat(),
            },
        )


def statistics(values: Iterable[float] | Array, *names: str) -> dict[str, float]:
    """Statistics of finite values, NaN for none: by name median, mean, rms, p95, min, max; without names median, mean, p95, max."""
    v = np.array([x for x in np.asarray(list(values), dtype=float) if np.isfinite(x)])
    of: dict[str, Callable[[Array], Any]] = {
        "median": np.median,
        "mean": np.mean,
        "rms": lambda x: np.sqrt(np.mean(x**2)),
        "p95": lambda x: np.percentile(x, 95),
        "min": np.min,
        "max": np.max,
    }
    chosen = names or ("median", "mean", "p95", "max")
    return {name: float(of[name](v)) if len(v) else float("nan") for name in chosen}


def done(results: Results) -> list[Result]:
    """The results of the cases that were not refused."""
    return [r for r in results.values() if r.get("state") != FAILED]


def runs_csv(cases: Cases, results: Results) -> str:
    """One line a case: its name, arguments and results; members of an object are named "a.b", lists stay JSON text."""
    lines = [{"case": name} | _flat(cases.get(name, {})) | _flat(found) for name, found in results.items()]
    columns = list(dict.fromkeys(key for line in lines for key in line))
    return csv_text(columns, ([line.get(key, "") for key in columns] for line in lines))


def _flat(value: Mapping[str, Any], before: str = "") -> dict[str, object]:
    out: dict[str, object] = {}
    for key, item in value.items():
        item = plain(item)
        out |= _flat(item, f"{before}{key}.") if isinstance(item, Mapping) else {f"{before}{key}": item}
    return out
