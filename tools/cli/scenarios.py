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
    part: Annotated[
        Path | None, option("--part", "FILE", "A part of your own: STEP, STL, OBJ or PLY. It is copied there.")
    ] = None,
    edges: Annotated[
        str, option("--edges", "N,N...", "Edges of the seam, from weldcal part; default: the longest.")
    ] = "",
    joint: Annotated[
        str | None, option("--joint", "NAME", "v_groove, butt, fillet or lap; default: by the angle.")
    ] = None,
    tool: Annotated[bool, switch("--tool", "Also write tool.yaml, a copy of the welding tool to change.")] = False,
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
        from weldcal.models.tools.loading import WELDING
        from weldcal.tools.scenarios.new_cell import OwnPart, write_cell

        numbers = tuple(edge_numbers(edges))
        own = None if part is None else OwnPart(part, numbers, joint)
        written = write_cell(folder, base, own, WELDING if tool else None)
        following = f"weldcal demo --scenario {written}"
    summary = {"state": "done", "written": str(written), "next": following}
    return Outcome(summary, values={"written": str(written), "next": following})


def edge_numbers(text: str) -> list[int]:
    """The numbers of a list such as 12,13. Raises InputError."""
    from weldcal.models.errors import InputError

    words = [word.strip() for word in text.split(",") if word.strip()]
    if not all(word.isdecimal() for word in words):
        raise InputError(f"--edges must be numbers with commas between them, such as 12,13, not '{text}'.")
    return [int(word) for word in words]


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
