"""Runs the weld study: rows, turns and laws; writes table.json, CSV files and report.html."""

import time
from collections.abc import Iterable
from dataclasses import astuple, fields

from weldcal.tools.console import Progress
from weldcal.tools.report.files import csv_text, write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.weld.report import study_report
from weldcal.tools.studies.weld.results import Study, StudyOptions
from weldcal.tools.studies.weld.rows import COMPARED, get_rows
from weldcal.tools.studies.weld.study import CaseResult, measure_row, run_cases
from weldcal.tools.studies.weld.turns import CHORDS, TURNS, TurnResult, run_turn
from weldcal.tools.worlds.weld.case import Case
from weldcal.tools.worlds.weld.metrics import RunMetrics
from weldcal.tools.worlds.weld.plant import COLUMNS, PHASES, StudyRun

COMPARED_SEEDS = 3


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
    folder = options.folder
    write_json(folder / "table.json", study.summary())
    write_atomic(folder / "runs.csv", runs_csv([*results.values(), *compared.values()]))
    for case, run, _ in study.pictured:
        write_atomic(folder / "runs" / f"{case.name}.csv", run_csv(run))
    write_atomic(folder / "report.html", study_report(study))
    return study


def runs_csv(results: Iterable[CaseResult]) -> str:
    """One line per run: case, seed and every figure."""
    header = ["case", "seam", "budget", "chord_mm", "speed_mm_s", "law", "seed", *(f.name for f in fields(RunMetrics))]
    lines: list[tuple[object, ...]] = []
    for result in results:
        c = result.case
        head = (c.name, c.seam, c.budget, 1e3 * c.chord_m, 1e3 * c.speed_m_s, c.law)
        lines += [(*head, seed, *astuple(m)) for seed, m in zip(result.seeds, result.metrics, strict=True)]
    return csv_text(header, lines)


def run_csv(run: StudyRun) -> str:
    """One run, a line per servo tick; units in the header's names, positions in m."""
    k = COLUMNS.index("phase")
    lines = [[f"{v:.7g}" for v in row] for row in run.table.tolist()]
    for line, phase in zip(lines, run.column("phase"), strict=True):
        line[k] = PHASES[int(phase)].value
    return csv_text(COLUMNS, lines)
