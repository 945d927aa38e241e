"""weldcal new and weldcal schema: a cell or dataset of one's own to start from, and the keys that a scenario may have."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import LOOK, Call, Outcome, command, option, switch


@command("new", common=("seed", "json", "debug"), short_help="Write a cell or a dataset of your own to start from.")
def new(
    call: Call,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to write it.")],
    base: Annotated[str, option("--from", "NAME", "Scenario that the cell begins as, by name or path.")] = "s_groove",
    dataset: Annotated[
        bool, switch("--dataset", "Write an example of a calibration dataset, scanned in simulation, instead.")
    ] = False,
) -> Outcome:
    """Write a commented scenario that runs, cell.yaml, with a schema for editors; or an example of a calibration dataset."""
    if dataset:
        from weldcal.tools.commands.new import write_example

        written = write_example(folder, call.seed, call.progress)
        following = f"weldcal calibrate {written}"
    else:
        from weldcal.tools.scenarios.new_cell import write_cell

        written = write_cell(folder, base)
        following = f"weldcal demo --scenario {written}"
    summary = {"state": "done", "written": str(written), "next": following}
    return Outcome(summary, values={"written": str(written), "next": following})


@command("schema", common=LOOK, short_help="Print the keys that a scenario may have.")
def schema(
    call: Call,
    markdown: Annotated[bool, switch("--markdown", "Print the reference page instead of the JSON schema.")] = False,
) -> Outcome:
    """Print the JSON schema of a scenario, for editors, with the drivers that are installed."""
    import json

    from weldcal.tools.scenarios.json_schema import json_schema
    from weldcal.tools.scenarios.reference import reference

    text = reference() if markdown else json.dumps(json_schema(), indent=1) + "\n"
    return Outcome(json_schema(), text=partial(typer.echo, text, nl=False))
