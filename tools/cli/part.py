"""weldcal part: the edges of a part that can be welded, with numbers to pick and a picture."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import RESULT, Call, Outcome, command, option


@command("part", common=RESULT, short_help="List the edges of a part's file that can be welded.")
def part(
    call: Call,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A STEP, STL, OBJ or PLY file.", show_default=False)],
    units: Annotated[
        str | None, option("--units", "UNIT", "mm, m or inch.", show_default="the STEP file's own, mm for a mesh")
    ] = None,
) -> Outcome:
    """List the edges of a part with their numbers, for workpiece.seams in a scenario, and draw them."""
    from weldcal.models.workpieces.reading import read_shape
    from weldcal.tools.commands.part import as_json, emit_table, write_part

    shape = read_shape(file, units)
    folder = call.folder("part", file.name)
    write_part(shape, folder)
    return Outcome(as_json(shape, folder), text=partial(emit_table, shape, folder))
