"""`weldcal calibrate`: estimates X_BC and its uncertainty from a folder of scans, and writes exports and a report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from weldcal.calibration.data.checks import is_carried, is_motion
from weldcal.calibration.recorded_flange import FlangeOptions
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
from weldcal.tools.recorded import calibrate_dataset


@command("calibrate", options=(*MOTION, "record"), short_help="Calibrate a scanner from scans, or live in a scenario.")
def calibrate(
    call: Call,
    dataset: Annotated[
        Path | None, typer.Argument(help="A folder with poses and clouds (docs/datasets.md), or a ROS recording.")
    ] = None,
    scenario: Annotated[str | None, option("--scenario", "NAME", "Calibrate live in this scenario instead.")] = None,
    robot: Annotated[
        str | None,
        option(
            "--robot",
            "NAME",
            "For a dataset: the arm, if dataset.yaml does not name it. Live: simulated, emulated or a controller's"
            " address.",
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
            "Of a dataset: local (a field of what the calibration leaves), joints or links (errors of the arm; needs"
            " its joint angles).",
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
    compare: Annotated[
        bool, switch("--compare", "Of a dataset: also run the published method (Algorithm 1, ICP) on the same scans.")
    ] = False,
    limit_mm: LimitOption = None,
) -> Outcome | Mapping[str, object] | None:
    """Calibrate a scanner from a folder of flange scans and robot poses, or live in a scenario."""
    if (dataset is None) == (scenario is None):
        raise typer.BadParameter("give either a dataset folder or --scenario NAME")
    if scenario is not None:
        if poses is not None or refine is not None or kinematics is not None or compare:
            raise typer.BadParameter(
                "--poses, --refine, --kinematics and --compare are for a dataset; omit them with --scenario"
            )
        if limit_mm is not None:
            raise typer.BadParameter("--limit-mm is for a dataset; a scenario states calibration.required_error_mm")
        from weldcal.tools.commands.demo import calibrate_live

        return calibrate_live(call, scenario, robot)
    assert dataset is not None
    if is_motion(dataset):
        if poses is not None or axis_turn is not None or refine is not None or compare:
            raise typer.BadParameter(
                "--poses, --refine, --axis-turn and --compare are for scans at rest; omit them with a recording in"
                " motion"
            )
        from weldcal.tools.commands.calibrate_motion import calibrate_recording

        moving = calibrate_recording(
            dataset,
            call.folder("calibrate", dataset.resolve().name),
            robot=robot,
            flange=flange,
            seed=call.seed,
            progress=call.progress,
            centres=centres,
            limit_mm=limit_mm,
        )
        return Outcome(moving.summary(), first=moving.first)
    if is_carried(dataset):
        if axis_turn is not None or refine is not None or compare or centres or not scanner_correction:
            raise typer.BadParameter(
                "--refine, --axis-turn, --compare, --centres and --no-scanner-correction are for a scanner beside the"
                " robot; omit them"
            )
        from weldcal.tools.commands.mounting_live import calibrate_recorded

        out, known = (
            call.folder("calibrate", dataset.resolve().name),
            {"robot": robot, "flange": flange, "poses": poses},
        )
        carried = calibrate_recorded(dataset, out, **known, limit_mm=limit_mm, progress=call.progress)
        return Outcome(carried.summary(), text=carried.text(), first=carried.first)
    asked = FlangeOptions(
        robot=robot,
        flange=flange,
        correct_scanner=scanner_correction,
        axis_turn_deg=axis_turn,
        poses=poses,
        refine=refine,
        kinematics=kinematics,
        seed=call.seed,
    )
    report = calibrate_dataset(
        dataset,
        call.folder("calibrate", dataset.resolve().name),
        asked,
        progress=call.progress,
        centres=centres,
        compare=compare,
        limit_mm=limit_mm,
    )
    rows = {} if report.algorithm1 is None else {"Algorithm 1": report.algorithm1.sentence}
    if report.refinement is not None:
        rows["refinement"] = str(report.refinement["sentence"])
    interval = report.held_out_interval_mm
    if interval is not None:
        rows |= report.interval_rows
        rows["mean error of as many new scans"] = f"{interval[0]:.3f} to {interval[1]:.3f} mm (95 %)"
    rows["error budget"] = report.budget.sentence
    return Outcome(report.summary(), rows=rows, first=report.first)
