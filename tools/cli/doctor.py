"""weldcal doctor: names what disturbs a calibration or a weld, with the evidence and the next step."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import LOOK, Call, FlangeOption, Outcome, command


@command("doctor", common=("seed", *LOOK), short_help="Name what disturbs a calibration or a weld.")
def doctor(
    call: Call,
    path: Annotated[Path, typer.Argument(help="A result folder, a recording.mcap, or a dataset folder.")],
    flange: FlangeOption = None,
) -> Outcome:
    """Name the causes that disturb a calibration or a weld, likeliest first, each with its evidence and the next step.

    Each cause is a test on the residuals; docs/doctor.md says from which size on it is named.
    """
    from weldcal.tools.commands.doctor import examine

    report = examine(path, flange=flange, seed=call.seed, progress=call.progress)
    return Outcome(report.summary(), text=report.text())
