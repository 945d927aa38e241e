"""`weldcal verify RESULT DATASET`: judges a calibration by its errors at the flange on scans that it did not use."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from weldcal.calibration.verified_pairs import PairsOptions, holds_scans
from weldcal.calibration.verified_scans import VerifyOptions
from weldcal.tools.cli.options import Call, FlangeOption, Outcome, command, option, switch
from weldcal.tools.commands.hand_eye import (
    BoardOption,
    CameraPosesOption,
    MountingOption,
    RobotPosesOption,
    UnitOption,
    stated_lists,
)
from weldcal.tools.verified import verify_dataset, verify_on_pairs

OF_SCANS = "scanner-correction"


@command(
    "verify",
    keys=("robot-form", "camera-form", "intrinsics", OF_SCANS),
    options=("browser", "share"),
    defaults={"browser": False},
    short_help="Verify a calibration on scans that it did not use.",
)
def verify(
    call: Call,
    result: Annotated[
        Path,
        typer.Argument(
            help="A result folder, its calibration.yaml, or any file with a camera's pose (docs/hand_eye.md)."
        ),
    ],
    dataset: Annotated[
        Path | None,
        typer.Argument(
            help=(
                "Scans: a folder with poses and clouds, or pairs.csv. Or pairs of poses or pictures, as hand-eye reads"
                " (docs/datasets.md)."
            )
        ),
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
            "--scenario", "NAME", "In place of scans let this scenario's robot touch the part that its scanner sees."
        ),
    ] = None,
    robot: Annotated[
        str | None, option("--robot", "NAME", "The arm of joint angles; with --scenario: simulated or an address ...")
    ] = None,
    flange: FlangeOption = None,
    correct: Annotated[
        bool, switch("--correct", "Also write the pose shifted by what the new scans show, where that is no chance.")
    ] = False,
    limit_mm: Annotated[
        float | None,
        option(
            "--limit-mm",
            "MM",
            "Largest median error of the new scans.",
            show_default="from what the calibration states; 1 % false alarms",
        ),
    ] = None,
    pose: Annotated[
        str | None, option("--pose", "NAME", "The key of the pose, where the file of RESULT holds several.")
    ] = None,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    board: BoardOption = None,
) -> Outcome:
    """Verify a calibration on scans, pairs of poses or pictures that it did not use: a verdict, and the error of each.

    Scans of the flange give position error and tilt at the flange. Pairs of robot and camera poses, or pictures of a
    board (--board), give the error of any stated pose of a camera. With --touch or --scenario: by points that the tip
    touched, each against the stated 95 % region. The exit code is 1 where the verdict is "do not use".
    """
    if sum(given is not None for given in (dataset, touch, scenario)) != 1:
        raise typer.BadParameter(
            "give a folder of new scans, touched points (--touch FILE) or a cell (--scenario NAME)"
        )
    if correct and (dataset is None or board is not None or not holds_scans(dataset)):
        raise typer.BadParameter("--correct is for scans of a flange")
    if correct and not call.reading.get(OF_SCANS, True):
        raise typer.BadParameter("--correct shifts the pose of corrected points: leave out --as scanner-correction=no")
    if touch is not None or scenario is not None:
        from weldcal.tools.commands.touch import live_touches_outcome, touches_outcome
    if scenario is not None:
        return live_touches_outcome(call, result, scenario, robot or "simulated")
    if touch is not None or dataset is None:
        assert touch is not None
        return touches_outcome(call, result, touch)
    named = {"--unit": unit, "--robot-poses": robot_poses, "--camera-poses": camera_poses}
    of_pairs = [(name, value) for name, value in named.items() if value is not None]
    of_pairs += [("--as", f"{key}={value}") for key, value in call.reading.items() if key != OF_SCANS]
    if board is not None or not holds_scans(dataset):
        known = PairsOptions(
            mounting=mounting,
            unit=unit,
            stated=replace(stated_lists(call, robot_poses, camera_poses), arm=robot),
            pose=pose,
            board=board,
            intrinsics=call.reading.get("intrinsics"),
            seed=call.seed,
        )
        words = (word for name, value in of_pairs for word in (name, shlex.quote(value)))
        folder = call.folder("verify", dataset.resolve().stem)
        paired = verify_on_pairs(result, dataset, folder, known, limit_mm=limit_mm, options=tuple(words))
        return Outcome(paired.summary(), values={}, rows=paired.rows(), first=paired.first)
    if of_pairs or mounting is not None:
        surplus = " ".join(of_pairs[0]) if of_pairs else "--mounting"
        raise typer.BadParameter(f"{surplus} is for pairs of poses, and '{dataset.name}' holds scans of a flange")
    asked = VerifyOptions(
        flange=flange,
        robot=robot,
        correct_scanner=call.reading.get(OF_SCANS, True),
        limit_mm=limit_mm,
        pose=pose,
        correct=correct,
        seed=call.seed,
    )
    report = verify_dataset(result, dataset, call.folder("verify", dataset.resolve().name), asked, call.progress)
    summary = report.summary()
    return Outcome(
        summary,
        values={key: value for key, value in summary.items() if key not in ("verdict", "reason")},
        rows=report.interval_rows,
        first=report.first,
    )
