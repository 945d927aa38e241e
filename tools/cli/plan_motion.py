"""weldcal plan-motion: compares motions before a scanner is calibrated in motion."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, Outcome, command, option, switch


@command("plan-motion", short_help="Find the best motion for a calibration in motion.")
def plan_motion(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="Arm, scanner's guess and cube: a scenario by name or YAML file.")
    ] = "motion",
    stream: Annotated[
        list[Path] | None,
        option("--stream", "FILE", "Compare recorded programs, tables as stream.csv, instead of cubes; may repeat."),
    ] = None,
    calibration: Annotated[
        Path | None, option("--calibration", "RESULT", "Where the scanner stands.", show_default="the scenario's guess")
    ] = None,
    seconds: Annotated[float, option("--seconds", "S", "How long the scanner streams.", min=2.0)] = 20.0,
    device_clock: Annotated[
        bool, switch("--device-clock/--no-device-clock", "Frames with the device's times, or arrivals only.")
    ] = True,
) -> Outcome:
    """Predict what motions tell of the scanner's pose and clock, and write the best one as URScript. Nothing moves.

    The error is that of a point among the flange's places, one sigma, of noise alone.
    """
    from weldcal.tools.commands.plan_motion import plan_motions

    found = plan_motions(
        scenario, call.folder("plan-motion", scenario), streams=stream or (), calibration=calibration, seconds=seconds,
        device=device_clock, seed=call.seed, progress=call.progress,
    )  # fmt: skip
    rows = {str(p["name"]): _line(p) for p in found["motions"]}  # type: ignore[attr-defined]
    return Outcome(found, values={"written to": found["written_to"]}, rows=rows)


def _line(p: dict[str, float | None]) -> str:
    shown = (("error_mm", "mm", 3), ("rotation_deg", "deg", 4), ("clock_offset_ms", "ms", 3))
    return ", ".join("open" if p[k] is None else f"{p[k]:.{digits}f} {unit}" for k, unit, digits in shown)
