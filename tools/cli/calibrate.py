"""weldcal calibrate: a scanner's pose from a dataset, or live in a scenario."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import (
    MOTION,
    Call,
    CorrectionOption,
    FlangeOption,
    LimitOption,
    Outcome,
    command,
    option,
    switch,
)
from weldcal.tools.commands.run import run_options


@command(
    "calibrate",
    options=(*MOTION, "record"),
    short_help="Calibrate a scanner from scans, or live in a scenario.",
)
def calibrate(
    call: Call,
    dataset: Annotated[
        Path | None,
        typer.Argument(
            help="A folder with poses and clouds (docs/datasets.md), a ROS recording; in motion stream.csv."
        ),
    ] = None,
    scenario: Annotated[str | None, option("--scenario", "NAME", "Calibrate live in this scenario instead.")] = None,
    robot: Annotated[
        str | None,
        option(
            "--robot",
            "NAME",
            "For a dataset: the arm, if dataset.yaml does not name it. Live: simulated, emulated or a controller's address.",
        ),
    ] = None,
    flange: FlangeOption = None,
    centres: Annotated[
        bool, switch("--centres", "Also write centres.csv: the flange centre found in each scan of a dataset.")
    ] = False,
    scanner_correction: CorrectionOption = True,
    poses: Annotated[
        str | None,
        option("--poses", "FROM:TO", "Of a dataset: use only the scans from one id to another, such as p09: or :p08."),
    ] = None,
    refine: Annotated[
        str | None,
        option(
            "--refine",
            "KIND",
            "Of a dataset: local (a field of what the calibration leaves), joints or links (errors of the arm; needs its joint angles).",
        ),
    ] = None,
    kinematics: Annotated[
        Path | None,
        option(
            "--kinematics",
            "FILE",
            "With --refine joints or links: the arm's factory calibration, which the controller uses.",
        ),
    ] = None,
    axis_turn: Annotated[
        float | None,
        option(
            "--axis-turn",
            "DEG",
            "Known rotation of the hole pattern about the flange axis; one to three scans are then enough.",
        ),
    ] = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate a scanner from a folder of flange scans and robot poses, or live in a scenario."""
    if dataset is not None and scenario is None:
        from weldcal.calibration.data.motion_dataset import is_motion

        if is_motion(dataset):
            if poses is not None or axis_turn is not None or refine is not None:
                raise typer.BadParameter(
                    "--poses, --refine and --axis-turn are for scans at rest; omit them with a recording in motion"
                )
            from weldcal.tools.commands.calibrate_motion import calibrate_motion

            folder = call.folder("calibrate", dataset.resolve().name)
            moving = calibrate_motion(
                dataset, folder, robot=robot, flange=flange, seed=call.seed, progress=call.progress, centres=centres,
                limit_mm=limit_mm,
            )  # fmt: skip
            return Outcome(moving.summary(), first=moving.first)
        from weldcal.tools.commands.calibrate import calibrate_dataset

        report = calibrate_dataset(
            dataset,
            call.folder("calibrate", dataset.resolve().name),
            robot=robot,
            flange=flange,
            seed=call.seed,
            progress=call.progress,
            centres=centres,
            correct_scanner=scanner_correction,
            axis_turn_deg=axis_turn,
            poses=poses,
            refine=refine,
            kinematics=kinematics,
            limit_mm=limit_mm,
        )
        algorithm1 = report.algorithm1
        rows = {} if algorithm1 is None else {"Algorithm 1": algorithm1.sentence}
        if report.refinement is not None:
            rows["refinement"] = str(report.refinement["sentence"])
        interval = report.held_out_interval_mm
        if interval is not None:
            rows |= report.interval_rows
            rows["mean error of as many new scans"] = f"{interval[0]:.3f} to {interval[1]:.3f} mm (95 %)"
        summary = report.summary()
        rows["error budget"] = report.budget.sentence
        return Outcome(summary, rows=rows, first=report.first)
    if scenario is None or dataset is not None:
        raise typer.BadParameter("give either a dataset folder or --scenario NAME")
    if poses is not None or refine is not None or kinematics is not None:
        raise typer.BadParameter("--poses, --refine and --kinematics are for a dataset; omit them with --scenario")
    from weldcal.tools.commands.demo import calibrate_live

    if limit_mm is not None:
        raise typer.BadParameter("--limit-mm is for a dataset; a scenario states calibration.required_error_mm")
    found, first = calibrate_live(run_options(call, "calibrate", scenario, robot=robot), call.progress)
    return Outcome(found, first=first)
