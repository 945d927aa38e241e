"""Find a folder's pictures and camera file, search a board in the pictures, and estimate the camera."""

import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.camera_file import CameraFile, read_camera
from weldcal.calibration.data.poses.names import natural, number_of
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import exp_rotation, pose
from weldcal.calibration.hand_eye.pictures.boards import (
    EXAMPLES,
    SIDE,
    Board,
    degree_of,
    find_board,
    find_circles,
    meets,
    tangents,
    what_is_there,
    with_layout,
)
from weldcal.models.arrays import Array

ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_OTHER = re.compile(
    r"(?i)(depth|disparity|mask|detected|corners|result|output|annotated|debug|visuali[sz]ation|overlay"
    r"|undistort|rectified)"
)
_CAMERA = re.compile(
    r"(?i)^(camera|cam|camera_?info|camera_?(params?|parameters|matrix|calib\w*|intrinsics?)|camchain.*"
    r"|.*intrinsics?.*|.*ost|calibration|calib"
    r"|sensor|param|params)$"
)
_CAMERA_ENDINGS = (".yaml", ".yml", ".xml", ".json", ".txt", ".npz")
FREE = np.arange(8)
"""Numbers of a camera that are estimated: fx, fy, cx, cy, k1, k2, p1, p2."""
FEWEST = 4
"""Pictures with the board that are needed."""
_CENTRAL = 0.3  # a choice: shares of width and height between which any lens has its principal point
GROSS = 4.0  # a choice: blur and wrong boards are worse; half would drop good pictures at the rim
"""Times the median error of a picture, beyond which it does not fit the camera."""
_K3_LEVEL = 0.999  # at which a third radial coefficient is no chance
_THUMBNAIL_PX = 240
_RING = 32  # points of a circle, or of a tag's side, that is projected
_CENTRED = 2  # corrections of the points, each with the camera that the one before gave


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """One picture.

    Attributes:
        name: of its file.
        points: of the board (m, 2) px; NaN where one was not found.
        size: width and height, px; zeros where it cannot be read.
        thumbnail: a small JPEG with the points drawn.
        why: why it is not used, one sentence; empty where it is.
        rms_px: rms reprojection error; NaN where it is not used.
    """

    name: str
    points: Array
    size: tuple[int, int]
    thumbnail: bytes
    why: str = ""
    rms_px: float = float("nan")

    @property
    def found(self) -> int:
        """Number of points that were found."""
        return int(np.isfinite(self.points[:, 0]).sum())


def picture_files(folder: Path, named: str | None = None) -> list[Path]:
    """The pictures of one kind in a folder, two levels deep, in the natural order of their names.

    Args:
        named: part of the path of the right ones, where the user states it.

    Raises:
        DatasetError: there are none, or several kinds.
    """
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for path in sorted(p for pattern in ("*", "*/*", "*/*/*") for p in folder.glob(pattern)):
        inside = path.relative_to(folder).as_posix()
        if path.suffix.lower() not in ENDINGS or not path.is_file() or path.name.startswith((".", "_")):
            continue
        if named is not None and named not in inside:
            continue
        stem = re.sub(r"\d+$", "", path.stem) if number_of(path.stem) is not None else ""
        groups.setdefault((path.parent, stem, path.suffix.lower()), []).append(path)
    wanted = [g for g in groups.values() if named is not None or not _OTHER.search(g[0].relative_to(folder).as_posix())]
    if not wanted:
        raise DatasetError(
            f"'{folder.resolve().name}' holds no pictures ({', '.join(ENDINGS)}): name the folder that holds them."
        )
    by_place: dict[tuple[Path, str], list[list[Path]]] = {}
    for (parent, stem, _), files in groups.items():
        if files in wanted:
            by_place.setdefault((parent, stem), []).append(files)
    # beside a picture, a TIFF of the same name is a depth image
    kinds = [min(g, key=lambda f: (f[0].suffix.lower() in (".tif", ".tiff"), -len(f))) for g in by_place.values()]
    most = max(len(k) for k in kinds)
    kinds = [k for k in kinds if 2 * len(k) > most]
    if len(kinds) > 1 and len({k[0].parent for k in kinds}) == 1 and all(len(k) == 1 for k in kinds):
        kinds = [[k[0] for k in kinds]]
    if len(kinds) > 1:
        colour = [
            k for k in kinds if re.search(r"(?i)(rgb|colou?r|left|image|img)", k[0].relative_to(folder).as_posix())
        ]
        kinds = colour if len(colour) == 1 else kinds
    if len(kinds) > 1:
        names = ", ".join(repr(k[0].relative_to(folder).as_posix()) for k in kinds[:4])
        raise DatasetError(
            f"'{folder.name}' holds several kinds of pictures ({names}): name the right ones with --camera-poses, by a"
            " part of their path."
        )
    return sorted(kinds[0], key=lambda p: natural(p.name))


