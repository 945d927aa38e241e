"""The report page of `weldcal fleet`: every cell in one table, those that need a visit first."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from weldcal.tools.outcomes.fleet import FINE, LOOK, VISIT, Cell, FleetReport
from weldcal.tools.report.render import fixed, render

WIDTH, HEIGHT, EDGE = 120.0, 28.0, 3.0


def fleet_report(report: FleetReport, folder: str) -> str:
    """The whole page as one HTML text; it links to the reports of the datasets beside it."""
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


def _row(cell: Cell) -> dict[str, object]:
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
