"""Counts what `weldcal fleet` says of simulated cells of which some move, drift or break."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.fleet import run_fleet
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.fleet import FINE, LOOK, VISIT
from weldcal.tools.studies.harness import Figures, Results, Row, Study
from weldcal.tools.worlds.fleet_cells import FAULTS, write_fleet

RIGHT = {"none": (FINE,), "moved": (VISIT,), "drifts": (VISIT, LOOK), "broken": (VISIT,)}


def _figures(found: Results) -> Figures:
    return found["fleet"]


def _rows(figures: Figures) -> Iterable[Row]:
    for fault in FAULTS:
        yield fault, *(str(figures[fault][state]) for state in (VISIT, LOOK, FINE))


STUDY = Study(
    name="fleet",
    what="What `weldcal fleet` says of simulated cells that are fine, moved, drift or are broken.",
    figures=_figures,
    header=("fault", VISIT, LOOK, FINE),
    rows=_rows,
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
    return STUDY.measured({"fleet": found}, folder).outcome()