def camera_in(folder: Path) -> tuple[Path, CameraFile] | None:
    """Return the file of a folder that is named as a camera's and states one, or None."""
    found = [p for pattern in ("*", "*/*") for p in sorted(folder.glob(pattern)) if p.is_file()]
    for path in found:
        if path.suffix.lower() in _CAMERA_ENDINGS and _CAMERA.match(path.stem):
            try:
                return path, read_camera(path)
            except DatasetError:
                continue
    return None


def load_grey(path: Path) -> NDArray[np.uint8] | None:
    """Return a picture in 8 bits of grey; None where it cannot be read."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError:
        return None
    if not data.size:
        return None
    try:
        image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    if image is None:
        return None
    if image.dtype != np.uint8:
        low, high = np.percentile(image, [0.5, 99.5])
        image = np.clip((image.astype(float) - low) * 255.0 / max(float(high - low), 1.0), 0, 255).astype(np.uint8)
    return np.asarray(image, dtype=np.uint8)


def find_in(
    files: Sequence[Path], board: Board, source: str, known: dict[str, Picture] | None = None
) -> tuple[Board, list[Picture]]:
    """Return the board in every picture, on two threads.

    ``known`` holds the pictures that were searched before, by name, and takes what is found now.

    Raises:
        DatasetError: it is in fewer than four; the sentence says what was found in its place.
    """
    some = (
        [g for g in (load_grey(files[k]) for k in spread(len(files), 6)) if g is not None] if board.layouts > 1 else []
    )
    board = with_layout(some, board)

    radii: list[float] = []

    def one(path: Path) -> Picture:
        grey = load_grey(path)
        none = np.full((len(board.points), 2), np.nan)
        if grey is None:
            return Picture(
                name=path.name, points=none, size=(0, 0), thumbnail=b"", why="It cannot be read as a picture."
            )
        if board.kind in ("circles", "acircles"):
            found, radius = find_circles(grey, board)
            points = none if found is None else found
            radii.append(radius)
        else:
            points = find_board(grey, board)
        least = 4 if board.kind == "tag" else min(8, len(board.points))
        why = ""
        if int(np.isfinite(points[:, 0]).sum()) < least:
            points, why = none, "The board was not found: show it whole, sharp, evenly lit, with a white margin."
        return Picture(
            name=path.name, points=points, size=grey.shape[::-1], thumbnail=_thumbnail(grey, points), why=why
        )

    known = (
        {} if known is None or board.kind in ("circles", "acircles") else known
    )  # of circles the radius is found anew
    with ThreadPoolExecutor(max_workers=2) as pool:
        known |= {p.name: p for p in pool.map(one, [path for path in files if path.name not in known])}
    pictures = [known[path.name] for path in files]
    if np.isfinite(radii).any():
        board = replace(board, radius=float(np.nanmedian(radii)))
    n = sum(not p.why for p in pictures)
    if n < FEWEST:
        some = [g for g in (load_grey(files[k]) for k in spread(len(files), 6)) if g is not None]
        there = what_is_there(some, board)
        raise DatasetError(
            f"The board {board} was found in {n} of {len(files)} pictures of '{source}', and {FEWEST} are needed"
            + (
                f": {there}. Correct --board."
                if there
                else f". Check --board, such as {EXAMPLES[board.kind]}, and the pictures."
            )
        )
    return board, pictures


def spread(n: int, most: int) -> list[int]:
    """At most so many of the indices below n, evenly chosen."""
    return sorted({int(k) for k in np.linspace(0, n - 1, min(n, most)).round()})


def _thumbnail(grey: NDArray[np.uint8], points: Array) -> bytes:
    scale = min(1.0, _THUMBNAIL_PX / max(grey.shape))
    small = cv2.cvtColor(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    for u, v in points[np.isfinite(points[:, 0])]:
        cv2.circle(small, (round(scale * u), round(scale * v)), 2, (0, 120, 255), -1, cv2.LINE_AA)
    ok, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])
    return data.tobytes() if ok else b""


def common_size(pictures: Sequence[Picture]) -> tuple[int, int]:
    """Return the size of most pictures in which the board was found."""
    sizes = [p.size for p in pictures if not p.why]
    return max(set(sizes), key=sizes.count)


def sized(picture: Picture, size: tuple[int, int]) -> Picture:
    """Return the picture, not used where it has another size."""
    if picture.why or picture.size == size:
        return picture
    return replace(
        picture, why=f"It has {picture.size[0]} x {picture.size[1]} pixels, and the others have {size[0]} x {size[1]}."
    )


def estimate_camera(
    pictures: list[Picture], board: Board, size: tuple[int, int], file: CameraFile | None, named: str | bool
) -> tuple[Array, Array, NDArray[np.int64], list[Picture]]:
    """Camera matrix, distortion, which of their numbers are free, and the pictures, those that do not fit left out.

    Points become pictures of the board's points, see ``offsets``.
    """
    measured = [p.points for p in pictures]
    K, dist, free, pictures = _estimate(pictures, board, size, file, named)
    for _ in range(_CENTRED if board.radius > 0.0 or board.kind in ("tag", "tags") else 0):
        for k, picture in enumerate(pictures):
            if not picture.why and (found := solutions(picture.points, board, K, dist)):
                pictures[k] = replace(picture, points=measured[k] - offsets(board, found[0][1], K, dist))
        K, dist, free, pictures = _estimate(pictures, board, size, file, named)
    return K, dist, free, pictures


def _estimate(
    pictures: list[Picture], board: Board, size: tuple[int, int], file: CameraFile | None, named: str | bool
) -> tuple[Array, Array, NDArray[np.int64], list[Picture]]:
    if file is not None:
        name = f" {named}" if named else ""
        if file.size is not None and file.size != size:
            raise DatasetError(
                f"The camera file{name} is for pictures of {file.size[0]} x {file.size[1]} pixels, but these"
                f" have {size[0]} x {size[1]}. Give the file of this resolution, or leave it out: the camera is then"
                " estimated."
            )
        at = file.K[:2, 2] / size
        if not ((at > _CENTRAL) & (at < 1.0 - _CENTRAL)).all():
            raise DatasetError(
                f"The camera file{name} has its principal point at ({file.K[0, 2]:.0f}, {file.K[1, 2]:.0f}), far"
                f" from the middle of pictures of {size[0]} x {size[1]} pixels: it is for another resolution. Give the"
                " file of this one, or leave it out: the camera is then estimated."
            )
        return file.K, file.distortion, file.free, pictures
    start = np.array(
        [[1.2 * max(size), 0.0, 0.5 * size[0] - 0.5], [0.0, 1.2 * max(size), 0.5 * size[1] - 0.5], [0.0, 0.0, 1.0]]
    )
    fixed = cv2.CALIB_FIX_K3
    few = board.kind == "tag"  # four corners a picture do not show the lens
    if few:
        fixed |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags = fixed | (cv2.CALIB_USE_INTRINSIC_GUESS if few else 0)
    for _ in range(4):
        kept = [k for k, p in enumerate(pictures) if not p.why]
        if len(kept) < FEWEST:
            raise DatasetError("Fewer than four pictures fit one camera: give the camera with --as intrinsics=FILE.")
        obj = [board.points[np.isfinite(pictures[k].points[:, 0])].astype(np.float32) for k in kept]
        img = [pictures[k].points[np.isfinite(pictures[k].points[:, 0])].astype(np.float32) for k in kept]
        try:
            found = cv2.calibrateCameraExtended(obj, img, size, start.copy(), np.zeros(5), flags=flags)
        except cv2.error as problem:
            raise DatasetError("The pictures do not show one camera: give it with --as intrinsics=FILE.") from problem
        error = np.ravel(found[7])
        bad = error > GROSS * float(np.median(error)) + 0.3
        if not bad.any():
            break
        for k, e in zip(np.array(kept)[bad], error[bad], strict=True):
            pictures[k] = replace(pictures[k], why=f"Its points do not fit the camera of the others ({e:.1f} px).")
    K, dist = np.asarray(found[1], dtype=float), np.ravel(np.asarray(found[2], dtype=float))[:5]
    free = FREE
    if not few:
        more = cv2.calibrateCamera(obj, img, size, K.copy(), dist.copy(), flags=cv2.CALIB_USE_INTRINSIC_GUESS)
        numbers = 2.0 * sum(len(o) for o in obj)
        if numbers * 2.0 * np.log(max(found[0], 1e-9) / max(more[0], 1e-9)) > float(chi2_quantile(_K3_LEVEL, 1)):
            K, dist = np.asarray(more[1], dtype=float), np.ravel(np.asarray(more[2], dtype=float))[:5]
            free = np.append(free, 8)
    if not (0.2 * max(size) < K[0, 0] < 50.0 * max(size)) or not np.isfinite(dist).all():
        raise DatasetError(
            f"The camera cannot be estimated from these pictures: a focal length of {K[0, 0]:.0f} px for pictures"
            f" {size[0]} pixels wide is impossible. Tilt the board by 20 to 40 degrees in some pictures, or give the"
            " camera with --as intrinsics=FILE."
        )
    return K, dist, free.astype(np.int64), pictures


def offsets(board: Board, C: Array, K: Array, dist: Array) -> Array:
    """Points (m, 2) px as they are measured without noise, less the pictures of the board's points.

    The picture of a circle is no circle about the picture of its centre. Straight lines along a tag's sides, which the
    lens bends, meet beside the picture of its corner.

    Args:
        board: circles with their radius, or tags; other boards have none.
        C: its pose in the camera (4, 4).
        K, dist: the camera.
    """
    true = _projected(board.points, C, K, dist)
    if board.radius > 0.0:
        turn = np.linspace(0.0, 2.0 * np.pi, _RING, endpoint=False)
        ring = board.radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(_RING)], axis=1)
        a = _projected(board.points[:, None] + ring, C, K, dist) - true[:, None]
        b = np.roll(a, -1, axis=1)
        double = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]  # twice the area of a triangle
        return np.asarray((double[..., None] * (a + b)).sum(axis=1) / (3.0 * double.sum(axis=1))[:, None])
    if board.kind not in ("tag", "tags"):
        return np.zeros_like(true)
    corners = board.points.reshape(-1, 4, 3)
    along = np.linspace(0.0, 1.0, _RING)[:, None] * (np.roll(corners, -1, axis=1) - corners)[:, :, None]
    sides = _projected(corners[:, :, None] + along, C, K, dist)
    measured = []
    for tag in sides:
        lines = []
        for uv in tag:
            chord = uv[-1] - uv[0]
            t = (uv - uv[0]) @ chord / (chord @ chord)
            outside = (uv - uv[0]) @ [chord[1], -chord[0]] / np.linalg.norm(chord)
            curve = np.polyfit(SIDE, np.interp(SIDE, t, outside), degree_of(uv[0], uv[-1]))
            lines.append(tangents(uv[0], uv[-1], curve))
        measured.append(meets(lines))
    return np.concatenate(measured) - true


def _projected(points: Array, C: Array, K: Array, dist: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) of the board."""
    flat = np.ascontiguousarray(points.reshape(-1, 3))
    uv = cv2.projectPoints(flat, cv2.Rodrigues(C[:3, :3])[0], C[:3, 3], K, dist)[0]
    return np.asarray(uv, dtype=float).reshape(*points.shape[:-1], 2)


