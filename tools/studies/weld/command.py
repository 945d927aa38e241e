"""The whole study as one call: rows, turns and laws run, tables, CSV files and the report written."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

from weldcal.tools.console import Progress, plain
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.weld.files import row_summary, run_csv, runs_csv, turn_summary
from weldcal.tools.studies.weld.metrics import RunMetrics
from weldcal.tools.studies.weld.plant import StudyRun
from weldcal.tools.studies.weld.rows import COMPARED, Case, get_rows
from weldcal.tools.studies.weld.study import CaseResult, RowResult, measure_row, run_cases
from weldcal.tools.studies.weld.turns import CHORDS, TURNS, TurnResult, run_turn

COMPARED_SEEDS = 3


@dataclass(frozen=True)
class StudyOptions:
    """Where to write, which rows (all when none), how many seeds from which on, and whether in short."""

    folder: Path
    rows: tuple[str, ...] = ()
    seeds: int = 10
    first_seed: int = 0
    quick: bool = False


@dataclass(frozen=True, eq=False)
class Study:
    """Everything that a study found."""

    options: StudyOptions
    rows: tuple[RowResult, ...]
    turns: tuple[TurnResult, ...]
    compared: tuple[CaseResult, ...]
    pictured: tuple[tuple[Case, StudyRun, RunMetrics], ...]
    wall_seconds: float

    @property
    def folder(self) -> Path:
        """Where it was written."""
        return self.options.folder

    @property
    def met(self) -> bool:
        """Whether every weld was completed, every target met, and every impossible turn named."""
        return all(r.met for r in self.rows) and all(t.named and not t.stalled for t in self.turns)

    def summary(self) -> dict[str, object]:
        """The result for JSON."""
        return {
            "state": "done",
            "met": self.met,
            "seeds": self.options.seeds,
            "first_seed": self.options.first_seed,
            "rows": {r.row.key: row_summary(r) for r in self.rows},
            "turns": [turn_summary(t) for t in self.turns],
            "laws": [
                {
                    "case": c.case.name,
                    "law": c.case.law,
                    "completed": c.completed,
                    "runs": [m.as_row() for m in c.metrics],
                }
                for c in self.compared
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.folder,
        }


def run_study(options: StudyOptions, progress: Progress) -> Study:
    """Run what is asked for and write table.json, runs.csv, one CSV per pictured run, and report.html."""
    start = time.monotonic()
    everything = not options.rows
    rows = get_rows(options.rows)
    wanted = [case for row in rows for case in row.cases]
    seeds = tuple(range(options.first_seed, options.first_seed + options.seeds))
    pictured: dict[str, tuple[Case, StudyRun, RunMetrics]] = {}

    def keep(case: Case, seed: int, run: StudyRun, figures: RunMetrics) -> None:
        # One run of each seam is drawn: the first seed, ours, nominal, as far as there is one.
        if seed == options.first_seed and case.law == "guarded" and case.seam not in pictured:
            pictured[case.seam] = (case, run, figures)

    results = run_cases(wanted, seeds, keep, lambda name, share: progress(name, 0.7 * share))
    turns: list[TurnResult] = []
    if everything or "turns" in options.rows:
        chords = CHORDS[1:2] if options.quick else CHORDS
        pairs = [(name, chord) for name in TURNS for chord in chords]
        for k, (name, chord) in enumerate(pairs):
            progress(name, 0.7 + 0.05 * k / len(pairs))
            turns.append(run_turn(name, chord, options.first_seed))
    compared: dict[Case, CaseResult] = {}
    if everything or "laws" in options.rows:
        few = seeds[: 1 if options.quick else COMPARED_SEEDS]
        compared = run_cases(COMPARED, few, keep, lambda name, share: progress(name, 0.75 + 0.25 * share), results)
    study = Study(
        options,
        tuple(measure_row(row, results) for row in rows) if results else (),
        tuple(turns),
        tuple(compared.values()),
        tuple(pictured.values()),
        time.monotonic() - start,
    )
    _write(study, [*results.values(), *compared.values()])
    return study


def _write(study: Study, results: list[CaseResult]) -> None:
    from weldcal.tools.studies.weld.report import study_report

    folder = study.folder
    text = json.dumps(plain(study.summary()), allow_nan=False, indent=1)
    write_atomic(folder / "table.json", text + "\n")
    write_atomic(folder / "runs.csv", runs_csv(results))
    for case, run, _ in study.pictured:
        write_atomic(folder / "runs" / f"{case.name}.csv", run_csv(run))
    write_atomic(folder / "report.html", study_report(study))
