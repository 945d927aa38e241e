"""Describe calibration boards by a string, and find their points in pictures with OpenCV."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array

Grey = NDArray[np.uint8]

FORMS = {
    "chessboard": "chessboard:COLSxROWS:SQUARE",
    "charuco": "charuco:COLSxROWS:SQUARE:MARKER:DICT",
    "circles": "circles:COLSxROWS:PITCH",
    "acircles": "acircles:COLSxROWS:PITCH",
    "tag": "tag:ID:SIZE:DICT",
    "tags": "tags:COLSxROWS:SIZE:GAP:DICT",
}
"""What describes a board, by its kind; lengths in mm."""
EXAMPLES = {
    "chessboard": "chessboard:9x6:25 (9 x 6 inner corners, squares of 25 mm)",
    "charuco": "charuco:8x6:30:22:5X5_100 (8 x 6 squares of 30 mm, markers of 22 mm)",
    "circles": "circles:7x5:20 (7 x 5 circles, 20 mm apart)",
    "acircles": "acircles:4x11:20 (4 circles in each of 11 rows, rows 20 mm apart)",
    "tag": "tag:7:50:APRILTAG_36h11 (number 7, black side 50 mm)",
    "tags": "tags:4x3:40:10:4X4_50 (4 x 3 tags of 40 mm, gaps of 10 mm)",
}
_LARGEST_MM, _MOST = 5000.0, 60
_LARGE_PX, _MIDDLE_PX = 1750, 900  # beyond these a chessboard is searched in reduced pictures first
_REDUCED_PX = (700, 1400)
_SHARPEN = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 0.002)
_DICTIONARIES = {name[5:]: getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.startswith("DICT_")}
SIDE = np.linspace(0.12, 0.88, 25)
"""Places along a tag's side where its edge is measured."""
_CURVED_PX = 100.0  # length of a tag's side from which on its curvature can be measured
_USUAL = "4X4_1000 5X5_1000 6X6_1000 7X7_1000 ARUCO_ORIGINAL APRILTAG_36h11 APRILTAG_25h9"  # dictionaries in use
_TRIED = 8  # pictures that show which layout a board has, or what there is in place of it