def solutions(points: Array, board: Board, K: Array, dist: Array) -> list[tuple[float, Array]]:
    """Poses (4, 4) of the board in the camera that fit a picture, with their rms reprojection errors px, best first."""
    seen = np.isfinite(points[:, 0])
    obj, img = board.points[seen], points[seen]
    found = []
    kind = cv2.SOLVEPNP_IPPE
    count, turns, shifts, _ = cv2.solvePnPGeneric(obj, img, K, dist, flags=kind)
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        w, t = cv2.solvePnPRefineLM(obj, img, K, dist, turn.copy(), shift.copy())
        uv, _ = cv2.projectPoints(obj, w, t, K, dist)
        error = float(np.sqrt(((np.asarray(uv)[:, 0] - img) ** 2).sum(axis=1).mean()))
        found.append((error, pose(exp_rotation(np.ravel(w)), np.ravel(t))))
    return sorted(found, key=lambda one: one[0])


def reprojection(points: Array, obj: Array, C: Array, K: Array, dist: Array) -> Array:
    """Squared distances px of a picture's points (m, 2) from the board's (m, 3) in the best pose near C."""
    seen = np.isfinite(points[:, 0])
    w, t = cv2.solvePnPRefineLM(obj[seen], points[seen], K, dist, cv2.Rodrigues(C[:3, :3])[0], C[:3, 3:].copy())
    uv = cv2.projectPoints(obj[seen], w, t, K, dist)[0]
    return np.asarray(((np.asarray(uv)[:, 0] - points[seen]) ** 2).sum(axis=1))
