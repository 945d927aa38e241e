"""A printed board measures what it should: its PDF is rasterised, found by OpenCV and measured in mm of the page."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from weldcal.calibration.hand_eye.pictures.boards import find_board, parse_board
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell.board import PAPERS, CharucoBoard, described_sheet, tag_sheet
from weldcal.welding.finger.deformation import TagModel

DPI = 600
PIXELS_PER_MM = DPI / 25.4
NUMBER = r"(-?\d+\.?\d*)"


class Page:
    """The page as a printer makes it: filled rectangles and thin lines of the PDF's own stream, in pixels."""

    def __init__(self, content: bytes) -> None:
        text = content.decode("latin-1")
        assert text.startswith("%PDF-1.4")
        assert text.endswith("%%EOF\n")
        self._check_offsets(content)
        box = [float(v) for v in re.search(r"/MediaBox \[([^\]]+)\]", text).group(1).split()]  # type: ignore[union-attr]
        self.width_mm, self.height_mm = (v * 25.4 / 72.0 for v in box[2:])
        self.picture = np.full(
            (round(self.height_mm * PIXELS_PER_MM), round(self.width_mm * PIXELS_PER_MM)), 255, np.uint8
        )
        self.lines: list[list[float]] = []
        body = text.split("stream\n", 1)[1].split("\nendstream", 1)[0]
        scale = float(re.match(NUMBER + " 0 0", body).group(1)) * 25.4 / 72.0  # type: ignore[union-attr]
        grey, path, outline = 0, [], []
        for line in body.splitlines():
            *values, operator = line.split()
            if operator == "re":
                path.append([float(v) * scale for v in values])
            elif operator == "m":
                outline = [[float(v) * scale for v in values[:2]]]
            elif operator == "c":
                outline += self._curve(outline[-1], [float(v) * scale for v in values])
            elif operator == "f" and len(outline) > 4:
                top = [(x * PIXELS_PER_MM, (self.height_mm - y) * PIXELS_PER_MM) for x, y in outline]
                cv2.fillPoly(self.picture, [np.round(top).astype(np.int32)], 255 * grey)
                outline = []
            elif operator == "f":
                for rectangle in path:
                    self._fill(rectangle, 255 * grey)
                path = []
            elif operator == "g":
                grey = int(values[0])
            elif operator == "S":
                self.lines.append([float(v) * scale for v in (values[0], values[1], values[3], values[4])])
        self.text = body

    @staticmethod
    def _curve(start: list[float], values: list[float]) -> list[list[float]]:
        """Points of a Bezier curve."""
        p = np.array([start, values[:2], values[2:4], values[4:]])
        t = np.linspace(0.0, 1.0, 20)[1:, None]
        return ((1 - t) ** 3 * p[0] + 3 * t * (1 - t) ** 2 * p[1] + 3 * t**2 * (1 - t) * p[2] + t**3 * p[3]).tolist()

    def _check_offsets(self, content: bytes) -> None:
        start = int(content.rsplit(b"startxref\n", 1)[1].split()[0])
        assert content[start : start + 4] == b"xref"
        for number, entry in enumerate(re.findall(rb"(\d{10}) 00000 n", content), 1):
            assert content[int(entry) :].startswith(b"%d 0 obj" % number)

    def _fill(self, rectangle: list[float], grey: int) -> None:
        x, y, w, h = (v * PIXELS_PER_MM for v in rectangle)
        top = self.picture.shape[0] - y - h
        self.picture[round(top) : round(top + h), round(x) : round(x + w)] = grey


@pytest.mark.parametrize(
    ("board", "paper"),
    [("8x6:4:3:4X4_50", "A4"), ("11x8:15:11:5X5_50", "A4"), ("5x7:30:22.5:4X4_50", "A3"), ("7x6:7.3:5.1:4X4_50", "A5")],
)
def test_the_squares_of_a_board_have_their_size(board: str, paper: str) -> None:
    described = parse_board(f"charuco:{board}")
    page = Page(described_sheet(described, paper).pdf())
    assert (page.width_mm, page.height_mm) == pytest.approx(PAPERS[paper], abs=0.01)
    corners, ids, _, markers = cv2.aruco.CharucoDetector(described.opencv).detectBoard(page.picture)
    assert corners is not None
    assert len(corners) == (described.columns - 1) * (described.rows - 1)
    assert len(markers) == described.columns * described.rows // 2
    found = corners.reshape(-1, 2) / PIXELS_PER_MM
    expected = 1e3 * described.opencv.getChessboardCorners()[ids.ravel(), :2]
    offset = found - expected
    # in every direction and all over the board, to a fifth of a pixel of 0.04 mm
    assert np.abs(offset - offset.mean(axis=0)).max() < 0.02
    middle = found.mean(axis=0)
    assert middle[0] == pytest.approx(0.5 * page.width_mm, abs=0.05)