@dataclass(frozen=True, kw_only=True)
class Board:
    """A calibration board. Its points lie in the plane z = 0 of the board's frame: x right, y down, z into the board.

    Attributes:
        kind: one of FORMS.
        columns, rows: inner corners (chessboard), squares (charuco), circles or tags.
        size: side of a square or of a tag, or distance of circles, m.
        inner: side of a marker (charuco) or gap between tags (tags), m.
        dictionary: name of the markers' dictionary, or empty.
        id: number of the tag (kind tag).
        layout: 1 for OpenCV's ChArUco layout before 4.6; for tags order of numbers and first corner, see ``layouts``.
        radius: of circles, m, as the pictures show it; 0 until then.
        given: points m of a board of another detector (kind "corners"), which no string describes.
    """

    kind: str
    columns: int = 1
    rows: int = 1
    size: float = 0.0
    inner: float = 0.0
    dictionary: str = ""
    id: int = 0
    layout: int = 0
    radius: float = 0.0
    given: tuple[tuple[float, ...], ...] = ()

    def __str__(self) -> str:
        """Return the string that describes the board."""
        grid, size, inner = f"{self.columns}x{self.rows}", f"{1e3 * self.size:g}", f"{1e3 * self.inner:g}"
        if self.kind in ("charuco", "tags"):
            return f"{self.kind}:{grid}:{size}:{inner}:{self.dictionary}"
        return f"tag:{self.id}:{size}:{self.dictionary}" if self.kind == "tag" else f"{self.kind}:{grid}:{size}"

    @property
    def layouts(self) -> int:
        """Return the number of layouts that share the string and that pictures distinguish."""
        if self.kind == "charuco":
            return 2 if self.rows % 2 == 0 else 1
        return 8 if self.kind == "tags" else 1

    @property
    def opencv(self) -> Any:
        """The board as OpenCV's CharucoBoard; only for charuco."""
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.size, self.inner, dictionary(self.dictionary))
        board.setLegacyPattern(self.layout == 1)
        return board

    @cached_property
    def points(self) -> Array:
        """Points (m, 3) m of the board in its frame, row by row; of tags four corners clockwise from the upper left."""
        xy: NDArray[np.floating[Any]]
        j, i = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        if self.given or self.kind == "charuco":
            return np.array(self.given or self.opencv.getChessboardCorners(), dtype=float)
        if self.kind in ("tag", "tags"):
            corner = self.size * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            corner = corner - 0.5 * self.size if self.kind == "tag" else corner
            first = (self.size + self.inner) * np.stack([j.ravel(), i.ravel()], axis=1)
            xy = (first[:, None] + corner).reshape(-1, 2)
        elif self.kind == "acircles":
            xy = self.size * np.stack([(2 * j + i % 2).ravel(), i.ravel()], axis=1)
        else:
            xy = self.size * np.stack([j.ravel(), i.ravel()], axis=1)
        return np.column_stack([xy, np.zeros(len(xy))]).astype(float)

    @cached_property
    def symmetries(self) -> tuple[NDArray[np.int64], ...]:
        """Orders (m,) of the points that look alike in a picture; the first is the identity."""
        n = self.columns * self.rows
        grid = np.arange(n).reshape(self.rows, self.columns)
        found: list[Any] = [grid]
        if self.kind == "chessboard":
            if (self.columns + self.rows) % 2 == 0:
                found.append(np.rot90(grid, 2))
            if self.columns == self.rows and self.columns % 2 == 0:
                found += [np.rot90(grid, 1), np.rot90(grid, 3)]
        elif self.kind == "circles":
            found.append(np.rot90(grid, 2))
            if self.columns == self.rows:
                found += [np.rot90(grid, 1), np.rot90(grid, 3)]
        elif self.kind == "acircles" and self.rows % 2 == 0:
            found.append(np.rot90(grid, 2))
        else:
            return (np.arange(len(self.points)),)
        return tuple(one.ravel() for one in found)

    @cached_property
    def ids(self) -> dict[int, int]:
        """Place (row by row) of each tag by its number."""
        if self.kind == "tag":
            return {self.id: 0}
        place = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        numbers = place[::-1] if self.layout >= 4 else place
        return {int(n): int(k) for n, k in zip(numbers.ravel(), place.ravel(), strict=True)}


def dictionary(name: str) -> Any:
    """OpenCV's dictionary of markers by its name, such as APRILTAG_36h11. Raises DatasetError for another."""
    plain = re.sub(r"^DICT_", "", name.strip(), flags=re.IGNORECASE).lower()
    family = re.fullmatch(r"(tag)?(16h5|25h9|36h10|36h11)", plain)
    plain = f"apriltag_{family[2]}" if family else plain
    found = next((key for key in _DICTIONARIES if key.lower() == plain), None)
    if found is None:
        raise DatasetError(f"There is no dictionary of markers '{name[:30]}'; use {', '.join(sorted(_DICTIONARIES))}.")
    return cv2.aruco.getPredefinedDictionary(_DICTIONARIES[found])


def parse_board(text: str) -> Board:
    """Return the board that a string describes; see FORMS.

    Raises:
        DatasetError: it describes none; the sentence has the form and an example.
    """
    kind, *words = text.strip().split(":")
    kind = {"checkerboard": "chessboard", "aruco": "tag", "apriltag": "tag"}.get(kind.lower(), kind.lower())
    if kind not in FORMS:
        known = "; ".join(FORMS.values())
        raise DatasetError(
            f"--board '{text[:60]}' names no kind of board. Use {known}. Example: {EXAMPLES['chessboard']}."
        )
    wrong = f"--board '{text[:60]}' is not of the form {FORMS[kind]} with lengths in mm, such as {EXAMPLES[kind]}."
    names = FORMS[kind].split(":")[1:]
    if len(words) != len(names):
        raise DatasetError(wrong)
    found: dict[str, Any] = {}
    for name, word in zip(names, words, strict=True):
        if name == "COLSxROWS":
            match = re.fullmatch(r"\s*(\d+)\s*[xX*]\s*(\d+)\s*", word)
            if match is None:
                raise DatasetError(wrong)
            found["columns"], found["rows"] = int(match[1]), int(match[2])
        elif name == "DICT":
            dictionary(word)
            found["dictionary"] = word.strip()
        elif name == "ID":
            if not word.strip().isdigit():
                raise DatasetError(wrong)
            found["id"] = int(word)
        else:
            match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(mm)?\s*", word)
            if match is None or not 0.0 < float(match[1]) <= _LARGEST_MM:
                raise DatasetError(wrong)
            found["inner" if name in ("MARKER", "GAP") else "size"] = 1e-3 * float(match[1])
    _check(kind, found, text)
    return Board(kind=kind, **found)


