"""weldcal print-board: a calibration board or tags as PDF at true scale."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
import yaml

from weldcal.calibration.hand_eye.pictures.boards import EXAMPLES, FORMS, dictionary, parse_board
from weldcal.calibration.hand_eye.pictures.boards import Board as DescribedBoard
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.render import write_atomic
from weldcal.welding.finger.deformation import TagModel, dictionary_named, tag_cells

PAPERS = {"A5": (148.0, 210.0), "A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of papers, mm."""
MARGIN_MM, RULER_MM, FOOT_MM = 12.0, 100.0, 34.0
POINTS_PER_MM = 72.0 / 25.4
QUIET = 0.25  # white margin around a tag, of its side: OpenCV needs one of its cells
NOTE = "Print at 100 %, not fitted to the page. This line is 100 mm long: measure it."
Rectangle = tuple[float, float, float, float]
"""x, y of the lower left corner, width, height, mm."""


@command("print-board", short_help="Write a calibration board or tags as PDF at true scale.")
def print_board(
    call: Call,
    board: Annotated[
        str, typer.Argument(metavar="[BOARD]", help=f"As hand-eye --board: {', '.join(FORMS.values())}.")
    ] = "charuco:8x6:4:3:4X4_50",
    copies: Annotated[int, option("--copies", "N", "Copies of a single tag.", min=1, max=500)] = 1,
    paper: Annotated[str, option("--paper", "NAME", "A5, A4, A3 or letter.")] = "A4",
) -> Outcome:
    """Write a board or a tag as board.pdf at true scale, with a line of 100 mm to check the print by."""
    described = parse_board(board)
    if copies == 1:
        sheet = described_sheet(described, paper)
    elif described.kind == "tag":
        sheet = tag_sheet([TagModel(described.dictionary, described.id, described.size)] * copies, paper)
    else:
        raise InputError(f"--copies is for a single tag, such as {EXAMPLES['tag'].split()[0]}, not for '{board}'.")
    written = write_board(call.folder("print-board", described.kind), sheet, described)
    return Outcome({"state": "done", "kind": described.kind, **written, "note": NOTE})


