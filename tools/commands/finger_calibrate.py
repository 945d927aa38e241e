"""`weldcal finger calibrate`: intrinsics from pictures of a board, tag, seat and stiffness from touches on a known plate."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from weldcal.calibration.data.tables import read_rows
from weldcal.models.arrays import Array
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.models.images import read_grey_image
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.finger_file import SCHEMA
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.tools.commands.print_board import Board
from weldcal.tools.report.render import write_atomic
from weldcal.welding.servo.deformation import TagModel, TagObservation, deflection_from_tag, detect_tag
from weldcal.welding.servo.finger_calibration import (
    Intrinsics,
    TipCalibration,
    calibrate_intrinsics,
    calibrate_tip,
    find_board,
)

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
COLUMNS = ("x_mm", "y_mm", "z_mm")
FORCES = ("fx_n", "fy_n", "fz_n")


@dataclass(frozen=True, eq=False)
class FingerReport:
    """The camera, the tip (None without touches), pictures in which the board was not found, and the tag's pose at rest."""

    camera: Intrinsics
    tip: TipCalibration | None
    without_board: tuple[str, ...]
    tag_size_mm: float | None = None
    tag_at_rest_mm: tuple[float, ...] | None = None  # p_KM

    def document(self) -> dict[str, Any]:
        """The contents of finger.yaml, and the JSON object of the command."""
        K, c = self.camera.K, self.camera
        found: dict[str, Any] = {
            "schema": SCHEMA,
            "camera": {
                "width": c.width,
                "height": c.height,
                "fx": float(K[0, 0]),
                "fy": float(K[1, 1]),
                "cx": float(K[0, 2]),
                "cy": float(K[1, 2]),
                "distortion": [float(v) for v in c.distortion],
                "rms_px": c.rms_px,
                "held_out_px": c.held_out_px,
                "pictures": c.used,
                "held_out_pictures": c.held_out,
                "focal_sigma_px": c.focal_sigma_px,
            },
        }
        if self.tip is not None and self.tag_size_mm is not None:
            t = self.tip
            found["tag"] = {"size_mm": self.tag_size_mm, "sigma_mm": self.tag_size_mm * t.scale_sigma / t.scale}
            if self.tag_at_rest_mm is not None:
                found["tag"]["rest_mm"] = list(self.tag_at_rest_mm)
            found["tip"] = {
                "seat_mm": [None if np.isnan(v) else 1e3 * float(v) for v in t.seat_m],
                "rotation_deg": t.rotation_deg,
                "stiffness_N_per_mm": {axis: 1e-3 * v for axis, v in t.stiffness_N_per_m.items()},
                "held_out_mm": 1e3 * t.held_out_m,
                "unknown": list(t.unknown),
            }
        return found


def calibrate_finger(
    folder: Path, board: Path, touches: Path | None, out: Path, tool: Path | None = None
) -> FingerReport:
    """Calibrate from a folder of pictures of the board, and a table of touches with a picture each; writes finger.yaml to `out`.
    `tool` is the file of the tool that carries the tag; None: the welding tool.

    Raises:
        InputError: what was given cannot be used; nothing is written.
    """
    opencv = read_board(board).opencv()
    carrier = load_tool(WELDING if tool is None else tool).tool
    names = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES) if folder.is_dir() else []
    if not names:
        raise InputError(f"'{folder}' holds no pictures: give the folder of the pictures of the board, png or jpg.")
    seen, without, size = [], [], None
    for name in names:
        picture = read_grey_image(name)
        size = _same_size(size, picture, name)
        found = find_board(picture, opencv)
        if found is None:
            without.append(name.name)
        else:
            seen.append(found)
    assert size is not None
    camera = calibrate_intrinsics(seen, size)
    report = FingerReport(camera, None, tuple(without))
    if touches is not None:
        report = _with_touches(report, touches, size, carrier)
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / "finger.yaml", yaml.safe_dump(report.document(), sort_keys=False))
    return report


def read_board(path: Path) -> Board:
    """The board that `weldcal print-board` described. Raises InputError where the file is no such description."""
    try:
        keys = dict(read_document(path)["board"])
        board = Board(**keys)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"'{path}' describes no board: give the board.yaml that weldcal print-board wrote.") from error
    return board


def _same_size(size: tuple[int, int] | None, picture: NDArray[np.uint8], name: Path) -> tuple[int, int]:
    found = (picture.shape[1], picture.shape[0])
    if size is not None and found != size:
        raise InputError(
            f"'{name.name}' is {found[0]} x {found[1]}, and the others are {size[0]} x {size[1]}: use one camera mode."
        )
    return found


def _with_touches(report: FingerReport, table: Path, size: tuple[int, int], tool: WeldingTool) -> FingerReport:
    """The report with what the touches show."""
    header, rows = read_rows(table)
    if not {"picture", *COLUMNS} <= set(header):
        raise InputError(
            f"'{table.name}' needs the columns picture, {', '.join(COLUMNS)}; forces are fx_N, fy_N, fz_N."
        )
    camera = report.camera
    tag = TagModel(tool.tag_dictionary, tool.tag_id, tool.tag_size_m)
    R_TK = tool.X_FT.rotation().inverse() @ tool.X_FK.rotation()
    rest: TagObservation | None = None
    pressed, shown, forces = [], [], []
    for line, row in enumerate(rows, 2):
        name = table.parent / row["picture"]
        picture = read_grey_image(name)
        _same_size(size, picture, name)
        found = detect_tag(picture, camera.K, tag, distortion=camera.distortion)
        if not found.valid or found.X_KM is None:
            raise InputError(f"'{table.name}', line {line}: the tag is not seen in {row['picture']}: {found.reason}")
        if not any(row[key] for key in COLUMNS):
            rest = found
            continue
        if rest is None or rest.X_KM is None:
            raise InputError(
                f"'{table.name}' must begin with a picture of the free tip, with x_mm, y_mm and z_mm left empty."
            )
        pressed.append([1e-3 * _number(table, line, row, key) for key in COLUMNS])
        shown.append(deflection_from_tag(found.X_KM, rest.X_KM, R_TK))
        forces.append([_number(table, line, row, key) if row.get(key) else np.nan for key in FORCES])
    measured: Array | None = np.array(forces) if np.isfinite(forces).any() else None
    tip = calibrate_tip(np.array(pressed).reshape(-1, 3), np.array(shown).reshape(-1, 3), measured)
    assert rest is not None
    assert rest.X_KM is not None
    at_rest = tuple(float(1e3 * v / tip.scale) for v in rest.X_KM.translation())
    return FingerReport(camera, tip, report.without_board, 1e3 * tag.size_m / tip.scale, at_rest)


def _number(table: Path, line: int, row: dict[str, str], key: str) -> float:
    try:
        found = float(row[key] or "0")
    except ValueError:
        found = np.nan
    if not np.isfinite(found):
        raise InputError(f"'{table.name}', line {line}: {key} is '{row[key]}', not a number.")
    return float(found)
