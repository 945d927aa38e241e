"""The state of each cell of a fleet, judged from the calibrations and verifications of its datasets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from weldcal.tools.report.first_screen import DO_NOT
from weldcal.tools.report.render import fixed, render

VISIT, LOOK, FINE = "visit", "look", "fine"


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
        """Median error of the cell's first calibration here, mm: held-out for its own dataset, else verified."""
        if self.verification is None:
            return None if self.calibration["state"] == "failed" else self.calibration["held_out_mm"]["median"]
        return None if self.verification["state"] == "failed" else self.verification["position_error_mm"]["median"]

    @property
    def refuted(self) -> bool:
        """Whether the cell's first calibration must not be used on this dataset."""
        return self.verification is not None and self.verification.get("verdict") == DO_NOT


@dataclass(frozen=True, kw_only=True)
class FleetCell:
    """A cell with its datasets, oldest first, and the verdict: VISIT, LOOK or FINE, why, and what to do."""

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
        return held_out_mm(self.datasets[-1])

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
        """Return the JSON object of the cell."""
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

    cells: tuple[FleetCell, ...]
    out: Path

    def named(self, state: str) -> list[str]:
        """Names of the cells in a state."""
        return [cell.name for cell in self.cells if cell.state == state]

    def summary(self) -> dict[str, object]:
        """Return the JSON object of `fleet`."""
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


def held_out_mm(dataset: Checked) -> float | None:
    return None if dataset.calibration["state"] == "failed" else dataset.calibration["held_out_mm"]["median"]


WIDTH, HEIGHT, EDGE = 120.0, 28.0, 3.0


def fleet_report(report: FleetReport, folder: str) -> str:
    """Return the whole page as one HTML text; it links to the reports of the datasets beside it."""
    visit, look = report.named(VISIT), report.named(LOOK)
    summary = report.summary()
    return render(
        "fleet.html.j2",
        folder=folder,
        cells=[_row(cell) for cell in report.cells],
        tone="bad" if visit else "warn" if look else "good",
        headline=_headline(visit, look, len(report.cells)),
        n_cells=len(report.cells),
        n_datasets=summary["datasets"],
        n_visit=len(visit),
        n_look=len(look),
        n_fine=len(report.named(FINE)),
        drifting=summary["drifting"],
    )


def sparkline(values: Sequence[float | None]) -> Markup:
    """A small line of the values (mm) from zero up, as inline SVG in the text's colour; a gap where one is missing."""
    seen = [v for v in values if v is not None]
    if len(seen) < 2:
        return Markup("")
    high = max(seen)
    x = np.linspace(EDGE, WIDTH - EDGE, len(values))
    points = [
        None if v is None else (xi, HEIGHT - EDGE - v / high * (HEIGHT - 2 * EDGE))
        for xi, v in zip(x, values, strict=True)
    ]
    path, pen = "", "M"
    for point in points:
        path += "" if point is None else f"{pen}{point[0]:.1f} {point[1]:.1f}"
        pen = "M" if point is None else "L"
    last = next(p for p in reversed(points) if p is not None)
    said = f"from {fixed(seen[0], 2)} to {fixed(seen[-1], 2)} mm, at most {fixed(high, 2)} mm"
    return Markup(
        '<svg class="spark" viewBox="0 0 {w:g} {h:g}" width="{w:g}" height="{h:g}" role="img" aria-label="{said}">'
        '<title>{said}</title><path d="{path}" fill="none" stroke="currentColor" stroke-width="1.5"/>'
        '<circle cx="{cx:.1f}" cy="{cy:.1f}" r="2.5" fill="currentColor"/></svg>'
    ).format(w=WIDTH, h=HEIGHT, said=said, path=path, cx=last[0], cy=last[1])


def _headline(visit: list[str], look: list[str], cells: int) -> str:
    if visit:
        return f"{len(visit)} of {cells} cells {'needs' if len(visit) == 1 else 'need'} a visit"
    if look:
        return f"No cell needs a visit; {len(look)} of {cells} should be looked at"
    return f"All {cells} cells are fine" if cells > 1 else "The cell is fine"


def _row(cell: FleetCell) -> dict[str, object]:
    newest = cell.datasets[-1]
    return {
        "name": cell.name,
        "state": cell.state,
        "reason": cell.reason,
        "next": cell.next,
        "held_out": fixed(cell.held_out_mm, 3),
        "work": fixed(cell.error_95_mm, 2),
        "shift": fixed(cell.shift_mm, 2),
        "spark": sparkline([d.error_mm for d in cell.datasets]),
        "datasets": len(cell.datasets),
        "report": newest.report,
        "verified": newest.verified,
    }
