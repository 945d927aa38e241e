"""Runs the fleet's command on made cells, and counts what it says of each fault."""

from pathlib import Path

from weldcal.tools.commands.fleet import run_fleet
from weldcal.tools.farm.run import Farm
from weldcal.tools.outcomes.fleet import FINE, LOOK, VISIT
from weldcal.tools.worlds.fleet_cells import FAULTS, write_fleet

RIGHT = {"none": (FINE,), "moved": (VISIT,), "drifts": (LOOK, VISIT), "broken": (VISIT,)}


def run_fleet_study(farm: Farm, cells: int, datasets: int, seed: int) -> dict[str, object]:
    """Cells by fault and by the state that the page gives them; `right` of all cells are judged as RIGHT says."""
    folder = farm.folder / "cells"
    faults = write_fleet(folder, cells, datasets, seed)
    report = run_fleet(folder, Farm(farm.folder / "page", farm.workers, farm.scheduler, farm.progress), seed=seed)
    states = {cell.name: cell.state for cell in report.cells}
    counts = {
        fault: {
            state: sum(states[n] == state for n, f in faults.items() if f == fault) for state in (VISIT, LOOK, FINE)
        }
        for fault in FAULTS
    }
    right = sum(states[name] in RIGHT[fault] for name, fault in faults.items())
    wrong = [f"{name} ({fault}): {states[name]}" for name, fault in faults.items() if states[name] not in RIGHT[fault]]
    return {
        "state": "done", "cells": cells, "datasets": cells * datasets, "right": right, "wrong": wrong, **counts,
        "page": str(Path(report.out) / "report.html"),
    }  # fmt: skip