def _check(kind: str, found: dict[str, Any], text: str) -> None:
    grid = (found.get("columns", 9), found.get("rows", 9))
    least = {"tags": 1, "tag": 1, "charuco": 2}.get(kind, 2)
    if not (least <= min(grid) and max(grid) <= _MOST) or (kind != "tag" and grid[0] * grid[1] < 2):
        raise DatasetError(f"--board '{text[:60]}': a board has {least} to {_MOST} columns and rows.")
    if kind == "chessboard" and min(grid) < 3:
        raise DatasetError(f"--board '{text[:60]}': a chessboard has 3 x 3 inner corners or more.")
    if kind == "charuco" and found["inner"] >= found["size"]:
        raise DatasetError(
            f"--board '{text[:60]}': the markers ({1e3 * found['inner']:g} mm) must be smaller than the squares."
        )
    if "dictionary" in found:
        most, name = len(dictionary(found["dictionary"]).bytesList), found["dictionary"]
        needed = {"tag": found.get("id", 0) + 1, "charuco": grid[0] * grid[1] // 2}.get(kind, grid[0] * grid[1])
        if needed > most:
            raise DatasetError(
                f"--board '{text[:60]}': the dictionary {name} has {most} markers, and {needed} are needed."
            )


def find_board(grey: Grey, board: Board) -> Array:
    """Points (m, 2) px of a board in a picture, NaN where not found; the first pixel's centre is (0, 0)."""
    none = np.full((len(board.points), 2), np.nan)
    finders = {"chessboard": _chessboard, "charuco": _charuco, "tag": _tags, "tags": _tags}
    find = finders.get(board.kind)
    found = find_circles(grey, board)[0] if find is None else find(grey, board)
    return none if found is None else found


def with_layout(greys: Sequence[Grey], board: Board) -> Board:
    """Return the board with the layout that agrees best with the pictures."""
    if board.layouts == 1:
        return board
    if board.kind == "charuco":
        tried = [replace(board, layout=k) for k in range(board.layouts)]
        count = [sum(int(np.isfinite(find_board(g, one)[:, 0]).sum()) for g in greys[:_TRIED]) for one in tried]
        return tried[int(np.argmax(count))]
    best, least = board, np.inf
    markers = [_markers(grey, board) for grey in greys[:_TRIED]]
    for layout in range(board.layouts):
        one = replace(board, layout=layout)
        errors = [e for found in markers if (e := _off_plane(_placed(found, one), one)) is not None]
        if errors and float(np.median(errors)) < 0.5 * least:
            best, least = one, float(np.median(errors))
    return best


def _off_plane(points: Array | None, board: Board) -> float | None:
    """Rms distance px of the points from a homography of the board; None with fewer than two tags."""
    seen = np.zeros(0, dtype=bool) if points is None else np.isfinite(points[:, 0])
    if points is None or int(seen.sum()) < 8:
        return None
    H: Any = cv2.findHomography(board.points[seen, :2], points[seen])[0]
    if H is None:
        return None
    back = cv2.perspectiveTransform(board.points[seen, None, :2], H)[:, 0]
    return float(np.sqrt(((back - points[seen]) ** 2).sum(axis=1).mean()))


def _right_handed(points: Array, columns: int, rows: int) -> bool:
    """Return whether the columns go to the right of the rows' direction, as on a board from its front."""
    grid = points.reshape(rows, columns, 2)
    right, down = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    return bool(right[0] * down[1] - right[1] * down[0] > 0.0)


def _chessboard(grey: Grey, board: Board) -> Array | None:
    size, width, plain = (board.columns, board.rows), max(grey.shape), cv2.CALIB_CB_NORMALIZE_IMAGE
    smaller = [(_REDUCED_PX[0] / width, plain)] * (width > _MIDDLE_PX)
    ways = [*smaller, (1.0, plain), (1.0, plain | cv2.CALIB_CB_ACCURACY)]
    if width > _LARGE_PX:
        ways = [(min(px / width, 1.0), plain) for px in (*_REDUCED_PX, width)]
    if (rough := next((found for way in ways if (found := _search(grey, size, *way)) is not None), None)) is None:
        return None
    there = rough.reshape(board.rows, board.columns, 2)
    gap = min(float(np.linalg.norm(np.diff(there, axis=k), axis=2).min()) for k in (0, 1))
    half = int(np.clip(0.3 * gap, 3, 15))
    fine = cv2.cornerSubPix(grey, np.ascontiguousarray(rough[:, None], np.float32), (half, half), (-1, -1), _SHARPEN)
    points = np.asarray(fine, dtype=float)[:, 0]
    grid = points.reshape(board.rows, board.columns, 2)
    if not _right_handed(points, board.columns, board.rows):
        grid = grid[:, ::-1]
    if (board.columns + board.rows) % 2 and not _dark(grey, grid):
        grid = grid[::-1, ::-1]
    elif board.columns == board.rows and board.columns % 2 and not _dark(grey, grid):
        grid = np.rot90(grid)
    return np.asarray(grid.reshape(-1, 2))


def _smaller(grey: Grey, scale: float) -> Grey:
    if scale >= 1.0:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _search(grey: Grey, size: tuple[int, int], scale: float, flags: int) -> Array | None:
    """Corners (m, 2) px of a chessboard, in the whole picture, searched in a picture reduced by ``scale``."""
    found, points = cv2.findChessboardCornersSB(_smaller(grey, scale), size, flags=flags)
    return (np.asarray(points, dtype=float)[:, 0] + 0.5) / scale - 0.5 if found else None


def _dark(grey: Grey, grid: Array) -> bool:
    """Return whether the square between the first four corners is darker than its neighbours."""
    centre = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    u = np.clip(np.rint(centre).astype(int), 0, [grey.shape[1] - 1, grey.shape[0] - 1])
    value = grey[u[..., 1], u[..., 0]].astype(float)
    even = np.add.outer(np.arange(value.shape[0]), np.arange(value.shape[1])) % 2 == 0
    return bool(value[even].mean() < value[~even].mean())


def _parameters(**more: object) -> Any:
    found = cv2.aruco.DetectorParameters()
    found.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found.relativeCornerRefinmentWinSize = 0.3
    found.cornerRefinementMaxIterations = 60
    found.cornerRefinementMinAccuracy = 0.005
    for key, value in more.items():
        setattr(found, key, value)
    return found


def _charuco(grey: Grey, board: Board) -> Array | None:
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv).detectBoard(grey)
    if ids is None or len(ids) < 4:
        return None
    out = np.full((len(board.points), 2), np.nan)
    out[np.ravel(ids)] = np.asarray(corners, dtype=float).reshape(-1, 2)
    seen = board.points[np.ravel(ids), :2]
    # corners of one row of squares give no pose
    return out if np.linalg.matrix_rank(seen - seen.mean(axis=0), tol=0.5 * board.size) == 2 else None


