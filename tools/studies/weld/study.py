"""Runs every case of the weld study over its seeds and compares the figures with the targets."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from weldcal.tools.console import Progress
from weldcal.tools.studies.weld.rows import Row, Target
from weldcal.tools.worlds.weld.case import Case, run_case
from weldcal.tools.worlds.weld.metrics import RunMetrics
from weldcal.tools.worlds.weld.plant import StudyRun


@dataclass(frozen=True)
class Reached:
    """One figure held against its target: the mean and the worst over all runs of the row, and which run was worst."""

    target: Target
    mean: float
    worst: float
    worst_run: str

    @property
    def value(self) -> float:
        """The number that the target speaks of."""
        return self.worst if self.target.over == "worst" else self.mean

    @property
    def met(self) -> bool:
        """Whether it is within the limit; what could not be measured is not."""
        return self.value <= self.target.limit


@dataclass(frozen=True)
class CaseResult:
    """All runs of one case: seeds and figures, in order."""

    case: Case
    seeds: tuple[int, ...]
    metrics: tuple[RunMetrics, ...]

    @property
    def completed(self) -> int:
        """How many welds were completed."""
        return sum(m.completed for m in self.metrics)

    def figures(self, name: str) -> np.ndarray:
        """One figure (n,) over the runs."""
        return np.array([float(getattr(m, name)) for m in self.metrics])


@dataclass(frozen=True)
class RowResult:
    """A row of the table, measured."""

    row: Row
    cases: tuple[CaseResult, ...]
    reached: tuple[Reached, ...]

    @property
    def runs(self) -> int:
        """How many welds there were."""
        return sum(len(c.metrics) for c in self.cases)

    @property
    def completed(self) -> int:
        """How many of them were completed."""
        return sum(c.completed for c in self.cases)

    @property
    def met(self) -> bool:
        """Whether every weld was completed and every target met."""
        return self.completed == self.runs and all(r.met for r in self.reached)


def hold_against(target: Target, cases: Iterable[CaseResult]) -> Reached:
    """A target's figure over all runs; a run that lacks it (it broke off before) counts as infinitely bad."""
    values = {
        f"{c.case.name} seed {seed}": v if math.isfinite(v) else math.inf
        for c in cases
        for seed, v in zip(c.seeds, c.figures(target.figure).tolist(), strict=True)
    }
    worst = max(values, key=lambda name: values[name])
    return Reached(target, float(np.mean(list(values.values()))), values[worst], worst)


def measure_row(row: Row, results: dict[Case, CaseResult]) -> RowResult:
    """The row's table line from the results of its cases."""
    cases = tuple(results[case] for case in row.cases)
    return RowResult(row, cases, tuple(hold_against(t, cases) for t in row.targets))


def run_cases(
    cases: Iterable[Case],
    seeds: tuple[int, ...],
    keep: Callable[[Case, int, StudyRun, RunMetrics], None],
    progress: Progress,
    known: dict[Case, CaseResult] | None = None,
) -> dict[Case, CaseResult]:
    """Every case over every seed, each case once however many rows ask for it; `keep` sees each run as it ends.

    What is `known` of the same seeds already is not run again.
    """
    wanted = list(dict.fromkeys(cases))
    results = {}
    for k, case in enumerate(wanted):
        if known and case in known and known[case].seeds[: len(seeds)] == seeds:
            results[case] = CaseResult(case, seeds, known[case].metrics[: len(seeds)])
            continue
        metrics = []
        for i, seed in enumerate(seeds):
            progress(case.name, (k + i / len(seeds)) / len(wanted))
            run, figures = run_case(case, seed)
            keep(case, seed, run, figures)
            metrics.append(figures)
        results[case] = CaseResult(case, seeds, tuple(metrics))
    return results
