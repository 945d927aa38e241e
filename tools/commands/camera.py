"""weldcal camera: camera matrix and distortion with their covariance, from pictures of a board."""

import shlex
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml

from weldcal.calibration.data.camera_file import camera_document
from weldcal.calibration.hand_eye.pictures.boards import FORMS, Board, parse_board
from weldcal.calibration.hand_eye.pictures.camera import NUMBERS, CameraEstimate, calibrate_camera
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, Next
from weldcal.tools.report.page import Bullets, Section, TableRows, page_html
from weldcal.tools.report.render import write_atomic

_NO_LIMIT = "No tolerance is stated in pixels: hand-eye carries the covariance on to millimetres."


@command("camera", keys=("intrinsics",), short_help="Calibrate a camera, with covariance, from pictures.")
def camera(
    call: Call,
    pictures: Annotated[Path, typer.Argument(metavar="PICTURES", help="Folder of pictures of the board, tilted.")],
    board: Annotated[
        str, option("--board", "BOARD", f"The board: {', '.join(FORMS.values())}; or board.yaml from print-board.")
    ],
) -> Outcome:
    """Calibrate a camera from pictures of a board that need not be flat: camera.yaml has camera matrix, distortion and
    covariance. With --as intrinsics=FILE also say whether the camera is still that of the file."""
    found = calibrate_camera(pictures, named_board(board), call.reading.get("intrinsics"))
    out = call.folder("camera", pictures.resolve().name)
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / "camera.yaml", yaml.safe_dump(camera_document(found.camera), sort_keys=False))
    first = camera_screen(found, out / "camera.yaml")
    write_atomic(out / "report.html", camera_page(found, first, pictures))
    values = dict(camera_rows(found))
    summary: dict[str, Any] = {"state": "done", "out": str(out), "file": str(out / "camera.yaml")}
    summary |= camera_document(found.camera)
    summary |= {"rms_px": found.rms_px, "held_out_px": found.held_out_px, "pictures": found.used}
    summary |= {"without_board": list(left_out(found))}
    if found.change is not None:
        summary |= {"changed": found.change.changed, "change_chi2": found.change.square}
        values["since"] = found.change.sentence
    return Outcome(summary, values=values, first=first)


def named_board(board: str) -> Board:
    """The board of a description, or of the board.yaml that `weldcal print-board` wrote. Raises InputError."""
    path = Path(board)
    if not path.is_file():
        return parse_board(board)
    try:
        k = dict(read_document(path)["board"])
        words = f"charuco:{k['columns']}x{k['rows']}:{k['square_mm']}:{k['marker_mm']}:{k['dictionary']}"
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"'{path}' describes no board: give the board.yaml that weldcal print-board wrote.") from error
    return parse_board(words)


def left_out(found: CameraEstimate) -> tuple[str, ...]:
    """Names of the pictures that are not used."""
    return tuple(p.name for p in found.pictures if p.why)


def camera_rows(found: CameraEstimate) -> list[tuple[str, str]]:
    """The camera and the board in words."""
    c, s, b = found.camera, found.sigma, found.bundle
    of = {name: f"{v:.2f} +- {e:.2f}" for name, v, e in zip(NUMBERS[:4], c.numbers, s, strict=False)}
    lens = zip(NUMBERS[4:], c.distortion, s[4:], strict=False)
    return [
        ("focal length", f"{of['fx']}, {of['fy']} px"),
        ("principal point", f"{of['cx']}, {of['cy']} px"),
        ("distortion", ", ".join(f"{name} {v:.4f} +- {e:.4f}" for name, v, e in lens if e > 0.0)),
        ("reprojection", f"{found.rms_px:.3f} px, on held-out pictures {found.held_out_px:.3f} px"),
        ("pictures", f"{found.used} used, {len(left_out(found))} not used"),
        (
            "board",
            f"{found.board}, {1e3 * np.ptp(b.shape[:, 2]):.2f} mm from flat, print"
            f" {100 * (b.terms[0] - b.terms[1]):+.2f}"
            f" % longer along than across (+- {100 * np.hypot(*b.terms_sigma[:2]):.2f} with its common scale)",
        ),
    ]


def camera_screen(found: CameraEstimate, file: Path) -> FirstScreen:
    """Return the first screen of a camera that is written to a file."""
    fx, sigma = found.camera.K[0, 0], found.sigma[0]
    concerns = [found.change.sentence] if found.change is not None and found.change.changed else []
    lost = left_out(found)
    notes = [f"{len(lost)} pictures are not used ({', '.join(lost[:4])})."] if lost else []
    backing = (
        f"{found.used} pictures; {found.held_out} of them, left out of a second fit: {found.held_out_px:.3f} px rms"
    )
    return FirstScreen(
        Findings(unseen=found.held_out, concerns=concerns, notes=notes, no_tolerance=_NO_LIMIT),
        ExpectedError("standard deviation of the focal length", f"{sigma:.2f} px, {100 * sigma / fx:.3f} %", backing),
        Next(f"Give the file to 'weldcal hand-eye' with --as intrinsics={shlex.quote(str(file))}.", uses=True),
        (),
        dict(camera_rows(found)[:2]),
    )


def camera_page(found: CameraEstimate, first: FirstScreen, folder: Path) -> str:
    """Return the report as one self-contained HTML text."""
    left = [f"{p.name}: {p.why}" for p in found.pictures if p.why]
    sections: list[Section] = [
        ("Figures", [TableRows(camera_rows(found), text=(0, 1))]),
        ("", [Bullets(left, folded="Pictures that are not used")]),
    ]
    return page_html(f"Camera from {folder.name}", "Camera matrix, distortion and covariance", sections, first=first)
