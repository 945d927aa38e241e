"""Calibrates and verifies every dataset below a folder, cell by cell, and writes one page about all of them."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from weldcal.calibration.recorded_flange import FlangeOptions
from weldcal.calibration.verified_scans import VerifyOptions
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.farm.run import Farm
from weldcal.tools.recorded import calibrate_dataset
from weldcal.tools.report.first_screen import CARE, DO_NOT
from weldcal.tools.report.fleet import FINE, LOOK, VISIT, Checked, FleetCell, FleetReport, fleet_report, held_out_mm
from weldcal.tools.report.render import write_atomic, write_json
from weldcal.tools.verified import verify_dataset

HEADER = "dataset.yaml"
FAILED = "failed"

OUTLIER = 3.0  # times the fleet's median held-out error
FALSE_ALARM = 1e-3  # of a trend, per cell
REFUSED = 0.2  # share of a dataset's scans


@command("fleet", options=FARM, short_help="Calibrate and verify the datasets of many cells.")
def fleet(
    call: Call,
    folder: Annotated[Path, typer.Argument(help="A folder of cells, each a dataset or a folder of datasets by date.")],
    limit_mm: Annotated[
        float | None,
        option(
            "--limit-mm",
            "MM",
            "Largest median error of a later dataset.",
            show_default="from what the calibration states",
        ),
    ] = None,
) -> Outcome:
    """Calibrate every dataset, verify each cell's first calibration on its later datasets, and write one page: which
    cells drift, and which need a visit."""
    find_cells(folder)
    out = call.folder("fleet", folder.resolve().name)
    report = run_fleet(folder, Farm.of(out, call.given, call.progress), limit_mm=limit_mm, seed=call.seed)
    summary = report.summary()
    shown = {
        cell.name: f"{cell.state}: {cell.reason} {cell.next}" for cell in report.cells if cell.state in (VISIT, LOOK)
    }
    counts = {name: summary[name] for name in ("cells", "datasets", "fine")} | {
        name: len(report.named(name)) for name in (VISIT, LOOK)
    }
    refuted = [cell.name for cell in report.cells if cell.since is not None]
    problem = f"The verdict is: {DO_NOT}, for the first calibration of {', '.join(refuted)}." if refuted else ""
    return Outcome(summary, values=counts, rows={**shown, "report": str(out / "report.html")}, problem=problem)


def run_fleet(folder: Path, farm: Farm, *, limit_mm: float | None = None, seed: int = 0) -> FleetReport:
    """Calibrate every dataset, verify each cell's first calibration on its later ones; write report.html, fleet.json.

    A folder with dataset.yaml is a dataset. Datasets in one folder below ``folder`` are of one cell, the oldest first
    by name; a dataset directly in ``folder`` is a cell by itself. A second run with the same output folder does only
    what is missing.

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
                "result": str(first),
                "dataset": str(datasets[name]),
                "out": str(into),
                "limit_mm": limit_mm,
                "seed": seed,
            }
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
    """Sort datasets by cell and name.

    A cell is the folder that holds its datasets, or a dataset directly in ``folder``.

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
    found = dict(calibrate_dataset(Path(dataset), Path(out), FlangeOptions(seed=seed)).summary())
    found.pop("seconds")
    return found


def verify_one(result: str, dataset: str, out: str, limit_mm: float | None, seed: int) -> Mapping[str, object]:
    """One task: verify a calibration on a dataset; the JSON object of `verify`."""
    return verify_dataset(Path(result), Path(dataset), Path(out), VerifyOptions(limit_mm=limit_mm, seed=seed)).summary()


def _step(farm: Farm, what: str) -> Farm:
    """Return the farm for one of the two steps: its tasks in a folder of their own, half of the progress each."""
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


def judge_fleet(cells: Mapping[str, Sequence[Checked]], out: Path) -> FleetReport:
    """Judge every cell, and put those that need a visit first, the largest error first within each state."""
    found = [held_out_mm(datasets[-1]) for datasets in cells.values()]
    usual = np.median([mm for mm in found if mm is not None]) if any(mm is not None for mm in found) else np.inf
    judged = [judge_cell(name, tuple(datasets), float(usual)) for name, datasets in cells.items()]
    order = (VISIT, LOOK, FINE)
    judged.sort(key=lambda cell: (order.index(cell.state), -(cell.datasets[-1].error_mm or np.inf), cell.name))
    return FleetReport(tuple(judged), out)


def judge_cell(name: str, datasets: tuple[Checked, ...], usual_mm: float) -> FleetCell:
    """Judge a cell by its newest dataset, its history, and the fleet's usual held-out error (mm)."""
    newest = datasets[-1]
    since = _refuted_since(datasets)
    trend = _grows([d.error_mm for d in datasets])
    state, reason, then = FINE, "", ""
    if newest.calibration["state"] == "failed":
        state, reason = VISIT, f"'{newest.name}' cannot be calibrated. {newest.calibration['reason']}"
        then = "Take new scans of the flange."
    elif since is not None:
        state, reason = (
            VISIT,
            f"Since '{since}' the first calibration does not hold. {(newest.verification or {}).get('reason', '')}",
        )
        then = "Find what moved, then use the newest calibration."
    elif newest.verification is not None and newest.verification["state"] == "failed":
        state = LOOK
        reason = (
            f"The first calibration could not be verified on '{newest.name}'. {newest.verification.get('reason', '')}"
        )
        then = "Correct what the reason names, then run the command again with a new --out."
    elif trend:
        state, reason = LOOK, f"The error of the first calibration grows: {_mm(datasets[0])} to {_mm(newest)} mm."
        then = "Check the mounts of scanner and robot, and the scanner's warm-up. Use the newest calibration."
    else:
        reason, then = _smaller_signs(newest, usual_mm)
        state = LOOK if reason else FINE
    return FleetCell(name=name, datasets=datasets, state=state, reason=reason, next=then, since=since, trend=trend)


def _smaller_signs(newest: Checked, usual_mm: float) -> tuple[str, str]:
    held_out = held_out_mm(newest)
    if held_out is not None and held_out > OUTLIER * usual_mm:
        return (
            f"Its held-out error, {held_out:.2f} mm, is {held_out / usual_mm:.1f} times the usual one.",
            f"Compare its scans with those of a good cell: {newest.report}.",
        )
    used, refused = newest.calibration["n_used"], len(newest.calibration["refused"])
    if refused > REFUSED * (used + refused):
        return f"{refused} of {used + refused} scans were refused.", "Clean the flange and the scanner's window."
    if newest.verification is not None and newest.verification.get("verdict") == CARE:
        return str(newest.verification["reason"]), "Take more scans."
    return "", ""


def _refuted_since(datasets: Sequence[Checked]) -> str | None:
    """The dataset from which on the first calibration must not be used, up to the newest; None where it may be used."""
    since = None
    for dataset in reversed(datasets):
        if not dataset.refuted:
            break
        since = dataset.name
    return since


def _grows(errors_mm: Sequence[float | None]) -> bool:
    """Return whether errors grow with time: Kendall's rank correlation at FALSE_ALARM. Seven datasets are the least."""
    seen = [mm for mm in errors_mm if mm is not None]
    if len(seen) < 7:
        return False
    from scipy.stats import kendalltau  # slow to import

    found = kendalltau(np.arange(len(seen)), seen, alternative="greater")
    return bool(found.pvalue < FALSE_ALARM)


def _mm(dataset: Checked) -> str:
    return "–" if dataset.error_mm is None else f"{dataset.error_mm:.2f}"
