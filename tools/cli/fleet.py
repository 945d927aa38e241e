"""weldcal fleet: calibrates and verifies the datasets of many cells, and says which need a visit."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import FARM, Call, Outcome, command, option


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
    """Calibrate every dataset, verify each cell's first calibration on its later datasets, and write one page: which cells
    drift, and which need a visit."""
    from weldcal.tools.commands.fleet import find_cells, run_fleet
    from weldcal.tools.outcomes.fleet import LOOK, VISIT

    find_cells(folder)
    out = call.folder("fleet", folder.resolve().name)
    report = run_fleet(folder, call.farm(out), limit_mm=limit_mm, seed=call.seed)
    summary = report.summary()
    shown = {
        cell.name: f"{cell.state}: {cell.reason} {cell.next}" for cell in report.cells if cell.state in (VISIT, LOOK)
    }
    counts = {name: summary[name] for name in ("cells", "datasets", "fine")} | {
        name: len(report.named(name)) for name in (VISIT, LOOK)
    }
    return Outcome(summary, values=counts, rows={**shown, "report": str(out / "report.html")})
