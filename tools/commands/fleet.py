"""Calibrates and verifies every dataset below a folder, cell by cell, and writes one page about all of them."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from weldcal.models.errors import InputError
from weldcal.tools.commands.calibrate import calibrate_dataset
from weldcal.tools.commands.verify import verify_dataset
from weldcal.tools.farm.run import Farm
from weldcal.tools.outcomes.fleet import Checked, FleetReport, judge_fleet
from weldcal.tools.report.files import write_json
from weldcal.tools.report.fleet import fleet_report
from weldcal.tools.report.render import write_atomic

HEADER = "dataset.yaml"
FAILED = "failed"


def run_fleet(folder: Path, farm: Farm, *, limit_mm: float | None = None, seed: int = 0) -> FleetReport:
    """Calibrate every dataset and verify each cell's first calibration on its later datasets; write report.html and fleet.json.

    A folder with dataset.yaml is a dataset. Datasets in one folder below ``folder`` are of one cell, the oldest first by
    name; a dataset directly in ``folder`` is a cell by itself. A second run with the same output folder does only what is
    missing.

    Raises:
        InputError: no dataset is there.
    """
    cells = find_cells(folder)
    out = farm.folder.absolute()
    calibrations = _step(farm, "calibrations").run(
        calibrate_one,
        {
            _key(cell, name): {"dataset": str(path), "out": str(out / "calibrations" / cell / name), "seed": seed}
            for cell, datasets in cells.items()
            for name, path in datasets.items()
        },
    )
    tasks: dict[str, dict[str, Any]] = {}
    for cell, datasets in cells.items():
        made = [name for name in datasets if calibrations[_key(cell, name)]["state"] != FAILED]
        for name in made[1:]:
            first = out / "calibrations" / cell / made[0]
            into = out / "verifications" / cell / name
            tasks[_key(cell, name)] = {
                "result": str(first), "dataset": str(datasets[name]), "out": str(into), "limit_mm": limit_mm, "seed": seed,
            }  # fmt: skip
    verifications = _step(farm, "verifications").run(verify_one, tasks) if tasks else {}
    checked = {
        cell: [_checked(cell, name, calibrations, verifications) for name in datasets]
        for cell, datasets in cells.items()
    }
    report = judge_fleet(checked, out)
    write_json(out / "fleet.json", report.summary())
    write_atomic(out / "report.html", fleet_report(report, folder.resolve().name))
    return report


def find_cells(folder: Path) -> dict[str, dict[str, Path]]:
    """Datasets by cell and name, sorted: a cell is the folder that holds its datasets, or a dataset directly in ``folder``.

    Raises:
        InputError: there is none, or ``folder`` is one dataset itself.
    """
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder. Give the folder that holds the cells' datasets.")
    if (folder / HEADER).exists():
        raise InputError(f"'{folder}' is one dataset. Use `weldcal calibrate`, or give the folder above it.")
    found: dict[str, dict[str, Path]] = {}
    for there, below, files in os.walk(folder):
        below.sort()
        if HEADER not in files:
            continue
        below.clear()  # what is inside a dataset belongs to it
        path = Path(there)
        cell = path if path.parent == folder else path.parent
        found.setdefault(cell.relative_to(folder).as_posix(), {})[path.name] = path.absolute()
    if not found:
        raise InputError(f"No folder below '{folder}' has a {HEADER}. docs/datasets.md shows what a dataset holds.")
    return {cell: dict(sorted(found[cell].items())) for cell in sorted(found)}


def calibrate_one(dataset: str, out: str, seed: int) -> Mapping[str, object]:
    """One task: calibrate a dataset; the JSON object of `calibrate`, without the time it took."""
    found = dict(calibrate_dataset(Path(dataset), Path(out), seed=seed).summary())
    found.pop("seconds")
    return found


def verify_one(result: str, dataset: str, out: str, limit_mm: float | None, seed: int) -> Mapping[str, object]:
    """One task: verify a calibration on a dataset; the JSON object of `verify`."""
    return verify_dataset(Path(result), Path(dataset), Path(out), limit_mm=limit_mm, seed=seed).summary()


def _step(farm: Farm, what: str) -> Farm:
    """The farm for one of the two steps: its tasks in a folder of their own, half of the progress each."""
    before = 0.0 if what == "calibrations" else 0.5

    def tell(stage: str, share: float) -> None:
        farm.progress(stage, before + 0.5 * share)

    return Farm(farm.folder / what, farm.workers, farm.scheduler, tell)


def _checked(cell: str, name: str, calibrations: Mapping[str, Any], verifications: Mapping[str, Any]) -> Checked:
    key = _key(cell, name)
    calibration, verification = calibrations[key], verifications.get(key)

    def page(what: str, of: Mapping[str, Any] | None) -> str | None:
        return None if of is None or of["state"] == FAILED else f"{what}/{cell}/{name}/report.html"

    return Checked(
        name, calibration, verification, page("calibrations", calibration), page("verifications", verification)
    )


def _key(cell: str, name: str) -> str:
    return cell if cell == name else f"{cell}/{name}"
