"""weldcal finger calibrate: the finger camera, its tag and the soft tip, from pictures; finger loading: its creep."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from numpy.typing import NDArray

from weldcal.calibration.data.checks import read_rows
from weldcal.calibration.hand_eye.pictures.camera import CameraEstimate, calibrate_camera
from weldcal.models.array_files import read_grey_image
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.finger_file import SCHEMA
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.tools.cli.options import LOOK, Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.camera import left_out, named_board
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, Next, Tolerance, check_limit
from weldcal.tools.report.page import Bullets, Section, TableRows, page_html
from weldcal.tools.report.render import write_atomic
from weldcal.welding.finger.calibration import TipCalibration, calibrate_tip
from weldcal.welding.finger.creep import LoadingError, LoadingEstimate, estimate_loading
from weldcal.welding.finger.deformation import TagModel, TagObservation, deflection_from_tag, detect_tag

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
COLUMNS = ("x_mm", "y_mm", "z_mm")
FORCES = ("fx_n", "fy_n", "fz_n")
PRESS_M = 0.003  # of a weld, as a rule
ZERO_M = 5e-5  # how far from its zero a tip may be at touch-on: a sixth of the weld's 0.3 mm
_NO_TOUCHES = "Only the camera is calibrated: without touches nothing says how exactly the tip is measured."


@command("finger calibrate", short_help="Calibrate the finger camera, its tag and the soft tip.")
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
    """Calibrate the finger: intrinsics from pictures of the board; tag, seat and stiffness from touches on a known
    plate."""
    report = calibrate_finger(folder, board, touches, call.folder("finger-calibrate", folder.name), tool, limit_mm)
    found = report.document()
    camera = found["camera"]
    values = {
        "focal length": f"{camera['fx']:.2f}, {camera['fy']:.2f} px, +- {camera['focal_sigma_px']:.2f}",
        "principal point": f"{camera['cx']:.2f}, {camera['cy']:.2f} px",
        "reprojection": f"{camera['rms_px']:.3f} px, on held-out pictures {camera['held_out_px']:.3f} px",
        "pictures": (
            f"{camera['pictures']} used, {camera['held_out_pictures']} held out, {len(report.without_board)} without"
            " the board"
        ),
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


@command("finger loading", common=LOOK, short_help="Find the soft tip's creep and loss from a loading cycle.")
def finger_loading(
    call: Call,
    table: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE", help="CSV: t_s, indentation_mm, and force_N, deflection_mm as the tag shows it, or both."
        ),
    ],
) -> Outcome:
    """Find relaxation time, creep and loss of the soft tip, with their sigmas, from one press on a rigid plate: down,
    held, and back until the tip is free."""
    found = read_loading(table)
    tip, (time, creep, loss) = found.tip, found.sigmas
    shown = {"relaxation_s": (tip.relaxation_s, time), "creep_share": (tip.creep_share, creep)}
    shown["loss_share"] = (tip.loss_share, loss)
    summary: dict[str, Any] = {"state": "done", **{key: value for key, (value, _) in shown.items()}}
    summary |= {f"{key}_sigma": sigma for key, (_, sigma) in shown.items()}
    summary["free_s"] = tip.free_s(PRESS_M, ZERO_M)
    summary["concerns"] = list(found.concerns)
    values = {key.replace("_", " "): f"{value:.3g} +- {sigma:.2g}" for key, (value, sigma) in shown.items()}
    if found.stiffness_N_per_m is not None:
        summary["stiffness_N_per_mm"] = 1e-3 * found.stiffness_N_per_m
        values["stiffness"] = f"{1e-3 * found.stiffness_N_per_m:.3g} N/mm, after relaxation"
    values["wait between welds"] = f"{summary['free_s']:.1f} s, until a free tip is {1e3 * ZERO_M:g} mm from its zero"
    values["tool file"] = f"tip: {{{', '.join(f'{key}: {value:.3g}' for key, (value, _) in shown.items())}}}"
    return Outcome(summary, values=values, rows={"open": " ".join(found.concerns) or "nothing"})


def read_loading(table: Path) -> LoadingEstimate:
    """Return the estimate from a table of a loading cycle. Raises InputError where it is none."""
    header, rows = read_rows(table)
    keys = ("t_s", "indentation_mm", *(name for name in ("force_n", "deflection_mm") if name in header))
    if not {"t_s", "indentation_mm"} <= set(header) or len(keys) == 2:
        raise InputError(
            f"'{table.name}' needs the columns t_s, indentation_mm, and force_N, deflection_mm or both; it has"
            f" {', '.join(header) or 'none'}."
        )
    column = {key: np.array([_number(table, line, row, key, "") for line, row in enumerate(rows, 2)]) for key in keys}
    t, u, force = column["t_s"], 1e-3 * column["indentation_mm"], column.get("force_n")
    shown = 1e-3 * column["deflection_mm"] if "deflection_mm" in column else None
    try:
        return estimate_loading(t, u, force, shown)
    except LoadingError as error:
        raise InputError(f"'{table.name}': {error}") from error


@dataclass(frozen=True, kw_only=True, eq=False)
class FingerReport:
    """The camera, the tip (None without touches), and the tag's pose at rest."""

    camera: CameraEstimate
    tip: TipCalibration | None
    tag_size_mm: float | None = None
    tag_at_rest_mm: tuple[float, ...] | None = None  # p_KM
    touches: int = 0
    limit_mm: float | None = None

    @property
    def without_board(self) -> tuple[str, ...]:
        """Names of the pictures that are not used."""
        return left_out(self.camera)

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        There is no work point: the error of a touch that the fit did not use stands in its place; without
        touches the reprojection of pictures that were left out.
        """
        c, tip, K = self.camera, self.tip, self.camera.camera.K
        concerns = [] if tip is None else [f"Open: {text}" for text in tip.unknown]
        lost = f"The board was not found in {len(self.without_board)} pictures ({', '.join(self.without_board[:4])})."
        notes = [lost] if self.without_board else []
        pictures = f"{c.held_out} of {c.used} pictures were left out of a second fit: {c.held_out_px:.3f} px rms"
        more = {
            "camera": (
                f"focal length {K[0, 0]:.2f}, {K[1, 1]:.2f} px, +- {c.sigma[0]:.2f}; centre {K[0, 2]:.2f},"
                f" {K[1, 2]:.2f} px"
            ),
            "pose": "none is computed; the tool file states that of the camera",
        }
        if self.tag_at_rest_mm is not None:
            more["tag at rest"] = "({:.3f}, {:.3f}, {:.3f}) mm in the camera".format(*self.tag_at_rest_mm)
        if tip is None:
            found = Findings(unseen=c.held_out, concerns=concerns, notes=notes, no_tolerance=_NO_TOUCHES)
            after = Next(
                "Touch a plate at known displacements, a picture each, and calibrate again with --touches FILE."
            )
            return FirstScreen(
                found,
                ExpectedError("reprojection of pictures left out", f"{c.held_out_px:.3f} px", pictures),
                after,
                (),
                more,
            )
        error, what = 1e3 * tip.held_out_m, "error of a touch, median"
        tolerance = None if self.limit_mm is None else Tolerance(f"the {what},", error, self.limit_mm, "--limit-mm")
        found = Findings(tolerance=tolerance, unseen=self.touches, concerns=concerns, notes=notes)
        expected = ExpectedError(
            what,
            f"{error:.3f} mm",
            f"of {self.touches} touches, each left out of the fit; too few for a 95 % figure. {pictures}",
        )
        after = Next(
            "Name the finger.yaml in the tool file; then 'weldcal check-cell' with your scenario shows whether the tag"
            " is seen.",
            uses=True,
        )
        return FirstScreen(found, expected, after, (), more)

    def document(self) -> dict[str, Any]:
        """Return the contents of finger.yaml, and the JSON object of the command."""
        K, c = self.camera.camera.K, self.camera
        width, height = c.camera.size or (0, 0)
        found: dict[str, Any] = {
            "schema": SCHEMA,
            "camera": {
                "width": int(width),
                "height": int(height),
                "fx": float(K[0, 0]),
                "fy": float(K[1, 1]),
                "cx": float(K[0, 2]),
                "cy": float(K[1, 2]),
                "distortion": [float(v) for v in c.camera.distortion],
                "rms_px": c.rms_px,
                "held_out_px": c.held_out_px,
                "pictures": c.used,
                "held_out_pictures": c.held_out,
                "focal_sigma_px": float(c.sigma[0]),
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
    folder: Path, board: Path, touches: Path | None, out: Path, tool: Path | None = None, limit_mm: float | None = None
) -> FingerReport:
    """Calibrate from pictures of the board and a table of touches; write finger.yaml and report.html to `out`.

    The table has a picture for each touch. `limit_mm` is the error of a touch that the job allows. `tool` is the
    file of the tool that carries the tag; None: the welding tool.

    Raises:
        InputError: what was given cannot be used; nothing is written.
    """
    check_limit(limit_mm)
    if limit_mm is not None and touches is None:
        raise InputError("--limit-mm is measured by touches: give them with --touches, or omit it.")
    carrier = load_tool(WELDING if tool is None else tool).tool
    report = FingerReport(camera=calibrate_camera(folder, named_board(str(board))), tip=None)
    if touches is not None:
        report = _with_touches(report, touches, carrier)
    report = replace(report, limit_mm=limit_mm)
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / "report.html", finger_page(report, folder))
    write_atomic(out / "finger.yaml", yaml.safe_dump(report.document(), sort_keys=False))
    return report


def finger_page(report: FingerReport, folder: Path) -> str:
    """Return the report as one self-contained HTML text."""
    c, t = report.camera, report.tip
    rows = [
        ("reprojection, rms, of the pictures used", f"{c.rms_px:.3f} px"),
        ("of the pictures left out", f"{c.held_out_px:.3f} px"),
        ("distortion", ", ".join(f"{v:.5f}" for v in c.camera.distortion)),
    ]
    if t is not None and report.tag_size_mm is not None:
        seat = ", ".join("open" if np.isnan(v) else f"{1e3 * v:.3f}" for v in t.seat_m)
        turn = "open" if t.rotation_deg is None else f"{t.rotation_deg:.2f} deg"
        rows += [
            ("tag", f"{report.tag_size_mm:.3f} mm, +- {report.tag_size_mm * t.scale_sigma / t.scale:.3f}"),
            ("seat in the tool's axes", f"{seat} mm"),
            ("turn of the camera's displacements", turn),
            *((f"stiffness along {axis}", f"{1e-3 * v:.2f} N/mm") for axis, v in t.stiffness_N_per_m.items()),
        ]
    sections: list[Section] = [
        ("Figures", [TableRows(rows, text=(0, 1))]),
        ("What the touches leave open", [Bullets([] if t is None else t.unknown)]),
        ("", [Bullets(report.without_board, folded="Pictures without the board")]),
    ]
    title, subtitle = f"Finger calibration from {folder.name}", "Finger camera, its tag and the soft tip"
    return page_html(title, subtitle, sections, first=report.first)


def _require_size(size: tuple[int, int] | None, picture: NDArray[np.uint8], name: Path) -> None:
    found = (picture.shape[1], picture.shape[0])
    if size is not None and found != size:
        raise InputError(
            f"'{name.name}' is {found[0]} x {found[1]}, and the others are {size[0]} x {size[1]}: use one camera mode."
        )


def _with_touches(report: FingerReport, table: Path, tool: WeldingTool) -> FingerReport:
    """Return the report with what the touches show."""
    header, rows = read_rows(table)
    if not {"picture", *COLUMNS} <= set(header):
        raise InputError(
            f"'{table.name}' needs the columns picture, {', '.join(COLUMNS)}; forces are fx_N, fy_N, fz_N."
        )
    camera = report.camera.camera
    tag = TagModel(tool.tag_dictionary, tool.tag_id, tool.tag_size_m)
    R_TK = tool.X_FT.rotation().inverse() @ tool.X_FK.rotation()
    rest: TagObservation | None = None
    pressed, shown, forces = [], [], []
    for line, row in enumerate(rows, 2):
        name = table.parent / row["picture"]
        picture = read_grey_image(name)
        _require_size(report.camera.camera.size, picture, name)
        found = detect_tag(picture, camera.K, tag, distortion=camera.distortion)
        if not found.valid or found.X_KM is None:
            raise InputError(f"'{table.name}', line {line}: no tag was found in {row['picture']}: {found.reason}")
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
    return FingerReport(
        camera=report.camera,
        tip=tip,
        tag_size_mm=1e3 * tag.size_m / tip.scale,
        tag_at_rest_mm=at_rest,
        touches=len(pressed),
    )


def _number(table: Path, line: int, row: dict[str, str], key: str, empty: str = "0") -> float:
    try:
        found = float(row[key] or empty)
    except ValueError:
        found = np.nan
    if not np.isfinite(found):
        raise InputError(f"'{table.name}', line {line}: {key} is '{row[key]}', not a number.")
    return float(found)
