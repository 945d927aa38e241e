"""The state of each cell of a fleet, judged from the calibrations and verifications of its datasets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.tools.outcomes.calibration import CARE, DO_NOT

VISIT, LOOK, FINE = "visit", "look", "fine"
OUTLIER = 3.0  # times the fleet's median held-out error
FALSE_ALARM = 1e-3  # of a trend, per cell
REFUSED = 0.2  # share of a dataset's scans


@dataclass(frozen=True)
class Checked:
    """One dataset of a cell: its calibration, and the verification of the cell's first calibration on it.

    Attributes:
        name: of the dataset within its cell.
        calibration: JSON object of `calibrate`, or {"state": "failed", "reason"}.
        verification: JSON object of `verify`, or failed; None for the dataset that was calibrated first.
        report, verified: the report's paths relative to the fleet's page; None: there is none.
    """

    name: str
    calibration: Mapping[str, Any]
    verification: Mapping[str, Any] | None
    report: str | None
    verified: str | None

    @property
    def error_mm(self) -> float | None:
        """Median error of the cell's first calibration on this dataset, mm: held-out for its own dataset, else verified."""
        if self.verification is None:
            return None if self.calibration["state"] == "failed" else self.calibration["held_out_mm"]["median"]
        return None if self.verification["state"] == "failed" else self.verification["position_error_mm"]["median"]

    @property
    def refuted(self) -> bool:
        """Whether the cell's first calibration must not be used on this dataset."""
        return self.verification is not None and self.verification.get("verdict") == DO_NOT


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell with its datasets in order, oldest first, and what follows from them: VISIT, LOOK or FINE, why, and what to do."""

    name: str
    datasets: tuple[Checked, ...]
    state: str
    reason: str
    next: str
    since: str | None
    trend: bool

    @property
    def held_out_mm(self) -> float | None:
        """Median held-out error of the newest calibration, mm."""
        return _held_out(self.datasets[-1])

    @property
    def error_95_mm(self) -> float | None:
        """Expected error of a scanned point at the work point by the newest calibration, 95 %, mm."""
        newest = self.datasets[-1].calibration
        return None if newest["state"] == "failed" else newest["work_point"]["error_95_mm"]

    @property
    def shift_mm(self) -> float | None:
        """Distance between the newest and the first calibration at the work point, mm; None where there is only one."""
        made = [d.calibration for d in self.datasets if d.calibration["state"] != "failed"]
        if len(made) < 2:
            return None
        p_B = 1e-3 * np.array(made[0]["work_point"]["p_B_mm"])
        first, newest = (np.array(c["X_BC"]) for c in (made[0], made[-1]))
        moved = newest @ np.linalg.inv(first) @ np.append(p_B, 1.0)
        return float(1e3 * np.linalg.norm(moved[:3] - p_B))

    def document(self) -> dict[str, object]:
        """The JSON object of the cell."""
        return {
            "cell": self.name,
            "state": self.state,
            "reason": self.reason,
            "next": self.next,
            "datasets": len(self.datasets),
            "since": self.since,
            "drifts": self.trend,
            "held_out_mm": self.held_out_mm,
            "error_95_mm": self.error_95_mm,
            "shift_mm": self.shift_mm,
            "errors_mm": [d.error_mm for d in self.datasets],
        }


@dataclass(frozen=True)
class FleetReport:
    """All cells, those that need a visit first, and where the page is."""

    cells: tuple[Cell, ...]
    out: Path

    def named(self, state: str) -> list[str]:
        """Names of the cells in a state."""
        return [cell.name for cell in self.cells if cell.state == state]

    def summary(self) -> dict[str, object]:
        """The JSON object of `fleet`."""
        return {
            "state": "done",
            "cells": len(self.cells),
            "datasets": sum(len(cell.datasets) for cell in self.cells),
            "visit": self.named(VISIT),
            "look": self.named(LOOK),
            "fine": len(self.named(FINE)),
            "drifting": [cell.name for cell in self.cells if cell.trend or cell.since is not None],
            "per_cell": [cell.document() for cell in self.cells],
        }


def judge_fleet(cells: Mapping[str, Sequence[Checked]], out: Path) -> FleetReport:
    """Judge every cell, and put those that need a visit first, the largest error first within each state."""
    found = [_held_out(datasets[-1]) for datasets in cells.values()]
    usual = np.median([mm for mm in found if mm is not None]) if any(mm is not None for mm in found) else np.inf
    judged = [judge_cell(name, tuple(datasets), float(usual)) for name, datasets in cells.items()]
    order = (VISIT, LOOK, FINE)
    judged.sort(key=lambda cell: (order.index(cell.state), -(cell.datasets[-1].error_mm or np.inf), cell.name))
    return FleetReport(tuple(judged), out)


def judge_cell(name: str, datasets: tuple[Checked, ...], usual_mm: float) -> Cell:
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
    return Cell(name=name, datasets=datasets, state=state, reason=reason, next=then, since=since, trend=trend)


def _smaller_signs(newest: Checked, usual_mm: float) -> tuple[str, str]:
    held_out = _held_out(newest)
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
    """Whether errors grow with time: Kendall's rank correlation at FALSE_ALARM. Seven datasets are the least."""
    seen = [mm for mm in errors_mm if mm is not None]
    if len(seen) < 7:
        return False
    from scipy.stats import kendalltau  # slow to import

    found = kendalltau(np.arange(len(seen)), seen, alternative="greater")
    return bool(found.pvalue < FALSE_ALARM)


def _held_out(dataset: Checked) -> float | None:
    return None if dataset.calibration["state"] == "failed" else dataset.calibration["held_out_mm"]["median"]


def _mm(dataset: Checked) -> str:
    return "–" if dataset.error_mm is None else f"{dataset.error_mm:.2f}"