def _markers(grey: Grey, board: Board) -> dict[int, Array]:
    """Corners (4, 2) px of every marker of the board's dictionary and border width, by its number."""
    found: dict[int, Array] = {}
    near = {"minMarkerDistanceRate": 0.02}  # of tags whose edge is near that of the paper
    for more, border in (({}, 1), ({}, 2), (near, 1)):
        if len(found) >= len(board.ids):
            break
        detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), _parameters(markerBorderBits=border, **more))
        corners, ids, _ = detector.detectMarkers(grey)
        if ids is not None and len(ids) > len(found):
            places = np.asarray(corners, dtype=float).reshape(-1, 4, 2)
            found = {int(k): corner for k, corner in zip(ids.ravel(), places, strict=True)}
    return found


def _by_sides(grey: Grey, corners: Array) -> Array:
    """Corners (4, 2) px where lines along the sides meet: blur pulls a corner alone inwards."""
    side = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    reach = float(np.clip(0.06 * side.min(), 2.0, 5.0))
    s, t = np.linspace(-reach, reach, int(8 * reach) | 1), SIDE
    lines = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        out = np.array([along[1], -along[0]])
        at = (a + t[:, None] * (b - a))[:, None] + s[:, None] * out
        u, v = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
        value = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        slope = np.clip(np.gradient(value.astype(float), axis=1), 0.0, None)
        slope = np.where(slope > 0.3 * slope.max(axis=1, keepdims=True), slope, 0.0)
        total = slope.sum(axis=1)
        strong = total > 0.5 * np.median(total)
        if np.median(total) < 10.0 or int(strong.sum()) < 8:
            return corners
        place = (slope @ s)[strong] / total[strong]
        keep = np.ones(len(place), dtype=bool)
        degree = degree_of(a, b)
        for _ in range(3):
            curve = np.polyfit(t[strong][keep], place[keep], degree)
            off = np.abs(np.polyval(curve, t[strong]) - place)
            keep = off <= max(3.0 * float(np.median(off)), 0.05)
        lines.append(tangents(a, b, curve))
    fine = meets(lines)
    return fine if float(np.linalg.norm(fine - corners, axis=1).max()) < reach else corners


