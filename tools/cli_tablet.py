"""weldcal tablet: a tablet as the calibration target."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console

tablet = typer.Typer(help="A tablet as the target: its dots are seen, then touched.", no_args_is_help=True)


@tablet.callback()
def _group() -> None:
    """A tablet as the target: its dots are seen, then touched."""


@tablet.command("serve")
def serve(
    host: Annotated[
        str, typer.Option("--host", metavar="ADDRESS", help="Where to listen; 0.0.0.0 lets a tablet in the network in.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", metavar="PORT", help="0 takes any free one.")] = 8077,
    out: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Where touches that the tablet sends are written.")
    ] = Path("weldcal-out/tablet"),
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """Hand the target's page to a tablet: landmarks at true scale, touches to a tenth of a pixel; until interrupted."""
    with console.boundary(json_wanted=False, debug=debug):
        from weldcal.tools.tablet_page.serve import run_server

        run_server(host, port, out, typer.echo)