@dataclass(kw_only=True)
class Sheet:
    """A page in mm: black rectangles, white ones over them, thin lines (x0, y0, x1, y1), texts (x, y, size, words)."""

    width: float
    height: float
    black: list[Rectangle] = field(default_factory=list)
    white: list[Rectangle] = field(default_factory=list)
    lines: list[Rectangle] = field(default_factory=list)
    texts: list[tuple[float, float, float, str]] = field(default_factory=list)
    discs: list[tuple[float, float, float]] = field(default_factory=list)  # x, y and radius of black discs
    origin: tuple[float, float] = (0.0, 0.0)  # of the frame of the board that it shows

    def marker(self, cells: np.ndarray, x: float, y: float, side: float) -> None:
        """A marker with its lower left corner at x, y; `cells` (n, n) is 1 where it is white, its first row on top."""
        n = len(cells)
        step = side / n
        self.black.append((x, y, side, side))
        for row in range(n):
            column = 0
            while column < n:
                run = column
                while run < n and cells[row, run]:
                    run += 1
                if run > column:
                    self.white.append((x + column * step, y + (n - 1 - row) * step, (run - column) * step, step))
                column = max(run, column + 1)

    def ruler(self, words: str) -> None:
        """The line to measure, at the foot of the page, with a tick every 10 mm, and what the sheet shows."""
        x = 0.5 * (self.width - RULER_MM)
        self.lines.append((x, MARGIN_MM + 8.0, x + RULER_MM, MARGIN_MM + 8.0))
        for k in range(11):
            self.lines.append((x + 10.0 * k, MARGIN_MM + 8.0, x + 10.0 * k, MARGIN_MM + (12.0 if k % 5 == 0 else 10.0)))
        self.texts.append((x, MARGIN_MM + 3.0, 3.0, NOTE))
        self.texts.append((x, MARGIN_MM - 1.5, 3.0, words))

    def pdf(self) -> bytes:
        """Return the page as a PDF file of version 1.4, uncompressed."""
        draw = [f"{POINTS_PER_MM:.9f} 0 0 {POINTS_PER_MM:.9f} 0 0 cm"]
        for colour, rectangles in ((0, self.black), (1, self.white)):
            draw.append(f"{colour} g")
            draw += [f"{x:.4f} {y:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in rectangles]
            draw.append("f" if rectangles else "n")
        draw.append("0 g")
        for x, y, r in self.discs:
            h = 0.5522847498 * r  # control points of four Bezier curves that follow a circle to 0.03 % of its radius
            draw.append(f"{x + r:.4f} {y:.4f} m")
            for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
                first, second, end = (
                    ((a * r, b * h), (a * h, b * r), (0.0, b * r))
                    if a == b
                    else ((a * h, b * r), (a * r, b * h), (a * r, 0.0))
                )
                draw.append(" ".join(f"{x + u:.4f} {y + v:.4f}" for u, v in (first, second, end)) + " c")
            draw.append("f")
        draw.append("0 G 0.15 w")
        draw += [f"{x0:.4f} {y0:.4f} m {x1:.4f} {y1:.4f} l S" for x0, y0, x1, y1 in self.lines]
        draw.append("0 g")
        draw += [
            f"BT /F {size:.2f} Tf {x:.4f} {y:.4f} Td ({_escaped(words)}) Tj ET" for x, y, size, words in self.texts
        ]
        stream = "\n".join(draw).encode("latin-1", "replace")
        box = f"0 0 {self.width * POINTS_PER_MM:.4f} {self.height * POINTS_PER_MM:.4f}"
        objects = [
            # a viewer is asked not to scale the page either
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents 4 0 R "
            "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
        out, offsets = bytearray(b"%PDF-1.4\n"), []
        for number, body in enumerate(objects, 1):
            offsets.append(len(out))
            out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
        start = len(out)
        out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
        out += b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
        out += b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
        return bytes(out)


@dataclass(frozen=True)
class CharucoBoard:
    """A ChArUco board: squares, their side and that of the markers in mm, and the markers' dictionary."""

    columns: int = 8
    rows: int = 6
    square_mm: float = 4.0
    marker_mm: float = 3.0
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        if not (2 <= self.columns <= 60 and 2 <= self.rows <= 60 and self.columns * self.rows >= 6):
            raise InputError("A board has 2 to 60 columns and rows, and six squares or more.")
        if not 0.0 < self.marker_mm < self.square_mm <= 500.0:
            raise InputError("The markers of a board are smaller than its squares, and a square is at most 500 mm.")
        most = len(dictionary_named(self.dictionary).bytesList)
        if self.columns * self.rows // 2 > most:
            raise InputError(f"The dictionary {self.dictionary} has {most} markers: take fewer squares or another one.")

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """Return the board in m, for OpenCV."""
        sides = (1e-3 * self.square_mm, 1e-3 * self.marker_mm)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), *sides, dictionary_named(self.dictionary))


def described_sheet(board: DescribedBoard, paper: str) -> Sheet:
    """What a description of a board says, in the middle of a page, with the description.

    Raises InputError where it does not fit.
    """
    sheet = _page(paper)
    size, gap = 1e3 * board.size, 1e3 * board.inner
    points = 1e3 * board.points[:, :2]
    # the rectangle of all that is black, in the board's frame: x right, y down
    outside = {"chessboard": size, "circles": 0.25 * size, "acircles": 0.5 * size, "charuco": size}.get(board.kind, 0.0)
    low, high = points.min(axis=0) - outside, points.max(axis=0) + outside
    width, height = (float(v) for v in high - low)
    side = Sheet(width=sheet.height, height=sheet.width)
    if (
        sheet.width - 2.0 * MARGIN_MM < width <= side.width - 2.0 * MARGIN_MM
        and height <= side.height - 2.0 * MARGIN_MM - FOOT_MM
    ):
        sheet = side
    _require_space(sheet, width, height, paper)
    x0 = 0.5 * (sheet.width - width) - low[0]
    y0 = 0.5 * (sheet.height + FOOT_MM + height) + low[1]  # of the board's origin, y up
    sheet.origin = (x0, y0)
    if board.kind in ("chessboard", "charuco"):
        columns, rows = (
            (board.columns + 1, board.rows + 1) if board.kind == "chessboard" else (board.columns, board.rows)
        )
        for i in range(rows):
            for j in range(columns):
                if (i + j) % 2 == 0:
                    sheet.black.append((x0 + low[0] + j * size, y0 - low[1] - (i + 1) * size, size, size))
    if board.kind == "charuco":
        found = board.opencv
        for corners, marker in zip(found.getObjPoints(), np.ravel(found.getIds()), strict=True):
            left, top = 1e3 * np.asarray(corners).min(axis=0)[:2]
            sheet.marker(marker_cells(board.dictionary, int(marker)), x0 + left, y0 - top - gap, gap)
    elif board.kind in ("tag", "tags"):
        for number, place in board.ids.items():
            left, top = points[4 * place]
            sheet.marker(marker_cells(board.dictionary, number), x0 + left, y0 - top - size, size)
    elif board.kind in ("circles", "acircles"):
        radius = (0.25 if board.kind == "circles" else 0.45) * size
        sheet.discs += [(x0 + u, y0 - v, radius) for u, v in points]
    sheet.ruler(f"--board {board}")
    return sheet