def degree_of(a: Array, b: Array) -> int:
    """Degree of the curve that is fitted to a tag's side from a to b px, which a lens bends."""
    return 2 if np.linalg.norm(b - a) > _CURVED_PX else 1


def tangents(a: Array, b: Array, curve: Array) -> list[Array]:
    """Lines (3,) along the ends of a tag's side a to b px, ``curve`` (polynomial of 0 to 1) px outside its chord."""
    out = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
    feet = [a + e * (b - a) + np.polyval(curve, e) * out for e in (0.0, 1.0)]
    ways = [b - a + np.polyval(np.polyder(curve), e) * out for e in (0.0, 1.0)]
    return [np.cross([*foot, 1.0], [*(foot + way), 1.0]) for foot, way in zip(feet, ways, strict=True)]


def meets(lines: Sequence[list[Array]]) -> Array:
    """Corners (4, 2) px of a tag from the lines along the ends of its sides."""
    found = np.array([np.cross(lines[k - 1][1], lines[k][0]) for k in range(4)])
    return np.asarray(found[:, :2] / found[:, 2:])


def _placed(found: dict[int, Array], board: Board) -> Array | None:
    out = np.full((len(board.points), 2), np.nan)
    for number, corners in found.items():
        place = board.ids.get(number)
        if place is not None:
            out[4 * place : 4 * place + 4] = np.roll(corners, board.layout % 4, axis=0)
    return out if np.isfinite(out).any() else None


def _tags(grey: Grey, board: Board) -> Array | None:
    found = {k: _by_sides(grey, corners) for k, corners in _markers(grey, board).items() if k in board.ids}
    return _placed(found, board)


def find_circles(grey: Grey, board: Board) -> tuple[Array | None, float]:
    """Centroids (m, 2) px of a board's circles, and the circles' radius, m; None and NaN where they are not found."""
    kind = cv2.CALIB_CB_SYMMETRIC_GRID if board.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    size, scales = (board.columns, board.rows), {min(1.0, 1000.0 / max(grey.shape)), 1.0}
    for colour, scale in ((c, s) for c in (0, 255) for s in sorted(scales)):
        small = _smaller(grey, scale)
        detector = _blobs(small, colour)
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            found, points = cv2.findCirclesGrid(small, size, flags=flags, blobDetector=detector)
            if found:
                rough = (np.asarray(points, dtype=float)[:, 0] + 0.5) / scale - 0.5
                centres, areas = _centres(grey, rough, colour)
                order = _in_order(centres, board)
                return centres[order], _radius(centres[order], areas[order], board)
    return None, np.nan


