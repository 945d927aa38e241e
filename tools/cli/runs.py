"""weldcal hand-eye live."""

from typing import Annotated

import typer

from weldcal.tools.cli.options import (
    LIVE,
    Call,
    Outcome,
    RecordOption,
    command,
)
from weldcal.tools.commands.run import run_options


@command(
    "hand-eye live", short_help="Calibrate a scanner live in any mounting.", options=LIVE, defaults={"browser": False}
)
def hand_eye_live(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A scenario with a mounting section, by name or path.")
    ] = "eye_in_hand",
    record: RecordOption = False,
) -> Outcome:
    """Calibrate a scanner live in any mounting: it scans the robot's flange, its foot, or a second arm's flange."""
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.tools.commands.mounting_live import run_mounting_live

    options = run_options(call, "hand-eye", scenario, recording=record)
    result = run_mounting_live(load_scenario(scenario), options, call.progress)
    return Outcome(result.summary(), text=result.text(), first=result.first)
