"""weldcal verify: a verdict on a calibration, from scans that it did not use."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, CorrectionOption, FlangeOption, Outcome, command, option


@command("verify", short_help="Verify a calibration on scans that it did not use.")
def verify(
    call: Call,
    result: Annotated[Path, typer.Argument(help="A result folder, or its calibration.yaml.")],
    dataset: Annotated[Path, typer.Argument(help="A folder with poses and clouds, or pairs.csv (docs/datasets.md).")],
    flange: FlangeOption = None,
    scanner_correction: CorrectionOption = True,
    limit_mm: Annotated[
        float | None,
        option(
            "--limit-mm",
            "MM",
            "Largest median error of the new scans.",
            show_default="from what the calibration states; 1 % false alarms",
        ),
    ] = None,
) -> Outcome:
    """Verify a calibration on scans that it did not use: a verdict, position error and tilt per pose, at the flange.

    The exit code is 1 where the verdict is "do not use".
    """
    from weldcal.tools.commands.verify import verify_dataset
    from weldcal.tools.outcomes.calibration import DO_NOT

    report = verify_dataset(
        result,
        dataset,
        call.folder("verify", dataset.resolve().name),
        flange=flange,
        seed=call.seed,
        progress=call.progress,
        correct_scanner=scanner_correction,
        limit_mm=limit_mm,
    )
    verdict, summary = report.verdict, report.summary()
    return Outcome(
        summary,
        values={key: value for key, value in summary.items() if key not in ("verdict", "reason")},
        rows=report.interval_rows,
        first=report.first,
        problem=f"The verdict is: {verdict.verdict}. {verdict.reason}" if verdict.verdict == DO_NOT else "",
    )
