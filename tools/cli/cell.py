"""weldcal check-cell, print-board and finger calibrate: what brings a cell with real devices to its first job."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import LOOK, Call, LimitOption, Outcome, command, option


@command("check-cell", common=LOOK, short_help="Check every device of a scenario. Nothing moves.")
def check_cell(
    call: Call,
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="Name of a scenario, or path of its YAML file.")],
) -> Outcome:
    """Look at robot, scanner, finger camera, torch output and computer: each is ok, or what to do. Nothing moves."""
    from weldcal.systems.drivers.ur.readiness.preflight import Preflight
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.tools.commands import check_cell as checking
    from weldcal.tools.commands.check_robot import emit_table

    report = checking.check_cell(load_scenario(scenario), scenario, progress=call.progress)
    rows = tuple(
        check if device == check.name else replace(check, name=f"{device.replace('_', ' ')}: {check.name}")
        for device, check in report.rows
    )
    table = Preflight(host=report.name, checks=rows)
    return Outcome(report.summary(), text=partial(emit_table, table), problem=report.first_problem)


@command("print-board", short_help="Write a calibration board or tags as PDF at true scale.")
def print_board(
    call: Call,
    kind: Annotated[str, typer.Argument(metavar="[KIND]", help="charuco (a board) or tags.")] = "charuco",
    columns: Annotated[int, option("--columns", "N", "Squares of the board across.")] = 8,
    rows: Annotated[int, option("--rows", "N", "Squares of the board down.")] = 6,
    square_mm: Annotated[float, option("--square-mm", "MM", "Side of a square.")] = 4.0,
    marker_mm: Annotated[float, option("--marker-mm", "MM", "Side of a marker in a square.")] = 3.0,
    ids: Annotated[str, option("--ids", "N,N...", "Numbers of the tags.")] = "7",
    size_mm: Annotated[float, option("--size-mm", "MM", "Black side of a tag.")] = 10.0,
    copies: Annotated[int, option("--copies", "N", "Copies of each tag.", min=1, max=500)] = 6,
    dictionary: Annotated[
        str, option("--dictionary", "NAME", "Markers: 4X4_50, 5X5_50, APRILTAG_36h11 ...")
    ] = "4X4_50",
    paper: Annotated[str, option("--paper", "NAME", "A5, A4, A3 or letter.")] = "A4",
) -> Outcome:
    """Write a ChArUco board, or tags, as board.pdf at true scale, with a line of 100 mm to check the print by."""
    from weldcal.models.errors import InputError
    from weldcal.tools.commands import print_board as printing
    from weldcal.welding.finger.deformation import TagModel

    board = None
    if kind == "charuco":
        board = printing.Board(columns, rows, square_mm, marker_mm, dictionary)
        sheet = printing.board_sheet(board, paper)
    elif kind == "tags":
        words = ids.split(",")
        if not all(word.strip().isdigit() for word in words):
            raise InputError(f"--ids must be whole numbers with commas between, not '{ids}'.")
        tags = [TagModel(dictionary, int(word), 1e-3 * size_mm) for word in words for _ in range(copies)]
        sheet = printing.tag_sheet(tags, paper)
    else:
        raise InputError(f"There is no board of the kind '{kind}': use charuco or tags.")
    written = printing.write_board(call.folder("print-board", kind), sheet, board)
    return Outcome({"state": "done", "kind": kind, **written, "note": printing.NOTE})


@command("finger calibrate", short_help="Calibrate the finger camera, its tag and the soft tip from pictures.")
def finger_calibrate(
    call: Call,
    folder: Annotated[Path, typer.Argument(metavar="PICTURES", help="Folder of pictures of the board, png or jpg.")],
    board: Annotated[Path, option("--board", "FILE", "board.yaml of the printed board, from print-board.")],
    touches: Annotated[
        Path | None, option("--touches", "FILE", "Table of touches on a plate: picture, x_mm, y_mm, z_mm, forces.")
    ] = None,
    tool: Annotated[
        Path | None,
        option("--tool", "FILE", "Tool file of the tool that carries the tag.", show_default="the welding tool"),
    ] = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the finger: intrinsics from pictures of the board; tag, seat and stiffness from touches on a known plate."""
    from weldcal.tools.commands.finger_calibrate import calibrate_finger

    report = calibrate_finger(folder, board, touches, call.folder("finger-calibrate", folder.name), tool, limit_mm)
    found = report.document()
    camera = found["camera"]
    values = {
        "focal length": f"{camera['fx']:.2f}, {camera['fy']:.2f} px, +- {camera['focal_sigma_px']:.2f}",
        "principal point": f"{camera['cx']:.2f}, {camera['cy']:.2f} px",
        "reprojection": f"{camera['rms_px']:.3f} px, on held-out pictures {camera['held_out_px']:.3f} px",
        "pictures": f"{camera['pictures']} used, {camera['held_out_pictures']} held out, {len(report.without_board)} without the board",
    }
    if report.tip is not None:
        tag, tip = found["tag"], found["tip"]
        values |= {
            "tag": f"{tag['size_mm']:.3f} mm, +- {tag['sigma_mm']:.3f}",
            "seat": ", ".join("-" if v is None else f"{v:.3f}" for v in tip["seat_mm"]) + " mm",
            "touches": f"held-out error {tip['held_out_mm']:.3f} mm",
            "open": " ".join(tip["unknown"]) or "nothing",
        }
    summary = {"state": "done", "out": str(call.written), "without_board": list(report.without_board), **found}
    return Outcome(summary, values=values, first=report.first)
