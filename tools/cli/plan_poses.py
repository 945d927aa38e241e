"""weldcal plan-poses: chooses the poses of scans for calibrate --refine."""

from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, Outcome, command, option


@command("plan-poses", short_help="Find the poses of scans for calibrate --refine.")
def plan_poses(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="Arm, scanner and its guess: a scenario by name or YAML file.")
    ] = "calibrate_only",
    scans: Annotated[int, option("--scans", "N", "Number of scans.", min=12)] = 20,
    kind: Annotated[str, option("--kind", "KIND", "The refinement that they are for: links or joints.")] = "links",
) -> Outcome:
    """Choose flange poses that the arm reaches and the scanner sees, and write them as a table and URScript. Nothing moves."""
    from weldcal.tools.commands.plan_poses import plan_refining_poses

    found = plan_refining_poses(
        scenario, call.folder("plan-poses", scenario), scans=scans, kind=kind, seed=call.seed, progress=call.progress
    )
    values = {k: found[k] for k in ("scans", "chosen_from", "written_to")}
    return Outcome(found, values={k.replace("_", " "): v for k, v in values.items()})
