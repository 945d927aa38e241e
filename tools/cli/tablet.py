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
        from weldcal.tools.commands.tablet.page.serve import run_server

        run_server(host, port, out, typer.echo)


@tablet.command("calibrate")
def calibrate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The page's touches (CSV), or planar touches (npz).")],
    poses: Annotated[
        Path | None, typer.Option("--poses", metavar="CSV", help="Flange poses at each touch, and one row 'camera'.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option("--camera", metavar="YAML", help="fx, fy, cx, cy and distortion of the camera.")
    ] = None,
    image: Annotated[
        Path | None, typer.Option("--image", metavar="PICTURE", help="What the camera saw; landmarks are found in it.")
    ] = None,
    seen: Annotated[
        Path | None, typer.Option("--seen", metavar="CSV", help="Instead: landmark,u,v in the camera's image.")
    ] = None,
    look: Annotated[
        str, typer.Option("--look", metavar="LOOK", help="Landmarks in the image: rings or dots.")
    ] = "rings",
    pen_length_mm: Annotated[
        float | None, typer.Option("--pen-length-mm", metavar="MM", help="Pen tip before the flange, along its z.")
    ] = None,
    pen_radius_mm: Annotated[
        float, typer.Option("--pen-radius-mm", metavar="MM", min=0.0, help="Radius of the pen's round tip.")
    ] = 0.0,
    hand_step_mm: Annotated[
        float | None,
        typer.Option(
            "--hand-step-mm",
            metavar="MM",
            min=0.0,
            help="npz: hands were read off in such steps; 0: they were not.",
            show_default="found in the hands",
        ),
    ] = None,
    printed_sign: Annotated[
        bool, typer.Option("--printed-sign", help="npz: the touching error with the sign that the paper prints.")
    ] = False,
    two_stages: Annotated[bool, typer.Option("--two-stages", help="npz: also the paper's own two stages.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Names the folder; nothing here is random.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """Where do camera and pen sit on the wrist? From one look at the tablet and a touch of each landmark."""
    from weldcal.tools.cli.options import finish, fresh_folder

    folder = out or fresh_folder("tablet", file.stem, seed)
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.tablet.calibrate import TabletInputs, calibrate_tablet

        inputs = TabletInputs(
            file,
            poses,
            camera,
            image,
            seen,
            look,
            None if pen_length_mm is None else 1e-3 * pen_length_mm,
            1e-3 * pen_radius_mm,
            None if hand_step_mm is None else 1e-3 * hand_step_mm,
            printed_sign,
            two_stages,
        )
        summary = calibrate_tablet(inputs, folder).summary()
    finish("tablet calibrate", summary, folder, json_wanted=json)


@tablet.command("demo")
def demo(
    scenario: Annotated[
        str, typer.Option("--scenario", metavar="NAME", help="A scenario's name, or the path of a scenario YAML file.")
    ] = "tablet",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
    ] = 0,
    browser: Annotated[bool, typer.Option("--browser", help="Open the live 3D view in the web browser.")] = False,
    realtime: Annotated[bool, typer.Option("--realtime", help="Never run faster than the real robot would.")] = False,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            metavar="ROBOT",
            help="simulated, emulated (a controller on loopback), or the address of a controller.",
            show_default="the scenario's",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only look at the robot, then run on a simulated arm like it.")
    ] = False,
    pace: Annotated[
        float | None, typer.Option("--pace", metavar="P", help="Emulated controller only: 0.05 to 1 of real time.")
    ] = None,
    speed_factor: Annotated[
        float | None, typer.Option("--speed-factor", metavar="X", help="Make the arm's moves slower: 0.05 to 1.")
    ] = None,
    record: Annotated[bool, typer.Option("--record", help="Also write recording.html, the run in 3D.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """The whole procedure in the station: a look, a touch of each landmark by contact, the calibration, against the truth."""
    from weldcal.tools.cli.options import finish, fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("tablet demo") as progress:
        from weldcal.systems.scenario.loading import load_scenario
        from weldcal.tools.commands.tablet.demo import run_tablet_demo
        from weldcal.tools.outcomes.options import RunOptions

        options = RunOptions(
            scenario=scenario,
            out=out or fresh_folder("tablet", scenario, seed),
            seed=seed,
            browser=browser and not json,
            realtime=realtime,
            robot=robot,
            dry_run=dry_run,
            pace=pace,
            speed_factor=speed_factor,
            recording=record,
        )
        result = run_tablet_demo(load_scenario(scenario), options, progress)
    finish("tablet demo", result.summary(), result.folder, json_wanted=json)
