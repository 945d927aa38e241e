"""weldcal verify: the errors of a calibration on scans that it did not use."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, CorrectionOption, FlangeOption, command


@command("verify", short_help="Verify a calibration on scans that it did not use.")
def verify(
    call: Call,
    result: Annotated[Path, typer.Argument(help="A result folder, or its calibration.yaml.")],
    dataset: Annotated[Path, typer.Argument(help="A folder with dataset.yaml, poses.csv and clouds/, or pairs.csv.")],
    flange: FlangeOption = None,
    scanner_correction: CorrectionOption = True,
) -> Mapping[str, object]:
    """Verify a calibration on scans that it did not use: position error and tilt per pose, at the flange."""
    from weldcal.tools.commands.verify import verify_dataset

    return verify_dataset(
        result,
        dataset,
        call.folder("verify", dataset.resolve().name),
        flange=flange,
        seed=call.seed,
        progress=call.progress,
        correct_scanner=scanner_correction,
    ).summary()