def marker_cells(name: str, number: int) -> np.ndarray:
    """Cells (n, n) of a marker with its border of one cell, 1 where it is white."""
    found = dictionary(name)
    side = int(found.markerSize) + 2
    return np.asarray(cv2.aruco.generateImageMarker(found, number, side) > 127, dtype=np.uint8)


def tag_sheet(tags: Iterable[TagModel], paper: str) -> Sheet:
    """Tags in rows, each with its white margin inside a line to cut along. Raises InputError where they do not fit."""
    sheet, tags = _page(paper), list(tags)
    if not tags:
        raise InputError("Give the number of at least one tag.")
    side = 1e3 * max(tag.size_m for tag in tags)
    cell = side * (1.0 + 2.0 * QUIET)
    per_row = int((sheet.width - 2.0 * MARGIN_MM) // (cell + 2.0))
    rows = -(-len(tags) // per_row) if per_row else 0
    _require_space(sheet, cell, max(rows, 1) * (cell + 2.0), paper)
    for k, tag in enumerate(tags):
        x = MARGIN_MM + (k % per_row) * (cell + 2.0)
        y = sheet.height - MARGIN_MM - (k // per_row + 1) * (cell + 2.0)
        sheet.marker(tag_cells(tag), x + QUIET * side, y + QUIET * side, 1e3 * tag.size_m)
        edges = (
            (x, y, x + cell, y),
            (x, y + cell, x + cell, y + cell),
            (x, y, x, y + cell),
            (x + cell, y, x + cell, y + cell),
        )
        sheet.lines += edges
    numbers = ", ".join(str(number) for number in sorted({tag.id for tag in tags}))
    sheet.ruler(f"Tags {numbers} of {tags[0].dictionary}, black side {side:g} mm")
    return sheet


def write_board(folder: Path, sheet: Sheet, board: DescribedBoard) -> dict[str, str]:
    """Write board.pdf, and board.yaml of a ChArUco board, into a folder; returns their paths by kind."""
    folder.mkdir(parents=True, exist_ok=True)
    written = {"pdf": str(folder / "board.pdf")}
    write_atomic(folder / "board.pdf", sheet.pdf())
    if board.kind == "charuco":
        sides = {"square_mm": round(1e3 * board.size, 9), "marker_mm": round(1e3 * board.inner, 9)}
        keys = {"columns": board.columns, "rows": board.rows, **sides, "dictionary": board.dictionary}
        write_atomic(folder / "board.yaml", yaml.safe_dump({"schema": 1, "board": keys}, sort_keys=False))
        written["board"] = str(folder / "board.yaml")
    return written


def _page(paper: str) -> Sheet:
    if paper not in PAPERS:
        raise InputError(f"There is no paper '{paper}': use one of {', '.join(PAPERS)}.")
    width, height = PAPERS[paper]
    return Sheet(width=width, height=height)


def _require_space(sheet: Sheet, width: float, height: float, paper: str) -> None:
    room = (sheet.width - 2.0 * MARGIN_MM, sheet.height - 2.0 * MARGIN_MM - FOOT_MM)
    if width > room[0] or height > room[1]:
        raise InputError(
            f"{width:.0f} x {height:.0f} mm do not fit on {paper}, whose printable area is {room[0]:.0f} x"
            f" {room[1]:.0f} mm. Take a larger --paper, or fewer or smaller squares."
        )


def _escaped(words: str) -> str:
    return words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
