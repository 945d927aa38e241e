"""Counts what the doctor and the fleet name in simulated sets and cells, disturbed and undisturbed."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

from tests.figures.harness import Cases, Figures, Results, Row, Study
from tests.worlds.doctor import CAUSES, FAULTS, clean, write_fleet
from weldcal.calibration.doctor.diagnose import diagnose
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.fleet import run_fleet
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.doctor import worded
from weldcal.tools.report.fleet import FINE, LOOK, VISIT

NONE = "none"
CLEAN_SEEDS = 10_000  # sets without a cause have seeds of their own


def named_first(cause: str, seed: int) -> Mapping[str, object]:
    """Return the cause that the doctor names first in one set; ``cause`` none: a set without."""
    report = worded("a made set", diagnose(clean(CLEAN_SEEDS + seed) if cause == NONE else CAUSES[cause](seed)))
    return {"cause": cause, "seed": seed, "named": report.causes[0].name if report.causes else NONE}


def cases(runs: int, cleans: int, seed: int) -> Cases:
    """``runs`` sets with each cause and ``cleans`` without."""
    wanted = [(cause, s) for cause in CAUSES for s in range(seed, seed + runs)]
    wanted += [(NONE, s) for s in range(seed, seed + cleans)]
    return {f"{cause}, set {s}": {"cause": cause, "seed": s} for cause, s in wanted}


def _doctor_figures(found: Results) -> Figures:
    counts = {
        cause: Counter(str(r["named"]) for r in found.values() if r["cause"] == cause) for cause in (*CAUSES, NONE)
    }
    right, cleans = sum(counts[cause][cause] for cause in CAUSES), counts[NONE].total()
    return {
        "sets": len(found) - cleans,
        "named_first": right,
        "named_first_percent": 100.0 * right / max(len(found) - cleans, 1),
        "clean_sets": cleans,
        "false_alarms": cleans - counts[NONE][NONE],
        "named": {cause: dict(count) for cause, count in counts.items()},
    }


def _doctor_rows(figures: Figures) -> Iterable[Row]:
    for cause, count in figures["named"].items():
        others = ", ".join(f"{name} {n}" for name, n in Counter(count).most_common() if name != cause)
        yield cause, f"{count.get(cause, 0)} of {sum(count.values())}", others


DOCTOR = Study(
    name="doctor",
    what="The cause that `weldcal doctor` names first in simulated sets of scans with one injected cause, and without.",
    case=named_first,
    figures=_doctor_figures,
    header=("injected", "named first", "instead"),
    rows=_doctor_rows,
)


@command("benchmark doctor", short_help="Count how often the doctor names the injected cause.", options=FARM)
def doctor(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Sets with each cause.", min=1)] = 20,
    cleans: Annotated[int, option("--clean", "N", "Sets without a cause.", min=0)] = 200,
) -> Outcome:
    """Inject each cause into simulated sets of scans, and count which one `weldcal doctor` names first."""
    return DOCTOR.outcome(call, cases(runs, cleans, call.seed))


RIGHT = {"none": (FINE,), "moved": (VISIT,), "drifts": (VISIT, LOOK), "broken": (VISIT,)}


def _fleet_figures(found: Results) -> Figures:
    return found["fleet"]


def _fleet_rows(figures: Figures) -> Iterable[Row]:
    for fault in FAULTS:
        yield fault, *(str(figures[fault][state]) for state in (VISIT, LOOK, FINE))


FLEET = Study(
    name="fleet",
    what="What `weldcal fleet` says of simulated cells that are fine, moved, drift or are broken.",
    figures=_fleet_figures,
    header=("fault", VISIT, LOOK, FINE),
    rows=_fleet_rows,
    numbers=3,
)


@command("benchmark fleet", short_help="Count what weldcal fleet states about made cells.", options=FARM)
def fleet(
    call: Call,
    cells: Annotated[int, option("--cells", "N", "Number of cells.", min=1)] = 25,
    datasets: Annotated[int, option("--datasets", "N", "Datasets of each.", min=1)] = 8,
) -> Outcome:
    """Write made cells, some of which move, drift or break, and count what `weldcal fleet` says of them."""
    folder = call.folder("benchmark", "fleet")
    faults = write_fleet(folder / "cells", cells, datasets, call.seed)
    farm = Farm.of(folder, call.given, call.progress)
    report = run_fleet(
        folder / "cells", Farm(folder / "page", farm.workers, farm.scheduler, farm.progress), seed=call.seed
    )
    states = {cell.name: cell.state for cell in report.cells}
    counts = {
        fault: {
            state: sum(states[n] == state for n, f in faults.items() if f == fault) for state in (VISIT, LOOK, FINE)
        }
        for fault in FAULTS
    }
    wrong = [f"{name} ({fault}): {states[name]}" for name, fault in faults.items() if states[name] not in RIGHT[fault]]
    found = {
        "cells": cells,
        "datasets": cells * datasets,
        "right": len(faults) - len(wrong),
        "wrong": wrong,
        **counts,
        "page": str(Path(report.out) / "report.html"),
    }
    return FLEET.measured({"fleet": found}, folder).outcome()