def test_a_wide_board_is_printed_across_the_page() -> None:
    board = parse_board("chessboard:9x6:20")
    page = Page(described_sheet(board, "A4").pdf())
    assert (page.width_mm, page.height_mm) == pytest.approx((297.0, 210.0), abs=0.01)
    found = find_board(page.picture, board).reshape(6, 9, 2) / PIXELS_PER_MM
    assert np.linalg.norm(np.diff(found, axis=1), axis=2) == pytest.approx(20.0, abs=0.05)


def test_a_tag_has_its_size_and_its_number() -> None:
    tags = [TagModel("4X4_50", number, 0.0125) for number in (7, 7, 31)]
    page = Page(tag_sheet(tags, "letter").pdf())
    found, ids, _ = cv2.aruco.ArucoDetector(
        tags[0] and cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    ).detectMarkers(page.picture)
    assert sorted(ids.ravel().tolist()) == [7, 7, 31]
    for corners in found:
        sides = (
            np.linalg.norm(np.diff(corners.reshape(4, 2)[[0, 1, 2, 3, 0]], axis=0), axis=1) + 1.0
        )  # centres of pixels
        assert sides / PIXELS_PER_MM == pytest.approx(12.5, abs=0.06)


def test_the_line_to_measure_is_100_mm_long_and_says_so() -> None:
    page = Page(described_sheet(parse_board("charuco:8x6:4:3:4X4_50"), "A4").pdf())
    lengths = [np.hypot(x1 - x0, y1 - y0) for x0, y0, x1, y1 in page.lines]
    assert max(lengths) == pytest.approx(100.0, abs=1e-3)
    assert "This line is 100 mm long" in page.text
    assert "--board charuco:8x6:4:3:4X4_50" in page.text


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: CharucoBoard(20, 20, 15.0, 10.0, "4X4_100"), "has 100 markers"),
        (
            lambda: described_sheet(parse_board("charuco:8x6:40:30:4X4_50"), "A4"),
            "320 x 240 mm do not fit on A4, whose printable area is 186 x 239 mm",
        ),
        (lambda: CharucoBoard(8, 6, 4.0, 4.0), "smaller than its squares"),
        (lambda: described_sheet(parse_board("tag:7:10:4X4_50"), "B5"), "There is no paper 'B5'"),
        (lambda: tag_sheet([TagModel("4X4_50", 7, 0.3)], "A4"), "do not fit on A4"),
    ],
)
def test_what_cannot_be_printed_is_a_sentence(make: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        make()  # type: ignore[operator]


def test_the_command_writes_the_page_and_the_boards_numbers(tmp_path: Path) -> None:
    runner = CliRunner()
    done = runner.invoke(app, ["print-board", "charuco:8x6:5:3.5:4X4_50", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["state"] == "done"
    assert yaml.safe_load((tmp_path / "board.yaml").read_text())["board"]["square_mm"] == 5.0
    assert Page((tmp_path / "board.pdf").read_bytes()).width_mm == pytest.approx(210.0, abs=0.01)
    for board, code in (("tag:7:10:4X4_50", 0), ("chessboard:9x6:20", 1)):
        done = runner.invoke(app, ["print-board", board, "--copies", "6", "--out", str(tmp_path / board[:3])])
        assert done.exit_code == code, done.output


@pytest.mark.parametrize(
    "text",
    ["chessboard:7x5:20", "charuco:6x4:25:18:5X5_50", "circles:6x4:25", "acircles:3x5:20", "tag:7:80:APRILTAG_36h11", "tags:3x2:40:10:4X4_50"],
)  # fmt: skip
def test_a_described_board_is_printed_at_true_scale_with_its_description(text: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["print-board", text, "--out", str(tmp_path / "o"), "--json"])
    assert done.exit_code == 0
    page = Page(Path(json.loads(done.stdout.splitlines()[-1])["pdf"]).read_bytes())
    assert f"(--board {text})" in page.text
    scale = 4
    picture = cv2.resize(page.picture, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
    board = parse_board(text)
    found = find_board(picture, board)
    assert np.isfinite(found).all()
    mm = (found - found[0]) / (PIXELS_PER_MM / scale)
    expected = 1e3 * (board.points - board.points[0])[:, :2]
    assert np.abs(np.linalg.norm(mm, axis=1) - np.linalg.norm(expected, axis=1)).max() < 0.15