def _radius(centres: Array, areas: Array, board: Board) -> float:
    """Radius m of a board's circles from their areas px^2, by the homography of their centres."""
    H: Any = cv2.findHomography(board.points[:, :2], centres)[0]
    if H is None:
        return np.nan
    w = np.column_stack([board.points[:, :2], np.ones(len(centres))]) @ H[2]
    return float(np.sqrt(np.nanmedian(areas * np.abs(w) ** 3) / (np.pi * abs(np.linalg.det(H)))))


def _blobs(grey: Grey, colour: int) -> Any:
    opencv: Any = cv2  # its types lack the blob detector
    settings = opencv.SimpleBlobDetector_Params()
    settings.filterByColor, settings.blobColor = True, colour
    settings.filterByArea, settings.minArea, settings.maxArea = True, 20.0, 0.02 * grey.size
    settings.filterByCircularity = False
    settings.filterByInertia, settings.minInertiaRatio = True, 0.1
    settings.filterByConvexity, settings.minConvexity = True, 0.85
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 20.0, 230.0, 15.0
    settings.minDistBetweenBlobs = 4.0
    return opencv.SimpleBlobDetector_create(settings)


def _centres(grey: Grey, points: Array, colour: int) -> tuple[Array, Array]:
    """Centroids (m, 2) px of circles' contrast in the whole picture, and areas (m,) px^2; NaN where not clear."""
    far = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(far, np.inf)
    out, areas = points.copy(), np.full(len(points), np.nan)
    for k, (u, v) in enumerate(points):
        half = int(np.ceil(0.5 * far[k].min()))
        x0, y0 = max(round(u) - half, 0), max(round(v) - half, 0)
        window = grey[y0 : round(v) + half + 1, x0 : round(u) + half + 1].astype(float)
        window = window if colour else 255.0 - window
        low, high = np.percentile(window, 15), np.percentile(window, 97)
        _, labels = cv2.connectedComponents((window > 0.5 * (low + high)).astype(np.uint8))
        own = labels == labels[min(round(v) - y0, window.shape[0] - 1), min(round(u) - x0, window.shape[1] - 1)]
        own = cv2.dilate(own.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        weight = np.where(own, np.clip(window - low, 0.0, None), 0.0)
        if weight.sum() > 0.0:
            y, x = np.mgrid[: window.shape[0], : window.shape[1]]
            centre = np.array([x0 + (weight * x).sum() / weight.sum(), y0 + (weight * y).sum() / weight.sum()])
            if float(np.linalg.norm(centre - points[k])) < 0.25 * half:
                out[k], areas[k] = centre, weight.sum() / (high - low)
    return out, areas


def _in_order(points: Array, board: Board) -> NDArray[np.int64]:
    """Return the order (m,) in which points that OpenCV found are the board's."""
    order = np.arange(len(points)).reshape(board.rows, board.columns)
    if not _right_handed(points, board.columns, board.rows):
        order = order[:, ::-1] if board.kind == "circles" else order[::-1]
    return order.ravel()


def what_is_there(greys: Sequence[Grey], board: Board) -> str:
    """What the first pictures show in place of the board, or empty where nothing is known."""
    for grey in greys[:_TRIED]:
        if board.kind in ("charuco", "tag", "tags"):
            markers = _markers(grey, board)
            if markers:
                ids = ", ".join(str(k) for k in sorted(markers)[:12])
                what = "" if board.kind != "charuco" else " and the squares do not fit them"
                return f"markers of {board.dictionary} were found ({ids}){what}"
            for name in _USUAL.split():
                markers = _markers(grey, replace(board, dictionary=name))
                if len(markers) > 1 or (board.kind == "tag" and markers):
                    ids = ", ".join(str(k) for k in sorted(markers)[:12])
                    return f"markers of {name} were found ({ids}), none of {board.dictionary}"
        small = _smaller(grey, min(1.0, _REDUCED_PX[-1] / max(grey.shape)))
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
        if found and meta is not None:
            rows, columns = sorted(meta.shape[:2])
            asked = f", not {board.columns}x{board.rows}" if board.kind == "chessboard" else ""
            return f"{columns}x{rows} inner corners of a chessboard were found{asked}"
    return ""
