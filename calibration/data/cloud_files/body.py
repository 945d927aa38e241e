"""Take points out of the body of a cloud's file: its numbers, its missing points, and the grid of the sensor."""

import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import MOST_POINTS, expansion_limit, opened, read_bytes

VIEWPOINTS = ("sensor", "world")
"""What VIEWPOINT of a PCD file means: the points are in the sensor's frame, or were moved by VIEWPOINT."""

_ROWS = 50_000  # of text, converted at a time
_LONGEST_LINE = 1_000_000
_LONGEST_NUMBER = 100  # characters

_SAMPLE = 4000  # pairs of neighbours that are compared
_SIDE = 8  # points of the shortest side of a grid, and the largest ratio of its sides
_FAR = 0.25  # largest distance of neighbours, in distances of any two points
_NEAR = 4.0  # distance of neighbours in a column, in distances of neighbours in a row
_SHARE = 0.9  # of the pairs that must be so near
_CLEAR = 1.25  # by which the next best width must be worse


@dataclass(frozen=True, kw_only=True)
class CloudForm:
    """What dataset.yaml states of its clouds.

    Attributes:
        intrinsics: fx, fy, cx, cy of depth images, pixels, with pixel centres at whole numbers; None: a file of the
            camera beside the images says it.
        depth_scale: length of one unit of a depth image in ``unit``; 0: one.
        viewpoint: one of VIEWPOINTS, or empty: a VIEWPOINT other than identity is refused.
        folder: the dataset's folder, where a file of the camera is looked for, too.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float = 0.0
    viewpoint: str = ""
    folder: Path | None = None


class CloudError(InputError):
    """A cloud cannot be used; ``reason`` is one sentence without its name."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = str(self)


