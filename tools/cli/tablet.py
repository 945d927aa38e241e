"""weldcal tablet serve and calibrate: a tablet as the calibration target."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, LimitOption, Outcome, check_writable, command, option, switch


@command("tablet serve", common=("debug",))
def serve(
    call: Call,
    host: Annotated[
        str, option("--host", "ADDRESS", "Address to listen on; 0.0.0.0 admits the whole network.")
    ] = "127.0.0.1",
    port: Annotated[int, option("--port", "PORT", "Port; 0 takes any free one.")] = 8077,
    out: Annotated[Path, option("--out", "FOLDER", "Folder for the touches that the tablet sends.")] = Path(
        "weldcal-out/tablet"
    ),
) -> None:
    """Serve the target page to a tablet until interrupted: landmarks at true scale, touches to a tenth of a pixel."""
    from weldcal.tools.commands.tablet.page.serve import run_server

    check_writable(out)
    run_server(host, port, out, typer.echo)


@command("tablet calibrate")
def calibrate(
    call: Call,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The page's touches (CSV), or planar touches (npz).")],
    poses: Annotated[Path | None, option("--poses", "CSV", "Flange poses at each touch, and one row 'camera'.")] = None,
    camera: Annotated[Path | None, option("--camera", "YAML", "fx, fy, cx, cy and distortion of the camera.")] = None,
    image: Annotated[
        Path | None, option("--image", "PICTURE", "The camera's image; landmarks are detected in it.")
    ] = None,
    seen: Annotated[Path | None, option("--seen", "CSV", "Instead of --image: landmark,u,v in the image.")] = None,
    look: Annotated[str, option("--look", "LOOK", "Landmarks in the image: rings or dots.")] = "rings",
    pen_length_mm: Annotated[
        float | None, option("--pen-length-mm", "MM", "Distance of the pen tip from the flange, along its z axis.")
    ] = None,
    pen_radius_mm: Annotated[float, option("--pen-radius-mm", "MM", "Radius of the pen's round tip.", min=0.0)] = 0.0,
    hand_step_mm: Annotated[
        float | None,
        option(
            "--hand-step-mm",
            "MM",
            "npz: hand positions are rounded to this step; 0: not rounded.",
            min=0.0,
            show_default="detected",
        ),
    ] = None,
    printed_sign: Annotated[
        bool, switch("--printed-sign", "npz: use the sign of the touching error as printed in the paper.")
    ] = False,
    two_stages: Annotated[bool, switch("--two-stages", "npz: also run the paper's two stages.")] = False,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate camera and pen on the wrist from one image of the tablet and a touch of each landmark."""
    from weldcal.tools.commands.tablet.calibrate import TabletInputs, calibrate_tablet

    inputs = TabletInputs(
        file=file,
        poses=poses,
        camera=camera,
        image=image,
        seen=seen,
        look=look,
        pen_length_m=None if pen_length_mm is None else 1e-3 * pen_length_mm,
        pen_radius_m=1e-3 * pen_radius_mm,
        hand_step_m=None if hand_step_mm is None else 1e-3 * hand_step_mm,
        printed_sign=printed_sign,
        two_stages=two_stages,
        limit_mm=limit_mm,
    )
    made = calibrate_tablet(inputs, call.folder("tablet", file.stem))
    return Outcome(made.summary(), first=made.first)
