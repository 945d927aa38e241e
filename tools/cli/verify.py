"""weldcal verify: a verdict on a calibration, from scans that it did not use."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, CorrectionOption, FlangeOption, Outcome, command, option


@command(
    "verify",
    options=("browser", "share"),
    defaults={"browser": False},
    short_help="Verify a calibration on scans that it did not use.",
)
def verify(
    call: Call,
    result: Annotated[Path, typer.Argument(help="A result folder, or its calibration.yaml.")],
    dataset: Annotated[
        Path | None, typer.Argument(help="A folder with poses and clouds, or pairs.csv (docs/datasets.md).")
    ] = None,
    touch: Annotated[
        Path | None,
        option(
            "--touch",
            "CSV",
            "Points that the robot's tip touched and the scanner measured (docs/datasets.md), in place of scans.",
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        option(
            "--scenario",
            "NAME",
            "Let the robot of this scenario touch the part that its scanner sees, in place of scans.",
        ),
    ] = None,
    robot: Annotated[
        str, option("--robot", "NAME", "With --scenario: simulated, emulated or a controller's address.")
    ] = "simulated",
    points: Annotated[int, option("--points", "N", "With --scenario: places to touch.", min=3, max=60)] = 8,
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

    With --touch or --scenario: by points that the tip touched, each against the stated 95 % region. The exit code is 1 where the verdict is "do not use".
    """
    if sum(given is not None for given in (dataset, touch, scenario)) != 1:
        raise typer.BadParameter(
            "give a folder of new scans, touched points (--touch FILE) or a cell (--scenario NAME)"
        )
    if scenario is not None:
        return _touched_live(call, result, scenario, robot, points)
    if touch is not None or dataset is None:
        assert touch is not None
        return _by_touch(call, result, touch)
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


def _by_touch(call: Call, result: Path, touches: Path) -> Outcome:
    from weldcal.tools.commands.touch import verify_touches
    from weldcal.tools.outcomes.calibration import DO_NOT

    report = verify_touches(result, touches, call.folder("verify", touches.resolve().stem))
    verdict = report.verdict
    return Outcome(
        report.summary(),
        values={},
        rows={name: text for name, text in report.rows.items() if name != "verdict"},
        first=report.first,
        problem=f"The verdict is: {verdict.verdict}. {verdict.reason}" if verdict.verdict == DO_NOT else "",
    )


def _touched_live(call: Call, result: Path, scenario: str, robot: str, points: int) -> Outcome:
    from weldcal.tools.commands.touch_live import run_touches, touching
    from weldcal.tools.outcomes.calibration import DO_NOT
    from weldcal.tools.report.run import RunOptions

    options = RunOptions(
        scenario=scenario, out=call.folder("verify", scenario), seed=call.seed, robot=robot, **call.live
    )
    found = run_touches(touching(scenario, result, points), options, call.progress)
    report, problem = found.report, ""
    if found.state == "held":
        problem = found.reason
    elif report is not None and report.verdict.verdict == DO_NOT:
        problem = f"The verdict is: {DO_NOT}. {report.verdict.reason}"
    return Outcome(
        found.summary(),
        rows={} if report is None else report.rows,
        problem=problem,
        first=None if report is None else report.first,
    )