@contextmanager
def cloud_stream(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """The file, open for reading bytes, and its length in bytes; a .gz file expanded, within expansion_limit.

    Raises:
        CloudError: a .gz file that is damaged, truncated or expands too far. InputError: the file cannot be opened.
    """
    if path.suffix.lower() != ".gz":
        with opened(path) as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            yield stream, size
        return
    content = _expanded(path, read_bytes(path))
    yield io.BytesIO(content), len(content)


def _expanded(path: Path, packed: bytes) -> bytes:
    limit = expansion_limit(len(packed))
    parts: list[bytes] = []
    left = limit
    try:
        while packed:
            inflate = zlib.decompressobj(31)
            parts.append(inflate.decompress(packed, left + 1))
            left -= len(parts[-1])
            if left < 0:
                raise CloudError(
                    f"The file {path.name} would expand to more than {1e-6 * limit:.0f} MB, too much for its size."
                )
            if not inflate.eof:
                raise CloudError(f"The file {path.name} is truncated: its compressed body has no end.")
            packed = inflate.unused_data.lstrip(b"\0")
    except zlib.error as e:
        raise CloudError(f"The file {path.name} is damaged: it cannot be expanded as gzip ({e}).") from None
    return b"".join(parts)


def check_points(path: Path, points: int, size: int) -> None:
    """Refuses a cloud without points, or of more than a file of ``size`` bytes may hold. Raises CloudError."""
    if points == 0:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if points > MOST_POINTS or 24 * points > expansion_limit(size):
        raise CloudError(
            f"The header of {path.name} promises {points} points, more than"
            f" {min(MOST_POINTS, expansion_limit(size) // 24)}, the most that are read of a file of its size."
        )


def column_values(path: Path, content: bytes, n: int, record: int, columns: list[tuple[int, str]]) -> Array:
    """Columns (n, k), each (offset, type), of n records of so many bytes. Raises CloudError where bytes are missing."""
    if len(content) < n * record:
        raise CloudError(
            f"The file {path.name} is truncated: {n} points are promised and {len(content) // record} are there."
        )
    out = np.empty((n, len(columns)))
    with np.errstate(invalid="ignore"):  # the processor flags the conversion of some patterns of NaN, which stay NaN
        for k, (at, kind) in enumerate(columns):
            out[:, k] = np.ndarray(n, kind, content, at, strides=(record,))
    return out


def text_columns(
    path: Path, stream: BinaryIO, columns: list[int], numbers: int | None, skip: int, rows: int, lines: int
) -> Array:
    """Columns (rows, k) of the text that follows in the stream.

    ``rows`` lines of ``numbers`` numbers (None: any) after ``skip`` lines.

    Raises CloudError where there are more or fewer than ``lines`` lines, or a line is not as promised.
    """
    out = np.empty((min(rows, MOST_POINTS), len(columns)))
    text, found = text_lines(path, stream), 0
    while block := list(islice(text, _ROWS)):
        k, some = max(found - skip, 0), block[max(skip - found, 0) : max(skip + rows - found, 0)]
        found += len(block)
        if numbers is None or not some:
            continue
        counts = [len(line.split()) for line in some]  # lists that are kept would cost a search for garbage
        if counts[-1] < numbers and not some[-1].endswith(b"\n"):  # the end of a file that was cut off
            found -= 1
            del some[-1], counts[-1]
        bad = next((i for i, count in enumerate(counts) if count != numbers), None)
        if bad is not None:
            raise CloudError(
                f"The file {path.name} is damaged: point {k + bad + 1} has {counts[bad]} numbers instead of the"
                f" {numbers} of its header."
            )
        if some and max(map(len, some)) <= _LONGEST_NUMBER:
            with suppress(ValueError):  # this fast way takes fewer forms of numbers
                out[k : k + len(some)] = np.loadtxt(some, usecols=columns, comments=None, ndmin=2)
                continue
        out[k : k + len(some)] = converted(path, [[row[c] for c in columns] for row in map(bytes.split, some)])
    if found < lines:
        raise CloudError(
            f"The file {path.name} is truncated: its header promises {rows} points and"
            f" {max(min(found - skip, rows), 0)} are there."
        )
    if found > lines:
        raise CloudError(
            f"The header of {path.name} promises {rows} points, and {found - lines} lines more follow; export it again."
        )
    return out


def text_lines(path: Path, stream: BinaryIO) -> Iterator[bytes]:
    """The lines that are not blank. Raises CloudError for one of extreme length."""
    while line := stream.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise CloudError(f"The file {path.name} is damaged: a line is longer than {_LONGEST_LINE} characters.")
        if line.strip():
            yield line


def converted(path: Path, block: list[list[bytes]]) -> Array:
    """Rows of words as numbers. Raises CloudError for a word that is none."""
    bad = next((w for row in block for w in row if len(w) > _LONGEST_NUMBER), None)
    if bad is None:
        try:
            return np.array(block, dtype="S").astype(float)
        except ValueError:
            bad = next((w for row in block for w in row if not _is_number(w)), b"")
    raise CloudError(f"The file {path.name} is damaged: '{bad.decode('latin-1')[:40]}' is not a number.")


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def measured(points: Array, name: str) -> Array:
    """Return the points without missing ones: NaN in a grid, left out of a list.

    A list in the sensor's order becomes its grid.

    Args:
        points: (N, 3), or organised (H, W, 3). A point with NaN, or at 0 0 0 (the camera's centre), was not measured.
        name: the cloud's name in messages.

    Returns:
        (N, 3) of finite points, or (H, W, 3) with NaN where nothing was measured.

    Raises:
        CloudError: nothing was measured.
    """
    flat = points.reshape(-1, 3)
    x, y, z = flat.T  # whole columns: reductions over three numbers take several times as long
    sums = x + y
    sums += z
    missing = np.isnan(sums)
    nothing = np.flatnonzero(sums == 0.0)
    missing[nothing] = ~flat[nothing].any(axis=1)
    if missing.all():
        raise CloudError(f"Every point of {name} is missing (NaN or 0 0 0): nothing was measured; scan again.")
    if not missing.any():
        return points
    width = points.shape[1] if points.ndim == 3 else sensor_width(flat, ~missing)
    if width is None:
        return flat[~missing]
    out = flat if flat.flags.writeable else flat.copy()
    out[missing] = np.nan
    return out.reshape(-1, width, 3)


def sensor_width(points: Array, valid: NDArray[np.bool_], widths: tuple[int, ...] = ()) -> int | None:
    """Width of the grid in which points (N, 3) follow each other row by row; None where they do not.

    In a grid the point one row below is about as near as the next one, and both are much nearer than any two points.
    That tells the width among the divisors of N.

    Args:
        valid: which points were measured (N).
        widths: the widths that are tried; without them every divisor of N that makes a grid of usual proportions.
    """
    n = len(points)
    starts = np.flatnonzero(valid[:-1] & valid[1:])
    starts = starts[:: 1 + len(starts) // _SAMPLE]
    tried = widths or _widths(n)
    if len(starts) < _SIDE or not tried:
        return None
    pitch = float(np.median(np.linalg.norm(points[starts + 1] - points[starts], axis=1)))
    others = points[np.roll(starts, len(starts) // 2)]
    spread = float(np.median(np.linalg.norm(points[starts] - others, axis=1)))
    if not 0.0 < pitch < _FAR * spread:
        return None
    found: list[tuple[float, float, int]] = []
    for width in tried:
        below = starts[starts + width < n]
        below = below[valid[below + width]]
        if 2 * len(below) < len(starts) or len(below) < _SIDE:
            continue
        steps = np.linalg.norm(points[below + width] - points[below], axis=1) / pitch
        found.append((float(np.median(steps)), float(np.mean(steps < _NEAR)), width))
    found.sort()
    if (
        not found
        or found[0][1] < _SHARE
        or found[0][0] * pitch > _FAR * spread
        or (len(found) > 1 and found[1][0] < _CLEAR * found[0][0])
    ):
        return None
    return found[0][2]


def _widths(n: int) -> tuple[int, ...]:
    low = np.arange(_SIDE, int(np.sqrt(n)) + 1)
    low = low[n % low == 0] if len(low) else low
    both = sorted({*low.tolist(), *(n // low).tolist()})
    return tuple(w for w in both if max(w, n // w) <= _SIDE * min(w, n // w))
